"""Anisotropic total variation (Rudin, Osher & Fatemi, 1992) of a picture in a region, and its gradient."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np

from sags_node.kernels.jit import inlined, kernel, parallel_kernel, read_only
from sags_node.types import F32, Bool

f4 = np.float32
u8 = np.uint64
ZERO, ONE = f4(0.0), f4(1.0)
MAX_DIFFERENCE = f4(1e3)  # also rejects NaN


@inlined
def _sign(difference: Any, counted: Any) -> Any:
    up = ONE if counted & (difference > ZERO) & (difference < MAX_DIFFERENCE) else ZERO
    down = ONE if counted & (difference < ZERO) & (difference > -MAX_DIFFERENCE) else ZERO
    return up - down


@inlined
def _pixel(
    above: F32,
    here: F32,
    below: F32,
    in_above: Bool,
    inside: Bool,
    in_below: Bool,
    left: Any,
    x: Any,
    right: Any,
) -> Any:
    """Gradient of the sum over the four neighbours of |here - neighbour|."""
    value, counted = here[x], inside[x]
    return (
        _sign(value - here[left], counted | inside[left])
        + _sign(value - here[right], counted | inside[right])
        + _sign(value - above[x], counted | in_above[x])
        + _sign(value - below[x], counted | in_below[x])
    )


@kernel
def _row(
    above: F32,
    here: F32,
    below: F32,
    in_above: Bool,
    inside: Bool,
    in_below: Bool,
    scale: Any,
    v_here: F32,  # added to
) -> Any:
    """One row; a neighbour beyond the picture is the pixel itself. Returns the sum of value * gradient."""
    last = u8(here.size - 1)
    total = ZERO
    for k in range(1, here.size - 1):
        x = u8(k)
        slope = _pixel(above, here, below, in_above, inside, in_below, x - u8(1), x, x + u8(1))
        v_here[x] += scale * slope
        # a sum over edges of |a - b| is a sum over pixels of value * gradient
        total += here[x] * slope if slope != ZERO else ZERO
    first = u8(0)
    slope = _pixel(above, here, below, in_above, inside, in_below, first, first, min(first + u8(1), last))
    v_here[first] += scale * slope
    total += here[first] * slope if slope != ZERO else ZERO
    if last > first:
        slope = _pixel(above, here, below, in_above, inside, in_below, last - u8(1), last, last)
        v_here[last] += scale * slope
        total += here[last] * slope if slope != ZERO else ZERO
    return total


@parallel_kernel
def _total_variation(picture: F32, region: Bool, scale: Any, v_picture: F32, row_sums: F32) -> None:
    height = picture.shape[0]
    for y in numba.prange(height):
        above = max(y - 1, 0)
        below = min(y + 1, height - 1)
        row_sums[y] = _row(
            picture[above], picture[y], picture[below], region[above], region[y], region[below],
            scale, v_picture[y],
        )  # fmt: skip


def add_total_variation(picture: F32, region: Bool, scale: float, v_picture: F32) -> float:
    """Sum of |a - b| over neighbouring pixels a, b of which at least one lies in the region, so that what is
    filled in joins its surroundings. Pairs with a NaN or an infinity are left out.

    Args:
        picture: [H, W].
        region: [H, W].
        scale: of the gradient.
        v_picture: [H, W]; `scale` times the gradient is added to it.

    Returns:
        The sum, which does not depend on the number of threads.
    """
    row_sums = np.empty(len(picture), np.float32)
    _total_variation(read_only(picture), read_only(region), f4(scale), v_picture, row_sums)
    return float(row_sums.sum(dtype=np.float64))
