"""Fused Adam (Kingma & Ba, 2015) on the rows of a table, where a step may take only some of the rows.

A row's moments move only in steps that take it, and so does its bias correction: each row behaves as if it
had an optimiser of its own that never saw the other steps. (With one step count for all, a row that is taken
for the first time late would step several times too far.) Instead of a count, a row keeps the moments of a
gradient that is always 1. They equal the bias corrections 1 - beta^t, so no power is computed.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numba
import numpy as np

from sags_node.kernels.jit import aligned, kernel, parallel_kernel, read_only, square_root
from sags_node.types import F32, I32, I64, Bool

f4 = np.float32
u8 = np.uint64
ZERO, ONE, INFINITY = f4(0.0), f4(1.0), f4(np.inf)


@kernel
def _step_row(
    values: F32,  # [C] changed
    gradients: F32,  # [C]
    moments: F32,  # [2 C] changed: m and v of column after column
    shares: F32,  # [2] changed
    rates: F32,  # [C]
    move_m: Any,  # 1 - beta1
    move_v: Any,
    eps: Any,
) -> bool:
    """Update one row. Return True if it is not finite: its values stay, and its state is reset."""
    size = ZERO
    for k in range(values.size):
        i = u8(k)
        size += gradients[i] * gradients[i] + abs(moments[i + i]) + abs(moments[i + i + u8(1)])
    if not size < INFINITY:
        moments[:] = ZERO
        shares[:] = ZERO
        return True
    shares[0] += move_m * (ONE - shares[0])
    shares[1] += move_v * (ONE - shares[1])
    by_m, by_v = ONE / shares[0], ONE / shares[1]
    for k in range(values.size):
        i = u8(k)
        gradient = gradients[i]
        m, v = moments[i + i], moments[i + i + u8(1)]
        m += move_m * (gradient - m)
        v += move_v * (gradient * gradient - v)
        moments[i + i] = m
        moments[i + i + u8(1)] = v
        values[i] -= rates[i] * (m * by_m) / (square_root(v * by_v) + eps)
    return False


@parallel_kernel
def _step(
    values: F32, gradients: F32, moments: F32, shares: F32, rates: F32, rows: Any,
    move_m: Any, move_v: Any, eps: Any,
    fixed: Bool,  # [K] written
) -> None:  # fmt: skip
    for k in numba.prange(rows.size):
        row = rows[k]
        fixed[k] = _step_row(
            values[row], gradients[row], moments[row], shares[row], rates, move_m, move_v, eps
        )


@dataclass(frozen=True, slots=True)
class AdamState:
    """The state of Adam for a table of M rows and C columns. All zeros: the row was never updated."""

    moments: F32  # [M, C, 2] running means of the gradient and of its square, interleaved for fast reading
    shares: F32  # [M, 2] the same of a gradient that is always 1: 1 - beta^t after t steps of the row

    @classmethod
    def new(cls, rows: int, columns: int) -> AdamState:
        return cls(aligned((rows, columns, 2)), aligned((rows, 2)))


def adam_step(
    values: F32,
    gradients: F32,
    state: AdamState,
    rates: F32,
    *,
    rows: I32 | I64 | None = None,
    betas: tuple[float, float] = (0.9, 0.999),
    eps: float = 1e-15,
) -> int:
    """Take one Adam step on rows of a table. The result does not depend on the number of threads.

    A row whose gradient or state is NaN or infinite (or whose squared gradient overflows) is left out of the
    step, and its state is reset.

    Args:
        values: [M, C] changed in place.
        gradients: [M, C]; rows that are not taken may hold anything.
        state: of this table, changed in place.
        rates: [C] learning rate of each column.
        rows: [K] the rows to take, none of them twice, for example `np.flatnonzero(contribution > 1e-3)`;
            None: all.
        betas: decay rates of the two moments; they must not change while a state is in use.
        eps: > 0.

    Returns:
        The number of rows that were left out because they were not finite.

    Raises:
        ValueError: shapes do not fit, or eps is not positive.
    """
    count, columns = values.shape
    if gradients.shape != values.shape or state.moments.shape != (count, columns, 2):
        raise ValueError(
            f"values {values.shape}, gradients {gradients.shape}, state {state.moments.shape} differ"
        )
    if rates.shape != (columns,) or not eps > 0:
        raise ValueError(f"rates {rates.shape} and eps {eps}: expected ({columns},) and a positive number")
    if rows is None:
        rows = np.arange(count)
    fixed = np.empty(len(rows), np.bool_)
    _step(
        values,
        read_only(gradients),
        state.moments.reshape(count, 2 * columns),
        state.shares,
        read_only(rates),
        read_only(rows),
        f4(1 - betas[0]),
        f4(1 - betas[1]),
        f4(eps),
        fixed,
    )
    return int(np.count_nonzero(fixed))
