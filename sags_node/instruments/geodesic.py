"""How far every pixel of an instrument is from where it enters, on ways inside of it."""

from __future__ import annotations

import numpy as np

from sags_node.kernels.jit import kernel
from sags_node.types import I32, U8


@kernel
def geodesic(inside: U8, start: U8) -> tuple[I32, I32, I32]:
    """Rows, columns and steps from the start [K] of each pixel that is reached; the nearest first.

    Every other step goes to four neighbours, the others to eight: so the fronts are octagons, nearly round
    (Rosenfeld and Pfaltz, 1968, "Distance functions on digital pictures").

    Args:
        inside, start: [h, w] 1: a way may lead there; all of the start is inside. It is at 1.
    """
    height, width = inside.shape
    rows, columns = np.empty(inside.size, np.int32), np.empty(inside.size, np.int32)
    steps, left = np.empty(inside.size, np.int32), inside.copy()
    count = 0
    for y in range(height):
        for x in range(width):
            if start[y, x]:
                rows[count], columns[count], steps[count] = y, x, 1
                left[y, x] = 0
                count += 1
    older, old, step = 0, 0, 1  # where the last two fronts begin: a corner is reached a step later
    while old < count:
        end = count
        for i in range(older, end):
            for dy in range(-1, 2):
                for dx in range(-1, 2):
                    y, x = rows[i] + dy, columns[i] + dx
                    if step % 2 == 1 and dy != 0 and dx != 0:
                        continue
                    if 0 <= y < height and 0 <= x < width and left[y, x]:
                        rows[count], columns[count], steps[count] = y, x, step + 1
                        left[y, x] = 0
                        count += 1
        older, old, step = old, end, step + 1
    return rows[:count], columns[:count], steps[:count]
