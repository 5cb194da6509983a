"""From splats to depth-sorted lists of splats per tile.

With C cameras there are C N splats, camera after camera, and C times the tiles of a picture; a splat only
meets the tiles of its own camera. All are sorted together: what is in order is also in order within a camera.
"""

from __future__ import annotations

from typing import Any

import numba
import numpy as np

from sags_node.kernels.jit import (
    inlined,
    kernel,
    parallel_kernel,
    prefetch_read,
    prefetch_write,
    round_down,
    round_up,
    square_root,
    take,
)
from sags_node.types import F32, I32, I64, Bool

f4 = np.float32
ZERO, HALF, ONE = f4(0.0), f4(0.5), f4(1.0)
ROW_SLACK = f4(0.001)  # px: rounding must not lose a row
BLOCK = 64  # splats that are looked at in one go
CHUNK = 1024  # slots that a worker reserves at a time
AHEAD = 12  # how far ahead records are prefetched
DIGIT_BITS = 12
DIGITS = 1 << DIGIT_BITS


@inlined
def _up(value: Any, low: int, high: int) -> Any:
    """Rounded up to an integer, held in a range first: a far-off float does not fit an integer."""
    return np.int64(round_up(min(max(value, f4(low)), f4(high))))


@inlined
def _down(value: Any, low: int, high: int) -> Any:
    return np.int64(round_down(min(max(value, f4(low)), f4(high))))


@inlined
def _pixels(mean: Any, radius: Any, size: int) -> Any:
    """First and last pixel of the picture whose centre lies within `radius` of `mean`; where there is none
    the first is larger."""
    return _up(mean - radius - HALF, 0, size), _down(mean + radius - HALF, -1, size - 1)


@inlined
def _box(splat: Any, width: int, height: int, tile_width_bits: int, tile_height_bits: int) -> Any:
    """Half the width and height, px, of the ellipse on which a splat's alpha is 1/255, and the tiles that its
    box touches: first column and one after the last, then rows; none where the box lies outside."""
    a, b, c = splat.whiten_xx, splat.whiten_xy, splat.whiten_yy
    radius_x = square_root(splat.extent * (b * b + c * c)) / (a * c)
    radius_y = square_root(splat.extent) / c
    x_first, x_last = _pixels(splat.mean_x, radius_x, width)
    y_first, y_last = _pixels(splat.mean_y, radius_y, height)
    left, right = x_first >> tile_width_bits, (x_last >> tile_width_bits) + 1
    top, bottom = y_first >> tile_height_bits, (y_last >> tile_height_bits) + 1
    if x_first > x_last or y_first > y_last:
        right, bottom = left, top
    return radius_x, radius_y, left, right, top, bottom


@kernel
def _drop_block(
    splats: Any, depths: F32, first: int, last: int, sums: I32, first_sum: int, width: int, height: int,
    tile_width_bits: int, tile_height_bits: int,
) -> None:  # fmt: skip
    row = ((width + (1 << tile_width_bits) - 1) >> tile_width_bits) + 1  # of the integral picture
    for i in range(first, last):
        splat = splats[i]
        if splat.extent > ZERO:
            _, _, left, right, top, bottom = _box(splat, width, height, tile_width_bits, tile_height_bits)
            upper, lower = first_sum + top * row, first_sum + bottom * row
            if sums[lower + right] - sums[lower + left] == sums[upper + right] - sums[upper + left]:
                splat.extent = ZERO
                depths[i] = ZERO


@parallel_kernel
def drop_untouched(
    splats: Any,  # [C N] SPLAT; extent made 0 where no active tile is touched
    depths: F32,  # [C N] likewise
    cameras: int,  # C
    active_sums: I32,  # [C (tile rows + 1) (tile columns + 1)] integral pictures of the active tiles
    width: int,
    height: int,
    tile_width_bits: int,  # tiles are 2**bits px
    tile_height_bits: int,
) -> None:
    """Take out what meets no active tile, before it costs more than this look at its box."""
    count, area = splats.size // cameras, active_sums.size // cameras
    blocks = (count + BLOCK - 1) // BLOCK  # of one camera
    for n in numba.prange(cameras * blocks):
        first = n // blocks * count
        _drop_block(
            splats, depths, first + n % blocks * BLOCK, min(first + (n % blocks + 1) * BLOCK, first + count),
            active_sums, n // blocks * area, width, height, tile_width_bits, tile_height_bits,
        )  # fmt: skip


