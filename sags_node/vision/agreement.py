"""Which matches to believe: those whose surroundings look alike, and that no nearer surface hides."""

from typing import Any

import numpy as np

from sags_node.kernels.jit import kernel
from sags_node.kernels.vectors import (
    lane_numbers,
    larger,
    load_anywhere,
    select,
    smaller,
    spread,
    square_roots,
    store_anywhere,
)
from sags_node.types import F32
from sags_node.vision.pyramid import BORDER
from sags_node.vision.windows import chunk, chunks, inside, repeat_ends, window_row

RADIUS = 4  # px of the windows that are compared
NOISE_VARIANCE = np.float32(1.0)  # grey levels squared: texture below it is camera noise, not agreement
LEAST_AGREEMENT = np.float32(0.57)  # matches below it are wrong more often than right
HIDDEN_TOLERANCE = np.float32(2.0)  # px of disparity between two matches of one right pixel
HALF = np.float32(0.5)  # of the patches over a pixel must be good


@kernel
def correlate(left: F32, seen: F32, agreement: F32) -> None:
    """Compute the zero-mean normalised cross-correlation (ZNCC) of the windows around each pixel.

    Args:
        left: rows of the left image with its border.
        seen: [h, w] the right image, warped by the matches to these rows; at least 16 px wide.
        agreement: [h, w] result, -1..1.
    """
    height, width = seen.shape
    own, line = left.shape[1], width + 2 * RADIUS
    sums = np.empty(5 * line, np.float32)  # of a, b, aa, bb and ab
    zero = spread(np.float32(0))
    share = np.float32(1) / np.float32((2 * RADIUS + 1) ** 2)
    for y in range(height):
        for i in range(chunks(width)):
            x = chunk(i, width)
            a, b, aa, bb, ab = zero, zero, zero, zero, zero
            for j in range(y - RADIUS, y + RADIUS + 1):
                row = inside(j, height)
                p = load_anywhere(left, (row + BORDER) * own + BORDER + x)
                q = load_anywhere(seen, row * width + x)
                a, b = a + p, b + q
                aa, bb, ab = aa + p * p, bb + q * q, ab + p * q
            at = RADIUS + x
            store_anywhere(sums, at, a)
            store_anywhere(sums, at + line, b)
            store_anywhere(sums, at + 2 * line, aa)
            store_anywhere(sums, at + 3 * line, bb)
            store_anywhere(sums, at + 4 * line, ab)
        for k in range(5):
            repeat_ends(sums, k * line, width, RADIUS)
        for i in range(chunks(width)):
            x = chunk(i, width)
            a, b = window_row(sums, x, RADIUS) * share, window_row(sums, x + line, RADIUS) * share
            aa = window_row(sums, x + 2 * line, RADIUS) * share - a * a + NOISE_VARIANCE
            bb = window_row(sums, x + 3 * line, RADIUS) * share - b * b + NOISE_VARIANCE
            ab = window_row(sums, x + 4 * line, RADIUS) * share - a * b
            store_anywhere(agreement, y * width + x, ab / square_roots(aa * bb))


@kernel
def drop_wrong(agreement: F32, disparity: F32, good: F32, smallest: Any, largest: Any, trust: F32) -> None:
    """Compute how far to trust each match, [h, w]: linear in the agreement, from 0 at 0.57 to 1 at 1.

    It is also 0 for impossible disparities (px), where less than half of the patches are good, and where a
    nearer surface is matched to the right eye's pixel. The last stands in for a left-right check, since only
    the left image is matched.
    """
    height, width = disparity.shape
    nearest = np.empty(width, np.float32)  # by right column
    zero, scale = np.float32(0), np.float32(1) / (np.float32(1) - LEAST_AGREEMENT)
    for y in range(height):
        for i in range(chunks(width)):
            x = chunk(i, width)
            at = y * width + x
            d = load_anywhere(disparity, at)
            found = larger((load_anywhere(agreement, at) - LEAST_AGREEMENT) * scale, zero)
            most = smaller(largest, lane_numbers() + np.float32(x))
            can_be = (d >= smallest) & (d <= most) & (load_anywhere(good, at) > HALF)
            store_anywhere(trust, at, select(can_be, found, zero))
        nearest[:] = 0
        for x in range(width):
            if trust[y, x] > 0:
                column = int(x - disparity[y, x] + HALF)
                nearest[column] = max(nearest[column], disparity[y, x])
        for x in range(width):
            d = disparity[y, x]
            if trust[y, x] > 0 and d <= nearest[int(x - d + HALF)] - HIDDEN_TOLERANCE:
                trust[y, x] = 0
