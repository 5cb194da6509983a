"""The tissue's surface as a few triangles: pixels of the depth picture, joined."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from sags_node.confidence import SURE
from sags_node.geometry import unproject
from sags_node.types import F32, F64, Camera

STEEPEST = math.radians(75)  # seen at more than that from the front, an edge joins two surfaces


def surface_of(camera: Camera, depth: F32, confidence: F32, step: int) -> tuple[F64, NDArray[np.int64]]:
    """Corners [N, 3] (m, world) and triangles [M, 3] of every `step`-th pixel whose depth is sure to 3 mm.

    A surface says nothing of how far to trust it, so what is less sure is a hole.
    """
    rows = np.arange(step // 2, depth.shape[0], step)
    columns = np.arange(step // 2, depth.shape[1], step)
    z = depth[np.ix_(rows, columns)].astype(np.float64)
    known = np.isfinite(z) & (confidence[np.ix_(rows, columns)] >= SURE)
    u, v = np.meshgrid(columns.astype(np.float64), rows.astype(np.float64))
    places = unproject(camera, np.stack([u, v], axis=-1), np.where(known, z, np.nan))
    corner = np.arange(z.size).reshape(z.shape)
    above, below = corner[:-1], corner[1:]
    # Two triangles of each four neighbours; the corners go round so that normals look at the camera.
    triangles = np.concatenate(
        [
            np.stack([above[:, :-1], below[:, :-1], above[:, 1:]], axis=-1).reshape(-1, 3),
            np.stack([above[:, 1:], below[:, :-1], below[:, 1:]], axis=-1).reshape(-1, 3),
        ]
    )
    corners = np.where(known, z, np.nan).ravel()[triangles]  # NaN: unknown, and so in no comparison
    nearest, farthest = corners.min(axis=1), corners.max(axis=1)
    across = step * nearest / float(camera.K[0, 0])
    triangles = triangles[farthest - nearest <= math.tan(STEEPEST) * across]
    used, numbers = np.unique(triangles, return_inverse=True)
    return places.reshape(-1, 3)[used], numbers.reshape(-1, 3).astype(np.int64)
