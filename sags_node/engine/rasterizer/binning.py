"""From splats to depth-sorted lists of splats per tile."""

from typing import Any

import numba
import numpy as np

from sags_node.engine.rasterizer.layout import COLUMNS
from sags_node.kernels.jit import (
    inlined,
    kernel,
    parallel_kernel,
    prefetch_read,
    prefetch_write,
    round_down,
    round_up,
    take,
)
from sags_node.kernels.vectors import (
    BLOCK_WIDTH,
    LANES,
    half_lanes,
    half_signs,
    larger,
    round_downs,
    select,
    smaller,
    square_roots,
    store_integers,
)
from sags_node.types import F32, I32, I64, Bool

f4 = np.float32
ZERO, HALF, ONE = f4(0.0), f4(0.5), f4(1.0)
ROW_SLACK = f4(0.001)  # px: rounding must not lose a row
BLOCK = 64  # splats that are looked at in one go
AT_ONCE = LANES // 2  # 8 px wide columns of a splat that are looked at in one go
CHUNK = 1024  # slots that a worker reserves at a time
AHEAD = 12  # splats between prefetch and use
DIGIT_BITS = 12
DIGITS = 1 << DIGIT_BITS


@inlined
def _up(value: Any, low: int, high: int) -> Any:
    """Clamp to a range, then round up: a float far outside it would not fit an integer."""
    return np.int64(round_up(min(max(value, f4(low)), f4(high))))


@inlined
def _down(value: Any, low: int, high: int) -> Any:
    return np.int64(round_down(min(max(value, f4(low)), f4(high))))


@inlined
def _pixels(mean: Any, radius: Any, size: int) -> Any:
    """First and last pixel of the image whose centre lies within `radius` of `mean`; where there is none
    the first is larger."""
    return _up(mean - radius - HALF, 0, size), _down(mean + radius - HALF, -1, size - 1)


@inlined
def _box(splat: Any, width: int, height: int, tile_width_bits: int) -> Any:
    """Return what a splat's bounding box touches: the first column of tiles and one after the last; the first
    and last row of pixels. Both ranges are empty if the box lies outside the image."""
    x_first, x_last = _pixels(splat.mean_x, splat.reach_x, width)
    y_first, y_last = _pixels(splat.mean_y, splat.reach_y, height)
    left, right = x_first >> tile_width_bits, (x_last >> tile_width_bits) + 1
    if x_first > x_last or y_first > y_last:
        right, y_last = left, y_first - 1
    return left, right, y_first, y_last


@kernel
def _drop_block(
    splats: Any, depths: F32, first: int, last: int, sums: I32, width: int, height: int, tile_width_bits: int,
    tile_height_bits: int,
) -> None:  # fmt: skip
    row = ((width + (1 << tile_width_bits) - 1) >> tile_width_bits) + 1  # of the integral image
    for i in range(first, last):
        splat = splats[i]
        if splat.extent > ZERO:
            left, right, y_first, y_last = _box(splat, width, height, tile_width_bits)
            top, bottom = y_first >> tile_height_bits, (y_last >> tile_height_bits) + 1
            upper, lower = top * row, bottom * row
            if sums[lower + right] - sums[lower + left] == sums[upper + right] - sums[upper + left]:
                splat.extent = ZERO
                depths[i] = ZERO


