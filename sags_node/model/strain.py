"""How the surface is stretched since a moment: principal strains, from the relative places of Gaussians.

For each patch of the surface, least squares find the affine map that takes its Gaussians from where they were
to where they are. In the patch's tangent plane that is a deformation gradient F [3, 2]; the roots of the
eigenvalues of F^T F are the principal stretches, and a strain is a stretch less 1 (Biot's, nominal).
"""

from __future__ import annotations

from copy import copy
from dataclasses import replace

import cv2
import numpy as np

from sags_node.model.deformation import cell_centres, nearest_nodes
from sags_node.types import F32, F64, I64, Bool, Gaussians, Snapshot, Strained

PATCH = 0.004  # m between patches: each has the Gaussians of about twice that
FEWEST = 12  # Gaussians of a patch
LEAST_SPREAD = 0.25  # of `PATCH`, standard deviation of them along each direction of the surface
LEAST_OPACITY = 0.1
SURE = 2e-3  # m: depths with a larger predicted error are not used
FULL = 0.3  # strain with the brightest colour
UNKNOWN = (0.35, 0.35, 0.35)  # RGB


class Strain:
    """How tissue is stretched since a moment; immutable.

    Args:
        snapshot: the model at that moment.

    Attributes:
        since_ns: that moment, by the clock as it is now.
    """

    def __init__(self, snapshot: Snapshot) -> None:
        gaussians = snapshot.gaussians
        self.since_ns = snapshot.t_capture_ns
        kept = np.flatnonzero(_is_sure(gaussians) & (gaussians.opacities >= LEAST_OPACITY))
        kept = kept[np.argsort(gaussians.ids[kept])]
        self._ids, self._places = gaussians.ids[kept], gaussians.means[kept]
        self._followed = np.ones(len(kept), np.bool_)  # none of them may have slid since
        if len(kept):
            self._patches = cell_centres(self._places, PATCH)
            self._index, self._weight, _ = nearest_nodes(self._places, self._patches)

    @property
    def knows_nothing(self) -> bool:
        """Tell whether no depth was sure at that moment, so that all strain stays unknown."""
        return len(self._ids) == 0

    def followed(self, snapshot: Snapshot) -> Strain:
        """The strain after one more frame. What is not sure in it, as behind an instrument, may have slid and
        is dropped. If most is not sure, as after a gap, none is: motion finds tissue in sight again."""
        at, rows = self._found(snapshot.gaussians)
        sure = _is_sure(snapshot.gaussians)[rows]
        if 2 * np.count_nonzero(sure) < len(sure) or sure.all():
            return self
        after = copy(self)
        after._followed = self._followed.copy()
        after._followed[at] &= sure
        return after

    def set_back(self, ns: int) -> Strain:
        """The same strain, after the clock was set back by `ns`."""
        after = copy(self)
        after.since_ns -= ns
        return after

    def at(self, gaussians: Gaussians) -> F32:
        """The largest and the smallest strain [N, 2] where each Gaussian of this frame is; NaN: not known: it
        is new, or its depth, or too many around it, were not `SURE` at that moment, now or in between."""
        found = np.full((len(gaussians), 2), np.nan, np.float32)
        at, rows = self._found(gaussians)
        sure = self._followed[at] & _is_sure(gaussians)[rows]
        at, rows = at[sure], rows[sure]
        if len(at) == 0:
            return found
        strains = self._of_patches(at, gaussians.means[rows])
        weight = np.where(np.isnan(strains[self._index[at], 0]), 0, self._weight[at])
        shares = weight / np.maximum(weight.sum(1, keepdims=True), 1e-9)
        mean = np.einsum("nk,nka->na", shares, np.nan_to_num(strains)[self._index[at]])
        mean[weight[:, 0] == 0] = np.nan  # its own patch is not known
        found[rows] = mean
        return found

    def _found(self, gaussians: Gaussians) -> tuple[I64, I64]:
        """Which of the moment's Gaussians are still there: their numbers, and their rows now."""
        if len(self._ids) == 0:
            return np.zeros(0, np.int64), np.zeros(0, np.int64)
        at = np.minimum(np.searchsorted(self._ids, gaussians.ids), len(self._ids) - 1)
        rows = np.flatnonzero(self._ids[at] == gaussians.ids)
        return at[rows], rows

    def _of_patches(self, at: I64, now: F32) -> F64:
        """Strains [M, 2] of all patches, by the known Gaussians: numbers [K] and places now [K, 3]."""
        near, count = self._index[at].ravel(), len(self._patches)
        own = self._patches[near]
        before = np.repeat(self._places[at], self._index.shape[1], 0) - own
        after = np.repeat(now, self._index.shape[1], 0) - own
        both = np.hstack([before, after]).astype(np.float64)
        members = np.bincount(near, minlength=count)
        many = np.maximum(members, 1)[:, None]
        mean = np.stack([np.bincount(near, column, count) for column in both.T], -1) / many
        sums = np.stack(
            [np.bincount(near, both[:, i] * both[:, j], count) for i in range(6) for j in range(3)], -1
        )
        moments = (sums / many).reshape(count, 6, 3) - mean[:, :, None] * mean[:, None, :3]
        spreads, axes = np.linalg.eigh(moments[:, :3])
        good = (members >= FEWEST) & (spreads[:, 1] > (LEAST_SPREAD * PATCH) ** 2)
        strains = np.full((count, 2), np.nan)
        tangents = axes[good][:, :, 1:]  # [G, 3, 2], in which the moments are diagonal
        F = moments[good][:, 3:] @ tangents / spreads[good][:, None, 1:]
        stretches = np.sqrt(np.maximum(np.linalg.eigvalsh(np.swapaxes(F, 1, 2) @ F), 0))
        strains[good] = stretches[:, ::-1] - 1
        return strains


def painted(gaussians: Gaussians, strain: Strained) -> Gaussians:
    """Colour the Gaussians by their largest strain: dark at 0, yellow at `FULL`; grey: not known."""
    largest = strain.at(gaussians)[:, 0]
    levels = np.nan_to_num(np.clip(largest / FULL, 0, 1) * 255).astype(np.uint8)
    colors = cv2.applyColorMap(levels[:, None], cv2.COLORMAP_VIRIDIS)[:, 0, ::-1].astype(np.float32) / 255
    colors[np.isnan(largest)] = UNKNOWN
    return replace(gaussians, colors=colors, slopes=None, sh_rest=None)


def _is_sure(gaussians: Gaussians) -> Bool:
    if gaussians.depth_errors is None:
        return np.ones(len(gaussians), np.bool_)
    return np.asarray(gaussians.depth_errors <= SURE)
