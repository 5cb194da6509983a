"""From blended planes to the image that is shown: colour and depth normalised by coverage."""

from typing import Any

import cv2
import numpy as np
from numba import prange

from sags_node.kernels.jit import inlined, kernel, parallel_kernel, read_only
from sags_node.types import F32, U8, Camera, Colours, RenderedView

f4 = np.float32
u8 = np.uint64
ZERO, ONE = f4(0.0), f4(1.0)
FAINT = f4(1e-3)  # below this coverage a colour means nothing
SOLID = f4(0.4)  # coverage from which on a depth is stated; below it a pixel of tissue is a hole


def to_view(planes: F32, camera: Camera, frame_id: int, t_capture_ns: int) -> RenderedView:
    """Return the image that `planes` [5, h, w] of `Rasterizer.forward` show, in new arrays of camera size.

    rgb = C / alpha clamped to 0..1, 0 where alpha <= 0.001. depth = D / alpha (m) where alpha >= 0.4, or
    where alpha > 0.001 and all four neighbours have alpha >= 0.4; else 0.
    Planes of another size than the camera's are interpolated: D and alpha linearly, before the division, so
    no depth lies beyond those around it; colours as bytes, when they are asked for.
    """
    height, width = camera.height, camera.width
    colours = np.empty((*planes.shape[1:], 3), np.uint8)
    _write_colours(read_only(planes), colours)
    sums, coverage = planes[3], planes[4]
    if coverage.shape != (height, width):
        sums, coverage = (
            cv2.resize(plane, (width, height), interpolation=cv2.INTER_LINEAR) for plane in (sums, coverage)
        )
    depth, alpha = np.empty((2, height, width), f4)
    _write_depths(read_only(sums), read_only(coverage), depth, alpha)
    return RenderedView(frame_id, t_capture_ns, camera, Colours(colours, width, height), depth, alpha)


def colours_of(planes: F32) -> F32:
    """Return the RGB [H, W, 3] 0..1 that `planes` [5, H, W] show, as `to_view` but not rounded to bytes."""
    with np.errstate(divide="ignore", invalid="ignore"):
        found = np.where(planes[4] > FAINT, planes[:3] / planes[4], ZERO)
    return np.ascontiguousarray(np.clip(found, ZERO, ONE).transpose(1, 2, 0))


@inlined
def _byte(value: Any) -> Any:
    return np.uint8(np.int32(min(max(value, ZERO), ONE) * f4(255) + f4(0.5)))


@parallel_kernel
def _write_colours(planes: F32, colours: U8) -> None:
    for row in prange(planes.shape[1]):
        y = np.int64(row)
        _write_colours_row(planes[0, y], planes[1, y], planes[2, y], planes[4, y], colours[y].reshape(-1))


@kernel
def _write_colours_row(red: F32, green: F32, blue: F32, coverage: F32, colours: U8) -> None:
    for i in range(coverage.size):
        x = u8(i)
        inverse = ONE / coverage[x] if coverage[x] > FAINT else ZERO
        at = u8(3) * x
        colours[at] = _byte(red[x] * inverse)
        colours[at + u8(1)] = _byte(green[x] * inverse)
        colours[at + u8(2)] = _byte(blue[x] * inverse)


@parallel_kernel
def _write_depths(sums: F32, coverage: F32, depth: F32, alpha: F32) -> None:
    for row in prange(len(sums)):
        y = np.int64(row)
        _write_depths_row(sums[y], coverage[y], depth[y], alpha[y])
        if 0 < y < len(sums) - 1:
            _fill_holes_row(sums[y], coverage[y - 1], coverage[y], coverage[y + 1], depth[y])


@kernel
def _write_depths_row(sums: F32, coverage: F32, depth: F32, alpha: F32) -> None:
    for i in range(sums.size):
        x = u8(i)
        solid = coverage[x] >= SOLID
        quotient = sums[x] / coverage[x]
        depth[x] = quotient if solid else ZERO
        alpha[x] = min(max(coverage[x], ZERO), ONE)


@kernel
def _fill_holes_row(sums: F32, above: F32, coverage: F32, below: F32, depth: F32) -> None:
    """Fill in the depth of single pixels between Gaussians that hardly touch; new models have many."""
    for i in range(1, sums.size - 1):
        x = u8(i)
        if FAINT < coverage[x] < SOLID:
            beside = min(coverage[x - u8(1)], coverage[x + u8(1)])
            if min(beside, above[x], below[x]) >= SOLID:
                depth[x] = sums[x] / coverage[x]