@parallel_kernel
def drop_untouched(
    splats: Any,  # [N] SPLAT; extent made 0 where no active tile is touched
    depths: F32,  # [N] likewise
    active_sums: I32,  # [(tile rows + 1) (tile columns + 1)] integral image of the active tiles
    width: int,
    height: int,
    tile_width_bits: int,  # tiles are 2**bits px
    tile_height_bits: int,
) -> None:
    """Drop the splats whose bounding box touches no active tile, before they cost more time."""
    count = splats.size
    for n in numba.prange((count + BLOCK - 1) // BLOCK):
        _drop_block(
            splats, depths, n * BLOCK, min((n + 1) * BLOCK, count), active_sums, width, height,
            tile_width_bits, tile_height_bits,
        )  # fmt: skip


@kernel
def sort_by_depth(depths: F32, slots: Any, order: I32, spare_order: I32, keys: I32, spare_keys: I32) -> int:
    """Write the indices of the `depths` [N] above 0 to the beginning of `order`, near to far; return how many
    they are. A stable radix sort; positive floats sort like their bits. The `slots` [N] SLOTS of the others
    are made empty."""
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
        else:
            slots[i].first = slots[i].count = 0
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
def _find_rows(splat: Any, box: Any, height: int, tile_width_bits: int, rows: I32, n: int) -> Any:
    """Find which rows of the image a splat touches in each 8 px wide column of its box. Return the place in
    `rows` for the next splat.

    Rotated by 180 degrees, the splat's upper end is its lower end. So half of a vector's lanes find the lower
    ends in AT_ONCE columns, and the other half the upper ends in the same columns. For each AT_ONCE columns,
    `rows` holds one after the last row of each, then the first row of each, negated. The sum of the two is
    the number of rows; there is none if it is not above 0.
    """
    left, right, y_first, y_last = box
    # The ellipse u^2 + v^2 = extent lies over any dx between dy = -shear dx +- chord sqrt(reach_x^2 - dx^2)
    a, b, c = splat.whiten_xx, splat.whiten_xy, splat.whiten_yy
    per_bb_cc = ONE / (b * b + c * c)
    chord, shear = a * c * per_bb_cc, a * b * per_bb_cc
    side = half_signs()
    low = half_lanes() * f4(BLOCK_WIDTH) + (f4(left << tile_width_bits) + HALF - splat.mean_x)
    most = select(side > ZERO, f4(y_last + 1), f4(-y_first))
    for _ in range(0, (right - left) * COLUMNS, AT_ONCE):
        begin, end = larger(low, -splat.reach_x), smaller(low + f4(BLOCK_WIDTH - 1), splat.reach_x)
        dx = smaller(larger(side * splat.lowest_x, begin), end)
        half_chord = square_roots(larger((splat.reach_x - dx) * (splat.reach_x + dx), ZERO)) * chord
        dy = half_chord - side * dx * shear
        last = round_downs(side * splat.mean_y + dy + (HALF + ROW_SLACK))
        store_integers(rows, n, smaller(select(begin <= end, larger(last, f4(-height)), f4(-height)), most))
        low += f4(BLOCK_WIDTH * AT_ONCE)
        n += LANES
    return n


@inlined
def _row_in_tile(row: int, first: int, tile_height: int) -> int:
    return min(max(row - first, 0), tile_height)


@kernel
def _emit_parts(
    splats: Any, order: I32, active: Bool, width: int, height: int, tile_width_bits: int,
    tile_height_bits: int, emitted: Any, slots: Any, runs: Any, reserved: I64, histogram: I32, next_part: I64,
) -> None:  # fmt: skip
    """Find the rows of all splats of a block first, then write their pairs. In a single loop the processor
    would wait for every square root before it knows the next branch."""
    tile_height = 1 << tile_height_bits
    tiles_x = (width + (1 << tile_width_bits) - 1) >> tile_width_bits
    boxes = np.empty((BLOCK, 2), np.int32)
    rows = np.empty(BLOCK * (tiles_x * COLUMNS // AT_ONCE + 1) * LANES, np.int32)
    slot: Any = 0
    limit: Any = 0
    while True:
        part = take(next_part, 1)
        if part >= histogram.shape[0]:
            break
        counts = histogram[part]
        counts[:] = 0
        first_block, end_block = blocks_of(part, histogram.shape[0], order.size)
        for block in range(first_block, end_block):
            begin, end = block * BLOCK, min((block + 1) * BLOCK, order.size)
            n, needed = 0, 0
            for position in range(begin, end):
                soon = order[min(position + AHEAD, order.size - 1)]
                prefetch_read(splats, soon)
                prefetch_write(slots, soon)
                splat = splats[order[position]]
                box = _box(splat, width, height, tile_width_bits)
                n = _find_rows(splat, box, height, tile_width_bits, rows, n)
                left, right, y_first, y_last = box
                boxes[position - begin, 0] = left
                boxes[position - begin, 1] = right
                needed += (right - left) * ((y_last >> tile_height_bits) - (y_first >> tile_height_bits) + 1)
            if slot + needed > limit:
                # which slots a worker gets depends on the timing; the result does not
                limit = needed if needed > CHUNK else CHUNK
                slot = take(reserved, limit)
                limit += slot
            if limit > emitted.size:  # no room: only go on counting what is needed
                slot += needed
                continue
            runs[block].first = slot
            n = 0
            for position in range(begin, end):
                i = order[position]
                left, right = boxes[position - begin, 0], boxes[position - begin, 1]
                first = slot
                for column in range(left, right):
                    k = (column - left) * COLUMNS
                    at = n + k // AT_ONCE * LANES + k % AT_ONCE
                    end0, end1 = rows[at], rows[at + 1]
                    begin0, begin1 = -rows[at + AT_ONCE], -rows[at + AT_ONCE + 1]
                    row_first, row_end = min(begin0, begin1), max(end0, end1)
                    for row in range(row_first >> tile_height_bits, (row_end - 1 >> tile_height_bits) + 1):
                        tile = row * tiles_x + column
                        if active[tile]:
                            pair = emitted[slot]
                            top = row * tile_height
                            pair.splat = i
                            pair.tile = tile
                            pair.begin[0] = _row_in_tile(begin0, top, tile_height)
                            pair.end[0] = _row_in_tile(end0, top, tile_height)
                            pair.begin[1] = _row_in_tile(begin1, top, tile_height)
                            pair.end[1] = _row_in_tile(end1, top, tile_height)
                            counts[tile] += 1
                            slot += 1
                n += ((right - left) * COLUMNS + AT_ONCE - 1) // AT_ONCE * LANES
                slots[i].first = first
                slots[i].count = slot - first
                if slot == first:
                    splats[i].extent = ZERO
            runs[block].count = slot - runs[block].first


@inlined
def blocks_of(part: int, parts: int, size: int) -> Any:
    """The first block of a part of the order, and that of the next part."""
    blocks = (size + BLOCK - 1) // BLOCK
    return blocks * part // parts, blocks * (part + 1) // parts


@parallel_kernel
def emit_pairs(
    splats: Any,  # [N] SPLAT; extent made 0 where no pair is found
    order: I32,  # what is drawn, near to far
    active: Bool,  # [tiles] True: this tile is drawn
    width: int,
    height: int,
    tile_width_bits: int,
    tile_height_bits: int,
    workers: int,
    emitted: Any,  # EMITTED, written, with gaps
    slots: Any,  # [N] SLOTS, written for what is drawn: the slots of a splat's pairs
    runs: Any,  # [ceil(N / BLOCK)] SLOTS, written: the slots of the pairs of a block of the order
    reserved: I64,  # [1] written: records needed in `emitted`; if it has fewer, call again with a larger one
    histogram: I32,  # [parts, tiles] pairs per tile of each part of the order, written
    next_part: I64,  # [1] shared counter of the workers
) -> None:
    """Find the tiles and rows that each splat touches."""
    reserved[0] = 0
    next_part[0] = 0
    for _ in numba.prange(workers):
        _emit_parts(
            splats, order, active, width, height, tile_width_bits, tile_height_bits, emitted, slots, runs,
            reserved, histogram, next_part,
        )  # fmt: skip


@kernel
def _place_parts(emitted: Any, runs: Any, size: int, histogram: I32, pairs: Any, next_part: I64) -> None:
    parts = histogram.shape[0]
    while True:
        part = take(next_part, 1)
        if part >= parts:
            break
        places = histogram[part]
        first_block, end_block = blocks_of(part, parts, size)
        for block in range(first_block, end_block):
            first = runs[block].first
            for slot in range(first, first + runs[block].count):
                source = emitted[slot]
                place = places[source.tile]
                places[source.tile] = place + 1
                pair = pairs[place]
                pair.splat = source.splat
                pair.slot = slot
                pair.rows = source.rows


@parallel_kernel
def sort_into_tiles(
    workers: int,
    size: int,  # of the order
    emitted: Any,  # EMITTED, of `emit_pairs`, as the next two
    runs: Any,
    histogram: I32,  # overwritten
    pairs: Any,  # PAIR, written: tile after tile, near to far within each
    tile_starts: I32,  # [tiles + 1] written
    next_part: I64,  # [1] shared counter of the workers
) -> None:
    """Sort the pairs by tile. A stable counting sort: the result does not depend on the number of parts."""
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
        _place_parts(emitted, runs, size, histogram, pairs, next_part)
