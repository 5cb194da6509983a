"""Front-to-back blending of the splats of each tile, and its derivative.

For a pixel with splats i from near to far: w_i = alpha_i T_i, T_(i+1) = T_i - w_i, out = sum w_i f_i with
f = (r, g, b, z, 1). The backward pass runs front to back too: with g = dL/dout and s_i = f_i . g it keeps
R_i = sum over j > i of w_j s_j, starting from out . g, so that

    dL/dlog alpha_i = w_i s_i - alpha_i R_i / (1 - alpha_i).

Nothing is recovered by dividing, so saturated pixels cannot underflow. A tile stops when all its pixels have
T <= 1e-4.

A tile is two columns of blocks (see `vectors`); a pair says which rows of each column its splat touches. With
d = pixel - mean2d a block's u = a dx + b dy and v = c dy (see `layout`) follow from those of the block above
by adding a constant. The scratch of a worker holds a tile block by block, and each block plane by plane.

`median` uses the constants and helpers of this file. Tile sizes are defined here only.
"""

from typing import Any

import numba
import numpy as np

from sags_node.engine.rasterizer.layout import COLUMNS
from sags_node.engine.rasterizer.projection import LOG2_MIN_ALPHA
from sags_node.kernels.jit import (
    inlined,
    kernel,
    parallel_kernel,
    prefetch_far,
    prefetch_read,
    prefetch_write,
    take,
)
from sags_node.kernels.vectors import (
    BLOCK_WIDTH,
    LANES,
    RECORD,
    any_of,
    block_x,
    block_y,
    load,
    load_block,
    multiply_add,
    select,
    spread,
    store,
    store_block,
    store_sums,
    times_power_of_two,
)
from sags_node.types import F32, I32, I64

f4 = np.float32

TILE_WIDTH_BITS, TILE_HEIGHT_BITS = 4, 5
TILE_WIDTH, TILE_HEIGHT = 1 << TILE_WIDTH_BITS, 1 << TILE_HEIGHT_BITS  # 16x32 px
BLOCK_HEIGHT = LANES // BLOCK_WIDTH
BLOCKS = TILE_HEIGHT // BLOCK_HEIGHT  # in a column

# Planes of a block in the scratch
TRANSMITTANCE, RED, GREEN, BLUE, DEPTH, COVERAGE, REMAINING, WEIGHT, LUMINANCE = (k * LANES for k in range(9))
DRAWN = 5 * LANES  # floats from one block to the next in the forward pass, which needs the first five planes
DERIVED = 9 * LANES  # the same in the backward pass; blocks 512 bytes apart would share few cache sets
SCRATCH = COLUMNS * BLOCKS * DERIVED  # floats per worker

ZERO, HALF, ONE = f4(0.0), f4(0.5), f4(1.0)
OPAQUE = f4(1e-4)  # transmittance at which a pixel is finished
TEST_EVERY = 8  # pairs between two looks at the transmittance
AHEAD = 8  # pairs between prefetch and use

# 2^x on -1/2 <= x <= 1/2, relative error 2.6e-6
P0, P1, P2, P3, P4 = f4(0.999999285), f4(0.693121791), f4(0.240247443), f4(0.0559179001), f4(0.00957010966)
ROUNDING = f4(1.5 * 2**23)  # a float32 this large has no place for fractions: adding it rounds to an integer


@inlined
def alpha_of(exponent: Any) -> Any:
    """Return 2**exponent of a vector; 0 where that is below 1/255."""
    rounded = exponent + ROUNDING
    x = exponent - (rounded - ROUNDING)
    power = times_power_of_two((((x * P4 + P3) * x + P2) * x + P1) * x + P0, rounded)
    return select(exponent >= LOG2_MIN_ALPHA, power, ZERO)


