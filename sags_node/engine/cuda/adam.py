"""Adam on rows of a table, on the device; `engine.adam` says what is particular about it.

Two kernels, since a row sits out as a whole: one looks at the rows, the other moves their columns. A table of
many short rows (cells of a HexPlane) and one of a single long row (a decoder) both keep the device busy so.
Where the CPU takes a list of rows this takes a mask of all: a list's length would have to come to the host.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
import triton
import triton.language as tl

from sags_node.engine.cuda.signatures import Compiled

if TYPE_CHECKING:
    from torch import Tensor

ROWS, COLUMNS = 16, 64  # of a program
INFINITY = tl.constexpr(float("inf"))
MOVES, BROKEN = tl.constexpr(1), tl.constexpr(2)  # what a row does; 0: it is not taken


@triton.jit(do_not_specialize=("count", "columns"))
def _look(
    gradients: tl.tensor,  # [M, C]
    moments: tl.tensor,  # [M, C, 2]
    shares: tl.tensor,  # [M, 2] changed
    taken: tl.tensor,  # [M]
    fates: tl.tensor,  # [M] written
    count: tl.tensor,
    columns: tl.tensor,
    move_m: tl.tensor,
    move_v: tl.tensor,
    ROWS: tl.constexpr,
    COLUMNS: tl.constexpr,
) -> None:
    """Which rows move, and how far their bias corrections are."""
    row = tl.program_id(0) * ROWS + tl.arange(0, ROWS)
    known = row < count
    is_taken = tl.load(taken + row, known, other=0) != 0
    sizes = tl.zeros([ROWS, COLUMNS], tl.float32)
    for first in range(0, columns, COLUMNS):
        column = first + tl.arange(0, COLUMNS)
        here = is_taken[:, None] & (column < columns)[None, :]
        at = row[:, None].to(tl.int64) * columns + column[None, :]
        gradient = tl.load(gradients + at, here, other=0.0)
        m = tl.load(moments + 2 * at, here, other=0.0)
        v = tl.load(moments + 2 * at + 1, here, other=0.0)
        sizes += gradient * gradient + tl.abs(m) + tl.abs(v)
    sound = tl.sum(sizes, axis=1) < INFINITY
    m = tl.load(shares + 2 * row, known, other=0.0)
    v = tl.load(shares + 2 * row + 1, known, other=0.0)
    tl.store(shares + 2 * row, tl.where(sound, m + move_m * (1.0 - m), 0.0), is_taken)
    tl.store(shares + 2 * row + 1, tl.where(sound, v + move_v * (1.0 - v), 0.0), is_taken)
    tl.store(fates + row, tl.where(is_taken, tl.where(sound, MOVES, BROKEN), 0), known)


@triton.jit(do_not_specialize=("count", "columns"))
def _move(
    values: tl.tensor,  # [M, C] changed
    gradients: tl.tensor,  # [M, C]
    moments: tl.tensor,  # [M, C, 2] changed
    shares: tl.tensor,  # [M, 2]
    rates: tl.tensor,  # [C]
    fates: tl.tensor,  # [M] of `_look`
    count: tl.tensor,
    columns: tl.tensor,
    move_m: tl.tensor,
    move_v: tl.tensor,
    eps: tl.tensor,
    ROWS: tl.constexpr,
    COLUMNS: tl.constexpr,
) -> None:
    row = tl.program_id(0) * ROWS + tl.arange(0, ROWS)
    column = tl.program_id(1) * COLUMNS + tl.arange(0, COLUMNS)
    fate = tl.load(fates + row, row < count, other=0)
    in_table = (column < columns)[None, :]
    moves, broken = (fate == MOVES)[:, None] & in_table, (fate == BROKEN)[:, None] & in_table
    at = row[:, None].to(tl.int64) * columns + column[None, :]
    gradient = tl.load(gradients + at, moves, other=0.0)
    m = tl.load(moments + 2 * at, moves, other=0.0)
    v = tl.load(moments + 2 * at + 1, moves, other=0.0)
    m += move_m * (gradient - m)
    v += move_v * (gradient * gradient - v)
    share_m = tl.load(shares + 2 * row, fate == MOVES, other=1.0)[:, None]
    share_v = tl.load(shares + 2 * row + 1, fate == MOVES, other=1.0)[:, None]
    rate = tl.load(rates + column, column < columns, other=0.0)[None, :]
    step = rate * (m / share_m) / (tl.sqrt_rn(v / share_v) + eps)
    tl.store(values + at, tl.load(values + at, moves, other=0.0) - step, moves)
    # of a broken row nothing was loaded: it is made anew from zeros
    tl.store(moments + 2 * at, m, moves | broken)
    tl.store(moments + 2 * at + 1, v, moves | broken)


@dataclass(frozen=True, slots=True)
class AdamState:
    """What Adam remembers of a table of M rows and C columns. All zeros: a row was never touched."""

    moments: Tensor  # [M, C, 2] running means of the gradient and of its square
    shares: Tensor  # [M, 2] the same of a gradient that is always 1: 1 - beta^t after t steps of the row

    @classmethod
    def new(cls, rows: int, columns: int, device: torch.device) -> AdamState:
        return cls(torch.zeros((rows, columns, 2), device=device), torch.zeros((rows, 2), device=device))

    def rows(self, rows: slice) -> AdamState:
        """A part of the same state."""
        return AdamState(self.moments[rows], self.shares[rows])


def adam_step(
    values: Tensor,
    gradients: Tensor,
    state: AdamState,
    rates: Tensor,
    *,
    taken: Tensor | None = None,
    betas: tuple[float, float] = (0.9, 0.999),
    eps: float = 1e-15,
) -> Tensor:
    """Move the rows of a table against their gradients; the same bits every time.

    A row whose gradient or state is NaN or infinite (or whose squared gradient overflows) sits the step out,
    with its state made anew. All tensors lie contiguous on one device.

    Args:
        values: [M, C] changed in place.
        gradients: [M, C]; rows that are not taken may hold anything.
        state: of this table, changed in place.
        rates: [C] learning rate of each column.
        taken: [M] bool, the rows to take; None: all.
        betas: decay of the two momenta; they may not change while a state is in use.
        eps: > 0.

    Returns:
        [M] bool: the rows that sat out because they were not finite.

    Raises:
        ValueError: shapes do not fit, or eps is not positive.
    """
    count, columns = values.shape
    if gradients.shape != values.shape or state.moments.shape != (count, columns, 2):
        raise ValueError(
            f"values {tuple(values.shape)}, gradients {tuple(gradients.shape)}, "
            f"state {tuple(state.moments.shape)} differ"
        )
    if rates.shape != (columns,) or not eps > 0:
        raise ValueError(
            f"rates {tuple(rates.shape)} and eps {eps}: expected ({columns},) and a positive number"
        )
    if taken is None:
        taken = torch.ones(count, dtype=torch.bool, device=values.device)
    elif taken.shape != (count,):
        raise ValueError(f"taken has shape {tuple(taken.shape)}, expected ({count},)")
    fates = torch.empty(count, dtype=torch.int32, device=values.device)
    if count > 0:
        move_m, move_v, blocks = 1.0 - betas[0], 1.0 - betas[1], triton.cdiv(count, ROWS)
        _look[(blocks,)](
            gradients, state.moments, state.shares, taken, fates, count, columns, move_m, move_v,
            ROWS=ROWS, COLUMNS=COLUMNS,
        )  # fmt: skip
        _move[(blocks, triton.cdiv(columns, COLUMNS))](
            values, gradients, state.moments, state.shares, rates, fates, count, columns, move_m, move_v, eps,
            ROWS=ROWS, COLUMNS=COLUMNS,
        )  # fmt: skip
    return torch.eq(fates, BROKEN.value)


SIGNATURES = (
    Compiled(
        _look,
        {
            **dict.fromkeys(("gradients", "moments", "shares"), "*fp32"),
            "taken": "*i1",
            "fates": "*i32",
            **dict.fromkeys(("count", "columns"), "i32"),
            **dict.fromkeys(("move_m", "move_v"), "fp32"),
        },
        {"ROWS": ROWS, "COLUMNS": COLUMNS},
    ),
    Compiled(
        _move,
        {
            **dict.fromkeys(("values", "gradients", "moments", "shares", "rates"), "*fp32"),
            "fates": "*i32",
            **dict.fromkeys(("count", "columns"), "i32"),
            **dict.fromkeys(("move_m", "move_v", "eps"), "fp32"),
        },
        {"ROWS": ROWS, "COLUMNS": COLUMNS},
    ),
)
