"""Inverse search (Kroeger et al., "Fast Optical Flow using Dense Inverse Search", ECCV 2016): where patches
of one image lie in another.

Patches of 8x8 px stand `stride` px apart; the last ones of a row or column end at the image's edge. Each is
moved by Gauss-Newton steps that use its own gradient (Baker and Matthews, IJCV 2004), so that everything but
the differences is computed once. Brightness may differ by a constant from patch to patch. Good places spread:
a patch first tries those of its neighbours. The images have borders, see `pyramid`.
"""

from typing import Any

import numpy as np
from numba import prange

from sags_node.kernels.jit import inlined, kernel, parallel_kernel, stack_floats
from sags_node.kernels.threads import thread_count
from sags_node.kernels.vectors import (
    BLOCK_WIDTH,
    LANES,
    lane_sums,
    load,
    load_block,
    spread,
    store,
    store_block,
)
from sags_node.types import F32, Bool
from sags_node.vision.pyramid import BORDER

PATCH = BLOCK_WIDTH  # px, 8: rows of a patch are those of a vector's block
COUNT = PATCH * PATCH  # px
ACROSS, DOWN = COUNT, 2 * COUNT  # where a patch's gradients begin in `S`, after the patch
BAND = 5  # rows of patches that are searched as one piece of work: places do not spread beyond it
FEWEST_PATCHES = 300  # for a thread to take: waking it takes as long as searching them
FEWEST_ROWS = 32  # of pixels, for a thread to take when patches are spread over them
CENTRE = (PATCH - 1) / 2  # px, of a patch, from its first pixel
AREA = np.float32(COUNT)
SAME_PLACE = np.float32(0.2**2)  # px squared: a neighbour's place this near to the patch's own is not tried
CONVERGED = np.float32(0.03**2)  # px squared: a shorter step is the last
NOISE = np.float32(1.0)  # added to the Hessian: a patch without texture stays where it is
CHANNELS = 4  # of a pixel while patches are spread over it: the weights' sum, and three weighted ones