@inlined
def whitened(a: Any, b: Any, c: Any, dx: Any, dy: Any) -> Any:
    """Return a dx, u and v. All kernels must round them alike, or one would cut off a splat at a pixel where
    another draws it."""
    along = dx * a
    return along, multiply_add(dy, b, along), dy * c


@inlined
def place_of(t: int, width: int, height: int) -> Any:
    """Return a tile's first column and row in the image, and its numbers of columns and rows, px."""
    tiles_x = (width + TILE_WIDTH - 1) // TILE_WIDTH
    x0, y0 = t % tiles_x * TILE_WIDTH, t // tiles_x * TILE_HEIGHT
    return x0, y0, min(TILE_WIDTH, width - x0), min(TILE_HEIGHT, height - y0)


@inlined
def is_whole(columns: int, rows: int) -> bool:
    """Tell whether all of a tile lies in the image."""
    return columns == TILE_WIDTH and rows == TILE_HEIGHT


@inlined
def place_in_scratch(x: int, y: int, stride: int) -> int:
    """The index of a tile's pixel in the first plane of the scratch."""
    block = x // BLOCK_WIDTH * BLOCKS + y // BLOCK_HEIGHT
    return block * stride + y % BLOCK_HEIGHT * BLOCK_WIDTH + x % BLOCK_WIDTH


@inlined
def open_tile(tile: F32, stride: int, columns: int, rows: int) -> None:
    """Set the transmittance to 1 inside the image, 0 outside: pixels outside do not keep a tile open."""
    for block in range(COLUMNS * BLOCKS):
        store(tile, block * stride + TRANSMITTANCE, spread(ONE))
    if not is_whole(columns, rows):
        for y in range(TILE_HEIGHT):
            for x in range(TILE_WIDTH):
                if x >= columns or y >= rows:
                    tile[place_in_scratch(x, y, stride) + TRANSMITTANCE] = ZERO


@inlined
def any_above(tile: F32, stride: int, transmittance: Any) -> Any:
    """Tell whether a pixel of the tile still has more than this transmittance."""
    above = load(tile, TRANSMITTANCE) > transmittance
    for block in range(1, COLUMNS * BLOCKS):
        above |= load(tile, block * stride + TRANSMITTANCE) > transmittance
    return any_of(above)


@inlined
def write_plane(
    tile: Any, plane: int, stride: int, picture: Any, start: int, width: int, columns: int, rows: int
) -> None:
    """Copy a plane of the scratch into the tile's part of an image [H W]; `start` is its first pixel."""
    if is_whole(columns, rows):
        for block in range(COLUMNS * BLOCKS):
            y, x = block % BLOCKS * BLOCK_HEIGHT, block // BLOCKS * BLOCK_WIDTH
            store_block(picture, start + y * width + x, width, load(tile, block * stride + plane))
    else:
        for y in range(rows):
            for x in range(columns):
                picture[start + y * width + x] = tile[place_in_scratch(x, y, stride) + plane]


