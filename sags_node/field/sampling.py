"""Sampling of the HexPlane at places: bilinear samples of six planes, multiplied.

`by_planes` is the formula in torch. It stores six samples of every place, and as much for the gradient. For
float32 on the CPU, `sample` uses kernels that store none; a test compares both.
"""

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from numba import prange
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import grid_sample

from sags_node.field import twins
from sags_node.kernels.jit import add_lanes, copy, inlined, kernel, parallel_kernel, read_only, stack_floats
from sags_node.types import F32, I64

PAIRS = ((0, 1), (0, 2), (1, 2))  # the planes in space: xy, xz, yz
OUTER = (0, 0, 1, 3, 3, 3)  # axis of x, y, z, t along the rows of the planes xy, xz, yz, tx, ty, tz
INNER = (1, 2, 2, 0, 1, 2)  # axis along their columns
LANES = 16  # channels that a loop takes at a time
PIECE = 512  # places that a thread takes at a time

u8 = np.uint64
ZERO, ONE = np.float32(0), np.float32(1)


class Places(NamedTuple):
    """Where N places lie between the nodes of L levels."""

    node: Tensor  # [N, L, 4] the nodes before them along x, y, z and t
    share: Tensor  # [N, L, 4] of the nodes after them, differentiable
    first: Tensor  # [L, 6] first row of each plane in the table
    step: Tensor  # [L, 6] rows of the table from one row of a plane to the next


class Level(NamedTuple):
    """One level's planes at a time."""

    planes: Sequence[Tensor]  # xy, xz, yz: each [nodes of the first axis, nodes of the second, C]
    lines: Sequence[Tensor]  # of x, y, z: each [1, nodes, C]


def has_kernels(cells: Tensor) -> bool:
    """Tell whether `sample` can take this table [M, C]."""
    return twins.by_kernels(cells) and cells.shape[1] % LANES == 0


def sample(cells: Tensor, places: Places) -> Tensor:
    """Sample features [N, L * C] of places from a table [M, C], differentiable in cells and shares."""
    features: Tensor = _Sample.apply(cells, *places)  # type: ignore[no-untyped-call]
    return features


def by_planes(levels: Sequence[Level], within: Tensor) -> Tensor:
    """Sample the features of places [N, 3] in the box, 0..1, differentiable in tables and places."""
    x, y, z = (2 * within - 1).unbind(1)
    pairs = [y, x, z, x, z, y, x, x, y, y, z, z]  # column and row of each; a line has one row
    grids = torch.split(torch.stack(pairs, 1).view(1, -1, 6, 2), 1, dim=2)
    features = []
    for level in levels:
        found = [
            grid_sample(table.permute(2, 0, 1)[None], grid, padding_mode="border", align_corners=True)
            for table, grid in zip((*level.planes, *level.lines), grids, strict=True)
        ]  # each [1, C, N, 1]
        xy, xz, yz, of_x, of_y, of_z = found
        features.append(((xy * xz * yz) * (of_x * of_y * of_z))[0, :, :, 0])
    return torch.cat(features).T


