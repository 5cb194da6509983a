"""How well the model's Gaussians stay on the surface points on which they started."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sags_node.geometry import project
from sags_node.types import F64, I64, Bool, Camera, Gaussians

NEIGHBOURS = 8
REACH = 0.003  # m: a Gaussian further from the point at the start is another piece of tissue
_SOFT = 1e-4  # m: neighbours nearer than this weigh the same


@dataclass(frozen=True, slots=True)
class TrackErrors:
    """The tracking errors of the visible points of one frame."""

    errors_mm: F64  # [F] of the points that were followed
    errors_px: F64  # [F] the same, in the left image
    lost: int  # visible, but no neighbour is left, or none was ever near enough


def pooled(tracks: Sequence[TrackErrors]) -> dict[str, float | None]:
    """The errors over points and frames; None where no point was followed."""
    mm, px = (
        np.concatenate([np.empty(0), *errors])
        for errors in ([each.errors_mm for each in tracks], [each.errors_px for each in tracks])
    )
    known = len(mm) > 0
    return {
        "median_mm": float(np.median(mm)) if known else None,
        "p90_mm": float(np.percentile(mm, 90)) if known else None,
        "median_px": float(np.median(px)) if known else None,
    }


class PointTracks:
    """Bind true surface points to their nearest Gaussians once, then follow these by their ids.

    A point is bound at the first frame that shows it and has Gaussians within `REACH`; from then on it
    moves by the mean displacement of those of its neighbours that still live, weighted by nearness at the
    start. Nothing about the truth is used after that.
    """

    def __init__(self, points: int) -> None:
        self._ids: I64 = np.full((points, NEIGHBOURS), -1, np.int64)
        self._weights: F64 = np.zeros((points, NEIGHBOURS))
        self._neighbours: F64 = np.zeros((points, NEIGHBOURS, 3))  # where they were at the start, m
        self._start: F64 = np.zeros((points, 3))  # where the point was at the start, m

    def update(self, gaussians: Gaussians, points: F64, visible: Bool, camera: Camera) -> TrackErrors:
        """Errors at one frame, then bind the points [P, 3] (m, world) first seen in it.

        The frame in which a point is bound says nothing about following and is left out.
        """
        estimates, followed = self._estimates(gaussians)
        bound = self._weights.any(1)
        fresh = visible & ~bound
        self._bind(gaussians, points, fresh)
        newly_bound = fresh & self._weights.any(1)
        measured = visible & followed
        truth, estimate = points[measured], estimates[measured]
        pixels = project(camera, truth)[0] - project(camera, estimate)[0]
        return TrackErrors(
            np.linalg.norm(truth - estimate, axis=1) * 1e3,
            np.linalg.norm(pixels, axis=1),
            int((visible & ~followed & ~newly_bound).sum()),
        )

    def _estimates(self, gaussians: Gaussians) -> tuple[F64, Bool]:
        """The points' places according to the model, [P, 3], and for which of them it knows one, [P]."""
        if len(gaussians) == 0:
            return self._start, np.zeros(len(self._start), bool)
        order = np.argsort(gaussians.ids)
        ids = gaussians.ids[order]
        places = np.minimum(np.searchsorted(ids, self._ids), len(ids) - 1)
        alive = ids[places] == self._ids
        weights = self._weights * alive
        total = weights.sum(1)
        displacements = gaussians.means[order[places]] - self._neighbours
        mean = (displacements * weights[..., None]).sum(1) / np.maximum(total, 1e-12)[:, None]
        return self._start + mean, total > 0

    def _bind(self, gaussians: Gaussians, points: F64, fresh: Bool) -> None:
        count = min(NEIGHBOURS, len(gaussians))
        if count == 0:
            return
        means = gaussians.means.astype(np.float64)
        for point in np.flatnonzero(fresh):
            distances = np.linalg.norm(means - points[point], axis=1)
            nearest = np.argpartition(distances, count - 1)[:count]
            nearest = nearest[distances[nearest] <= REACH]
            self._ids[point, : len(nearest)] = gaussians.ids[nearest]
            self._weights[point, : len(nearest)] = 1 / np.maximum(distances[nearest], _SOFT)
            self._neighbours[point, : len(nearest)] = means[nearest]
            self._start[point] = points[point]
