"""A dense guess of the disparity in a small image, by semi-global matching (Hirschmueller, PAMI 2008) along
rows and columns: right to a pixel or so of the small image, and smooth where there is no texture."""

from typing import Any

import cv2
import numpy as np

from sags_node.kernels.jit import kernel
from sags_node.kernels.vectors import (
    LANES,
    load_anywhere,
    magnitudes,
    smaller,
    smallest_lane,
    spread,
    store_anywhere,
)
from sags_node.types import F32
from sags_node.vision.pyramid import inner

STEP = 16  # the number of disparities is a multiple of it, and so of any machine's vector length
EVEN_WINDOW = 9  # px: the mean over it is subtracted from the brightness
COST_WINDOW = 5  # px over which costs are summed
SMALL_STEP = 0.5  # P1, over the mean contrast: penalty if a neighbour's disparity differs by a pixel
LARGE_STEP = 2.0  # P2, over the mean contrast: penalty if it differs by more
FLAT = 1.0  # grey levels of contrast that are added for noise
ZERO = np.float32(0)
FAR = np.float32(1e9)  # no disparity costs so much


def coarse_disparity(left: F32, right: F32, least: float, most: float) -> F32:
    """Estimate the disparity [h, w] (px) between small images, given with their borders.

    Args:
        least, most: disparities to search, px.
    """
    first = max(0, int(least))
    used = max(1, int(np.ceil(most)) + 1 - first)
    count = -(-used // STEP) * STEP
    window = EVEN_WINDOW, EVEN_WINDOW
    details = [np.ascontiguousarray(inner(eye - cv2.blur(eye, window))) for eye in (left, right)]
    contrast = sum(float(np.mean(np.abs(detail))) for detail in details) / 2 + FLAT
    height, width = details[0].shape
    cost, sums = np.empty((2, height, width, count), np.float32)
    _differences(details[0], details[1], first, sums)
    _sum_windows(sums, cost)
    sums[:] = 0
    step = np.float32(contrast * COST_WINDOW**2)
    _aggregate(cost, np.float32(SMALL_STEP) * step, np.float32(LARGE_STEP) * step, sums)
    disparity = np.empty((height, width), np.float32)
    _cheapest(sums, used, first, disparity)
    return disparity


@kernel
def _differences(left: F32, right: F32, first: int, cost: F32) -> None:
    """cost[y, x, d] = |left[y, x] - right[y, x - first - d]|. Beyond its edge the right one is repeated."""
    height, width, count = cost.shape
    turned = np.empty(width + first + count, np.float32)  # a row of the right image from right to left
    for y in range(height):
        for x in range(width):
            turned[x] = right[y, width - 1 - x]
        turned[width:] = right[y, 0]
        for x in range(width):
            for d in range(0, count, LANES):
                difference = left[y, x] - load_anywhere(turned, width - 1 - x + first + d)
                store_anywhere(cost, (y * width + x) * count + d, magnitudes(difference))


@kernel
def _sum_windows(cost: F32, sums: F32) -> None:
    """Sums over windows of pixels; the images' edges are repeated. `cost` is overwritten."""
    height, width, count = cost.shape
    _sum_along(cost, width, count, height, width * count, sums)
    _sum_along(sums, height, width * count, width, count, cost)
    sums[:] = cost


@kernel
def _sum_along(source: F32, length: int, step: int, lines: int, between: int, sums: F32) -> None:
    """Sums over COST_WINDOW samples, `step` apart, in `lines` lines of `length` samples, `between` apart."""
    half, count = COST_WINDOW // 2, source.shape[2]
    for line in range(lines):
        for d in range(0, count, LANES):
            at = line * between + d
            window = spread(ZERO)
            for k in range(-half - 1, half):
                window = window + load_anywhere(source, at + min(max(k, 0), length - 1) * step)
            for k in range(length):
                entering = load_anywhere(source, at + min(k + half, length - 1) * step)
                leaving = load_anywhere(source, at + max(k - half - 1, 0) * step)
                window = window + entering - leaving
                store_anywhere(sums, at + k * step, window)


@kernel
def _aggregate(cost: F32, small_step: Any, large_step: Any, sums: F32) -> None:
    """Adds to `sums` the least costs of paths that end at each pixel, from left, right, above and below."""
    height, width, count = cost.shape
    row, last_row, last_column = width * count, (height - 1) * width * count, (width - 1) * count
    _follow(cost, 0, count, width, row, height, small_step, large_step, sums)
    _follow(cost, last_column, -count, width, row, height, small_step, large_step, sums)
    _follow(cost, 0, row, height, count, width, small_step, large_step, sums)
    _follow(cost, last_row, -row, height, count, width, small_step, large_step, sums)


@kernel
def _follow(
    cost: F32, start: int, step: int, length: int, between: int, lines: int, small_step: Any, large_step: Any,
    sums: F32,
) -> None:  # fmt: skip
    """Aggregates along `lines` paths side by side: a single path would wait for each of its steps."""
    count = cost.shape[2]
    line = count + 2 * LANES  # what is beyond either end costs too much
    paths = np.full((2, lines, line), FAR, np.float32)
    least = np.zeros(lines, np.float32)
    for k in range(length):
        for i in range(lines):
            at, before, now = (
                start + i * between + k * step,
                (k % 2 * lines + i) * line,
                ((k + 1) % 2 * lines + i) * line,
            )
            base, best = least[i], spread(FAR)
            for d in range(0, count, LANES):
                found = load_anywhere(cost, at + d)
                if k > 0:
                    to = before + LANES + d
                    beside = smaller(load_anywhere(paths, to - 1), load_anywhere(paths, to + 1)) + small_step
                    found = (
                        found + smaller(smaller(load_anywhere(paths, to), beside), base + large_step) - base
                    )
                store_anywhere(paths, now + LANES + d, found)
                store_anywhere(sums, at + d, load_anywhere(sums, at + d) + found)
                best = smaller(best, found)
            least[i] = smallest_lane(best)


@kernel
def _cheapest(sums: F32, used: int, first: int, disparity: F32) -> None:
    """The disparity of least cost, to a fraction of a pixel by a parabola through the costs beside it."""
    for y in range(sums.shape[0]):
        for x in range(sums.shape[1]):
            best = 0
            for d in range(1, used):
                if sums[y, x, d] < sums[y, x, best]:
                    best = d
            offset = np.float32(0)
            if 0 < best < used - 1:
                below, least, above = sums[y, x, best - 1], sums[y, x, best], sums[y, x, best + 1]
                bend = below + above - least - least
                if bend > 0:
                    offset = np.float32(0.5) * (below - above) / bend
            disparity[y, x] = np.float32(first + best) + offset
