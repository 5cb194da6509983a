"""The one way to draw Gaussians: `make_rasterizer`, then `forward`, `backward`, `to_view`.

Shapes are checked here, and here is the one place where OpenCV's pixel centres (first pixel at (0, 0)) become
those of the rasterisers (first pixel at (0.5, 0.5)).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from sags_node.engine import device
from sags_node.engine.interface import Backend, Gradients, Pinhole, Rasterizer
from sags_node.engine.rasterizer.compositing import TILE_HEIGHT, TILE_WIDTH
from sags_node.engine.rasterizer.views import to_view
from sags_node.errors import UsageError
from sags_node.kernels.jit import read_only
from sags_node.types import F32, I32, Bool, Camera, Gaussians, RenderedView

SH_TERMS = (0, 3, 8, 15)  # spherical harmonics of degree 0 to 3 without the constant

__all__ = [
    "TILE_HEIGHT", "TILE_WIDTH", "Gradients", "Rasterizer", "as_pinhole", "make_rasterizer", "rasterize",
    "to_view",
]  # fmt: skip


def make_rasterizer(backend: str, width: int, height: int, antialias: bool = True) -> Rasterizer:
    """A rasteriser for pictures of one size (px).

    Args:
        backend: "numba" (CPU), "warp" (GPU) or "reference" (torch, slow).
        width, height: px.
        antialias: the 2D filter of Mip-Splatting. False: the fixed dilation of 3D Gaussian Splatting in its
            place, which grows brighter and thicker when the picture gets smaller. For comparison only.

    Raises:
        UsageError: unknown backend, one that cannot be used here, or an empty picture.
    """
    if width < 1 or height < 1:
        raise UsageError(f"cannot draw a picture of {width}x{height} px; give a size of at least 1x1")
    if backend == "numba":
        from sags_node.engine.rasterizer.cpu import NumbaRasterizer

        return _CheckedRasterizer(NumbaRasterizer(width, height, antialias), width, height)
    if backend == "warp":
        from sags_node.engine.gpu.rasterizer import WarpBackend

        return _CheckedRasterizer(WarpBackend(width, height, antialias, device.gpu()), width, height)
    if backend == "reference":
        from sags_node.engine.reference.rasterizer import ReferenceRasterizer

        return _CheckedRasterizer(ReferenceRasterizer(antialias), width, height)
    raise UsageError(f"unknown engine backend '{backend}'; choose numba, warp or reference")


def rasterize(
    gaussians: Gaussians,
    camera: Camera,
    frame_id: int = 0,
    t_capture_ns: int = 0,
    backend: str = "numba",
) -> RenderedView:
    """Draw Gaussians for a camera of any size and pose. Makes its own rasteriser each time: keep one from
    `make_rasterizer` to draw often.

    Raises:
        UsageError: an array or the camera has the wrong shape or size.
    """
    rasterizer = make_rasterizer(backend, camera.width, camera.height)
    return to_view(rasterizer.forward(gaussians, camera), camera, frame_id, t_capture_ns)


class _CheckedRasterizer:
    """A backend behind checked shapes and shifted pixel centres."""

    def __init__(self, backend: Backend, width: int, height: int) -> None:
        self._backend = backend
        self._width, self._height = width, height
        self._drawn = False

    def forward(self, gaussians: Gaussians, camera: Camera, tiles: Bool | None = None) -> F32:
        if (camera.width, camera.height) != (self._width, self._height):
            raise UsageError(
                f"this rasteriser draws {self._width}x{self._height} px, "
                f"the camera has {camera.width}x{camera.height}; make one for its size"
            )
        shape = (-(-self._height // TILE_HEIGHT), -(-self._width // TILE_WIDTH))
        if tiles is not None and (tiles.shape != shape or tiles.dtype != np.bool_):
            raise UsageError(
                f"tiles is {tiles.dtype} {list(tiles.shape)}, expected bool {list(shape)}: one for each "
                f"{TILE_WIDTH}x{TILE_HEIGHT} px"
            )
        planes = self._backend.forward(_checked(gaussians), as_pinhole(camera), tiles)
        self._drawn = True
        return planes

    def backward(self, v_planes: F32, weight: F32) -> Gradients:
        if not self._drawn:
            raise UsageError("nothing was drawn yet; call forward before backward")
        v_planes = _as_f32(v_planes, (5, self._height, self._width), "v_planes")
        weight = _as_f32(weight, (self._height, self._width), "weight")
        return self._backend.backward(v_planes, weight)

    def median(self) -> tuple[F32, I32]:
        if not self._drawn:
            raise UsageError("nothing was drawn yet; call forward before median")
        return self._backend.median()


def as_pinhole(camera: Camera) -> Pinhole:
    """A camera as the rasterisers see it. UsageError: it has the wrong shape, or is no pinhole."""
    K, T = camera.K, camera.T_world_cam
    if K.shape != (3, 3) or T.shape != (4, 4):
        raise UsageError(f"a camera needs K [3, 3] and T_world_cam [4, 4], got {K.shape} and {T.shape}")
    (fx, skew, cx), (_, fy, cy), _ = K.tolist()
    if not (fx > 0 and fy > 0 and skew == 0):
        raise UsageError(
            "a camera needs positive focal lengths and no skew, "
            f"got fx {fx}, fy {fy}, skew {skew}; check the calibration"
        )
    if not all(map(math.isfinite, K.ravel().tolist() + T.ravel().tolist())):
        raise UsageError("the camera's K or pose holds NaN or infinity; check the calibration and the pose")
    R = np.ascontiguousarray(T[:3, :3].T)
    return Pinhole(camera.width, camera.height, fx, fy, cx + 0.5, cy + 0.5, R, t=-(R @ T[:3, 3]))


def _checked(gaussians: Gaussians) -> Gaussians:
    n = len(gaussians.means)
    return Gaussians(
        means=_as_f32(gaussians.means, (n, 3), "means"),
        quats=_as_f32(gaussians.quats, (n, 4), "quats"),
        scales=_as_f32(gaussians.scales, (n, 3), "scales"),
        opacities=_as_f32(gaussians.opacities, (n,), "opacities"),
        colors=_as_f32(gaussians.colors, (n, 3), "colors"),
        ids=gaussians.ids,
        sh_rest=_checked_harmonics(gaussians.sh_rest, n),
        smoothing=None if gaussians.smoothing is None else _as_f32(gaussians.smoothing, (n,), "smoothing"),
        slopes=None if gaussians.slopes is None else _as_f32(gaussians.slopes, (n, 3), "slopes"),
    )


def _checked_harmonics(sh_rest: F32 | None, n: int) -> F32 | None:
    """None where there is no view dependence."""
    if sh_rest is None or sh_rest.shape == (n, 0, 3):
        return None
    if sh_rest.ndim != 3 or sh_rest.shape[1] not in SH_TERMS:
        raise UsageError(
            f"sh_rest has shape {list(sh_rest.shape)}, expected [{n}, K, 3] with K one of {SH_TERMS}"
        )
    return _as_f32(sh_rest, (n, sh_rest.shape[1], 3), "sh_rest")


def _as_f32(array: NDArray[np.floating], shape: tuple[int, ...], name: str) -> F32:
    """The same memory where it is float32 and contiguous already."""
    if array.shape != shape:
        raise UsageError(f"{name} has shape {list(array.shape)}, expected {list(shape)}")
    return read_only(array.astype(np.float32, copy=False))