@kernel
def _composite_tiles(
    splats: Any, pairs: Any, tile_starts: I32, drawn: I32, next_tile: I64, tile: F32, width: int, height: int,
    planes: F32, tile_ends: I32,
) -> None:  # fmt: skip
    area, last = width * height, tile_starts[tile_starts.size - 1]
    while True:
        turn = take(next_tile, 1)
        if turn >= drawn.size:
            break
        t = drawn[turn]
        x0, y0, columns, rows = place_of(t, width, height)
        start = y0 * width + x0
        open_tile(tile, DRAWN, columns, rows)
        for block in range(COLUMNS * BLOCKS):
            for plane in range(RED, DRAWN, LANES):
                store(tile, block * DRAWN + plane, spread(ZERO))
        p, end = tile_starts[t], tile_starts[t + 1]
        row_to_come, until_test = 0, TEST_EVERY
        while p < end:
            if row_to_come < rows:  # prefetch the rows that are written at the end
                for k in range(5):
                    prefetch_write(planes, start + k * area + row_to_come * width)
                row_to_come += 1
            if p + AHEAD < last:
                prefetch_read(splats, pairs[p + AHEAD].splat)
            pair = pairs[p]
            splat = splats[pair.splat]
            a, b, c, log2_opacity = splat.whiten_xx, splat.whiten_xy, splat.whiten_yy, splat.log2_opacity
            red, green, blue, depth = splat.red, splat.green, splat.blue, splat.depth
            slope_u, slope_v = splat.slope_u, splat.slope_v
            for column in range(COLUMNS):
                first, beyond = pair.begin[column] // BLOCK_HEIGHT, pair.end[column]
                blocks = (beyond + BLOCK_HEIGHT - 1) // BLOCK_HEIGHT - first
                if blocks <= 0:
                    continue
                dx = block_x() + (f4(x0 + column * BLOCK_WIDTH) + HALF - splat.mean_x)
                dy = block_y() + (f4(y0 + first * BLOCK_HEIGHT) + HALF - splat.mean_y)
                _, u, v = whitened(a, b, c, dx, dy)
                at = (column * BLOCKS + first) * DRAWN
                for _ in range(blocks):
                    transmittance = load(tile, at + TRANSMITTANCE)
                    w = alpha_of(log2_opacity - v * v - u * u) * transmittance
                    brighter = u * slope_u + v * slope_v
                    store(tile, at + RED, load(tile, at + RED) + w * (brighter + red))
                    store(tile, at + GREEN, load(tile, at + GREEN) + w * (brighter + green))
                    store(tile, at + BLUE, load(tile, at + BLUE) + w * (brighter + blue))
                    store(tile, at + DEPTH, load(tile, at + DEPTH) + w * depth)
                    store(tile, at + TRANSMITTANCE, transmittance - w)
                    u += b * f4(BLOCK_HEIGHT)
                    v += c * f4(BLOCK_HEIGHT)
                    at += DRAWN
            p += 1
            until_test -= 1
            if until_test == 0:
                until_test = TEST_EVERY
                if not any_above(tile, DRAWN, OPAQUE):
                    break
        tile_ends[t] = p
        for block in range(COLUMNS * BLOCKS):
            at = block * DRAWN + TRANSMITTANCE
            store(tile, at, ONE - load(tile, at))
        for k in range(5):
            plane = (RED, GREEN, BLUE, DEPTH, TRANSMITTANCE)[k]
            write_plane(tile, plane, DRAWN, planes, start + k * area, width, columns, rows)


@parallel_kernel
def composite(
    splats: Any,  # [N] SPLAT
    pairs: Any,  # PAIR
    tile_starts: I32,  # [tiles + 1]
    drawn: I32,  # the tiles to draw
    next_tile: I64,  # [1] shared counter of the workers
    scratch: F32,  # [workers, SCRATCH]
    width: int,
    height: int,
    planes: F32,  # [5 H W] written where drawn
    tile_ends: I32,  # [tiles] first pair of a tile that was not blended, written where drawn
) -> None:
    next_tile[0] = 0
    for worker in numba.prange(scratch.shape[0]):
        _composite_tiles(
            splats, pairs, tile_starts, drawn, next_tile, scratch[worker], width, height, planes, tile_ends
        )


