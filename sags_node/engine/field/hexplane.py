"""The HexPlane field: features of points in space and time (Cao & Johnson, CVPR 2023; with the product of
K-Planes, Fridovich-Keil et al., CVPR 2023).

Six planes of feature vectors on each level, (x, y), (x, z), (y, z), (x, t), (y, t), (z, t), are sampled
bilinearly; a level's feature is the product of its six samples, and the levels are concatenated. The first
and last node of an axis lie on the faces of the box; outside it, the border's value holds.

All points of one call share one time, which lies between two slots: so the planes that hold time are blended
to lines once per call.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from sags_node.engine.field import hexplane_kernels as kernels
from sags_node.engine.field.hexplane_kernels import BLOCK, CHUNK, INNER, LANES, OUTER, RECORDS
from sags_node.errors import UsageError
from sags_node.kernels.jit import aligned, read_only
from sags_node.types import F32, I64


class Moment(NamedTuple):
    """A time as the field sees it: the blend (1 - fraction) slot_a + fraction slot_b."""

    slot_a: int
    slot_b: int
    fraction: float  # 0..1


@dataclass(frozen=True)
class Grid:
    """Where the cells of all planes lie in space, and in one array [rows, channels].

    First come the planes in space: level by level xy, xz, yz, each row-major, with axis `OUTER` down and
    `INNER` across. Then come the slots, `slot_rows` rows each: level by level the lines of x, y and z.

    Raises:
        UsageError: an axis has fewer than two nodes or no length, there is no slot, or the number of channels
            is no multiple of 16.
    """

    box: tuple[tuple[float, float, float], tuple[float, float, float]]  # m, smallest and largest corner
    nodes: tuple[tuple[int, int, int], ...]  # per level, along x, y, z
    slots: int
    channels: int

    def __post_init__(self) -> None:
        low, high = self.box
        if not all(np.isfinite([*low, *high])) or not all(a < b for a, b in zip(low, high, strict=True)):
            raise UsageError(f"a HexPlane needs a finite box with room on every axis, got {low} to {high} m")
        if not self.nodes or min(min(level) for level in self.nodes) < 2:
            raise UsageError(f"a HexPlane needs levels of at least 2 nodes an axis, got {self.nodes}")
        if self.slots < 1:
            raise UsageError(f"a HexPlane needs at least one time slot, got {self.slots}")
        if self.channels < LANES or self.channels % LANES:
            raise UsageError(f"a HexPlane needs a multiple of {LANES} channels, got {self.channels}")

    @property
    def levels(self) -> int:
        return len(self.nodes)

    @property
    def features(self) -> int:
        """Length of a point's feature vector."""
        return self.levels * self.channels

    @property
    def plane_rows(self) -> I64:
        """First row of each plane in space, [levels, 3]."""
        sizes = [
            level[outer] * level[inner]
            for level in self.nodes
            for outer, inner in zip(OUTER, INNER, strict=True)
        ]
        return _starts(sizes)

    @property
    def line_rows(self) -> I64:
        """First row of each axis' line within a slot, [levels, 3]."""
        return _starts([size for level in self.nodes for size in level])

    @property
    def space_rows(self) -> int:
        return sum(x * y + x * z + y * z for x, y, z in self.nodes)

    @property
    def slot_rows(self) -> int:
        return sum(sum(level) for level in self.nodes)

    @property
    def rows(self) -> int:
        return self.space_rows + self.slots * self.slot_rows

    def slot(self, slot: int) -> slice:
        """The rows of one slot."""
        first = self.space_rows + slot * self.slot_rows
        return slice(first, first + self.slot_rows)


def _starts(sizes: list[int]) -> I64:
    """Where stretches of these lengths begin, one behind the other, in rows of three."""
    lengths = np.array(sizes, np.int64)
    return (np.cumsum(lengths) - lengths).reshape(-1, 3)


@dataclass(frozen=True, slots=True)
class FieldGradients:
    """Derivatives by the cells and the points of one call."""

    v_cells: F32  # [M, C] only `rows` mean anything; the others hold what earlier calls left there
    rows: I64  # [K] the cells that took part, ascending: those of points with a cotangent other than zero
    v_points: F32  # [N, 3] per m


