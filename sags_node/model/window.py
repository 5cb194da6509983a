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

from __future__ import annotations

from typing import Generic, TypeVar

import numpy as np

from sags_node.model import columns, rotation
from sags_node.model.decoder import Decoder
from sags_node.model.deformable import DeformableModel
from sags_node.model.deformation import nearest_nodes
from sags_node.model.exposure import Exposure
from sags_node.model.field import Deltas, Field, FieldRates, PointField
from sags_node.types import F32, F64, Bool

F = TypeVar("F", F32, F64)

FIRST_HEAD = 0.01  # largest first weight of the decoder's last layer
MOST_GROWTH = 0.5  # of the first box, on each side: places beyond take the field's value at the border


def awaken(decoder: Decoder, seed: int) -> None:
    """Give the decoder's last layer weights. Of a difference between two times, the gradient by weights of 0
    is 0 while all times have the same features, and so is that by the features while the weights are 0: the
    field would never begin to learn. The deformation is still none at first, as the times do not differ."""
    weights = decoder.parameters["head_out_weight"]
    weights[:] = np.random.default_rng(seed).uniform(-FIRST_HEAD, FIRST_HEAD, weights.shape)


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
        self._place(places)

    @property
    def anchor_ns(self) -> int:
        """Time of the oldest slot."""
        hexplane = self.deltas.hexplane
        return hexplane.t0_ns + hexplane.oldest * hexplane.slot_ns

    def deform(self, rows: F32, t_ns: int) -> F32:
        self._rows, self._passage = rows, Passage(self._pose_at(self.anchor_ns), self._pose_at(t_ns))
        return self._passage.apply(rows)

    def backward(self, v_deformed: F32) -> F32:
        v_rows, v_anchor, v_pose = self._passage.backward(self._rows, v_deformed)
        self._field.backward(v_pose)
        self.deltas.set_aside()
        self._pose_at(self.anchor_ns)  # `backward` is that of the last evaluation
        self._field.backward(v_anchor)
        return v_rows

    def step(self, rates: FieldRates) -> None:
        self._field.step(rates)

    def follow(self, means: F32) -> None:
        """Nothing to do: places stay."""

    def carry(self, rows: F32, from_ns: int, to_ns: int) -> F32:
        """State [N, 14] at one time from that at another, both held within the window."""
        # In float64: the roundings of ten thousand quotients near 1 would add up.
        before, after = (self._pose_at(t_ns).astype(np.float64) for t_ns in (from_ns, to_ns))
        return Passage(before, after).apply(rows.astype(np.float64)).astype(np.float32)

    def keep(self, kept: Bool) -> None:
        """Forget the places where `kept` [N] is False."""
        self._place(self.places[kept])

    def append(self, places: F32) -> None:
        """Add places [M, 3] m."""
        self._place(np.concatenate([self.places, places]))

    def _place(self, places: F32) -> None:
        self.places = np.ascontiguousarray(places)
        self._reference = np.zeros((len(places), columns.COUNT), np.float32)
        self._reference[:, columns.MEAN] = places
        self._reference[:, columns.QUAT.start] = 1.0
        self._field.follow(self.places)

    def _pose_at(self, t_ns: int) -> F32:
        """g(p, t), [N, 14]."""
        return self._field.deform(self._reference, t_ns)