def grid_shape(picture: F32, stride: int) -> tuple[int, int]:
    """Return the rows and columns of patches in an image with its border, at least as large as a patch."""
    rows, columns = (-(-(side - 2 * BORDER - PATCH) // stride) + 1 for side in picture.shape)
    return rows, columns


def centres(picture: F32, stride: int) -> tuple[F32, F32]:
    """Return column and row (px) of the middle of each patch, both [rows, columns]."""
    rows, columns = (
        np.minimum(np.arange(count) * stride, side - 2 * BORDER - PATCH) + np.float32(CENTRE)
        for count, side in zip(grid_shape(picture, stride), picture.shape, strict=True)
    )
    across, down = np.meshgrid(columns.astype(np.float32), rows.astype(np.float32))
    return across, down


def start(picture: F32, stride: int, coarse: F32, coarse_stride: float, corner: float, scale: int) -> F32:
    """Interpolate a field to search from out of a coarser one.

    Args:
        picture: the one whose patches are to be searched.
        coarse: [r, c, channels] px, of an image `scale` times smaller; its samples stand `coarse_stride` px
            apart, the first one at pixel (corner, corner).

    Returns:
        [rows, columns, channels] px.
    """
    field = np.empty((*grid_shape(picture, stride), coarse.shape[2]), np.float32)
    _start(picture, stride, coarse, np.float32(coarse_stride), np.float32(corner), scale, field)
    return field


def search(first: F32, second: F32, stride: int, begin: F32, steps: int, tether: float = 0.0) -> F32:
    """Find where the patches of `first` lie in `second`: [rows, columns, 2] px to the right and down.

    The result is the same for any number of threads.

    Args:
        stride: px from patch to patch.
        begin: [rows, columns, 2 or 3] where to search first; the third, with a tether, is the row to expect.
        steps: at most so many for a patch.
        tether: how firmly a patch is held to that row, as a share of its texture along rows. One with less
            texture across rows gives way more.
    """
    field = np.empty((*begin.shape[:2], 2), np.float32)
    settings = stride, np.float32(tether), steps
    if field[..., 0].size < 2 * FEWEST_PATCHES:
        _search_bands(first, second, begin, *settings, 0, -(-len(field) // BAND), field)
    else:
        _search(first, second, begin, *settings, field)
    return field


def at_pixels(first: F32, second: F32, stride: int, field: F32) -> F32:
    """Return the field at every pixel [H, W, 2]: the mean of its patches, weighted by their agreement."""
    flow = np.empty((first.shape[0] - 2 * BORDER, first.shape[1] - 2 * BORDER, 2), np.float32)
    bands = max(1, min(thread_count(), len(flow) // FEWEST_ROWS))
    _flow_at_pixels(first, second, stride, field, bands, flow)
    return flow


@kernel
def _start(
    picture: F32, stride: int, coarse: F32, coarse_stride: Any, corner: Any, scale: int, field: F32
) -> None:
    height, width = picture.shape[0] - 2 * BORDER, picture.shape[1] - 2 * BORDER
    half, one = np.float32(0.5), np.float32(1)
    for row in range(field.shape[0]):
        y = (min(row * stride, height - PATCH) + np.float32(CENTRE) + half) / np.float32(scale) - half
        j, b = _between((y - corner) / coarse_stride, coarse.shape[0])
        for column in range(field.shape[1]):
            x = (min(column * stride, width - PATCH) + np.float32(CENTRE) + half) / np.float32(scale) - half
            i, a = _between((x - corner) / coarse_stride, coarse.shape[1])
            right, below = min(i + 1, coarse.shape[1] - 1), min(j + 1, coarse.shape[0] - 1)
            for k in range(coarse.shape[2]):
                upper = (one - a) * coarse[j, i, k] + a * coarse[j, right, k]
                lower = (one - a) * coarse[below, i, k] + a * coarse[below, right, k]
                field[row, column, k] = np.float32(scale) * ((one - b) * upper + b * lower)


@inlined
def _between(position: Any, count: int) -> Any:
    """The sample before a position, and how far it is towards the next."""
    position = min(max(position, np.float32(0)), np.float32(count - 1))
    before = np.int64(position)
    return before, np.float32(position - np.float32(before))


@parallel_kernel
def _search(first: F32, second: F32, begin: F32, stride: int, tether: Any, steps: int, field: F32) -> None:
    for band in prange(-(-field.shape[0] // BAND)):
        item = np.int64(band)
        _search_bands(first, second, begin, stride, tether, steps, item, item + 1, field)


@kernel
def _search_bands(
    first: F32, second: F32, begin: F32, stride: int, tether: Any, steps: int, low: Any, high: Any, field: F32
) -> None:
    for band in range(low, high):
        top = band * BAND
        for row in range(top, min(top + BAND, field.shape[0])):
            for column in range(field.shape[1]):
                _search_patch(first, second, begin, stride, tether, steps, top, row, column, field)


@kernel
def _search_patch(
    first: F32, second: F32, begin: F32, stride: int, tether: Any, steps: int,
    top: int, row: int, column: int, field: F32,
) -> None:  # fmt: skip
    """Searches one patch: takes the best of its own start and its neighbours' places, then steps from there
    while they help. Patches to the left and above, from row `top` on, have been searched already."""
    S = stack_floats(192)  # 3 COUNT
    line = first.shape[1]
    x = min(column * stride, line - 2 * BORDER - PATCH) + BORDER
    y = min(row * stride, first.shape[0] - 2 * BORDER - PATCH) + BORDER
    xx, xy, yy = _prepare(first, y * line + x, S)
    hold = tether * xx
    xx += NOISE
    yy += NOISE + hold
    scale = np.float32(1) / (xx * yy - xy * xy)
    expected = begin[row, column, begin.shape[2] - 1]

    left, above = np.float32(x), np.float32(y)
    u, v = begin[row, column, 0], begin[row, column, 1]
    best = np.float32(-1)  # not known yet
    for neighbour in range(4):
        if neighbour == 0:
            other = field[row, column - 1] if column > 0 else begin[row, column]
        elif neighbour == 1:
            other = field[row - 1, column] if row > top else begin[max(row - 1, 0), column]
        elif neighbour == 2:
            other = begin[row, min(column + 1, begin.shape[1] - 1)]
        else:
            other = begin[min(row + 1, begin.shape[0] - 1), column]
        u_other, v_other = other[0], other[1]
        if (u_other - u) * (u_other - u) + (v_other - v) * (v_other - v) > SAME_PLACE:
            if best < 0:
                best = _difference(S, second, left + u, above + v)
                best += hold * (v - expected) * (v - expected)
            found = _difference(S, second, left + u_other, above + v_other)
            found += hold * (v_other - expected) * (v_other - expected)
            if found < best:
                best, u, v = found, u_other, v_other

    u_start, v_start, u_best, v_best, best = u, v, u, v, np.float32(np.inf)
    for _ in range(steps):
        along, across_rows, mean, squares = _gradient(S, second, left + u, above + v)
        found = squares - mean * mean / AREA + hold * (v - expected) * (v - expected)
        if not found < best:
            break  # the last step went too far
        best, u_best, v_best = found, u, v
        across_rows += hold * (v - expected)
        du, dv = (yy * along - xy * across_rows) * scale, (xx * across_rows - xy * along) * scale
        u, v = u - du, v - dv
        if du * du + dv * dv < CONVERGED:
            u_best, v_best = u, v
            break
    du, dv = u_best - u_start, v_best - v_start
    lost = du * du + dv * dv > AREA
    field[row, column, 0] = u_start if lost else u_best
    field[row, column, 1] = v_start if lost else v_best


@inlined
def _prepare(picture: F32, at: int, S: F32) -> Any:
    """Put the patch at an index into `S`, with its gradients less their means. Returns the Hessian of the sum
    of squares."""
    line, half, zero = picture.shape[1], np.float32(0.5), spread(np.float32(0))
    sum_x, sum_y = zero, zero
    for k in range(0, COUNT, LANES):
        pixel = at + k // PATCH * line
        across = (load_block(picture, pixel + 1, line) - load_block(picture, pixel - 1, line)) * half
        down = (load_block(picture, pixel + line, line) - load_block(picture, pixel - line, line)) * half
        store(S, k, load_block(picture, pixel, line))
        store(S, ACROSS + k, across)
        store(S, DOWN + k, down)
        sum_x, sum_y = sum_x + across, sum_y + down
    total_x, total_y = lane_sums((sum_x, sum_y))
    xx, xy, yy = zero, zero, zero
    for k in range(0, COUNT, LANES):
        across, down = load(S, ACROSS + k) - total_x / AREA, load(S, DOWN + k) - total_y / AREA
        store(S, ACROSS + k, across)
        store(S, DOWN + k, down)
        xx, xy, yy = xx + across * across, xy + across * down, yy + down * down
    return lane_sums((xx, xy, yy))


@inlined
def _place(picture: F32, x: Any, y: Any) -> Any:
    """The index of the pixel at or before (x, y), or of the nearest one from which a patch fits, and the
    bilinear weights of the four pixels around."""
    one, last = np.float32(1), PATCH + 1
    x = min(max(x, np.float32(0)), np.float32(picture.shape[1] - last) - np.float32(0.01))
    y = min(max(y, np.float32(0)), np.float32(picture.shape[0] - last) - np.float32(0.01))
    i, j = np.int64(x), np.int64(y)
    a, b = np.float32(x - np.float32(i)), np.float32(y - np.float32(j))
    both = a * b
    return j * picture.shape[1] + i, one - a - b + both, a - both, b - both, both


@inlined
def _between_pixels(picture: F32, at: int, line: int, w00: Any, w01: Any, w10: Any, w11: Any) -> Any:
    """A block of an image, each pixel interpolated from four by their weights."""
    return (
        w00 * load_block(picture, at, line)
        + w01 * load_block(picture, at + 1, line)
        + w10 * load_block(picture, at + line, line)
        + w11 * load_block(picture, at + line + 1, line)
    )


@inlined
def _difference(S: F32, picture: F32, x: Any, y: Any) -> Any:
    """Sum of squared differences, less their mean, between the patch in `S` and the 8x8 px of an image from
    (x, y) on, counted from its border's corner."""
    at, w00, w01, w10, w11 = _place(picture, x, y)
    line = picture.shape[1]
    total = squares = spread(np.float32(0))
    for k in range(0, COUNT, LANES):
        seen = _between_pixels(picture, at + k // PATCH * line, line, w00, w01, w10, w11)
        difference = seen - load(S, k)
        total, squares = total + difference, squares + difference * difference
    sum_d, sum_dd = lane_sums((total, squares))
    return sum_dd - sum_d * sum_d / AREA


@inlined
def _gradient(S: F32, picture: F32, x: Any, y: Any) -> Any:
    """Sums of these differences times the patch's gradients, of the differences, and of their squares."""
    at, w00, w01, w10, w11 = _place(picture, x, y)
    line = picture.shape[1]
    along = down = total = squares = spread(np.float32(0))
    for k in range(0, COUNT, LANES):
        seen = _between_pixels(picture, at + k // PATCH * line, line, w00, w01, w10, w11)
        difference = seen - load(S, k)
        along, down = along + load(S, ACROSS + k) * difference, down + load(S, DOWN + k) * difference
        total, squares = total + difference, squares + difference * difference
    return lane_sums((along, down, total, squares))


@parallel_kernel
def _flow_at_pixels(first: F32, second: F32, stride: int, field: F32, bands: int, flow: F32) -> None:
    for k in prange(bands):
        band, rows = np.int64(k), flow.shape[0]
        _flow_rows(first, second, stride, field, rows * band // bands, rows * (band + 1) // bands, flow)


@kernel
def _flow_rows(first: F32, second: F32, stride: int, field: F32, low: int, high: int, flow: F32) -> None:
    width = flow.shape[1]
    planes = np.empty((3, high - low, width), np.float32)
    spread_patches(first, second, stride, field, field[..., 0] == field[..., 0], low, planes)
    for y in range(high - low):
        for x in range(width):
            flow[low + y, x, 0] = planes[0, y, x]
            flow[low + y, x, 1] = planes[1, y, x]


@kernel
def spread_patches(
    first: F32, second: F32, stride: int, field: F32, good: Bool, low: int, planes: F32
) -> None:
    """Average the patches over each pixel, weighted by how well each agrees there.

    Args:
        good: [rows, columns] of the patches.
        low: the first row of pixels that is wanted.
        planes: [3, rows, W] of these rows: px right and down, share of good patches.
    """
    line, height = first.shape[1], first.shape[0] - 2 * BORDER
    high = low + planes.shape[1]
    sums = np.zeros((PATCH, CHANNELS, line), np.float32)  # of the rows of pixels under one row of patches
    begin = -1  # the first of them
    for row in range(field.shape[0]):
        top = min(row * stride, height - PATCH)
        if top + PATCH <= low or top >= high:
            continue
        if begin >= 0:
            _write_means(sums, begin, top - begin, low, planes)
            _move_up(sums, top - begin)
        begin = top
        for column in range(field.shape[1]):
            left = min(column * stride, line - 2 * BORDER - PATCH)
            u, v = field[row, column, 0], field[row, column, 1]
            _add_patch(first, second, left, top, u, v, np.float32(good[row, column]), sums)
    _write_means(sums, begin, PATCH, low, planes)


@kernel
def _add_patch(first: F32, second: F32, left: int, top: int, u: Any, v: Any, good: Any, sums: F32) -> None:
    """Adds to `sums` the weight of each pixel of a patch, and the weight times right, down and good."""
    S = stack_floats(64)  # COUNT
    line, one = first.shape[1], np.float32(1)
    at, w00, w01, w10, w11 = _place(second, np.float32(left + BORDER) + u, np.float32(top + BORDER) + v)
    own = (top + BORDER) * line + left + BORDER
    total = squares = spread(np.float32(0))
    for k in range(0, COUNT, LANES):
        rows = k // PATCH * line
        seen = _between_pixels(second, at + rows, line, w00, w01, w10, w11)
        difference = seen - load_block(first, own + rows, line)
        store(S, k, difference)
        total, squares = total + difference, squares + difference * difference
    sum_d, sum_dd = lane_sums((total, squares))
    whole = one / np.sqrt(one + (sum_dd - sum_d * sum_d / AREA) / AREA)
    for k in range(0, COUNT, LANES):
        off = load(S, k) - sum_d / AREA
        weight = whole / (off * off + one)
        to, below = left + k // PATCH * CHANNELS * line, CHANNELS * line
        _add(sums, to, below, weight)
        _add(sums, to + line, below, weight * u)
        _add(sums, to + 2 * line, below, weight * v)
        _add(sums, to + 3 * line, below, weight * good)


@inlined
def _add(sums: F32, to: int, below: int, value: Any) -> None:
    store_block(sums, to, below, load_block(sums, to, below) + value)


@kernel
def _write_means(sums: F32, begin: int, count: int, low: int, planes: F32) -> None:
    width = planes.shape[2]
    for k in range(max(count, 0)):
        y = begin + k - low
        if 0 <= y < planes.shape[1]:
            for x in range(width):
                scale = np.float32(1) / sums[k, 0, x]
                for channel in range(CHANNELS - 1):
                    planes[channel, y, x] = sums[k, channel + 1, x] * scale


@kernel
def _move_up(sums: F32, count: int) -> None:
    for k in range(PATCH):
        for channel in range(CHANNELS):
            if k + count < PATCH:
                sums[k, channel] = sums[k + count, channel]
            else:
                sums[k, channel] = 0
