"""From blended planes to the picture that is shown: colour and depth normalised by coverage."""

from __future__ import annotations

import cv2
import numba
import numpy as np

from sags_node.kernels.jit import parallel_kernel, read_only
from sags_node.types import F32, Camera, RenderedView

f4 = np.float32
ZERO, ONE = f4(0.0), f4(1.0)
FAINT = f4(1e-3)  # below this coverage a colour means nothing
SOLID = f4(0.5)  # coverage from which on a depth is stated


@parallel_kernel
def _normalise(planes: F32, solid: F32, rgb: F32, depth: F32, alpha: F32) -> None:
    """planes [5, H, W], the last for the coverage of the colours; solid [H, W] is that of the depth."""
    _, height, width = planes.shape
    for y in numba.prange(height):
        for x in range(width):
            coverage = planes[4, y, x]
            inverse = ONE / coverage if coverage > FAINT else ZERO
            for k in range(3):
                rgb[y, x, k] = min(max(planes[k, y, x] * inverse, ZERO), ONE)
            coverage = solid[y, x]
            depth[y, x] = planes[3, y, x] / coverage if coverage >= SOLID else ZERO
            alpha[y, x] = min(max(coverage, ZERO), ONE)


def to_view(planes: F32, camera: Camera, frame_id: int, t_capture_ns: int) -> RenderedView:
    """The picture that `planes` [5, h, w] of `Rasterizer.forward` show, in fresh arrays of the camera's size.

    rgb = C / alpha held in 0..1, 0 where alpha < 0.001; depth = D / alpha (m) where alpha >= 0.5, else 0.
    Planes of another size than the camera's are interpolated before they are divided: colours by cubic
    polynomials, which keep twice the sharpness, depths by straight lines, which invent no depth beyond those
    around.
    """
    height, width = camera.height, camera.width
    solid = planes[4]
    if planes.shape[1:] != (height, width):
        size, small = (width, height), planes
        planes = np.empty((5, height, width), f4)
        for k in (0, 1, 2, 4):
            cv2.resize(small[k], size, planes[k], interpolation=cv2.INTER_CUBIC)
        cv2.resize(small[3], size, planes[3], interpolation=cv2.INTER_LINEAR)
        solid = cv2.resize(solid, size, interpolation=cv2.INTER_LINEAR)
    rgb, (depth, alpha) = np.empty((height, width, 3), f4), np.empty((2, height, width), f4)
    _normalise(read_only(planes), read_only(solid), rgb, depth, alpha)
    return RenderedView(frame_id, t_capture_ns, camera, rgb, depth, alpha)