class _Sample(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, cells: Tensor, *places: Tensor) -> Tensor:
        ctx.save_for_backward(cells, *places)
        levels, channels = places[0].shape[1], cells.shape[1]
        features = cells.new_empty((len(places[0]), levels * channels))
        table, node, share, first, step = _arrays(cells, places)
        _sample(table, node, share, first, step, channels, features.view(-1).numpy())
        return features

    @staticmethod
    def backward(ctx: Any, v_features: Tensor) -> tuple[Tensor | None, ...]:
        cells, *places = ctx.saved_tensors
        channels, v_cells = cells.shape[1], torch.zeros_like(cells)
        v_shares = cells.new_zeros((channels // LANES, *places[0].shape))
        table, node, share, first, step = _arrays(cells, places)
        v, by_cells = read_only(v_features.contiguous().view(-1).numpy()), v_cells.view(-1).numpy()
        _differentiate(table, node, share, first, step, channels, v, by_cells, v_shares.numpy())
        return v_cells, None, v_shares.sum(0), None, None


def _arrays(cells: Tensor, places: Sequence[Tensor]) -> Iterator[NDArray[Any]]:
    return (read_only(each.detach().numpy()) for each in (cells.view(-1), *places))


@inlined
def _corner(
    node: I64, share: F32, first: I64, step: I64, channels: Any, block: Any, i: Any, level: Any, plane: Any
) -> Any:
    """Offsets of a place's cells in a plane, in the row before and the row after it; and its two shares."""
    outer, inner = OUTER[plane], INNER[plane]
    row = first[level, plane] + node[i, level, outer] * step[level, plane] + node[i, level, inner]
    low, high = u8(row * channels + block), u8((row + step[level, plane]) * channels + block)
    return low, high, share[i, level, outer], share[i, level, inner]


@inlined
def _corners(
    node: I64, share: F32, first: I64, step: I64, channels: Any, block: Any, i: Any, level: Any
) -> Any:
    """`_corner` of each plane."""
    return (
        _corner(node, share, first, step, channels, block, i, level, 0),
        _corner(node, share, first, step, channels, block, i, level, 1),
        _corner(node, share, first, step, channels, block, i, level, 2),
        _corner(node, share, first, step, channels, block, i, level, 3),
        _corner(node, share, first, step, channels, block, i, level, 4),
        _corner(node, share, first, step, channels, block, i, level, 5),
    )


@inlined
def _bilinear(cells: F32, corner: Any, c: Any, right: Any) -> Any:
    """A sample of channel c, and its derivatives by both shares."""
    low, high, a, b = corner[0] + c, corner[1] + c, corner[2], corner[3]
    across, above = cells[low + right] - cells[low], cells[high + right] - cells[high]
    before, after = cells[low] + b * across, cells[high] + b * above
    return before + a * (after - before), after - before, across + a * (above - across)


@kernel
def _sample_piece(
    begin: Any, end: Any, cells: F32, node: I64, share: F32, first: I64, step: I64, channels: Any,
    features: F32,
) -> None:  # fmt: skip
    found, right, levels = stack_floats(16), u8(channels), node.shape[1]
    for item in range(begin * levels, end * levels):
        i, level = item // levels, item % levels
        for block in range(0, channels, LANES):
            of_xy, of_xz, of_yz, of_tx, of_ty, of_tz = _corners(
                node, share, first, step, channels, block, i, level
            )
            for k in range(LANES):
                c = u8(k)
                xy, _, _ = _bilinear(cells, of_xy, c, right)
                xz, _, _ = _bilinear(cells, of_xz, c, right)
                yz, _, _ = _bilinear(cells, of_yz, c, right)
                tx, _, _ = _bilinear(cells, of_tx, c, right)
                ty, _, _ = _bilinear(cells, of_ty, c, right)
                tz, _, _ = _bilinear(cells, of_tz, c, right)
                found[c] = (xy * xz * yz) * (tx * ty * tz)
            copy(features, u8(item * channels + block), found, u8(0), u8(LANES))


@parallel_kernel
def _sample(cells: F32, node: I64, share: F32, first: I64, step: I64, channels: int, features: F32) -> None:
    for piece in prange(-(-len(node) // PIECE)):
        begin = np.int64(piece) * PIECE
        end = min(begin + PIECE, len(node))
        _sample_piece(begin, end, cells, node, share, first, step, channels, features)


@kernel
def _differentiate_block(
    level: Any, block: Any, cells: F32, node: I64, share: F32, first: I64, step: I64, channels: Any,
    v_features: F32, v_cells: F32, v_share: F32,
) -> None:  # fmt: skip
    """Add up all places' gradients for a block of channels of a level, so that its cells have one writer."""
    by, v, right = stack_floats(96), stack_floats(16), u8(channels)
    for i in range(len(node)):
        of_xy, of_xz, of_yz, of_tx, of_ty, of_tz = _corners(
            node, share, first, step, channels, block, i, level
        )
        copy(v, u8(0), v_features, u8((i * node.shape[1] + level) * channels + block), u8(LANES))
        by_x = by_y = by_z = ZERO
        for k in range(LANES):
            c = u8(k)
            xy, xy_x, xy_y = _bilinear(cells, of_xy, c, right)
            xz, xz_x, xz_z = _bilinear(cells, of_xz, c, right)
            yz, yz_y, yz_z = _bilinear(cells, of_yz, c, right)
            tx, _, tx_x = _bilinear(cells, of_tx, c, right)
            ty, _, ty_y = _bilinear(cells, of_ty, c, right)
            tz, _, tz_z = _bilinear(cells, of_tz, c, right)
            in_space, in_time = v[c] * (tx * ty * tz), v[c] * (xy * xz * yz)
            v_xy, v_xz, v_yz = in_space * (xz * yz), in_space * (xy * yz), in_space * (xy * xz)
            v_tx, v_ty, v_tz = in_time * (ty * tz), in_time * (tx * tz), in_time * (tx * ty)
            by_x += v_xy * xy_x + v_xz * xz_x + v_tx * tx_x
            by_y += v_xy * xy_y + v_yz * yz_y + v_ty * ty_y
            by_z += v_xz * xz_z + v_yz * yz_z + v_tz * tz_z
            by[c], by[c + u8(16)], by[c + u8(32)] = v_xy, v_xz, v_yz
            by[c + u8(48)], by[c + u8(64)], by[c + u8(80)] = v_tx, v_ty, v_tz
        v_share[i, level, 0], v_share[i, level, 1], v_share[i, level, 2] = by_x, by_y, by_z
        for plane in range(6):
            low, high, a, b = _corner(node, share, first, step, channels, block, i, level, plane)
            at = u8(plane * LANES)
            add_lanes(v_cells, low, (ONE - a) * (ONE - b), by, at)
            add_lanes(v_cells, low + right, (ONE - a) * b, by, at)
            add_lanes(v_cells, high, a * (ONE - b), by, at)
            add_lanes(v_cells, high + right, a * b, by, at)


@parallel_kernel
def _differentiate(
    cells: F32, node: I64, share: F32, first: I64, step: I64, channels: int, v_features: F32, v_cells: F32,
    v_shares: F32,
) -> None:  # fmt: skip
    blocks = channels // LANES
    for task in prange(blocks * node.shape[1]):
        level, block = np.int64(task) // blocks, np.int64(task) % blocks
        _differentiate_block(
            level, block * LANES, cells, node, share, first, step, channels, v_features, v_cells,
            v_shares[block],
        )  # fmt: skip
