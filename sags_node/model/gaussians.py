"""The trainable Gaussians: raw parameters in dense rows, with everything that must move with a row."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from sags_node.engine.rasterizer.smoothing import bake_filter
from sags_node.types import F32, I64, Gaussians, Snapshot

NEIGHBOURS = 4  # control nodes a Gaussian follows
ADAM_PARAMETERS = 11  # mean 3, quat 4, log scale 3, opacity logit 1

Row = TypeVar("Row", np.float32, np.int32, np.int64)


class _Column(Generic[Row]):
    """An array with one row for each Gaussian; reading it gives the live rows, as a view."""

    def __init__(self, kind: type[Row], *shape: int) -> None:
        self.kind: type[Row] = kind
        self.shape = shape

    def __set_name__(self, owner: type[GaussianModel], name: str) -> None:
        self._name = name

    def __get__(self, model: GaussianModel, owner: type[GaussianModel]) -> NDArray[Row]:
        return model.rows[self._name][: model.count]


class GaussianModel:
    """Up to `capacity` Gaussians in rows 0..count-1.

    Raw values that an optimiser changes have other names than the activated ones that are drawn:
    `log_scales` / `scales`, `opacity_logits` / `opacities`. Both are kept in step, so that drawing never
    activates anything. `ids` are never reused.
    """

    means = _Column(np.float32, 3)  # m, world
    quats = _Column(np.float32, 4)  # wxyz
    log_scales = _Column(np.float32, 3)
    scales = _Column(np.float32, 3)  # m, before the 3D filter
    smoothing = _Column(np.float32)  # m^2, variance of the 3D filter; 0: off
    opacity_logits = _Column(np.float32)
    opacities = _Column(np.float32)  # before the 3D filter
    colors = _Column(np.float32, 3)
    slopes = _Column(np.float32, 3)  # of the luminance, see `types.Gaussians`
    right_colors = _Column(np.float32, 3)  # the right eye's colours less `colors`, see `mapping.right_view`
    velocities = _Column(np.float32, 3)  # m/s, world
    depth_errors = _Column(np.float32)  # m, predicted, see `mapping.depth_memory`
    ids = _Column(np.int64)
    contribution = _Column(np.float32)  # px, in the last step on a whole image
    origin = _Column(np.int32)  # row + 1 of its optimiser's state on a GPU, see `mapping.gpu`; 0: it has none
    in_front = _Column(np.int32)  # frames in a row in front of the measured surface
    node_index = _Column(np.int32, NEIGHBOURS)
    node_weight = _Column(np.float32, NEIGHBOURS)
    adam_m = _Column(np.float32, ADAM_PARAMETERS)
    adam_v = _Column(np.float32, ADAM_PARAMETERS)

    def __init__(self, capacity: int) -> None:
        self.capacity = capacity
        self.count = 0
        self._next_id = 0
        columns = ((name, column) for name, column in vars(type(self)).items() if isinstance(column, _Column))
        # [capacity, ...] by the column's name, with the rows that are not used now.
        self.rows: dict[str, NDArray[Any]] = {
            name: np.zeros((capacity, *column.shape), column.kind) for name, column in columns
        }

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
        rows = self.rows
        for values in rows.values():
            values[added] = 0
        rows["means"][added] = means[:fits]
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
        """Add rows for `count` Gaussians, or as many as fit; returns them. They hold nothing useful: write
        them at once, by `replace`."""
        rows = np.arange(self.count, self.count + min(count, self.free))
        self.count += len(rows)
        return rows

    def replace(self, rows: I64, others: I64) -> None:
        """Forget the Gaussians in `rows`; copies of those in `others` take their place, under new ids."""
        for name, values in self.rows.items():
            values[rows] = self._new_ids(len(rows)) if name == "ids" else values[others]

    def never_reuse(self, later: GaussianModel) -> None:
        """Continue with ids after those of `later`, a model that was in use since this one."""
        self._next_id = max(self._next_id, later._next_id)

    def clear(self) -> None:
        """Forget all rows; ids go on."""
        self.count = 0

    def remove(self, prune_mask: np.ndarray) -> int:
        """Remove the rows where `prune_mask` [count] is True: the last rows move into the holes."""
        removed = int(np.count_nonzero(prune_mask))
        if removed == 0:
            return 0
        kept = self.count - removed
        holes = np.flatnonzero(prune_mask[:kept])
        movers = kept + np.flatnonzero(~prune_mask[kept:])
        for values in self.rows.values():
            values[holes] = values[movers]
        self.count = kept
        return removed

    def reorder(self, order: I64) -> None:
        """Reorder the rows: row k becomes what row `order[k]` was."""
        for values in self.rows.values():
            values[: self.count] = values[order]

    def grow(self, factor: float) -> None:
        """Scale all Gaussians by `factor`; their change of colour per metre stays."""
        self.slopes[:] *= np.float32(factor)
        self.scales[:] *= np.float32(factor)
        self.log_scales[:] += np.float32(np.log(factor))

    def gaussians(self) -> Gaussians:
        """The live rows as views, for drawing now."""
        return Gaussians(
            self.means,
            self.quats,
            self.scales,
            self.opacities,
            self.colors,
            self.ids,
            None,
            self.smoothing,
            self.depth_errors,
            self.slopes,
        )

    def snapshot(self) -> Gaussians:
        """Copy the live rows, for publishing, with the 3D filter folded in: any renderer draws the same
        image."""
        drawn = bake_filter(self.gaussians())
        return Gaussians(
            self.means.copy(),
            self.quats.copy(),
            drawn.scales,
            drawn.opacities,
            self.colors.copy(),
            self.ids.copy(),
            depth_errors=self.depth_errors.copy(),
            slopes=drawn.slopes,
        )

    def _new_ids(self, count: int) -> I64:
        self._next_id += count
        return np.arange(self._next_id - count, self._next_id)


def for_right_eye(gaussians: Gaussians, snapshot: Snapshot) -> Gaussians:
    """The Gaussians of a snapshot, perhaps moved since, in the colours that the right eye sees; in their own
    colours if those are not known."""
    more = snapshot.right_colors
    return gaussians if more is None else replace(gaussians, colors=gaussians.colors + more)
