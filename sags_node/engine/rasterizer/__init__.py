"""The rasteriser for the CPU, forward and backward; `rasterize.make_rasterizer` makes one of any backend."""
