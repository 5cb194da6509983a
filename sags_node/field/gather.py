"""Weighted sums of a table's rows: what bilinear sampling and following nodes have in common.

torch's own gradient of it sorts all indices and takes several times as long as the kernels here. The kernels
are for float32 on the CPU; a test compares them with torch.
"""

from typing import Any

import numpy as np
import torch
from numba import prange
from torch import Tensor
from torch.nn.functional import embedding_bag

from sags_node.field import twins
from sags_node.kernels.jit import kernel, parallel_kernel, read_only
from sags_node.types import F32, I64, Bool

u8 = np.uint64
LANES = 16  # columns of the table that one thread adds up: the same bits on any number of threads
PIECE = 512  # bags a thread takes at a time


def gather(table: Tensor, index: Tensor, weight: Tensor) -> Tensor:
    """Compute the sums over k of weight[b, k] * table[index[b, k]].

    Args:
        table: [M, C]
        index: [B, K] rows.
        weight: [B, K]

    Returns:
        [B, C], differentiable in table and weight.
    """
    if twins.by_kernels(table):
        gathered: Tensor = _Gather.apply(table, index, weight)  # type: ignore[no-untyped-call]
        return gathered
    return embedding_bag(index, table, per_sample_weights=weight, mode="sum")


class _Gather(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, table: Tensor, index: Tensor, weight: Tensor) -> Tensor:
        ctx.save_for_backward(table, index, weight)
        sums = table.new_empty((len(index), table.shape[1]))
        tables, rows, shares = (read_only(each.detach().numpy()) for each in (table, index, weight))
        _sum(tables, rows, shares, sums.numpy())
        return sums

    @staticmethod
    def backward(ctx: Any, v_sums: Tensor) -> tuple[Tensor | None, None, Tensor | None]:
        table, index, weight = ctx.saved_tensors
        rows, v = read_only(index.numpy()), read_only(v_sums.numpy())
        v_table = v_weight = None
        if ctx.needs_input_grad[0]:
            v_table = torch.zeros_like(table)
            _scatter(rows, read_only(weight.detach().numpy()), v, v_table.numpy())
        if ctx.needs_input_grad[2]:
            v_weight = torch.empty_like(weight)
            _dot(rows, read_only(table.detach().numpy()), v, v_weight.numpy())
        return v_table, None, v_weight


def filled(table: Tensor) -> Tensor:
    """Return [M] which rows of a table hold anything but zeros."""
    if not twins.by_kernels(table):
        return (table != 0).any(1)
    found = np.empty(len(table), np.bool_)
    _find_filled(read_only(table.numpy()), found)
    return torch.from_numpy(found)


@kernel
def _sum_piece(first: Any, end: Any, table: F32, index: I64, weight: F32, sums: F32) -> None:
    for bag in range(first, end):
        for c in range(table.shape[1]):
            sums[bag, u8(c)] = np.float32(0)
        for k in range(index.shape[1]):
            row, w = u8(index[bag, k]), weight[bag, k]
            for c in range(table.shape[1]):
                sums[u8(bag), u8(c)] += w * table[row, u8(c)]


@parallel_kernel
def _sum(table: F32, index: I64, weight: F32, sums: F32) -> None:
    for piece in prange(-(-len(index) // PIECE)):
        first = np.int64(piece) * PIECE
        end = min(first + PIECE, len(index))
        _sum_piece(first, end, table, index, weight, sums)


@kernel
def _scatter_columns(first: Any, end: Any, index: I64, weight: F32, v_sums: F32, v_table: F32) -> None:
    a, b = u8(first), u8(end)
    for bag in range(len(index)):
        for k in range(index.shape[1]):
            row, w = u8(index[bag, k]), weight[bag, k]
            for c in range(a, b):
                v_table[row, c] += w * v_sums[bag, c]


@parallel_kernel
def _scatter(index: I64, weight: F32, v_sums: F32, v_table: F32) -> None:
    columns = v_table.shape[1]
    for block in prange(-(-columns // LANES)):
        first = np.int64(block) * LANES
        _scatter_columns(first, min(first + LANES, columns), index, weight, v_sums, v_table)


@kernel
def _dot_piece(first: Any, end: Any, index: I64, table: F32, v_sums: F32, v_weight: F32) -> None:
    for bag in range(first, end):
        for k in range(index.shape[1]):
            row, total = u8(index[bag, k]), np.float32(0)
            for c in range(table.shape[1]):
                total += table[row, u8(c)] * v_sums[u8(bag), u8(c)]
            v_weight[bag, k] = total


@parallel_kernel
def _dot(index: I64, table: F32, v_sums: F32, v_weight: F32) -> None:
    for piece in prange(-(-len(index) // PIECE)):
        first = np.int64(piece) * PIECE
        end = min(first + PIECE, len(index))
        _dot_piece(first, end, index, table, v_sums, v_weight)


@kernel
def _find_filled_piece(first: Any, end: Any, table: F32, filled: Bool) -> None:
    for row in range(first, end):
        total = np.float32(0)
        for c in range(table.shape[1]):
            total += np.float32(table[u8(row), u8(c)] != np.float32(0))
        filled[row] = total > np.float32(0)


@parallel_kernel
def _find_filled(table: F32, filled: Bool) -> None:
    for piece in prange(-(-len(table) // PIECE)):
        first = np.int64(piece) * PIECE
        end = min(first + PIECE, len(table))
        _find_filled_piece(first, end, table, filled)
