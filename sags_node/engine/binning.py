"""From splats to depth-sorted lists of splats per tile."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np

from sags_node.engine.jit import inlined, kernel, parallel_kernel, prefetch_read, prefetch_write, square_root
from sags_node.types import F32

f4 = np.float32
ZERO, HALF, ONE = f4(0.0), f4(0.5), f4(1.0)
ROW_SLACK = f4(0.001)  # px: rounding must not lose a row
AHEAD = 12  # how far ahead records are prefetched
DIGIT_BITS = 12
DIGITS = 1 << DIGIT_BITS
Int32 = np.ndarray[Any, np.dtype[np.int32]]
Int64 = np.ndarray[Any, np.dtype[np.int64]]


@kernel
def sort_by_depth(depths: F32, order: Int32, spare_order: Int32, keys: Int32, spare_keys: Int32) -> None:
    """Stable radix sort: `order` becomes the indices of `depths` [N] from near to far.

    Positive floats sort like their bits. Depths of 0 (not drawn) come first, before any pair is made of them.
    """
    count = depths.size
    bits = depths.view(np.int32)
    smallest, largest = np.int32(0x7FFFFFFF), np.int32(0)
    for i in range(count):
        if bits[i] > 0:
            smallest = min(smallest, bits[i])
            largest = max(largest, bits[i])
    for i in range(count):
        keys[i] = max(bits[i] - smallest, np.int32(0))
        order[i] = i
    span = largest - smallest
    starts = np.empty(DIGITS + 1, np.int32)
    shift = 0
    swapped = False
    while span > 0 and shift < 32 and (span >> shift) > 0:
        if swapped:
            from_keys, to_keys, from_order, to_order = spare_keys, keys, spare_order, order
        else:
            from_keys, to_keys, from_order, to_order = keys, spare_keys, order, spare_order
        starts[:] = 0
        for i in range(count):
            starts[((from_keys[i] >> shift) & (DIGITS - 1)) + 1] += 1
        for digit in range(DIGITS):
            starts[digit + 1] += starts[digit]
        for i in range(count):
            digit = (from_keys[i] >> shift) & (DIGITS - 1)
            place = starts[digit]
            starts[digit] = place + 1
            to_keys[place] = from_keys[i]
            to_order[place] = from_order[i]
        swapped = not swapped
        shift += DIGIT_BITS
    if swapped:
        order[:] = spare_order


@inlined
def _whole(value: Any, low: int, high: int) -> Any:
    """A float as an integer, held in a range first: a far-off float does not fit an integer."""
    return np.int64(min(max(value, f4(low)), f4(high)))


@parallel_kernel
def emit_pairs(
    splats: Any,  # [N] SPLAT
    order: Int32,  # [N] near to far
    width: int,
    height: int,
    tile_width_bits: int,  # tiles are 2**bits px
    tile_height_bits: int,
    emitted: Any,  # EMITTED, one equal part per worker, written
    histogram: Int32,  # [workers, tiles] pairs per tile, written
    emitted_counts: Int64,  # [workers] written
    first_slots: Int32,  # [N] index of a Gaussian's first pair among its worker's, written
    slot_counts: Int32,  # [N] number of its pairs, written
) -> None:
    """Find the tiles and rows that each splat touches. Each worker takes a contiguous part of the order.

    A worker whose part of `emitted` is full only goes on counting: `emitted_counts` then says what is needed.
    """
    count = order.size
    workers = histogram.shape[0]
    room = emitted.size // workers
    tile_width, tile_height = 1 << tile_width_bits, 1 << tile_height_bits
    tiles_x = (width + tile_width - 1) >> tile_width_bits
    for worker in numba.prange(workers):
        part = emitted[worker * room : (worker + 1) * room]
        tile_counts = histogram[worker]
        tile_counts[:] = 0
        n = np.int64(0)
        end = count * (worker + 1) // workers
        for position in range(count * worker // workers, end):
            index = order[position]
            if position + AHEAD < end:
                soon = order[position + AHEAD]
                prefetch_read(splats, soon)
                prefetch_write(first_slots, soon)
                prefetch_write(slot_counts, soon)
            first_slots[index] = n
            slot_counts[index] = 0
            splat = splats[index]
            extent = splat.extent
            if extent <= ZERO:
                continue
            # u^2 + v^2 <= extent with u = a dx + b dy, v = c dy
            mean_x, mean_y = splat.mean_x, splat.mean_y
            a, b, c = splat.whiten_xx, splat.whiten_xy, splat.whiten_yy
            ab, ac, bb_cc = a * b, a * c, b * b + c * c
            inverse = ONE / bb_cc
            radius_x = square_root(extent * bb_cc) / ac
            radius_y = square_root(extent) / c
            x_first = _whole(np.ceil(mean_x - radius_x - HALF), 0, width)
            x_last = _whole(np.floor(mean_x + radius_x - HALF), -1, width - 1)
            y_first = _whole(np.ceil(mean_y - radius_y - HALF), 0, height)
            y_last = _whole(np.floor(mean_y + radius_y - HALF), -1, height - 1)
            if x_first > x_last or y_first > y_last:
                continue
            begin = n
            lowest_dx = -b / a * radius_y  # where the ellipse reaches dy = radius_y
            for column in range(x_first >> tile_width_bits, (x_last >> tile_width_bits) + 1):
                left = max(f4(column * tile_width) + HALF - mean_x, -radius_x)
                right = min(f4((column + 1) * tile_width) - HALF - mean_x, radius_x)
                # the largest and smallest dy of the ellipse over this column of tiles
                dx = min(max(lowest_dx, left), right)
                bottom = (square_root(max(bb_cc * extent - ac * ac * dx * dx, ZERO)) - ab * dx) * inverse
                dx = min(max(-lowest_dx, left), right)
                top = -(square_root(max(bb_cc * extent - ac * ac * dx * dx, ZERO)) + ab * dx) * inverse
                row_first = max(y_first, _whole(np.ceil(mean_y + top - HALF - ROW_SLACK), 0, height))
                row_last = min(y_last, _whole(np.floor(mean_y + bottom - HALF + ROW_SLACK), -1, height - 1))
                if row_first > row_last:
                    continue
                for row in range(row_first >> tile_height_bits, (row_last >> tile_height_bits) + 1):
                    if n < room:
                        tile = row * tiles_x + column
                        tile_counts[tile] += 1
                        pair = part[n]
                        pair.tile = tile
                        pair.splat = index
                        pair.row_begin = max(row_first - row * tile_height, 0)
                        pair.row_end = min(row_last - row * tile_height + 1, tile_height)
                    n += 1
            slot_counts[index] = n - begin
        emitted_counts[worker] = n


@parallel_kernel
def sort_into_tiles(
    emitted: Any,  # EMITTED, of `emit_pairs`, as the next four
    histogram: Int32,  # used up
    emitted_counts: Int64,
    order: Int32,
    first_slots: Int32,  # made to count over all workers
    pairs: Any,  # PAIR, written: tile after tile, near to far within each
    tile_starts: Int32,  # [tiles + 1] written
) -> None:
    """Stable counting sort: the result does not depend on the number of workers."""
    count = order.size
    workers, tiles = histogram.shape
    room = emitted.size // workers
    total = np.int32(0)
    for tile in range(tiles):
        tile_starts[tile] = total
        for worker in range(workers):
            here = histogram[worker, tile]
            histogram[worker, tile] = total
            total += here
    tile_starts[tiles] = total
    for worker in numba.prange(workers):
        part = emitted[worker * room : (worker + 1) * room]
        places = histogram[worker]
        before = np.int64(0)
        for other in range(worker):
            before += emitted_counts[other]
        for n in range(emitted_counts[worker]):
            source = part[n]
            place = places[source.tile]
            places[source.tile] = place + 1
            pair = pairs[place]
            pair.splat = source.splat
            pair.slot = before + n
            pair.row_begin = source.row_begin
            pair.row_end = source.row_end
        if before > 0:
            for position in range(count * worker // workers, count * (worker + 1) // workers):
                first_slots[order[position]] += before
