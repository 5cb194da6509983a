"""Projection inside kernels: a camera as twenty numbers."""

from typing import Any

import numpy as np

from sags_node.engine.interface import FRUSTUM_MARGIN
from sags_node.kernels.jit import inlined, kernel
from sags_node.types import F32, Camera


def pack(camera: Camera, first: float = 0.0) -> F32:
    """The camera as kernels take it, [20].

    Rotation from world to camera (9, row by row), translation (3, m), fx, fy, cx, cy (px), and the smallest
    and largest x/z, then y/z, at which the rasterisers linearise the projection.

    Args:
        first: where the first pixel has its centre: 0 as in `types.Camera`, 0.5 for the rasterisers.
    """
    packed = np.empty(20, np.float32)
    packed[:9], packed[9:12] = camera.viewmat[:3, :3].ravel(), camera.viewmat[:3, 3]
    (fx, _, cx), (_, fy, cy), _ = camera.K.tolist()
    cx, cy = cx + first, cy + first
    margin_x, margin_y = FRUSTUM_MARGIN * 0.5 * camera.width / fx, FRUSTUM_MARGIN * 0.5 * camera.height / fy
    packed[12:16] = fx, fy, cx, cy
    packed[16:18] = -cx / fx - margin_x, (camera.width - cx) / fx + margin_x
    packed[18:] = -cy / fy - margin_y, (camera.height - cy) / fy + margin_y
    return packed


@inlined
def to_camera(cam: Any, x: Any, y: Any, z: Any) -> Any:
    """Return the camera coordinates of a world point."""
    return (
        cam[0] * x + cam[1] * y + cam[2] * z + cam[9],
        cam[3] * x + cam[4] * y + cam[5] * z + cam[10],
        cam[6] * x + cam[7] * y + cam[8] * z + cam[11],
    )


@kernel
def to_pixel(cam: Any, x: Any, y: Any, z: Any) -> Any:
    """Return the pixel of a point in camera coordinates, z > 0."""
    return cam[12] * x / z + cam[14], cam[13] * y / z + cam[15]
