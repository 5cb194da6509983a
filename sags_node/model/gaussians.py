"""The trainable Gaussians: raw parameters in dense rows, with everything that must move with a row."""

from __future__ import annotations

import numpy as np

from sags_node.engine.rasterizer.smoothing import folded
from sags_node.types import F32, I64, Gaussians

NEIGHBOURS = 4  # control nodes a Gaussian follows
ADAM_PARAMETERS = 11  # mean 3, quat 4, log scale 3, opacity logit 1


class GaussianModel:
    """Up to `capacity` Gaussians in rows 0..count-1.

    Raw values that an optimiser changes have other names than the activated ones that are drawn:
    `log_scales` / `scales`, `opacity_logits` / `opacities`. Both are kept in step, so that drawing never
    activates anything. `ids` are never reused.
    """

    def __init__(self, capacity: int) -> None:
        self.capacity = capacity
        self.count = 0
        self._next_id = 0

        def rows(*shape: int) -> F32:
            return np.zeros((capacity, *shape), np.float32)

        self._rows: dict[str, np.ndarray] = {
            "means": rows(3),  # m, world
            "rest": rows(3),  # m, world: where it is most of the time; NaN: not known yet
            "quats": rows(4),  # wxyz
            "log_scales": rows(3),
            "scales": rows(3),  # m, before the 3D filter
            "smoothing": rows(),  # m^2, variance of the 3D filter; 0: off
            "opacity_logits": rows(),
            "opacities": rows(),  # before the 3D filter
            "colors": rows(3),
            "velocities": rows(3),  # m/s, world
            "depth_errors": rows(),  # m, predicted, see `mapping.depth_memory`
            "ids": np.zeros(capacity, np.int64),
            "contribution": rows(),  # px, in the last step on a whole picture
            "in_front": np.zeros(capacity, np.int32),  # frames in a row in front of the measured surface
            "node_index": np.zeros((capacity, NEIGHBOURS), np.int32),
            "node_weight": rows(NEIGHBOURS),
            "adam_m": rows(ADAM_PARAMETERS),
            "adam_v": rows(ADAM_PARAMETERS),
        }

    def __getattr__(self, name: str) -> np.ndarray:
        """The live rows of one array, as a view."""
        rows: dict[str, np.ndarray] = self.__dict__.get("_rows", {})
        if name not in rows:
            raise AttributeError(name)
        return rows[name][: self.count]

    @property
    def free(self) -> int:
        return self.capacity - self.count

    def append(self, means: F32, scales: F32, colors: F32, opacity: float) -> slice:
        """Add Gaussians, as many as fit; returns their rows.

        Args:
            means: [M, 3] m, world.
            scales: [M, 3] m.
            colors: [M, 3] RGB 0..1.
            opacity: of all of them, 0..1.
        """
        fits = min(len(means), self.free)
        added = slice(self.count, self.count + fits)
        for values in self._rows.values():
            values[added] = 0
        rows = self._rows
        rows["means"][added] = means[:fits]
        rows["rest"][added] = np.nan
        rows["quats"][added, 0] = 1.0
        rows["scales"][added] = scales[:fits]
        rows["log_scales"][added] = np.log(scales[:fits])
        rows["colors"][added] = colors[:fits]
        rows["opacities"][added] = opacity
        rows["opacity_logits"][added] = np.log(opacity / (1.0 - opacity))
        rows["contribution"][added] = np.inf  # not known yet
        rows["ids"][added] = self._new_ids(fits)
        self.count += fits
        return added

    def extend(self, count: int) -> I64:
        """Rows for so many Gaussians, or as many as fit; what is in them must be written at once, by
        `replace`."""
        rows = np.arange(self.count, self.count + min(count, self.free))
        self.count += len(rows)
        return rows

    def replace(self, rows: I64, others: I64) -> None:
        """Forget the Gaussians in `rows`; copies of those in `others` take their place, under new ids."""
        for name, values in self._rows.items():
            values[rows] = self._new_ids(len(rows)) if name == "ids" else values[others]

    def never_reuse(self, later: GaussianModel) -> None:
        """Give new ids after those of a model that was in use since this one."""
        self._next_id = max(self._next_id, later._next_id)

    def clear(self) -> None:
        """Forget all rows; ids go on."""
        self.count = 0

    def remove(self, doomed: np.ndarray) -> int:
        """Remove the rows where `doomed` [count] is True: the last rows move into the holes."""
        removed = int(np.count_nonzero(doomed))
        if removed == 0:
            return 0
        kept = self.count - removed
        holes = np.flatnonzero(doomed[:kept])
        movers = kept + np.flatnonzero(~doomed[kept:])
        for values in self._rows.values():
            values[holes] = values[movers]
        self.count = kept
        return removed

    def grow(self, factor: float) -> None:
        """Make all as much larger."""
        self.scales[:] *= np.float32(factor)
        self.log_scales[:] += np.float32(np.log(factor))

    def gaussians(self) -> Gaussians:
        """Views of the live rows, for drawing now."""
        return Gaussians(
            self.means,
            self.quats,
            self.scales,
            self.opacities,
            self.colors,
            self._ids(),
            None,
            self.smoothing,
            self.depth_errors,
        )

    def frozen(self) -> Gaussians:
        """Copies of the live rows, for publishing, with the 3D filter folded in: any renderer draws the same
        picture."""
        drawn = folded(self.gaussians())
        return Gaussians(
            self.means.copy(),
            self.quats.copy(),
            drawn.scales,
            drawn.opacities,
            self.colors.copy(),
            self._ids().copy(),
            depth_errors=self.depth_errors.copy(),
        )

    def _new_ids(self, count: int) -> I64:
        self._next_id += count
        return np.arange(self._next_id - count, self._next_id)

    def _ids(self) -> I64:
        ids: I64 = self._rows["ids"][: self.count]
        return ids
