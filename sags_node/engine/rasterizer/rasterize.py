"""The one way to draw Gaussians: `make_rasterizer`, then `forward`, `backward`, `to_view`."""

import logging
from collections.abc import Callable
from typing import TypeVar

from sags_node.engine import device
from sags_node.engine.interface import Gradients, Rasterizer
from sags_node.engine.rasterizer.compositing import TILE_HEIGHT, TILE_WIDTH
from sags_node.engine.rasterizer.views import to_view
from sags_node.errors import UsageError
from sags_node.types import F32, I32, Camera, Gaussians

__all__ = [
    "TILE_HEIGHT", "TILE_WIDTH", "Drawer", "Gradients", "Rasterizer", "make_rasterizer", "to_view",
]  # fmt: skip

log = logging.getLogger(__name__)
Result = TypeVar("Result")


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


class Drawer:
    """Draws Gaussians for who only looks at them: on the GPU until that fails, then on the CPU."""

    def __init__(self, backend: str, width: int, height: int, antialias: bool = True) -> None:
        """See `make_rasterizer`."""
        self._backend, self._as = backend, (width, height, antialias)
        self._made: Rasterizer | None = None

    def forward(self, gaussians: Gaussians, camera: Camera) -> F32:
        """Draw as `interface.Rasterizer.forward` does."""
        self._last = gaussians, camera
        return self._tried(lambda: self._rasterizer().forward(gaussians, camera))

    def median(self) -> tuple[F32, I32]:
        """Return what `interface.Rasterizer.median` does."""
        return self._tried(lambda: self._rasterizer().median())

    def _rasterizer(self) -> Rasterizer:
        if self._made is None:
            self._made = make_rasterizer(self._backend, *self._as)
        return self._made

    def _tried(self, work: Callable[[], Result]) -> Result:
        try:
            return work()
        except Exception as error:
            if self._backend == "numba" or not device.is_of_warp(error):
                raise
            log.exception("the GPU cannot draw any more; the CPU does")
            self._backend, self._made = "numba", None
            self.forward(*self._last)
            return work()
