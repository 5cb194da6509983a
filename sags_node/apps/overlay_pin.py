"""A point pinned to the tissue: it moves with the Gaussians around it, known by their ids."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sags_node.types import F32, F64, Bool

NEIGHBOURS = 16
MAX_DISTANCE = 0.005  # m; Gaussians farther than this from the point do not carry it
RENEW_BELOW = 0.8  # share of the weight still there: below it new neighbours are taken
LOST_BELOW = 0.5  # below it the point cannot be trusted any more
MIN_SPREAD = 1e-3  # second over first singular value: below it the Gaussians lie on a line
PATCH = 8  # px around the pin whose depth gives the normal
PATCH_DEPTH = 0.005  # m; pixels farther from the pin in depth belong to another surface
MIN_PATCH = 30  # pixels

Ids = NDArray[np.uint32]


@dataclass(frozen=True, slots=True)
class Pin:
    """A surface point held by its nearest Gaussians."""

    ids: Ids  # [k]
    places: F64  # [k, 3] m, of the Gaussians, seen from the point
    weights: F64  # [k], sum 1

    @staticmethod
    def attach(point: F64, means: F32, ids: Ids) -> Pin | None:
        """Hold `point` [3] by the nearest of `means` [N, 3] (m, world); None when none is near."""
        distances = np.linalg.norm(means - point, axis=1)
        count = min(NEIGHBOURS, len(distances))
        nearest = np.argpartition(distances, count - 1)[:count] if count else np.empty(0, np.intp)
        nearest = nearest[distances[nearest] < MAX_DISTANCE]
        if len(nearest) == 0:
            return None
        near = distances[nearest]
        weights = np.exp(-0.5 * (near / (near.mean() + 1e-6)) ** 2)
        return Pin(ids[nearest], means[nearest].astype(np.float64) - point, weights / weights.sum())

    def locate(self, means: F32, ids: Ids) -> tuple[F64, float] | None:
        """Where the point is in a later model, and the share of its weight that is still there.

        The point moves with the rigid motion that fits its Gaussians best. None when too few are left.
        """
        rows = np.flatnonzero(np.isin(ids, self.ids))
        mine = {int(one): i for i, one in enumerate(self.ids)}
        own = np.array([mine[int(one)] for one in ids[rows]], np.intp)
        remaining = float(self.weights[own].sum())
        if remaining < LOST_BELOW:
            return None
        weights = self.weights[own] / remaining
        before, after = self.places[own], means[rows].astype(np.float64)
        middle_before, middle_after = weights @ before, weights @ after
        R = _rotation(before - middle_before, after - middle_after, weights)
        return middle_after - R @ middle_before, remaining


def _rotation(before: F64, after: F64, weights: F64) -> F64:
    """The rotation [3, 3] that best turns centred points [k, 3] into others (Kabsch 1976).

    None of it can be told from points on one line: then there is no rotation.
    """
    U, spread, Vt = np.linalg.svd((before * weights[:, None]).T @ after)
    if spread[1] < MIN_SPREAD * spread[0] or spread[0] == 0:
        return np.eye(3)
    flip = np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))])
    rotation: F64 = Vt.T @ flip @ U.T
    return rotation


def pin_pixel(wanted: tuple[float, float] | None, depth: F32, tissue: Bool) -> tuple[int, int] | None:
    """The pixel (u, v) with tissue and depth nearest to the wanted one, or to the middle of the tissue.

    None when the picture has none, or none within a tenth of its width of a wanted pixel.
    """
    rows, columns = np.nonzero(tissue & np.isfinite(depth))
    if len(rows) == 0:
        return None
    u, v = wanted if wanted is not None else (np.median(columns), np.median(rows))
    distances = np.hypot(columns - u, rows - v)
    best = int(np.argmin(distances))
    if wanted is not None and distances[best] > depth.shape[1] / 10:
        return None
    return int(columns[best]), int(rows[best])


def surface_normal(depth: F32, tissue: Bool, K: F64, point: F64) -> F64 | None:
    """Unit normal [3] of the surface around a point [3] (m, camera), towards the camera.

    A plane fitted to the depth in a small patch; None when too little of the patch shows that surface.
    """
    height, width = depth.shape
    u, v = (K @ point)[:2] / point[2]
    left, right = max(0, int(u) - PATCH), min(width, int(u) + PATCH + 1)
    top, bottom = max(0, int(v) - PATCH), min(height, int(v) + PATCH + 1)
    if left >= right or top >= bottom:
        return None
    z = depth[top:bottom, left:right].astype(np.float64)
    near = np.abs(z - point[2]) < PATCH_DEPTH  # False where the depth is NaN
    near &= tissue[top:bottom, left:right]
    if near.sum() < MIN_PATCH:
        return None
    rows, columns = np.nonzero(near)
    pixels = np.stack([columns + left, rows + top, np.ones_like(rows)], axis=1).astype(np.float64)
    points = (pixels @ np.linalg.inv(K).T) * z[near][:, None]
    normal: F64 = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2][2]
    return -normal if normal @ point > 0 else normal
