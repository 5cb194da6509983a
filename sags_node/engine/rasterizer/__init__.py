"""Gaussians to pictures and back, for the CPU; `rasterize.make_rasterizer` is the way in to all backends."""
