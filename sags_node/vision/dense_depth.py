"""From matches to the depth of every pixel of the working image.

Each thread takes a band of rows, with as many around it as its windows need, through all stages: to pass
whole images from stage to stage would take longer than to compute them. The result is the same for any
number of threads.
"""

from typing import Any

import numpy as np
from numba import prange

from sags_node.kernels.jit import kernel, parallel_kernel
from sags_node.kernels.threads import thread_count
from sags_node.kernels.vectors import larger, load_anywhere, select, spread, store_anywhere
from sags_node.types import F32, Bool
from sags_node.vision import agreement
from sags_node.vision.agreement import correlate, drop_wrong
from sags_node.vision.inverse_search import spread_patches
from sags_node.vision.matchers import Patches
from sags_node.vision.pyramid import BORDER
from sags_node.vision.windows import chunk, chunks, inside, repeat_ends, window_row

FEWEST_ROWS = 32  # of a band
EDGE = np.float32(0.01)  # px kept from the last pixel, so that one beyond can be read
HALF = np.float32(0.5)  # of a pixel's neighbours, by weight, must have a disparity
SMOOTHING_VARIANCE = np.float32(0.2)  # px squared: disparity that varies less is noise on a smooth surface


def depth_of_patches(
    patches: Patches,
    clear: Bool,
    size: tuple[int, ...],
    disparities: tuple[float, float],
    radius: int,
    focal_baseline: float,
) -> tuple[F32, F32]:
    """Compute depth (m, 0 unknown) and confidence [H, W] (0..1, 0 where the depth is unknown).

    Args:
        clear: [h, w] pixels of the matching image for which depth is wanted.
        size: width and height of the result, px; a multiple of the matching image's, plus a remainder.
        disparities: the smallest and the largest that are possible, px.
        radius: px, of the smoothing.
        focal_baseline: px m, of the matching image.
    """
    depth, trust = np.empty((2, size[1], size[0]), np.float32)
    rows = len(clear)
    bands = max(1, min(thread_count(), rows // FEWEST_ROWS))
    limits = np.array([*disparities, focal_baseline], np.float32)
    _bands(*patches, clear, limits, radius, bands, depth, trust)
    return depth, trust


def depth_of_pixels(
    left: F32,
    seen: F32,
    disparity: F32,
    known: Bool,
    clear: Bool,
    size: tuple[int, ...],
    disparities: tuple[float, float],
    focal_baseline: float,
) -> tuple[F32, F32]:
    """Do the same from a disparity at every pixel of the matching image [h, w] where it is `known`.

    Args:
        left: the matching image with its border.
        seen: [h, w] the right image, warped by the disparity to the left one.
    """
    depth, trust = np.empty((2, size[1], size[0]), np.float32)
    limits = np.array([*disparities, focal_baseline], np.float32)
    _finish(left, seen, disparity, known.astype(np.float32), clear, limits, 0, 0, len(clear), depth, trust)
    return depth, trust


@parallel_kernel
def _bands(
    left: F32, right: F32, stride: int, field: F32, good: Bool, clear: Bool, limits: F32,
    radius: int, bands: int, depth: F32, trust: F32,
) -> None:  # fmt: skip
    for k in prange(bands):
        band, rows = np.int64(k), clear.shape[0]
        _band(
            left, right, stride, field, good, clear, limits, radius,
            rows * band // bands, rows * (band + 1) // bands, depth, trust,
        )  # fmt: skip


@kernel
def _band(
    left: F32, right: F32, stride: int, field: F32, good: Bool, clear: Bool, limits: F32,
    radius: int, low: int, high: int, depth: F32, trust: F32,
) -> None:  # fmt: skip
    margin = 2 * radius + agreement.RADIUS + 1  # one for the rows between which depth is interpolated
    begin, end = max(low - margin, 0), min(high + margin, clear.shape[0])
    height, width = end - begin, clear.shape[1]
    planes = np.empty((3, height, width), np.float32)
    spread_patches(left, right, stride, field, good, begin, planes)
    right_by, down, share = planes[0], planes[1], planes[2]
    for y in range(height):
        for x in range(width):
            right_by[y, x] = -right_by[y, x]
    disparity = np.empty((height, width), np.float32)
    guided(right_by, radius, SMOOTHING_VARIANCE, disparity)
    seen = right_by  # no longer needed
    _fetch(right, disparity, down, begin, seen)
    rows = left[begin : end + 2 * BORDER]
    _finish(
        rows, seen, disparity, share, clear[begin:end], limits, begin, low, high, depth, trust,
    )  # fmt: skip


@kernel
def _fetch(right: F32, disparity: F32, down: F32, begin: int, seen: F32) -> None:
    """The right image, warped by the matches to the left one, from row `begin` on."""
    one, border = np.float32(1), np.float32(BORDER)
    last_x, last_y = np.float32(right.shape[1] - 1) - EDGE, np.float32(right.shape[0] - 1) - EDGE
    for y in range(disparity.shape[0]):
        for x in range(disparity.shape[1]):
            u = min(max(np.float32(x) + border - disparity[y, x], np.float32(0)), last_x)
            v = min(max(np.float32(begin + y) + border + down[y, x], np.float32(0)), last_y)
            i, j = np.uint64(u), np.uint64(v)
            a, b = u - np.float32(i), v - np.float32(j)
            upper = (one - a) * right[j, i] + a * right[j, i + np.uint64(1)]
            lower = (one - a) * right[j + np.uint64(1), i] + a * right[j + np.uint64(1), i + np.uint64(1)]
            seen[y, x] = (one - b) * upper + b * lower


@kernel
def _finish(
    left: F32, seen: F32, disparity: F32, good: F32, clear: Bool, limits: F32,
    begin: int, low: int, high: int, depth: F32, trust: F32,
) -> None:  # fmt: skip
    """Depth and trust of rows `low` to `high` of the matching image; inputs begin at row `begin`."""
    believed, found = np.empty((2, *disparity.shape), np.float32)
    correlate(left, seen, found)
    drop_wrong(found, disparity, good, limits[0], limits[1], believed)
    for y in range(disparity.shape[0]):
        for x in range(disparity.shape[1]):
            if not clear[y, x]:
                believed[y, x] = 0
    _enlarge(disparity, believed, limits[2], begin, low, high, depth, trust)


@kernel
def _enlarge(
    disparity: F32,
    believed: F32,
    focal_baseline: Any,
    begin: int,
    low: int,
    high: int,
    depth: F32,
    trust: F32,
) -> None:
    """Interpolates disparity, which is linear on a plane, between known neighbours; turns it into depth."""
    height, width = disparity.shape
    scale = depth.shape[1] // width
    line = width + 2
    between = np.empty(
        3 * line, np.float32
    )  # a row of weights times disparity, weights, trust; ends repeated
    found = np.empty((2, scale * width), np.float32)  # a row of either result, phase by phase
    spare = np.empty(scale * width, np.float32)
    zero, one = np.float32(0), np.float32(1)
    last = high * scale if high < depth.shape[0] // scale else depth.shape[0]
    for row in range(low * scale, last):
        y = (np.float32(row) + HALF) / np.float32(scale) - HALF - np.float32(begin)
        above = np.int64(np.floor(y))
        b = np.float32(y - np.float32(above))
        above, below = inside(above, height), inside(above + 1, height)
        upper, lower = one - b, b
        for i in range(chunks(width)):
            x = chunk(i, width)
            p, q = load_anywhere(believed, above * width + x), load_anywhere(believed, below * width + x)
            v, w = select(p > zero, upper, zero), select(q > zero, lower, zero)
            far = w * load_anywhere(disparity, below * width + x)
            store_anywhere(between, x + 1, v * load_anywhere(disparity, above * width + x) + far)
            store_anywhere(between, line + x + 1, v + w)
            store_anywhere(between, 2 * line + x + 1, upper * p + lower * q)
        for k in range(3):
            between[k * line] = between[k * line + 1]
            between[k * line + line - 1] = between[k * line + line - 2]
        for phase in range(scale):
            a = (np.float32(phase) + HALF) / np.float32(scale) - HALF
            side = 0 if a < 0 else 2
            near, far = one - abs(a), abs(a)
            for i in range(chunks(width)):
                x = chunk(i, width)
                total = near * load_anywhere(between, x + 1) + far * load_anywhere(between, x + side)
                at = line + x
                weight = near * load_anywhere(between, at + 1) + far * load_anywhere(between, at + side)
                at += line
                mean = near * load_anywhere(between, at + 1) + far * load_anywhere(between, at + side)
                known = weight > HALF
                distance = focal_baseline * weight / select(known, total, one)
                store_anywhere(found, phase * width + x, select(known, distance, zero))
                store_anywhere(found, (scale + phase) * width + x, select(known, mean, zero))
        _interleave(found[0], scale, spare, depth[row])
        _interleave(found[1], scale, spare, trust[row])


@kernel
def _interleave(phases: F32, count: int, spare: F32, row: F32) -> None:
    """row[count x + k] = phases[k n + x] for `count` stretches of n samples; `count` is a power of two. The
    rest of the row repeats its last sample. `phases` and `spare` are overwritten."""
    length = phases.size // count
    while count > 1:
        count //= 2
        for k in range(count):
            _zip(
                phases[k * length : (k + 1) * length],
                phases[(k + count) * length : (k + count + 1) * length],
                spare[2 * k * length : 2 * (k + 1) * length],
            )
        phases, spare = spare, phases
        length *= 2
    row[:length] = phases
    row[length:] = phases[length - 1]


@kernel
def _zip(even: F32, odd: F32, row: F32) -> None:
    two, one = np.uint64(2), np.uint64(1)
    for i in range(even.size):
        x = np.uint64(i)
        row[two * x] = even[x]
        row[two * x + one] = odd[x]


@kernel
def guided(field: F32, radius: int, variance: Any, smooth: F32) -> None:
    """Smooth a field [h, w] by the guided filter (He et al., PAMI 2013), with the field as its own guide.

    Planes and steps larger than the noise stay as they are.

    Args:
        field: contiguous, at least 16 px wide; its edge is repeated.
        radius: px, of the windows.
        variance: float32; a field that varies less within a window is taken for noise.
        smooth: [h, w] result.
    """
    height, width = field.shape
    line = width + 2 * radius
    # The filter's coefficients: smooth = mean(kept) * field + mean(rest).
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
