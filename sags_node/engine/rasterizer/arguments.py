"""Checks the arguments of a rasteriser and converts them to what its kernels take."""

import math

import numpy as np
from numpy.typing import NDArray

from sags_node.engine.pinhole import pack
from sags_node.engine.rasterizer.compositing import TILE_HEIGHT, TILE_WIDTH
from sags_node.errors import UsageError
from sags_node.kernels.jit import read_only
from sags_node.types import F32, Bool, Camera, Gaussians

SH_TERMS = (0, 3, 8, 15)  # spherical harmonics of degree 0 to 3 without the constant


def view_of(camera: Camera) -> F32:
    """Return the camera as the rasterisers take it, [20] as in `pinhole.pack`: their first pixel has its
    centre at (0.5, 0.5), OpenCV's at (0, 0). UsageError: wrong shape, no pinhole, or not finite."""
    K, T = camera.K, camera.T_world_cam
    if K.shape != (3, 3) or T.shape != (4, 4):
        raise UsageError(f"a camera needs K [3, 3] and T_world_cam [4, 4], got {K.shape} and {T.shape}")
    (fx, skew, _), (_, fy, _), _ = K.tolist()
    if not (fx > 0 and fy > 0 and skew == 0):
        raise UsageError(
            "a camera needs positive focal lengths and no skew, "
            f"got fx {fx}, fy {fy}, skew {skew}; check the calibration"
        )
    if not all(map(math.isfinite, K.ravel().tolist() + T.ravel().tolist())):
        raise UsageError("the camera's K or pose holds NaN or infinity; check the calibration and the pose")
    return pack(camera, first=0.5)


def check_size(width: int, height: int, camera: Camera, tiles: Bool | None) -> None:
    """Raise UsageError where a camera or tiles do not fit a rasteriser of this image size, px."""
    if (camera.width, camera.height) != (width, height):
        raise UsageError(
            f"this rasteriser draws {width}x{height} px, "
            f"the camera has {camera.width}x{camera.height}; make one for its size"
        )
    shape = (-(-height // TILE_HEIGHT), -(-width // TILE_WIDTH))
    if tiles is not None and (tiles.shape != shape or tiles.dtype != np.bool_):
        raise UsageError(
            f"tiles is {tiles.dtype} {list(tiles.shape)}, expected bool {list(shape)}: one for each "
            f"{TILE_WIDTH}x{TILE_HEIGHT} px"
        )


def drawn(last: Gaussians | None, call: str) -> Gaussians:
    """Return the Gaussians that were drawn last. UsageError: nothing was drawn before `call`."""
    if last is None:
        raise UsageError(f"nothing was drawn yet; call forward before {call}")
    return last


def checked_cotangents(v_planes: F32, weight: F32, width: int, height: int) -> tuple[F32, F32]:
    """Return the arguments of `Rasterizer.backward` as kernels take them. UsageError: a shape is wrong."""
    size = height, width
    return _as_f32(v_planes, (5, *size), "v_planes"), _as_f32(weight, size, "weight")


def checked(gaussians: Gaussians) -> Gaussians:
    """Return the Gaussians with contiguous, read-only float32 arrays. UsageError: a shape is wrong."""
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
    """The checked `sh_rest`; None if colours do not depend on the view."""
    if sh_rest is None or sh_rest.shape == (n, 0, 3):
        return None
    if sh_rest.ndim != 3 or sh_rest.shape[1] not in SH_TERMS:
        raise UsageError(
            f"sh_rest has shape {list(sh_rest.shape)}, expected [{n}, K, 3] with K one of {SH_TERMS}"
        )
    return _as_f32(sh_rest, (n, sh_rest.shape[1], 3), "sh_rest")


def _as_f32(array: NDArray[np.floating], shape: tuple[int, ...], name: str) -> F32:
    """The array as contiguous float32; it is not copied if it is that already."""
    if array.shape != shape:
        raise UsageError(f"{name} has shape {list(array.shape)}, expected {list(shape)}")
    return read_only(array.astype(np.float32, copy=False))
