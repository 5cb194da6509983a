"""Sums over square windows of an image, a vector of pixels at a time, for kernels that need several at once.

A row of sums over columns is gathered first, then summed along: `window_row` reads it. Images are at least
16 px wide; the last pixels of a row may be done twice. Beyond an image's edge its edge is repeated.
"""

from typing import Any

from sags_node.kernels.jit import inlined, kernel
from sags_node.kernels.vectors import LANES, load_anywhere
from sags_node.types import F32


@inlined
def chunks(width: int) -> Any:
    """Return how many vectors cover a row."""
    return (width + LANES - 1) // LANES


@inlined
def chunk(i: int, width: int) -> Any:
    """Return the first pixel of a row's `i`-th vector."""
    return min(i * LANES, width - LANES)


@inlined
def inside(y: Any, height: int) -> Any:
    return min(max(y, 0), height - 1)


@kernel
def repeat_ends(line: F32, at: int, width: int, radius: int) -> None:
    """Repeat the first and the last of `width` sums, which stand in `line` from `at` + `radius` on, in the
    `radius` places before and after them."""
    for k in range(radius):
        line[at + k] = line[at + radius]
        line[at + radius + width + k] = line[at + radius + width - 1]


@inlined
def window_row(line: F32, at: int, radius: int) -> Any:
    """Return a vector of sums over 2 radius + 1 places, the first from `at` on."""
    found = load_anywhere(line, at)
    for k in range(1, 2 * radius + 1):
        found = found + load_anywhere(line, at + k)
    return found