@kernel
def sort_by_depth(depths: F32, order: I32, spare_order: I32, keys: I32, spare_keys: I32) -> int:
    """Stable radix sort: `order` begins with the indices of the `depths` [C N] above 0, from near to far.
    Returns how many those are. Positive floats sort like their bits."""
    bits = depths.view(np.int32)
    kept = 0
    smallest, largest = np.int32(0x7FFFFFFF), np.int32(0)
    for i in range(bits.size):
        if bits[i] > 0:
            keys[kept] = bits[i]
            order[kept] = i
            kept += 1
            smallest = min(smallest, bits[i])
            largest = max(largest, bits[i])
    span = largest - smallest
    starts = np.empty(DIGITS + 1, np.int32)
    shift = 0
    swapped = False
    while kept > 0 and shift < 32 and (span >> shift) > 0:
        if swapped:
            from_keys, to_keys, from_order, to_order = spare_keys, keys, spare_order, order
        else:
            from_keys, to_keys, from_order, to_order = keys, spare_keys, order, spare_order
        starts[:] = 0
        for i in range(kept):
            starts[(((from_keys[i] - smallest) >> shift) & (DIGITS - 1)) + 1] += 1
        for digit in range(DIGITS):
            starts[digit + 1] += starts[digit]
        for i in range(kept):
            digit = ((from_keys[i] - smallest) >> shift) & (DIGITS - 1)
            place = starts[digit]
            starts[digit] = place + 1
            to_keys[place] = from_keys[i]
            to_order[place] = from_order[i]
        swapped = not swapped
        shift += DIGIT_BITS
    if swapped:
        order[:kept] = spare_order[:kept]
    return kept


@inlined
def _find_spans(
    splat: Any, width: int, height: int, tile_width_bits: int, tile_height_bits: int, spans: I32, n: int
) -> Any:
    """Write the first and last row of a splat in each column of tiles to `spans` [n:, 2]. Returns the first
    column, one after the last, and the number of tiles that its box touches."""
    radius_x, radius_y, left, right, top, bottom = _box(
        splat, width, height, tile_width_bits, tile_height_bits
    )
    tile_width = 1 << tile_width_bits
    mean_x, mean_y, extent = splat.mean_x, splat.mean_y, splat.extent
    y_first, y_last = _pixels(mean_y, radius_y, height)
    # u^2 + v^2 <= extent with u = a dx + b dy, v = c dy
    a, b, c = splat.whiten_xx, splat.whiten_xy, splat.whiten_yy
    ab, ac, bb_cc = a * b, a * c, b * b + c * c
    inverse = ONE / bb_cc
    lowest_dx = -b / a * radius_y  # where the ellipse reaches dy = radius_y
    for column in range(left, right):
        low = max(f4(column * tile_width) + HALF - mean_x, -radius_x)
        high = min(f4((column + 1) * tile_width) - HALF - mean_x, radius_x)
        # the largest and smallest dy of the ellipse over this column of tiles
        dx = min(max(lowest_dx, low), high)
        below = (square_root(max(bb_cc * extent - ac * ac * dx * dx, ZERO)) - ab * dx) * inverse
        dx = min(max(-lowest_dx, low), high)
        above = -(square_root(max(bb_cc * extent - ac * ac * dx * dx, ZERO)) + ab * dx) * inverse
        spans[n, 0] = max(y_first, _up(mean_y + above - HALF - ROW_SLACK, 0, height))
        spans[n, 1] = min(y_last, _down(mean_y + below - HALF + ROW_SLACK, -1, height - 1))
        n += 1
    return left, right, (right - left) * (bottom - top)


