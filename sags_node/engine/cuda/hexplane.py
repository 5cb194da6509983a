"""The HexPlane field on the device; `engine.field.hexplane` says what it computes, and how cells lie."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
import triton

from sags_node.engine.cuda import hexplane_kernels as kernels
from sags_node.engine.cuda.hexplane_kernels import CHUNK, NODES, PART, POINTS
from sags_node.engine.field.hexplane import Grid, Moment
from sags_node.errors import UsageError

if TYPE_CHECKING:
    from torch import Tensor


@dataclass(frozen=True, slots=True)
class FieldGradients:
    """Derivatives by the cells and the points of one call."""

    v_cells: Tensor  # [M, C] only rows that are `touched` mean anything
    touched: Tensor  # [M] bool: the cells that took part, those of points with a cotangent other than zero
    v_points: Tensor  # [N, 3] per m


class HexPlane:
    """Samples a grid's cells on one device. The same bits every time. Nothing is read back to the host."""

    def __init__(self, grid: Grid, device: torch.device) -> None:
        self.grid = grid
        low, high = np.array(grid.box)
        nodes = np.array(grid.nodes)
        self._box = torch.tensor(
            np.vstack([low, (nodes - 1) / (high - low)]), dtype=torch.float32, device=device
        )
        places = np.hstack([nodes, grid.plane_rows, grid.line_rows])
        self._places = torch.tensor(places, dtype=torch.int32, device=device)
        self._space_rows = torch.arange(grid.space_rows + 1, dtype=torch.int32, device=device)
        self._channels = {"C": grid.channels, "CHANNELS": triton.next_power_of_2(grid.channels)}

    def forward(self, cells: Tensor, points: Tensor, moment: Moment) -> Tensor:
        """Features [N, levels * C] of points at one time, a fresh tensor.

        Args:
            cells: [M, C] float32 of the grid's layout, contiguous, as all tensors here.
            points: [N, 3] float32 m. Outside the box, and for NaN, the border's value holds.
            moment: the time, in slots.

        Raises:
            UsageError: a tensor has the wrong shape, or a slot does not exist.
        """
        grid, count = self.grid, len(points)
        if tuple(cells.shape) != (grid.rows, grid.channels):
            raise UsageError(f"cells have shape {list(cells.shape)}, expected {[grid.rows, grid.channels]}")
        if tuple(points.shape) != (count, 3):
            raise UsageError(f"points have shape {list(points.shape)}, expected [N, 3]")
        if not (0 <= min(moment[:2]) and max(moment[:2]) < grid.slots and 0 <= moment.fraction <= 1):
            raise UsageError(f"{moment} lies outside the {grid.slots} slots of this HexPlane")
        fraction = moment.fraction if moment.slot_a != moment.slot_b else 0.0
        self._moment = moment._replace(fraction=fraction)
        slot_a, slot_b = cells[grid.slot(moment.slot_a)], cells[grid.slot(moment.slot_b)]
        self._inputs = points, cells, (1.0 - fraction) * slot_a + fraction * slot_b, self._box, self._places
        features = torch.empty((count, grid.features), device=points.device)
        if count > 0:
            kernels.sample[(triton.cdiv(count, POINTS), grid.levels)](
                *self._inputs, features, count, LEVELS=grid.levels, **self._channels, POINTS=POINTS
            )
        return features

    def backward(self, v_features: Tensor) -> FieldGradients:
        """Gradients of sum(v_features * features) for the last `forward`, whose tensors must be unchanged.
        Takes 24 * levels * C bytes of memory per point while it runs.

        Args:
            v_features: [N, levels * C] cotangent. A point whose row is zero takes no part. What is not finite
                reaches the cells of its point in space, and is left out of the lines.

        Returns:
            Fresh tensors.

        Raises:
            UsageError: `v_features` has the wrong shape.
        """
        grid, points = self.grid, self._inputs[0]
        count, levels = len(points), grid.levels
        if tuple(v_features.shape) != (count, grid.features):
            raise UsageError(
                f"v_features have shape {list(v_features.shape)}, expected {[count, grid.features]}"
            )
        v_cells = v_features.new_empty((grid.rows, grid.channels))
        touched = torch.zeros(grid.rows, dtype=torch.bool, device=points.device)
        v_points = v_features.new_empty((count, 3))
        if count == 0:
            return FieldGradients(v_cells, touched, v_points)
        plane_records, line_records = v_features.new_empty((2, levels * 3, count, grid.channels))
        keys = torch.empty(levels * 3 * count, dtype=torch.int32, device=points.device)
        active = torch.empty(count, dtype=torch.bool, device=points.device)
        kernels.differentiate[(triton.cdiv(count, POINTS),)](
            *self._inputs, v_features, plane_records, line_records, keys, active, v_points,
            count, grid.space_rows, LEVELS=levels, **self._channels, POINTS=POINTS,
        )  # fmt: skip
        ordered, order = torch.sort(keys, stable=True)
        starts = torch.searchsorted(ordered, self._space_rows)
        kernels.add_planes[(grid.space_rows,)](
            points, plane_records, order, starts, self._box, self._places, v_cells, touched, count,
            LEVELS=levels, **self._channels, POINTS=POINTS,
        )  # fmt: skip
        self._add_lines(points, line_records, active, v_cells, touched)
        return FieldGradients(v_cells, touched, v_points)

    def _add_lines(
        self, points: Tensor, records: Tensor, active: Tensor, v_cells: Tensor, touched: Tensor
    ) -> None:
        """Sum the lines' gradients, and share them between the two slots."""
        grid, count = self.grid, len(points)
        chunks = triton.cdiv(count, CHUNK)
        v_lines = records.new_empty((chunks, grid.slot_rows, grid.channels))
        weights = records.new_empty((chunks, grid.slot_rows))
        blocks = triton.cdiv(max(max(level) for level in grid.nodes), NODES)
        kernels.add_lines[(chunks, 3 * grid.levels, blocks)](
            points, records, active, self._box, self._places, v_lines, weights, count, grid.slot_rows,
            **self._channels, CHUNK=CHUNK, PART=PART, NODES=NODES,
        )  # fmt: skip
        v_line, in_use = v_lines.sum(dim=0), weights.sum(dim=0) != 0
        slot_a, slot_b, fraction = self._moment
        for slot, share in ((slot_a, 1.0 - fraction), (slot_b, fraction)):
            if share != 0:
                v_cells[grid.slot(slot)] = share * v_line
                touched[grid.slot(slot)] = in_use