@inlined
def _read_tile(
    tile: F32, planes: F32, v_planes: F32, weight: F32, start: int, width: int, area: int, columns: int,
    rows: int,
) -> Any:  # fmt: skip
    """Fill the scratch with the cotangents, R before the first splat, and the weights. Return whether any
    cotangent or weight is not 0; NaN counts as not 0."""
    if is_whole(columns, rows):
        asked = spread(ZERO) != ZERO
        for block in range(COLUMNS * BLOCKS):
            at, y, x = block * DERIVED, block % BLOCKS * BLOCK_HEIGHT, block // BLOCKS * BLOCK_WIDTH
            remaining = luminance = spread(ZERO)
            for k in range(5):
                pixel = start + k * area + y * width + x
                cotangent = load_block(v_planes, pixel, width)
                remaining += cotangent * load_block(planes, pixel, width)
                asked |= cotangent != ZERO
                store(tile, at + RED + k * LANES, cotangent)
                if k < 3:
                    luminance += cotangent
            store(tile, at + REMAINING, remaining)
            store(tile, at + LUMINANCE, luminance)
            weights = load_block(weight, start + y * width + x, width)
            asked |= weights != ZERO
            store(tile, at + WEIGHT, weights)
        return any_of(asked)
    asked_at_edge = False
    tile[:] = ZERO
    for y in range(rows):
        for x in range(columns):
            at, pixel = place_in_scratch(x, y, DERIVED), start + y * width + x
            for k in range(5):
                value = v_planes[pixel + k * area]
                tile[at + RED + k * LANES] = value
                tile[at + REMAINING] += value * planes[pixel + k * area]
                if k < 3:
                    tile[at + LUMINANCE] += value
                asked_at_edge |= value != ZERO
            tile[at + WEIGHT] = weight[pixel]
            asked_at_edge |= tile[at + WEIGHT] != ZERO
    return asked_at_edge


@inlined
def _prefetch_row(
    planes: F32, v_planes: F32, weight: F32, place: Any, y: int, width: int, height: int
) -> None:
    """Prefetch one row of what `_read_tile` reads of a tile."""
    x0, y0, _, rows = place
    if y < rows:
        pixel = (y0 + y) * width + x0
        prefetch_far(weight, pixel)
        for k in range(5):
            plane = k * height * width
            prefetch_far(v_planes, plane + pixel)
            prefetch_far(planes, plane + pixel)