class HexPlane:
    """Samples a grid's cells. Not for use by two threads at once.

    Results do not depend on the number of threads.
    """

    def __init__(self, grid: Grid) -> None:
        self.grid = grid
        low, high = np.array(grid.box)
        nodes = np.array(grid.nodes)
        self._tables = (
            read_only(low.astype(np.float32)),
            read_only(((nodes - 1) / (high - low)).astype(np.float32)),
            read_only(nodes),
            read_only(grid.plane_rows),
            read_only(grid.line_rows),
        )
        channels, levels, chunks = grid.channels, grid.levels, BLOCK // CHUNK
        self._features = aligned((0, grid.features))
        self._v_points = aligned((0, 3))
        self._records = aligned((levels * 3 * (channels // LANES) * RECORDS,))
        self._active = np.zeros(BLOCK, np.uint8)
        self._v_lines = aligned((chunks, (grid.slot_rows + 3) * channels))
        self._lines_touched = np.zeros((chunks, grid.slot_rows), np.uint8)
        self._v_cells = aligned((grid.rows, channels))
        self._touched = np.zeros((channels // LANES, grid.rows), np.uint8)
        self._rows = np.zeros(grid.rows + 1, np.int64)

    def forward(self, cells: F32, points: F32, moment: Moment) -> F32:
        """Features of points at one time.

        Args:
            cells: [M, C] of the grid's layout.
            points: [N, 3] m. Outside the box, and for NaN, the border's value holds.
            moment: the time, in slots.

        Returns:
            [N, levels * C]. A view into own memory, overwritten by the next `forward`.

        Raises:
            UsageError: an array has the wrong shape, or a slot does not exist.
        """
        grid = self.grid
        count = len(points)
        if cells.shape != (grid.rows, grid.channels):
            raise UsageError(f"cells have shape {list(cells.shape)}, expected {[grid.rows, grid.channels]}")
        if points.shape != (count, 3):
            raise UsageError(f"points have shape {list(points.shape)}, expected [N, 3]")
        if not (0 <= min(moment[:2]) and max(moment[:2]) < grid.slots and 0 <= moment.fraction <= 1):
            raise UsageError(f"{moment} lies outside the {grid.slots} slots of this HexPlane")
        if count > len(self._features):
            room = count + count // 4
            self._features, self._v_points = aligned((room, grid.features)), aligned((room, 3))
        fraction = np.float32(moment.fraction if moment.slot_a != moment.slot_b else 0.0)
        weights = np.array([1 - fraction, fraction], np.float32)
        lines = weights[0] * cells[grid.slot(moment.slot_a)] + weights[1] * cells[grid.slot(moment.slot_b)]
        self._moment, self._weights = moment, weights
        self._points = read_only(points.astype(np.float32, copy=False))
        self._cells = read_only(cells.astype(np.float32, copy=False)).reshape(-1)
        self._lines = read_only(lines.astype(np.float32, copy=False)).reshape(-1)
        features = self._features[:count]
        kernels.sample(
            self._points, self._cells, self._lines, grid.channels, self._tables, features.reshape(-1)
        )
        return features

    def backward(self, v_features: F32) -> FieldGradients:
        """Gradients of sum(v_features * features) for the last `forward`, whose arrays must be unchanged.

        Args:
            v_features: [N, levels * C] cotangent. A point whose row is zero takes no part.

        Returns:
            Views into own memory, overwritten by the next `backward`.

        Raises:
            UsageError: `v_features` has the wrong shape.
        """
        grid = self.grid
        count = len(self._points)
        if v_features.shape != (count, grid.features):
            raise UsageError(
                f"v_features have shape {list(v_features.shape)}, expected {[count, grid.features]}"
            )
        v_features = read_only(v_features.astype(np.float32, copy=False))
        v_cells = self._v_cells.reshape(-1)
        self._lines_touched[:] = 0
        kernels.differentiate(
            self._points,
            self._cells,
            self._lines,
            grid.channels,
            self._tables,
            v_features,
            self._records,
            self._active,
            self._v_lines,
            self._lines_touched,
            v_cells,
            self._touched,
            self._v_points[:count],
        )
        slots = np.array([grid.slot(slot).start for slot in self._moment[:2]])
        kernels.share_lines(
            self._v_lines, self._lines_touched, slots, self._weights, grid.channels, v_cells, self._touched[0]
        )
        touched = kernels.list_touched(self._touched[0], self._rows)
        self._touched[1:] = 0
        return FieldGradients(self._v_cells, self._rows[:touched], self._v_points[:count])
