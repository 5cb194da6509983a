"""The one way to draw Gaussians: `make_rasterizer`, then `forward`, `backward`, `to_view`."""

from sags_node.engine import device
from sags_node.engine.interface import Gradients, Rasterizer
from sags_node.engine.rasterizer.compositing import TILE_HEIGHT, TILE_WIDTH
from sags_node.engine.rasterizer.views import to_view
from sags_node.errors import UsageError

__all__ = [
    "TILE_HEIGHT", "TILE_WIDTH", "Gradients", "Rasterizer", "make_rasterizer", "to_view",
]  # fmt: skip


def make_rasterizer(backend: str, width: int, height: int, antialias: bool = True) -> Rasterizer:
    """A rasteriser for images of one size (px).

    Args:
        backend: "numba" (CPU) or "warp" (GPU).
        width, height: px.
        antialias: the 2D filter of Mip-Splatting. False: the fixed dilation of 3D Gaussian Splatting in its
            place, which grows brighter and thicker when the image gets smaller. For comparison only.

    Raises:
        UsageError: unknown backend, one that cannot be used here, or an empty image.
    """
    if width < 1 or height < 1:
        raise UsageError(f"cannot draw an image of {width}x{height} px; give a size of at least 1x1")
    if backend == "numba":
        from sags_node.engine.rasterizer.cpu import CpuRasterizer

        return CpuRasterizer(width, height, antialias)
    if backend == "warp":
        from sags_node.engine.gpu.rasterizer import WarpRasterizer

        return WarpRasterizer(width, height, antialias, device.gpu())
    raise UsageError(f"unknown engine backend '{backend}'; choose numba or warp")