@kernel
def _composite_tiles_backward(
    splats: Any, pairs: Any, tile_starts: I32, tile_ends: I32, drawn: I32, next_tile: I64, tile: F32,
    width: int, height: int, planes: F32, v_planes: F32, weight: F32, v_pairs: F32,
) -> None:  # fmt: skip
    area, last = width * height, tile_starts[tile_starts.size - 1]
    turn = take(next_tile, 1)
    while turn < drawn.size:
        t, turn = drawn[turn], take(next_tile, 1)
        x0, y0, columns, rows = place_of(t, width, height)
        end = tile_ends[t]
        if not _read_tile(tile, planes, v_planes, weight, y0 * width + x0, width, area, columns, rows):
            end = tile_starts[t]
        open_tile(tile, DERIVED, columns, rows)
        following = place_of(drawn[min(turn, drawn.size - 1)], width, height)
        row_to_come = 0
        for p in range(tile_starts[t], end):
            if row_to_come < TILE_HEIGHT:
                _prefetch_row(planes, v_planes, weight, following, row_to_come, width, height)
                row_to_come += 1
            if p + AHEAD < last:
                prefetch_read(splats, pairs[p + AHEAD].splat)
                prefetch_write(v_pairs, pairs[p + AHEAD].slot * RECORD)
            pair = pairs[p]
            splat = splats[pair.splat]
            a, b, c, log2_opacity = splat.whiten_xx, splat.whiten_xy, splat.whiten_yy, splat.log2_opacity
            red, green, blue, depth = splat.red, splat.green, splat.blue, splat.depth
            slope_u, slope_v = splat.slope_u, splat.slope_v
            g_sum = g_u = g_v = g_uu = g_uv = g_vv = spread(ZERO)
            w_red = w_green = w_blue = w_depth = w_weight = w_spread = w_u = w_v = spread(ZERO)
            for column in range(COLUMNS):
                first, beyond = pair.begin[column] // BLOCK_HEIGHT, pair.end[column]
                blocks = (beyond + BLOCK_HEIGHT - 1) // BLOCK_HEIGHT - first
                if blocks <= 0:
                    continue
                dx = block_x() + (f4(x0 + column * BLOCK_WIDTH) + HALF - splat.mean_x)
                dy = block_y() + (f4(y0 + first * BLOCK_HEIGHT) + HALF - splat.mean_y)
                along, u, v = whitened(a, b, c, dx, dy)
                at = (column * BLOCKS + first) * DERIVED
                g_here = gv_here = gvv_here = w_here = wv_here = spread(ZERO)
                for _ in range(blocks):
                    alpha = alpha_of(log2_opacity - v * v - u * u)
                    transmittance = load(tile, at + TRANSMITTANCE)
                    w = alpha * transmittance
                    store(tile, at + TRANSMITTANCE, transmittance - w)
                    v_red, v_green, v_blue = (
                        load(tile, at + RED),
                        load(tile, at + GREEN),
                        load(tile, at + BLUE),
                    )
                    v_depth, v_luminance = load(tile, at + DEPTH), load(tile, at + LUMINANCE)
                    brighter = u * slope_u + v * slope_v
                    by_color = v_red * red + (v_green * green + (v_blue * blue + v_luminance * brighter))
                    ws = w * (by_color + (v_depth * depth + load(tile, at + COVERAGE)))
                    remaining = load(tile, at + REMAINING) - ws
                    store(tile, at + REMAINING, remaining)
                    g = ws - alpha / (ONE - alpha) * remaining
                    gv = g * v
                    g_here += g
                    gv_here += gv
                    gvv_here += gv * v
                    w_red += w * v_red
                    w_green += w * v_green
                    w_blue += w * v_blue
                    w_depth += w * v_depth
                    counted = w * load(tile, at + WEIGHT)
                    w_weight += counted
                    # not counted * (u * u + v * v): the compiler would then round alpha unlike `composite`
                    w_spread += counted * u * u
                    w_spread += counted * v * v
                    lit = w * v_luminance
                    w_here += lit
                    wv_here += lit * v
                    u += b * f4(BLOCK_HEIGHT)
                    v += c * f4(BLOCK_HEIGHT)
                    at += DERIVED
                # u = a dx + (b / c) v, and a dx is the same all the way down a lane
                slope = b / c
                gu_here, guv_here = g_here * along + gv_here * slope, gv_here * along + gvv_here * slope
                g_sum += g_here
                g_u += gu_here
                g_v += gv_here
                g_uu += gu_here * along + guv_here * slope
                g_uv += guv_here
                g_vv += gvv_here
                w_u += w_here * along + wv_here * slope
                w_v += wv_here
            store_sums(
                v_pairs,
                pair.slot * RECORD,
                (
                    g_sum, g_u, g_v, g_uu, g_uv, g_vv, w_red, w_green, w_blue, w_depth, w_weight,
                    w_u, w_v, w_spread,
                ),
            )  # fmt: skip
        for p in range(end, tile_starts[t + 1]):  # hidden in a finished tile, or all cotangents are 0
            for part in range(0, RECORD, LANES):
                store(v_pairs, pairs[p].slot * RECORD + part, spread(ZERO))


@parallel_kernel
def composite_backward(
    splats: Any,  # as in `composite`
    pairs: Any,
    tile_starts: I32,
    tile_ends: I32,
    drawn: I32,
    next_tile: I64,
    scratch: F32,
    width: int,
    height: int,
    planes: F32,  # [5 H W] of `composite`
    v_planes: F32,  # [5 H W]
    weight: F32,  # [H W]
    v_pairs: F32,  # [16 slots] written: a SPLAT_GRADIENT per slot
) -> None:
    next_tile[0] = 0
    for worker in numba.prange(scratch.shape[0]):
        _composite_tiles_backward(
            splats, pairs, tile_starts, tile_ends, drawn, next_tile, scratch[worker], width, height,
            planes, v_planes, weight, v_pairs,
        )  # fmt: skip
