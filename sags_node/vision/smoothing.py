"""Smoothing of a field that is smooth but for its steps."""

from __future__ import annotations

from typing import Any

import numpy as np

from sags_node.kernels.jit import kernel
from sags_node.kernels.vectors import larger, load_anywhere, spread, store_anywhere
from sags_node.types import F32
from sags_node.vision.windows import chunk, chunks, inside, repeat_ends, window_row


@kernel
def guided(field: F32, radius: int, variance: Any, smooth: F32) -> None:
    """The guided filter (He et al., PAMI 2013) of a field [h, w] with the field as its own guide.

    Planes and steps larger than the noise stay as they are.

    Args:
        field: contiguous, at least 16 px wide; its edge is repeated.
        radius: px, of the windows.
        variance: float32; where the field varies less around, it is noise.
        smooth: [h, w] result.
    """
    height, width = field.shape
    line = width + 2 * radius
    # The share that a pixel keeps of itself, and the part that is the mean's.
    kept, rest = np.empty((2, height, width), np.float32)
    sums = np.empty(2 * line, np.float32)
    zero = spread(np.float32(0))
    share = np.float32(1) / np.float32((2 * radius + 1) ** 2)
    for y in range(height):
        for i in range(chunks(width)):
            x = chunk(i, width)
            total, squares = zero, zero
            for j in range(y - radius, y + radius + 1):
                value = load_anywhere(field, inside(j, height) * width + x)
                total, squares = total + value, squares + value * value
            store_anywhere(sums, radius + x, total)
            store_anywhere(sums, line + radius + x, squares)
        repeat_ends(sums, 0, width, radius)
        repeat_ends(sums, line, width, radius)
        for i in range(chunks(width)):
            x = chunk(i, width)
            mean = window_row(sums, x, radius) * share
            varies = larger(window_row(sums, line + x, radius) * share - mean * mean, zero)
            own = varies / (varies + variance)
            store_anywhere(kept, y * width + x, own)
            store_anywhere(rest, y * width + x, mean - mean * own)
    for y in range(height):
        for i in range(chunks(width)):
            x = chunk(i, width)
            total, means = zero, zero
            for j in range(y - radius, y + radius + 1):
                at = inside(j, height) * width + x
                total, means = total + load_anywhere(kept, at), means + load_anywhere(rest, at)
            store_anywhere(sums, radius + x, total)
            store_anywhere(sums, line + radius + x, means)
        repeat_ends(sums, 0, width, radius)
        repeat_ends(sums, line, width, radius)
        for i in range(chunks(width)):
            x = chunk(i, width)
            own = load_anywhere(field, y * width + x)
            found = window_row(sums, x, radius) * own + window_row(sums, line + x, radius)
            store_anywhere(smooth, y * width + x, found * share)
