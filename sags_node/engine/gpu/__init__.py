"""The rasteriser in NVIDIA Warp: the same kernels on a GPU and, slowly, on Warp's CPU device.

Formulas and names are those of `engine.rasterizer`; here exponents have base e, and tiles are 16x16 px.
"""
