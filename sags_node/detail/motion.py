"""What a view's tissue has in common over many pixels, drawn small: how far it moved since another moment."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sags_node.detail.seen import SeenFrame
from sags_node.engine.rasterizer.rasterize import Rasterizer, make_rasterizer
from sags_node.geometry import resized_camera
from sags_node.types import F32, Bool, Camera, Gaussians

SMALLER = 4  # than the view: motion is smooth, and no detail is lost by it
LEAST_COVERED = 0.05
SIZES = 4  # of views, for which rasterisers are kept


class SmallDrawings:
    """Draws smooth properties of Gaussians at a quarter of a view's size. For one thread."""

    def __init__(self) -> None:
        self._rasterizers: dict[tuple[int, int], Rasterizer] = {}

    def __call__(self, gaussians: Gaussians, values: F32, camera: Camera) -> F32:
        """Draw `values` [N, 3] in the place of colours, for a camera of the view's size.

        Returns:
            [4, h, w]: their means, 0 where little is covered, and the coverage.
        """
        size = -(-camera.width // SMALLER), -(-camera.height // SMALLER)
        drawn = replace(gaussians, colors=values, sh_rest=None, slopes=None)
        planes = self.rasterizer(*size).forward(drawn, resized_camera(camera, *size))
        coverage = planes[4]
        found = np.zeros((4, *coverage.shape), np.float32)
        found[3] = coverage
        np.divide(planes[:3], coverage, out=found[:3], where=coverage > LEAST_COVERED)
        return found

    def rasterizer(self, width: int, height: int) -> Rasterizer:
        """The one for pictures of that size, px."""
        size = width, height
        if size not in self._rasterizers:
            if len(self._rasterizers) == SIZES:
                del self._rasterizers[next(iter(self._rasterizers))]
            self._rasterizers[size] = make_rasterizer("numba", width, height)
        return self._rasterizers[size]

    def motion(
        self, gaussians: Gaussians, camera: Camera, since: SeenFrame, trust: F32 | None = None
    ) -> F32 | None:
        """Draw how far the tissue has moved since a frame, for a camera that sees it now.

        Args:
            trust: [N] of that frame's Gaussians: the part of their motion that counts; None: all.

        Returns:
            [4, h, w]: metres along the axes of that frame's camera, and the coverage by tissue that it knew;
            None: not at all.
        """
        if gaussians.means is since.gaussians.means:
            return None
        rows, known = since.rows_of(gaussians.ids)
        moved = gaussians.means - since.gaussians.means[rows]
        moved = np.ascontiguousarray(moved @ since.camera.viewmat[:3, :3].T.astype(np.float32))
        if trust is not None:
            moved *= trust[rows, None]
        return self(gaussians if known.all() else _some(gaussians, known), moved[known], camera)


def _some(gaussians: Gaussians, kept: Bool) -> Gaussians:
    """The rows `kept` [N] of what places and covers."""
    smoothing = gaussians.smoothing
    return Gaussians(
        gaussians.means[kept], gaussians.quats[kept], gaussians.scales[kept], gaussians.opacities[kept],
        gaussians.colors[kept], gaussians.ids[kept], smoothing=None if smoothing is None else smoothing[kept],
    )  # fmt: skip
