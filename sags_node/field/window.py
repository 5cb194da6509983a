"""The SAGS model over a stream that never ends: what leaves the window of time is folded into the Gaussians.

Every Gaussian has a fixed place p, where it asks the field, and canonical rows, which are its state at the
oldest slot t0 of the field's window. At a time t within the window its state is

    mean, log scale, colour, opacity logit:   row + g(p, t) - g(p, t0)
    rotation:                                 g(p, t) g(p, t0)^-1 row      unit quaternions

where g(p, t) is what the field makes of an unturned Gaussian at p. When the oldest slot retires and t1
follows, the state at t1 becomes the canonical row. What the model says of every later time stays the same but
for rounding, as differences and quotients telescope. So field and Gaussians never hold more than the window.

Both evaluations have a gradient. Without that of g(p, t0) the fit diverges: steps that move all times alike,
as those of the decoder and of the planes in space mostly do, would seem to help and change nothing.
"""

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from sags_node.field.deformation import Deltas, Field, conjugate, product, unit
from sags_node.field.model import DeformableModel
from sags_node.model import columns
from sags_node.model.deformation import nearest_nodes
from sags_node.model.exposure import Exposure
from sags_node.types import F32, Bool


class AnchoredField:
    """A field relative to the oldest slot of its window, at fixed places."""

    def __init__(self, field: Field, places: F32) -> None:
        """
        Args:
            field: evaluated for one Gaussian at each place.
            places: [N, 3] m.
        """
        self._field = field
        self.deltas: Deltas = field.deltas
        self.place(places)

    @property
    def anchor_ns(self) -> int:
        """Time of the oldest slot."""
        hexplane = self.deltas.hexplane
        return hexplane.t0_ns + hexplane.oldest * hexplane.slot_ns

    def deform(self, rows: Tensor, t_ns: int, which: Tensor | None = None) -> Tensor:
        """Deform all Gaussians: `which` must be None."""
        return _passed(rows, self._pose_at(self.anchor_ns), self._pose_at(t_ns))

    def follow(self, means: F32) -> None:
        """Do nothing: places stay."""

    @torch.no_grad()
    def carry(self, rows: F32, from_ns: int, to_ns: int, which: Tensor | None = None) -> F32:
        """Compute the state [N, 14] at one time from that at another, both clamped to the window. `which`
        [N]: indices of these Gaussians; None: they are all."""
        # In float64: the roundings of ten thousand quotients near 1 would add up.
        before, after = (self._pose_at(t_ns, which).double() for t_ns in (from_ns, to_ns))
        carried: F32 = _passed(torch.from_numpy(rows).double(), before, after).float().numpy()
        return carried

    def place(self, places: F32) -> None:
        """Set the places [N, 3] m of all Gaussians."""
        self.places = np.ascontiguousarray(places)
        reference = np.zeros((len(places), columns.COUNT), np.float32)
        reference[:, columns.MEAN] = places
        reference[:, columns.QUAT.start] = 1.0
        self._reference = torch.from_numpy(reference)
        self._field.follow(self.places)

    def _pose_at(self, t_ns: int, which: Tensor | None = None) -> Tensor:
        """g(p, t), [N, 14]."""
        reference = self._reference if which is None else self._reference[which]
        return self._field.deform(reference, t_ns, which)


def _passed(rows: Tensor, before: Tensor, after: Tensor) -> Tensor:
    """Rows [N, 14], moved from where g is `before` to where it is `after`."""
    quat = columns.QUAT
    turn = product(unit(after[:, quat]), conjugate(unit(before[:, quat])))
    moved, turned = rows + (after - before), product(turn, rows[:, quat])
    return torch.cat([moved[:, : quat.start], turned, moved[:, quat.stop :]], 1)


class WindowModel(DeformableModel):
    """Gaussians and a field over a window of time that slides. There is no exposure."""

    def __init__(self, rows: F32, field: Field) -> None:
        """
        Args:
            rows: [N, 14] of the first frame; their means become the fixed places.
            field: its HexPlane has a window that slides.
        """
        neutral = Exposure(np.zeros(1, np.int64), np.ones((1, 3), np.float32))
        self._anchored = AnchoredField(field, rows[:, columns.MEAN])
        super().__init__(rows, self._anchored, neutral)

    def advance(self, t_ns: int) -> int:
        """Let the window reach `t_ns`. Every slot that leaves it is folded into the canonical rows.

        Returns:
            How many slots left it.
        """
        hexplane = self.field.deltas.hexplane
        retired: list[int] = []

        def fold(slot_ns: int) -> None:
            self.table[:] = self._anchored.carry(self.table, slot_ns, slot_ns + hexplane.slot_ns)
            retired.append(slot_ns)

        hexplane.advance(t_ns, fold)
        return len(retired)

    def settle(self, t_ns: int, change: Callable[[], None]) -> None:
        """Change the field, and keep the Gaussians at `t_ns` as they are, but clamped to the ranges of
        `columns`. At other times of the window they differ from that as the changed field says."""
        anchored = self._anchored
        state = columns.bounded(anchored.carry(self.table, anchored.anchor_ns, t_ns))
        change()
        self.table[:] = anchored.carry(state, t_ns, anchored.anchor_ns)

    def keep(self, kept: Bool) -> None:
        """Remove the Gaussians where `kept` [N] is False."""
        self._anchored.place(self._anchored.places[kept])
        super().keep(kept)

    def insert(self, rows: F32, t_ns: int) -> None:
        """Add Gaussians whose state at `t_ns` is `rows` [M, 14].

        Their places are where they would have been at first, had they moved as their neighbours since.
        """
        count, anchored = len(self), self._anchored
        means = np.ascontiguousarray(rows[:, columns.MEAN])
        with torch.no_grad():
            others = self.rows_at(t_ns)[:, columns.MEAN].contiguous().numpy()
        index, weight, _ = nearest_nodes(means, others)
        moved = ((others - anchored.places)[index] * weight[..., None]).sum(axis=1)
        anchored.place(np.concatenate([anchored.places, means - moved]))
        new = torch.arange(count, count + len(rows))
        self.append(anchored.carry(rows, t_ns, anchored.anchor_ns, new), index[:, 0].astype(np.int64))