@kernel
def _emit_parts(
    splats: Any, order: I32, cameras: int, active: Bool, width: int, height: int, tile_width_bits: int,
    tile_height_bits: int, emitted: Any, slots: Any, reserved: I64, histogram: I32, next_part: I64,
) -> None:  # fmt: skip
    """First all of a block's rows, then its pairs: with both in one loop the processor would wait for every
    square root before it knows where to go on."""
    count, tiles = splats.size // cameras, active.size // cameras
    tile_height = 1 << tile_height_bits
    tiles_x = (width + (1 << tile_width_bits) - 1) >> tile_width_bits
    boxes, spans = np.empty((BLOCK, 3), np.int32), np.empty((BLOCK * tiles_x, 2), np.int32)
    slot: Any = 0
    limit: Any = 0
    while True:
        part = take(next_part, 1)
        if part >= histogram.shape[0]:
            break
        counts = histogram[part]
        counts[:] = 0
        end = order.size * (part + 1) // histogram.shape[0]
        for begin in range(order.size * part // histogram.shape[0], end, BLOCK):
            last = min(begin + BLOCK, end)
            n = 0
            for position in range(begin, last):
                if position + AHEAD < end:
                    prefetch_read(splats, order[position + AHEAD])
                    prefetch_write(slots, order[position + AHEAD])
                left, right, touched = _find_spans(
                    splats[order[position]], width, height, tile_width_bits, tile_height_bits, spans, n
                )
                boxes[position - begin, 0] = left
                boxes[position - begin, 1] = right
                boxes[position - begin, 2] = touched
                n += right - left
            n = 0
            for position in range(begin, last):
                i = order[position]
                left, right = boxes[position - begin, 0], boxes[position - begin, 1]
                needed = boxes[position - begin, 2]
                if slot + needed > limit:
                    # where a worker's slots lie depends on who comes first; what becomes of them does not
                    limit = needed if needed > CHUNK else CHUNK
                    slot = take(reserved, limit)
                    limit += slot
                if limit > emitted.size:  # no room: only go on counting what is needed
                    slot += needed
                    n += right - left
                    continue
                first = slot
                first_tile = i // count * tiles
                for column in range(left, right):
                    row_first, row_last = spans[n, 0], spans[n, 1]
                    n += 1
                    if row_first > row_last:
                        continue
                    for row in range(row_first >> tile_height_bits, (row_last >> tile_height_bits) + 1):
                        tile = first_tile + row * tiles_x + column
                        if active[tile]:
                            pair = emitted[slot]
                            pair.tile = tile
                            pair.row_begin = max(row_first - row * tile_height, 0)
                            pair.row_end = min(row_last - row * tile_height + 1, tile_height)
                            counts[tile] += 1
                            slot += 1
                slots[i].first = first
                slots[i].count = slot - first
                if slot == first:
                    splats[i].extent = ZERO


@parallel_kernel
def emit_pairs(
    splats: Any,  # [C N] SPLAT; extent made 0 where no pair is found
    order: I32,  # what is drawn, near to far
    cameras: int,  # C
    active: Bool,  # [C tiles] True: this tile is drawn
    width: int,
    height: int,
    tile_width_bits: int,
    tile_height_bits: int,
    workers: int,
    emitted: Any,  # EMITTED, written, with gaps
    slots: Any,  # [C N] SLOTS, written for what is drawn: where a splat's pairs stand
    reserved: I64,  # [1] written: how many of `emitted` are needed; if that is more than it has, call again
    histogram: I32,  # [parts, C tiles] pairs per tile of each part of the order, written
    next_part: I64,  # [1] for the workers
) -> None:
    """Find the tiles and rows that each splat touches."""
    reserved[0] = 0
    next_part[0] = 0
    for _ in numba.prange(workers):
        _emit_parts(
            splats, order, cameras, active, width, height, tile_width_bits, tile_height_bits, emitted, slots,
            reserved, histogram, next_part,
        )  # fmt: skip


@kernel
def _place_parts(emitted: Any, slots: Any, order: I32, histogram: I32, pairs: Any, next_part: I64) -> None:
    parts = histogram.shape[0]
    while True:
        part = take(next_part, 1)
        if part >= parts:
            break
        places = histogram[part]
        end = order.size * (part + 1) // parts
        for position in range(order.size * part // parts, end):
            if position + AHEAD < end:
                prefetch_read(slots, order[position + AHEAD])
            i = order[position]
            first = slots[i].first
            for slot in range(first, first + slots[i].count):
                source = emitted[slot]
                place = places[source.tile]
                places[source.tile] = place + 1
                pair = pairs[place]
                pair.splat = i
                pair.slot = slot
                pair.row_begin = source.row_begin
                pair.row_end = source.row_end


@parallel_kernel
def sort_into_tiles(
    workers: int,
    order: I32,
    emitted: Any,  # EMITTED, of `emit_pairs`, as the next two
    slots: Any,
    histogram: I32,  # used up
    pairs: Any,  # PAIR, written: tile after tile, near to far within each
    tile_starts: I32,  # [C tiles + 1] written
    next_part: I64,  # [1] for the workers
) -> None:
    """Stable counting sort: the result does not depend on the number of parts."""
    parts, tiles = histogram.shape
    total = np.int32(0)
    for tile in range(tiles):
        tile_starts[tile] = total
        for part in range(parts):
            here = histogram[part, tile]
            histogram[part, tile] = total
            total += here
    tile_starts[tiles] = total
    next_part[0] = 0
    for _ in numba.prange(workers):
        _place_parts(emitted, slots, order, histogram, pairs, next_part)
