"""The pairs of a splat and a tile that it reaches, near to far within each tile.

Splats are sorted by depth, then their pairs by tile. Both sorts are stable: equal depths keep the order of
the rows. The pairs of one splat have neighbouring slots, so its gradients are summed without atomics.
"""

from __future__ import annotations

import warp as wp

from sags_node.engine.gpu.projection import FAR_KEY

wp.set_module_options({"enable_backward": False})

TILE = 16  # px, both ways
LANES = TILE * TILE  # threads of a tile, one for each pixel
SLACK = 1e-3  # px: rounding must not lose a pixel


@wp.func
def first_pixel(low: float, size: int):
    return int(wp.ceil(wp.min(wp.max(low - 0.5, 0.0), float(size))))


@wp.func
def last_pixel(high: float, size: int):
    return int(wp.floor(wp.min(wp.max(high - 0.5, -1.0), float(size - 1))))


@wp.func
def tile_rows(s: wp.vec4, reach_y: float, height: int):
    """The first row of tiles that a splat reaches, and one after the last."""
    first, last = first_pixel(s[1] - reach_y - SLACK, height), last_pixel(s[1] + reach_y + SLACK, height)
    begin, end = first // TILE, last // TILE + 1
    if first > last:
        end = begin
    return begin, end


@wp.func
def tile_columns(s: wp.vec4, r: wp.vec4, row: int, width: int, height: int):
    """The first tile of a row that the ellipse u^2 + v^2 = extent reaches, and one after the last."""
    a, b, c, extent = s[2], s[3], r[0], r[2]
    low = wp.max(float(row * TILE) + 0.5 - s[1], -wp.sqrt(extent) / c)
    high = wp.min(float(wp.min(row * TILE + TILE, height)) - 0.5 - s[1], wp.sqrt(extent) / c)
    extreme = b * wp.sqrt(extent / (b * b + c * c)) / c  # dy of the leftmost point; -dy of the rightmost
    left_dy = wp.min(wp.max(extreme, low), high)
    left = (-b * left_dy - wp.sqrt(wp.max(extent - c * c * left_dy * left_dy, 0.0))) / a
    right_dy = wp.min(wp.max(-extreme, low), high)
    right = (-b * right_dy + wp.sqrt(wp.max(extent - c * c * right_dy * right_dy, 0.0))) / a
    first, last = first_pixel(s[0] + left - SLACK, width), last_pixel(s[0] + right + SLACK, width)
    begin, end = first // TILE, last // TILE + 1
    if first > last or low > high + SLACK:
        end = begin
    return begin, end


@wp.kernel(grid_stride=False)
def count_pairs(
    splats: wp.array2d(dtype=wp.vec4), keys: wp.array(dtype=int), order: wp.array(dtype=int),
    width: int, height: int, active: wp.array(dtype=int), counts: wp.array(dtype=wp.int64),
):  # fmt: skip
    """Count the active tiles that each splat reaches; `counts` is in the order of depth. In 64 bits, which
    hold any sum of them."""
    n = wp.tid()
    total = int(0)
    if keys[n] != FAR_KEY:
        i = order[n]
        s, r = splats[i, 0], splats[i, 1]
        tiles_x = (width + TILE - 1) // TILE
        top, bottom = tile_rows(s, splats[i, 3][2], height)
        for row in range(top, bottom):
            begin, end = tile_columns(s, r, row, width, height)
            for column in range(begin, end):
                total += active[row * tiles_x + column]
    counts[n] = wp.int64(total)


@wp.kernel(grid_stride=False)
def emit_pairs(
    splats: wp.array2d(dtype=wp.vec4), keys: wp.array(dtype=int), order: wp.array(dtype=int),
    width: int, height: int, active: wp.array(dtype=int), counts: wp.array(dtype=wp.int64),
    ends: wp.array(dtype=wp.int64), tiles: wp.array(dtype=int), slots: wp.array(dtype=int),
    slot_splats: wp.array(dtype=int), own_slots: wp.array(dtype=wp.vec2i),
):  # fmt: skip
    """Write the pairs in the order of depth. `own_slots`: a splat's first slot, and one after its last."""
    n = wp.tid()
    i = order[n]
    at, end = int(ends[n] - counts[n]), int(ends[n])
    own_slots[i] = wp.vec2i(at, end)
    if at == end:
        return
    tiles_x = (width + TILE - 1) // TILE
    s, r = splats[i, 0], splats[i, 1]
    top, bottom = tile_rows(s, splats[i, 3][2], height)
    for row in range(top, bottom):
        begin, end = tile_columns(s, r, row, width, height)
        for column in range(begin, end):
            tile = row * tiles_x + column
            if active[tile] != 0:
                tiles[at] = tile
                slots[at] = at
                slot_splats[at] = i
                at += 1


@wp.kernel(grid_stride=False)
def find_ranges(
    tiles: wp.array(dtype=int), slots: wp.array(dtype=int), slot_splats: wp.array(dtype=int), count: int,
    starts: wp.array(dtype=int), pairs: wp.array(dtype=int),
):  # fmt: skip
    """Given pairs sorted by tile, write where each tile's pairs begin [tiles + 1] and the splat of each pair.
    Launch one thread more than there are pairs."""
    p = wp.tid()
    before, here = int(-1), starts.shape[0] - 1
    if p > 0:
        before = tiles[p - 1]
    if p < count:
        here = tiles[p]
        pairs[p] = slot_splats[slots[p]]
    for tile in range(before + 1, here + 1):
        starts[tile] = p
