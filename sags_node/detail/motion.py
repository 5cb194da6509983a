"""Small drawings of what changes slowly over a view: how far its tissue moved since another moment."""

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache, partial

import numpy as np

from sags_node.detail.carry import NEAREST, coarse_camera
from sags_node.detail.seen import SeenFrame
from sags_node.engine.rasterizer.rasterize import Rasterizer, make_rasterizer
from sags_node.types import F32, I64, U8, Camera, Gaussians

LEAST_COVERED = 0.05
SIZES = 4  # view sizes for which rasterizers are kept


class SmallDrawings:
    """Draws smooth properties of Gaussians at a quarter of a view's size. For one thread."""

    def __init__(self) -> None:
        # by width and height, px
        self.rasterizer: Callable[[int, int], Rasterizer]
        self.rasterizer = lru_cache(SIZES)(partial(make_rasterizer, "numba"))

    def __call__(self, gaussians: Gaussians, values: F32, camera: Camera) -> F32:
        """Draw `values` [N, 3] instead of colours, at a quarter of the size of the view's `camera`.

        Returns:
            [4, h, w]: their means, 0 where little is covered, and the coverage.
        """
        small = coarse_camera(camera)
        drawn = replace(gaussians, colors=values, sh_rest=None, slopes=None)
        planes = self.rasterizer(small.width, small.height).forward(drawn, small)
        coverage = planes[4]
        found = np.zeros((4, *coverage.shape), np.float32)
        found[3] = coverage
        np.divide(planes[:3], coverage, out=found[:3], where=coverage > LEAST_COVERED)
        return found

    def motion(
        self, gaussians: Gaussians, camera: Camera, since: SeenFrame, trust: F32 | None = None
    ) -> F32 | None:
        """Draw how far the tissue has moved since a frame, for a camera that sees it now.

        Args:
            trust: [N] of that frame's Gaussians: the part of their motion that counts; None: all.

        Returns:
            [4, h, w]: metres along the axes of that frame's camera, and the coverage by tissue that it knew;
            None: nothing has moved, or that frame has no Gaussians.
        """
        if gaussians.means is since.gaussians.means or not len(since.gaussians):
            return None
        rows, known = since.rows_of(gaussians.ids)
        moved = gaussians.means - since.gaussians.means[rows]
        moved = np.ascontiguousarray(moved @ since.camera.viewmat[:3, :3].T.astype(np.float32))
        if trust is not None:
            moved *= trust[rows, None]
        if not known.all():
            gaussians, moved = _some(gaussians, np.flatnonzero(known)), moved[known]
        return self(gaussians, moved, camera)


def gaussians_at(gaussians: Gaussians, camera: Camera, wanted: U8) -> Gaussians:
    """Return the Gaussians whose means fall on a camera's pixels where `wanted` [h, w] is not 0."""
    P = (camera.K @ camera.viewmat[:3]).astype(np.float32)
    x, y, z = P[:, :3] @ gaussians.means.T + P[:, 3:]
    z = np.maximum(z, np.float32(NEAREST))
    columns, rows = (np.clip(one / z + np.float32(0.5), -1, 1e6).astype(np.intp) for one in (x, y))
    height, width = wanted.shape
    inside = np.flatnonzero((columns >= 0) & (rows >= 0) & (columns < width) & (rows < height))
    return _some(gaussians, inside[wanted[rows[inside], columns[inside]] > 0])


def _some(gaussians: Gaussians, rows: I64) -> Gaussians:
    """The Gaussians of these rows [M], with places, shapes, colours and ids only."""
    smoothing = gaussians.smoothing
    return Gaussians(
        gaussians.means[rows], gaussians.quats[rows], gaussians.scales[rows], gaussians.opacities[rows],
        gaussians.colors[rows], gaussians.ids[rows], smoothing=None if smoothing is None else smoothing[rows],
    )  # fmt: skip
