"""The HexPlane: features of every place and time (SAGS, arXiv 2510.27318, equation of the feature field;
HexPlane, Cao & Johnson, CVPR 2023; the product is that of K-Planes, Fridovich-Keil et al., CVPR 2023).

    f(x, y, z, t) = concat over levels l of prod over c of interp(P_c^l, (x, y, z, t)_c)
    c in {xy, xz, yz, xt, yt, zt}

Six planes of feature vectors on each level are sampled bilinearly. The first and last node of an axis in
space lie on the faces of the box; outside it, the border's value holds.

Time: slot number k stands for t0_ns + k * slot_ns; the last `slots` of them are kept in a ring. Between slots
features are blended, before the oldest and after the newest they are constant. A new slot starts as a copy of
the newest.
"""

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from sags_node.errors import SagsError, UsageError
from sags_node.field.adam import RowAdam
from sags_node.field.gather import filled
from sags_node.field.sampling import PAIRS, Level, Places, by_planes, has_kernels, sample
from sags_node.types import F64, I64

MAX_BYTES = 1 << 29  # of the cells; their optimiser's state takes twice as much again, their gradients once
MAX_LEVELS = 8

# First values of the planes in space, and of the lines in time. EndoGaussian takes 0.1 to 0.5: the
# product of three planes is then about 0.03, the decoder sees next to nothing at first, and after 1300
# iterations on a real clip PSNR is 2.7 dB behind.
SPACE_RANGE = (0.7, 1.3)
FIRST_LINE = 1.0


