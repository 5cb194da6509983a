"""Where an object lies, given the anchors that hold it."""

import numpy as np

from sags_node.clients.overlay.frame import TissueFrame
from sags_node.geometry import invert, rigid, transform
from sags_node.types import F64

PATCH = 8  # px around an anchor whose depth gives the normal
PATCH_DEPTH = 0.005  # m; pixels farther from the anchor in depth belong to another surface
LEAST_PATCH = 30  # pixels


def on_surface(place: F64, at: F64, normal: F64, right: F64) -> F64:
    """The pose [4, 4] whose z axis is `normal`, whose x axis points to `right` as far as it can, and whose
    point `at` lies at `place` (all [3])."""
    across = right - (right @ normal) * normal
    if np.linalg.norm(across) < 1e-3:  # the surface is seen edge on
        across = np.cross(normal, np.eye(3)[int(np.argmin(np.abs(normal)))])
    across /= np.linalg.norm(across)
    R = np.stack([across, np.cross(normal, across), normal], axis=1)
    return rigid(R, place - R @ at)


def surface_normal(frame: TissueFrame, place: F64) -> F64 | None:
    """Unit normal [3] (world) of the surface around a place [3], towards the camera.

    A plane fitted to the depth in a small patch; None when too little of the patch shows that surface.
    """
    K, T_world_cam = frame.camera.K, frame.camera.T_world_cam
    point = np.asarray(transform(invert(T_world_cam), place))
    if not point[2] > 0:
        return None
    height, width = frame.depth.shape
    u, v = (K @ point)[:2] / point[2]
    left, right = max(0, int(u) - PATCH), min(width, int(u) + PATCH + 1)
    top, bottom = max(0, int(v) - PATCH), min(height, int(v) + PATCH + 1)
    if left >= right or top >= bottom:
        return None
    z = frame.depth[top:bottom, left:right].astype(np.float64)
    near = np.abs(z - point[2]) < PATCH_DEPTH  # False where the depth is NaN
    near &= frame.tissue[top:bottom, left:right]
    if near.sum() < LEAST_PATCH:
        return None
    rows, columns = np.nonzero(near)
    pixels = np.stack([columns + left, rows + top, np.ones_like(rows)], axis=1).astype(np.float64)
    points = (pixels @ np.linalg.inv(K).T) * z[near][:, None]
    normal: F64 = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2][2]
    return T_world_cam[:3, :3] @ (-normal if normal @ point > 0 else normal)