class WindowModel(DeformableModel):
    """Gaussians and a field over a window of time that slides. There is no exposure."""

    def __init__(self, rows: F32, field: Field, smooth: bool = True) -> None:
        """
        Args:
            rows: [N, 14] of the first frame; where they are now become their places.
            field: its HexPlane has a window that slides.
            smooth: whether the 3D filter is on.
        """
        neutral = Exposure(np.zeros(1, np.int64), np.ones((1, 3), np.float32))
        self._anchored = AnchoredField(field, rows[:, columns.MEAN])
        super().__init__(rows, self._anchored, neutral, smooth)
        self._asks_at_places = isinstance(field, PointField)  # control nodes stay where they are
        self._first_box: F64 = np.array(field.deltas.hexplane.grid.box)

    @property
    def nbytes(self) -> int:
        """Memory of all that is learnt and of its optimisers."""
        deltas = self.field.deltas
        tables = [self.rows, self._anchored.places, deltas.hexplane.cells, deltas.decoder.values]
        for state in (self.adam, deltas.adam, deltas.hexplane.adam):
            tables += [state.moments, state.shares]
        return self.ids.nbytes + sum(table.nbytes for table in tables)

    def advance(self, t_ns: int, folds: bool = True) -> int:
        """Let the window reach `t_ns`. Every slot that leaves it is folded into the canonical rows, or
        forgotten, which only shows what folding is for.

        Returns:
            How many left it.
        """
        hexplane = self.field.deltas.hexplane
        retired: list[int] = []

        def fold(slot_ns: int) -> None:
            if folds:
                self.rows[:] = self._anchored.carry(self.rows, slot_ns, slot_ns + hexplane.slot_ns)
            retired.append(slot_ns)

        hexplane.advance(t_ns, fold)
        return len(retired)

    def keep(self, kept: Bool) -> None:
        """Remove the Gaussians where `kept` [N] is False."""
        self._anchored.keep(kept)
        super().keep(kept)

    def insert(self, rows: F32, t_ns: int) -> None:
        """Add Gaussians that are as `rows` [M, 14] say at `t_ns`.

        They get places as if they had been there from the start, moved by what moved their neighbours.
        """
        count = len(self.rows)
        means = np.ascontiguousarray(rows[:, columns.MEAN])
        others = np.ascontiguousarray(self.field.deform(self.rows, t_ns)[:, columns.MEAN])
        index, weight, _ = nearest_nodes(means, others)
        moved = ((others - self._anchored.places)[index] * weight[..., None]).sum(axis=1)
        places = means - moved
        if self._asks_at_places:
            self._grow(places)
        self._anchored.append(places)
        padded = np.concatenate([self.rows, rows])
        canonical = self._anchored.carry(padded, t_ns, self._anchored.anchor_ns)[count:]
        super().append(canonical, index[:, 0].astype(np.int64))

    def _grow(self, places: F32) -> None:
        """Let the field's box hold the places, but never more than memory may grow."""
        first = self._first_box
        reach = MOST_GROWTH * (first[1] - first[0])
        box = np.array([places.min(axis=0), places.max(axis=0)], np.float64)
        self.field.deltas.hexplane.grow(np.clip(box, first[0] - reach, first[1] + reach))


class Passage(Generic[F]):
    """What g did from one time to another, for every place."""

    def __init__(self, before: F, after: F) -> None:
        """g at both times, [N, 14]."""
        self._shift: F = after - before
        self._before: F = before[:, columns.QUAT]
        self._after: F = after[:, columns.QUAT]
        self._unit_before: F = rotation.unit(self._before)
        self._unit_after: F = rotation.unit(self._after)
        self._turn: F = rotation.product(self._unit_after, rotation.conjugate(self._unit_before))

    def apply(self, rows: F) -> F:
        """Rows [N, 14], moved alike."""
        moved: F = rows + self._shift
        moved[:, columns.QUAT] = rotation.product(self._turn, rows[:, columns.QUAT])
        return moved

    def backward(self, rows: F, v_moved: F) -> tuple[F, F, F]:
        """Gradients of sum(v_moved * apply(rows)) by rows, and by g before and after."""
        quat, product, conjugate = columns.QUAT, rotation.product, rotation.conjugate
        v_rows, v_before, v_after = v_moved.copy(), -v_moved, v_moved.copy()
        v_rows[:, quat] = product(conjugate(self._turn), v_moved[:, quat])
        v_turn = product(v_moved[:, quat], conjugate(rows[:, quat]))
        v_inverse = product(conjugate(self._unit_after), v_turn)
        v_before[:, quat] = rotation.unit_backward(self._before, self._unit_before, conjugate(v_inverse))
        v_after[:, quat] = rotation.unit_backward(
            self._after, self._unit_after, product(v_turn, self._unit_before)
        )
        return v_rows, v_before, v_after
