"""Projection inside kernels: a camera as sixteen numbers."""

from __future__ import annotations

from typing import Any

import numpy as np

from sags_node.kernels.jit import kernel
from sags_node.types import F32, Camera


def pack(camera: Camera) -> F32:
    """[16]: the rows of the view matrix (12), then fx, fy, cx, cy."""
    packed = np.empty(16, np.float32)
    packed[:12] = camera.viewmat.ravel()[:12]
    (fx, _, cx), (_, fy, cy), _ = camera.K.tolist()
    packed[12:] = fx, fy, cx, cy
    return packed


@kernel
def to_camera(cam: F32, x: Any, y: Any, z: Any) -> Any:
    """Camera coordinates of a world point."""
    return (
        cam[0] * x + cam[1] * y + cam[2] * z + cam[3],
        cam[4] * x + cam[5] * y + cam[6] * z + cam[7],
        cam[8] * x + cam[9] * y + cam[10] * z + cam[11],
    )


@kernel
def to_pixel(cam: F32, x: Any, y: Any, z: Any) -> Any:
    """Pixel of a point in camera coordinates, z > 0."""
    return cam[12] * x / z + cam[14], cam[13] * y / z + cam[15]
