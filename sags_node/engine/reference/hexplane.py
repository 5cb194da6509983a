"""The readable twin of the HexPlane kernels: torch's own bilinear sampling, in any precision, by autograd."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sags_node.engine.field.hexplane import Grid, Moment
from sags_node.engine.field.hexplane_kernels import INNER, OUTER

if TYPE_CHECKING:
    from torch import Tensor


def sample(grid: Grid, cells: Tensor, points: Tensor, moment: Moment) -> Tensor:
    """Features [N, levels * C] of points [N, 3] (m) at one time from cells [M, C]; see `HexPlane.forward`."""
    import torch

    low, high = torch.tensor(np.array(grid.box), dtype=points.dtype)
    at = 2 * (points - low) / (high - low) - 1  # torch's coordinates: -1 and 1 are the first and last node
    at_time = torch.full_like(at[:, 0], 2 * moment.fraction - 1)
    slots = torch.stack([cells[grid.slot(moment.slot_a)], cells[grid.slot(moment.slot_b)]])
    features = []
    for level, sizes in enumerate(grid.nodes):
        feature = torch.ones((), dtype=points.dtype)
        for plane, (outer, inner) in enumerate(zip(OUTER, INNER, strict=True)):
            first = int(grid.plane_rows[level, plane])
            picture = cells[first : first + sizes[outer] * sizes[inner]].reshape(
                sizes[outer], sizes[inner], -1
            )
            feature = feature * _bilinear(picture, at[:, inner], at[:, outer])
        for axis in range(3):
            first = int(grid.line_rows[level, axis])
            feature = feature * _bilinear(slots[:, first : first + sizes[axis]], at[:, axis], at_time)
        features.append(feature)
    return torch.cat(features, 1)


def _bilinear(picture: Tensor, across: Tensor, down: Tensor) -> Tensor:
    """Values [N, C] of a picture [rows, columns, C] at places from -1 to 1."""
    import torch

    sampled = torch.nn.functional.grid_sample(
        picture.permute(2, 0, 1)[None],
        torch.stack([across, down], -1)[None, None],
        mode="bilinear",
        padding_mode="border",
        align_corners=True,
    )
    return sampled[0, :, 0].T
