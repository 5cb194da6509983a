"""The trainable HexPlane of a stream: a window of time slots that slides, and a box that grows.

Space: cells have a fixed size in metres. A box grows by whole cells of the coarsest level, so every cell that
was learnt stays as it is; new cells take the value of the nearest old one. That is what sampling gave outside
the old box before, so growing changes no feature anywhere. (Resampling onto the bigger box would blur all of
them a little each time, and coarsen the cells.)

Time: slot number k stands for t0_ns + k * slot_ns; the last `slots` of them are kept in a ring. Between slots
features are blended, after the newest (and before the oldest) they are constant. A new slot starts as a copy
of the newest.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sags_node.engine.adam import AdamState
from sags_node.engine.field.hexplane import FieldGradients, Grid, HexPlane, Moment
from sags_node.engine.field.hexplane_kernels import INNER, OUTER
from sags_node.errors import SagsError, UsageError
from sags_node.kernels.jit import aligned
from sags_node.types import F32, F64, I64

MAX_BYTES = 1 << 29  # of the cells; their optimiser's state takes twice as much again, their gradients once
MAX_LEVELS = 8
GROWTH_MARGIN = 4  # coarsest cells added beyond the need, so that a box does not grow every frame

# First values of the planes in space; the lines in time start at 1. EndoGaussian takes 0.1 to 0.5: the
# product of three planes is then about 0.03, the decoder sees next to nothing at first, and after 1300
# iterations on a real clip PSNR is 2.7 dB behind.
SPACE_RANGE = (0.7, 1.3)


class HexPlaneField:
    """`cells` [M, C], laid out as `grid` says, and what their optimiser remembers, row by row.

    Rows that are copied, to a new slot or into a grown box, take their optimiser state along: what comes
    there resembles what came to their neighbour.
    """

    def __init__(
        self,
        box: F64,
        t0_ns: int,
        slot_ns: int,
        slots: int = 25,
        cells: int | tuple[int, int, int] = 64,
        levels: int = 2,
        channels: int = 32,
        seed: int = 0,
        space_range: tuple[float, float] = SPACE_RANGE,
    ) -> None:
        """Start a stream's window: it holds slot 0 and grows up to `slots`.

        Args:
            box: [2, 3] m, smallest and largest corner.
            t0_ns: time of slot 0.
            slot_ns: time from one slot to the next.
            slots: how many are kept.
            cells: along each axis on the coarsest level; each further level has twice as many.
            levels: how many there are.
            channels: of each level, a multiple of 16.
            seed: of the first values.
            space_range: lowest and highest first value of the planes in space.

        Raises:
            UsageError: the box is empty or not finite, or a number is out of range.
            SagsError: the field is larger than the memory it may take.
        """
        counts = np.broadcast_to(np.asarray(cells, np.int64), 3)
        box = np.asarray(box, np.float64)
        if box.shape != (2, 3):
            raise UsageError(f"a HexPlane's box has shape {list(box.shape)}, expected [2, 3]")
        if slot_ns < 1 or not 1 <= levels <= MAX_LEVELS or counts.min() < 1:
            raise UsageError(
                f"a HexPlane needs slots of at least 1 ns, 1 to {MAX_LEVELS} levels and a cell on each axis, "
                f"got {slot_ns} ns, {levels} levels and {counts.tolist()} cells"
            )
        self.t0_ns, self.slot_ns = int(t0_ns), int(slot_ns)
        self.newest = 0  # number of the newest slot
        self._cell = (box[1] - box[0]) / counts  # m, [3], coarsest level
        self._counts = counts
        self.grid = _make_grid(box[0], self._cell, counts, levels, slots, channels)
        self.cells: F32 = aligned((self.grid.rows, channels))
        self.cells[:] = 1.0
        in_space = self.cells[: self.grid.space_rows]
        in_space[:] = np.random.default_rng(seed).uniform(*space_range, in_space.shape)
        self.adam = AdamState.new(*self.cells.shape)
        self._sampler = HexPlane(self.grid)

    @classmethod
    def for_clip(
        cls, box: F64, first_ns: int, last_ns: int, slots: int = 25, **options: Any
    ) -> HexPlaneField:
        """A window that covers a finished clip from its first to its last frame: nothing retires."""
        slot_ns = max(1, -(-(last_ns - first_ns) // max(1, slots - 1)))
        field = cls(box, first_ns, slot_ns, slots, **options)
        field.newest = slots - 1
        return field

    @property
    def oldest(self) -> int:
        """Number of the oldest slot that is kept."""
        return max(0, self.newest - self.grid.slots + 1)

    def locate(self, t_ns: int) -> Moment:
        """A time as the sampler wants it, held within the window."""
        number, rest = divmod(int(t_ns) - self.t0_ns, self.slot_ns)
        if not self.oldest <= number < self.newest:
            slot = min(max(number, self.oldest), self.newest) % self.grid.slots
            return Moment(slot, slot, 0.0)
        return Moment(number % self.grid.slots, (number + 1) % self.grid.slots, rest / self.slot_ns)

    def sample(self, points: F32, t_ns: int) -> F32:
        """Features [N, levels * C] of points [N, 3] (m) at one time; see `HexPlane.forward`."""
        return self._sampler.forward(self.cells, points, self.locate(t_ns))

    def backward(self, v_features: F32) -> FieldGradients:
        """Gradients of the last `sample`; see `HexPlane.backward`."""
        return self._sampler.backward(v_features)

    def advance(self, t_ns: int, retire: Callable[[int], None]) -> None:
        """Make slots up to the first that does not lie before `t_ns`.

        Args:
            t_ns: the time that is to lie within the window. An earlier one changes nothing.
            retire: called with the time (ns) of every slot that has to go, oldest first, while the field can
                still be sampled there: to fold what the field says there into the canonical Gaussians. After
                a gap longer than the window all slots go; those of the gap were never there.
        """
        newest = -((self.t0_ns - int(t_ns)) // self.slot_ns)
        if newest <= self.newest:
            return
        oldest = max(0, newest - self.grid.slots + 1)
        for number in range(self.oldest, min(oldest, self.newest + 1)):
            retire(self.t0_ns + number * self.slot_ns)
        for rows in (self.cells, self.adam.moments, self.adam.shares):
            last = rows[self.grid.slot(self.newest % self.grid.slots)].copy()
            for number in range(max(oldest, self.newest + 1), newest + 1):
                rows[self.grid.slot(number % self.grid.slots)] = last
        self.newest = newest

    def grow(self, box: F64) -> bool:
        """Make the field's box hold `box` [2, 3] (m) too. Features stay the same everywhere.

        Returns:
            Whether it grew; then `grid`, `cells` and `adam` are new.

        Raises:
            UsageError: the box is not finite.
            SagsError: the grown field is larger than the memory it may take; the field is as it was.
        """
        if not np.isfinite(box).all():
            raise UsageError(f"cannot grow a HexPlane to a box that is not finite: {box.tolist()} m")
        low, high = np.array(self.grid.box)
        slack = 1e-6  # of a cell: the box as it is must not look too small for itself
        before = np.maximum(0, np.ceil((low - box[0]) / self._cell - slack))
        after = np.maximum(0, np.ceil((box[1] - high) / self._cell - slack))
        before[before > 0] += GROWTH_MARGIN
        after[after > 0] += GROWTH_MARGIN
        if not (before.any() or after.any()):
            return False
        old = self.grid
        counts = self._counts + before + after
        grid = _make_grid(low - before * self._cell, self._cell, counts, old.levels, old.slots, old.channels)
        source = _nearest_rows(old, grid, before.astype(np.int64))
        self.cells = _taken(self.cells, source)
        self.adam = AdamState(_taken(self.adam.moments, source), _taken(self.adam.shares, source))
        self.grid, self._counts = grid, counts.astype(np.int64)
        self._sampler = HexPlane(grid)
        return True


def _make_grid(low: F64, cell: F64, counts: NDArray[Any], levels: int, slots: int, channels: int) -> Grid:
    """The grid of `counts` [3] cells of size `cell` [3] (m) on the coarsest level, from the corner `low`."""
    high = low + counts * cell
    rows = 0.0  # float: counts that are out of range must not wrap
    for level in range(levels):
        x, y, z = (float(count) * 2**level + 1 for count in counts)
        rows += x * y + x * z + y * z + slots * (x + y + z)
    if not rows * channels * 4 <= MAX_BYTES:
        raise SagsError(
            f"a HexPlane of {' x '.join(f'{c:.0f}' for c in counts)} cells and {levels} levels takes "
            f"{rows * channels * 4 / 1e6:.0f} MB, the limit is {MAX_BYTES / 1e6:.0f} MB: "
            "use fewer cells, or leave points that lie far away out of its box"
        )
    nodes = [tuple(int(count) * 2**level + 1 for count in counts) for level in range(levels)]
    return Grid((tuple(low.tolist()), tuple(high.tolist())), tuple(nodes), slots, channels)


def _taken(rows: F32, source: I64) -> F32:
    """The given rows in this order, in aligned memory."""
    taken: F32 = aligned((len(source), *rows.shape[1:]))
    np.take(rows, source, axis=0, out=taken)
    return taken


def _nearest_rows(old: Grid, new: Grid, before: I64) -> I64:
    """For each row of a grown grid, the nearest old one. `before` [3]: coarsest cells added below."""
    rows = np.empty(new.rows, np.int64)
    lines = []
    for level, (old_nodes, new_nodes) in enumerate(zip(old.nodes, new.nodes, strict=True)):
        nearest = [
            np.clip(np.arange(new_nodes[axis]) - before[axis] * 2**level, 0, old_nodes[axis] - 1)
            for axis in range(3)
        ]
        for plane, (outer, inner) in enumerate(zip(OUTER, INNER, strict=True)):
            table = nearest[outer][:, None] * old_nodes[inner] + nearest[inner]
            first = new.plane_rows[level, plane]
            rows[first : first + table.size] = old.plane_rows[level, plane] + table.ravel()
        lines += [old.line_rows[level, axis] + nearest[axis] for axis in range(3)]
    line = np.concatenate(lines)
    for slot in range(old.slots):
        rows[new.slot(slot)] = old.slot(slot).start + line
    return rows