class HexPlane:
    """All planes in one table: first those in space, level by level xy, xz, yz, each row-major; then the
    slots, each level by level the lines of x, y and z (what xt, yt and zt hold at the slot's time).

    Attributes:
        cells: [M, C], differentiable.
        adam: the state of the cells' optimiser, row by row. Where a row is copied, so is its state.
        box: [2, 3] m.
        nodes: [levels, 3] nodes along x, y, z.
        newest: number of the newest slot.
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
        device: torch.device | str = "cpu",
    ) -> None:
        """Start a stream's window: it holds slot 0 and grows up to `slots`.

        Args:
            box: [2, 3] m, smallest and largest corner.
            t0_ns: time of slot 0.
            slot_ns: time from one slot to the next.
            slots: how many are kept.
            cells: along each axis on the coarsest level; each further level has twice as many.
            levels: how many there are.
            channels: C, of each level.
            seed: of the first values.
            space_range: lowest and highest first value of the planes in space.
            device: that keeps the cells.

        Raises:
            UsageError: the box is empty or not finite, or a number is out of range.
            SagsError: the planes are larger than the memory they may take.
        """
        counts = np.broadcast_to(np.asarray(cells, np.int64), 3)
        box = np.array(box, np.float64)
        if box.shape != (2, 3) or not np.isfinite(box).all() or not (box[0] < box[1]).all():
            raise UsageError(
                f"a HexPlane needs a finite box [2, 3] with room on every axis, got {box.tolist()} m"
            )
        if min(slot_ns, slots, channels, counts.min()) < 1 or not 1 <= levels <= MAX_LEVELS:
            raise UsageError(
                f"a HexPlane needs 1 to {MAX_LEVELS} levels, and slots, channels, cells and ns of a slot of "
                f"at least 1, got {levels} levels, {slots} slots, {channels} channels, {counts.tolist()} "
                f"cells and {slot_ns} ns"
            )
        self.t0_ns, self.slot_ns, self.slots, self.channels = int(t0_ns), int(slot_ns), slots, channels
        self.newest = 0
        self._lay_out(box, counts, levels)
        rows = self._space_rows + slots * self._slot_rows
        values = np.full((rows, channels), FIRST_LINE, np.float32)
        values[: self._space_rows] = np.random.default_rng(seed).uniform(
            *space_range, (self._space_rows, channels)
        )
        self.cells: Tensor = torch.from_numpy(values).to(device).requires_grad_()
        self.adam = RowAdam.of(self.cells)

    def _lay_out(self, box: F64, counts: I64, levels: int) -> None:
        """Place the grid of `counts` [3] cells on the coarsest level in the box [2, 3] m."""
        nodes = counts * 2.0 ** np.arange(levels)[:, None] + 1  # float: what is out of range must not wrap
        x, y, z = nodes.T
        size = (x * y + x * z + y * z + self.slots * (x + y + z)).sum() * self.channels * 4
        if not size <= MAX_BYTES:
            raise SagsError(
                f"a HexPlane of {' x '.join(f'{c:.0f}' for c in counts)} cells and {levels} levels takes "
                f"{size / 1e6:.0f} MB, the limit is {MAX_BYTES / 1e6:.0f} MB: "
                "use fewer cells, or leave points that lie far away out of its box"
            )
        self.box = box
        self.nodes = nodes.astype(np.int64)
        planes = np.array([[level[a] * level[b] for a, b in PAIRS] for level in self.nodes])
        self._plane_rows = (planes.cumsum() - planes.ravel()).reshape(-1, 3)
        self._line_rows = (self.nodes.cumsum() - self.nodes.ravel()).reshape(-1, 3)  # within a slot
        self._space_rows, self._slot_rows = int(planes.sum()), int(self.nodes.sum())

    @property
    def features(self) -> int:
        """Length of a point's feature vector: levels * C."""
        return len(self.nodes) * self.channels

    @property
    def oldest(self) -> int:
        """Number of the oldest slot that is kept."""
        return max(0, self.newest - self.slots + 1)

    def slot(self, number: int) -> slice:
        """The rows of a slot."""
        first = self._space_rows + number % self.slots * self._slot_rows
        return slice(first, first + self._slot_rows)

    def locate(self, t_ns: int) -> tuple[int, int, float]:
        """The slots around a time, which is clamped to the window, and the share of the later one."""
        number, rest = divmod(int(t_ns) - self.t0_ns, self.slot_ns)
        if not self.oldest <= number < self.newest:
            number = min(max(number, self.oldest), self.newest)
            return number, number, 0.0
        return number, number + 1, rest / self.slot_ns

    def sample(self, points: Tensor, t_ns: int) -> Tensor:
        """Features [N, levels * C] of points [N, 3] m at one time, differentiable in both."""
        box = torch.tensor(self.box, dtype=points.dtype).to(points.device, non_blocking=True)
        low, high = box.unbind()
        within = torch.nan_to_num((points - low) / (high - low)).clamp(0, 1)
        if has_kernels(self.cells):
            return sample(self.cells, self._places(within, t_ns))
        return by_planes(self._levels(t_ns), within)

    def _levels(self, t_ns: int) -> list[Level]:
        """The planes in space and the lines at one time, views of the table where they can be."""
        before, after, share = self.locate(t_ns)
        planes = [int(level[a] * level[b]) for level in self.nodes for a, b in PAIRS]
        parts = torch.split(self.cells, planes + [self._slot_rows] * self.slots)  # at once: one gradient
        slots = parts[len(planes) :]
        # as float32: a slot whose share rounds to 0 then gets no gradient; Adam would make a whole step of it
        share = float(np.float32(share))
        at = torch.lerp(slots[before % self.slots], slots[after % self.slots], share)
        lines = torch.split(at, self.nodes.ravel().tolist())
        return [
            Level(
                [parts[3 * k + c].view(level[a], level[b], -1) for c, (a, b) in enumerate(PAIRS)],
                [lines[3 * k + axis][None] for axis in range(3)],
            )
            for k, level in enumerate(self.nodes.tolist())
        ]

    def _places(self, within: Tensor, t_ns: int) -> Places:
        before, after, share = self.locate(t_ns)
        slot, nodes = self.slot(before).start, torch.from_numpy(self.nodes)  # [levels, 3]
        at = within[:, None] * (nodes - 1)
        node = torch.minimum(at.detach().long(), nodes - 2)
        node, shares = pad(node, (0, 1)), pad(at - node, (0, 1), value=share)
        first = np.concatenate([self._plane_rows, self._line_rows + slot], axis=1)
        step = torch.full((len(nodes), 6), self.slot(after).start - slot)
        step[:, :3] = nodes[:, [1, 2, 2]]
        return Places(node, shares, torch.from_numpy(first), step)

    def step(self, planes: float, lines: float) -> None:
        """Take a step of Adam on the cells with a gradient; `planes`, `lines`: their learning rates."""
        gradient = self.cells.grad
        if gradient is not None:
            touched, space = filled(gradient), slice(0, self._space_rows)
            for rate, rows in ((planes, space), (lines, slice(space.stop, None))):
                rates = gradient.new_full((self.channels,), rate)
                self.adam.rows(rows).step(self.cells[rows], gradient[rows], rates, touched[rows])
            self.cells.grad = None

    def advance(self, t_ns: int, retire: Callable[[int], None]) -> None:
        """Make slots up to the first that does not lie before `t_ns`.

        Args:
            t_ns: the time that is to lie within the window. An earlier one changes nothing.
            retire: called with the time (ns) of every slot that has to go, oldest first, while the field can
                still be sampled there, to fold that into the canonical Gaussians. After a gap longer than the
                window all slots go; there never were slots for the gap.
        """
        newest = -((self.t0_ns - int(t_ns)) // self.slot_ns)
        if newest <= self.newest:
            return
        oldest = max(0, newest - self.slots + 1)
        for number in range(self.oldest, min(oldest, self.newest + 1)):
            retire(self.t0_ns + number * self.slot_ns)
        for rows in (self.cells.detach(), self.adam.moments, self.adam.shares):
            last = rows[self.slot(self.newest)].clone()
            for number in range(max(oldest, self.newest + 1), newest + 1):
                rows[self.slot(number)] = last
        self.newest = newest


def for_clip(box: F64, first_ns: int, last_ns: int, slots: int = 25, **options: object) -> HexPlane:
    """A HexPlane whose window covers a finished clip from its first to its last frame: nothing retires."""
    slot_ns = max(1, -(-(last_ns - first_ns) // max(1, slots - 1)))
    hexplane = HexPlane(box, first_ns, slot_ns, slots, **options)  # type: ignore[arg-type]
    hexplane.newest = slots - 1
    return hexplane
