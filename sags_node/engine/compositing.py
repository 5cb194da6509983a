"""Front-to-back blending of the splats of each tile, and its derivative.

For a pixel with splats i from near to far: w_i = alpha_i T_i, T_(i+1) = T_i - w_i, out = sum w_i f_i with
f = (r, g, b, z, 1). The backward pass runs front to back too: with g = dL/dout and s_i = f_i . g it keeps
R_i = sum over j > i of w_j s_j, starting from out . g, so that

    dL/dlog alpha_i = w_i s_i - alpha_i R_i / (1 - alpha_i).

Nothing is recovered by dividing, so saturated pixels cannot underflow.

A tile stops when all its pixels have T <= 1e-4. With d = pixel - mean2d, u = a dx + b dy and v = c dy
(see `layout`): what depends on the row alone is worked out for all rows of the tile at once.

`median` compiles the constants and helpers of this file into its own kernel: after editing them, delete the
caches (see `jit`). Tile sizes stand here only: see `jit` on the disk cache.
"""

from __future__ import annotations

import math
from typing import Any

import numba
import numpy as np

from sags_node.kernels.jit import (
    copy,
    inlined,
    kernel,
    parallel_kernel,
    prefetch_read,
    prefetch_write,
    round_to_even,
    scale_by_power_of_two,
    stack_floats,
    take,
)
from sags_node.types import F32, I32, I64

f4 = np.float32
u8 = np.uint64

TILE_WIDTH_BITS, TILE_HEIGHT_BITS = 4, 5
TILE_WIDTH, TILE_HEIGHT = 1 << TILE_WIDTH_BITS, 1 << TILE_HEIGHT_BITS  # 16x32 px
TILE_PIXELS = TILE_WIDTH * TILE_HEIGHT
PLANE = TILE_PIXELS + 16  # 64 bytes of padding: planes 4 KiB apart would evict each other

# planes of the scratch array
TRANSMITTANCE, RED, GREEN, BLUE, DEPTH, COVERAGE, REMAINING, WEIGHT, STAGED = (
    u8(k * PLANE) for k in range(9)
)
# and then one number per row of the tile: u at dx = 0 left of the tile, v, and the exponent where u = 0
ROW_U, ROW_V, ROW_EXPONENT = (u8(9 * PLANE + k * TILE_HEIGHT) for k in range(3))
SCRATCH = 9 * PLANE + 4 * TILE_HEIGHT  # floats per worker

# sums of the backward pass, each with one number per column of the tile
SUM, SUM_U, SUM_V, SUM_UU, SUM_UV, SUM_VV = (u8(k * TILE_WIDTH) for k in range(6))
SUM_RED, SUM_GREEN, SUM_BLUE, SUM_DEPTH, SUM_WEIGHT = (u8(k * TILE_WIDTH) for k in range(6, 11))
SUMS = 11 * TILE_WIDTH

ZERO, HALF, ONE = f4(0.0), f4(0.5), f4(1.0)
OPAQUE = f4(1e-4)  # transmittance at which a pixel is finished
LOG2_MIN_ALPHA = f4(math.log2(1.0 / 255.0))
TEST_EVERY = 8  # pairs between two looks at the transmittance
AHEAD = 8  # pairs between prefetch and use

# 2^x on -1/2 <= x <= 1/2, relative error 2.6e-6
P0, P1, P2, P3, P4 = f4(0.999999285), f4(0.693121791), f4(0.240247443), f4(0.0559179001), f4(0.00957010966)


@inlined
def alpha_of(exponent: Any) -> Any:
    """2**exponent, and 0 where that is below 1/255."""
    whole = round_to_even(exponent)
    x = exponent - whole
    power = scale_by_power_of_two((((P4 * x + P3) * x + P2) * x + P1) * x + P0, whole)
    return power if exponent >= LOG2_MIN_ALPHA else ZERO


@inlined
def place_of(t: int, width: int, height: int) -> Any:
    """Camera, first pixel and size of a tile."""
    tiles_x, tiles_y = (width + TILE_WIDTH - 1) // TILE_WIDTH, (height + TILE_HEIGHT - 1) // TILE_HEIGHT
    x0, y0 = t % tiles_x * TILE_WIDTH, t // tiles_x % tiles_y * TILE_HEIGHT
    return t // (tiles_x * tiles_y), x0, y0, min(TILE_WIDTH, width - x0), min(TILE_HEIGHT, height - y0)


@inlined
def open_tile(tile: F32, columns: int, rows: int) -> None:
    """Transmittance 1 inside the picture, 0 outside: pixels outside neither draw nor keep a tile open."""
    for i in range(TILE_PIXELS):
        x, y = i % TILE_WIDTH, i // TILE_WIDTH
        tile[TRANSMITTANCE + u8(i)] = ONE if x < columns and y < rows else ZERO


@inlined
def _load(tile: F32, plane: Any, picture: F32, start: int, width: int, columns: int, rows: int) -> None:
    """Copy the tile's part of a picture [H W] into a plane of the scratch; `start` is its first pixel."""
    if columns == TILE_WIDTH:  # a constant length is one instruction
        for y in range(rows):
            copy(tile, plane + u8(y * TILE_WIDTH), picture, start + y * width, TILE_WIDTH)
    else:
        for y in range(rows):
            copy(tile, plane + u8(y * TILE_WIDTH), picture, start + y * width, columns)


@inlined
def store(tile: Any, plane: Any, picture: Any, start: int, width: int, columns: int, rows: int) -> None:
    """Copy a plane of the scratch into the tile's part of a picture [H W]."""
    if columns == TILE_WIDTH:
        for y in range(rows):
            copy(picture, start + y * width, tile, plane + u8(y * TILE_WIDTH), TILE_WIDTH)
    else:
        for y in range(rows):
            copy(picture, start + y * width, tile, plane + u8(y * TILE_WIDTH), columns)


@inlined
def any_above(tile: F32, transmittance: Any) -> Any:
    """Whether a pixel of the tile still has more than this transmittance."""
    above = ZERO  # counted in float: an integer or a maximum would not vectorise
    for k in range(TILE_PIXELS):
        above += ONE if tile[TRANSMITTANCE + u8(k)] > transmittance else ZERO
    return above > ZERO


@inlined
def write_rows(tile: F32, splat: Any, x0: int, y0: int) -> None:
    """What depends on the row alone."""
    a, b, c = splat.whiten_xx, splat.whiten_xy, splat.whiten_yy
    from_x, from_y = f4(x0) - splat.mean_x, f4(y0) - splat.mean_y + HALF
    for y in range(TILE_HEIGHT):
        dy = f4(y) + from_y
        v = c * dy
        tile[ROW_U + u8(y)] = a * from_x + b * dy
        tile[ROW_V + u8(y)] = v
        tile[ROW_EXPONENT + u8(y)] = splat.log2_opacity - v * v


@kernel
def _composite_tiles(
    splats: Any, pairs: Any, tile_starts: I32, drawn: I32, next_tile: I64, tile: F32, width: int, height: int,
    planes: F32, tile_ends: I32,
) -> None:  # fmt: skip
    while True:
        turn = take(next_tile, 1)
        if turn >= drawn.size:
            break
        t = drawn[turn]
        camera, x0, y0, columns, rows = place_of(t, width, height)
        open_tile(tile, columns, rows)
        for k in range(4 * PLANE):
            tile[RED + u8(k)] = ZERO
        p, end = tile_starts[t], tile_starts[t + 1]
        until_test = TEST_EVERY
        while p < end:
            if p + AHEAD < end:
                prefetch_read(splats, pairs[p + AHEAD].splat)
            pair = pairs[p]
            splat = splats[pair.splat]
            a, red, green, blue, depth = splat.whiten_xx, splat.red, splat.green, splat.blue, splat.depth
            write_rows(tile, splat, x0, y0)
            for row in range(pair.row_begin, pair.row_end):
                row_u, row_exponent = tile[ROW_U + u8(row)], tile[ROW_EXPONENT + u8(row)]
                first = u8(row * TILE_WIDTH)
                for k in range(TILE_WIDTH):
                    i = first + u8(k)
                    u = a * (f4(k) + HALF) + row_u
                    transmittance = tile[TRANSMITTANCE + i]
                    w = alpha_of(row_exponent - u * u) * transmittance
                    tile[RED + i] += w * red
                    tile[GREEN + i] += w * green
                    tile[BLUE + i] += w * blue
                    tile[DEPTH + i] += w * depth
                    tile[TRANSMITTANCE + i] = transmittance - w
            p += 1
            until_test -= 1
            if until_test == 0:
                until_test = TEST_EVERY
                if not any_above(tile, OPAQUE):
                    break
        tile_ends[t] = p
        for k in range(TILE_PIXELS):
            tile[COVERAGE + u8(k)] = ONE - tile[TRANSMITTANCE + u8(k)]
        for k in range(5):
            start = ((camera * 5 + k) * height + y0) * width + x0
            store(tile, RED + u8(k * PLANE), planes, start, width, columns, rows)


@parallel_kernel
def composite(
    splats: Any,  # [C N] SPLAT
    pairs: Any,  # PAIR
    tile_starts: I32,  # [C tiles + 1]
    drawn: I32,  # the tiles to draw
    next_tile: I64,  # [1] for the workers
    scratch: F32,  # [workers, SCRATCH]
    width: int,
    height: int,
    planes: F32,  # [C 5 H W] written where drawn
    tile_ends: I32,  # [C tiles] first pair of a tile that was not blended, written where drawn
) -> None:
    next_tile[0] = 0
    for worker in numba.prange(scratch.shape[0]):
        _composite_tiles(
            splats, pairs, tile_starts, drawn, next_tile, scratch[worker], width, height, planes, tile_ends
        )


@inlined
def _is_zero(tile: F32) -> bool:
    """Whether no pixel has a cotangent or a weight; NaN is not zero."""
    size = ZERO
    for plane in range(5):
        for n in range(TILE_PIXELS):
            size += abs(tile[RED + u8(plane * PLANE) + u8(n)])
    for n in range(TILE_PIXELS):
        size += abs(tile[WEIGHT + u8(n)])
    return bool(size == ZERO)


@kernel
def _composite_tiles_backward(
    splats: Any, pairs: Any, tile_starts: I32, tile_ends: I32, drawn: I32, next_tile: I64, tile: F32,
    width: int, height: int, planes: F32, v_planes: F32, weight: F32, v_pairs: Any,
) -> None:  # fmt: skip
    sums = stack_floats(SUMS)
    while True:
        turn = take(next_tile, 1)
        if turn >= drawn.size:
            break
        t = drawn[turn]
        camera, x0, y0, columns, rows = place_of(t, width, height)
        open_tile(tile, columns, rows)
        if columns < TILE_WIDTH or rows < TILE_HEIGHT:
            for k in range(8 * PLANE):
                tile[RED + u8(k)] = ZERO
        for k in range(TILE_PIXELS):
            tile[REMAINING + u8(k)] = ZERO
        for k in range(5):
            plane = RED + u8(k * PLANE)
            start = ((camera * 5 + k) * height + y0) * width + x0
            _load(tile, plane, v_planes, start, width, columns, rows)
            _load(tile, STAGED, planes, start, width, columns, rows)
            for n in range(TILE_PIXELS):
                tile[REMAINING + u8(n)] += tile[plane + u8(n)] * tile[STAGED + u8(n)]
        _load(tile, WEIGHT, weight, (camera * height + y0) * width + x0, width, columns, rows)
        end = tile_ends[t]
        if _is_zero(tile):
            end = tile_starts[t]
        for p in range(tile_starts[t], end):
            if p + AHEAD < end:
                prefetch_read(splats, pairs[p + AHEAD].splat)
                prefetch_write(v_pairs, pairs[p + 2].slot)
            pair = pairs[p]
            splat = splats[pair.splat]
            a, red, green, blue, depth = splat.whiten_xx, splat.red, splat.green, splat.blue, splat.depth
            write_rows(tile, splat, x0, y0)
            for k in range(SUMS):
                sums[u8(k)] = ZERO
            for row in range(pair.row_begin, pair.row_end):
                row_u, row_exponent = tile[ROW_U + u8(row)], tile[ROW_EXPONENT + u8(row)]
                v = tile[ROW_V + u8(row)]
                first = u8(row * TILE_WIDTH)
                for k in range(TILE_WIDTH):
                    j = u8(k)
                    i = first + j
                    u = a * (f4(k) + HALF) + row_u
                    alpha = alpha_of(row_exponent - u * u)
                    transmittance = tile[TRANSMITTANCE + i]
                    w = alpha * transmittance
                    tile[TRANSMITTANCE + i] = transmittance - w
                    v_red, v_green, v_blue = tile[RED + i], tile[GREEN + i], tile[BLUE + i]
                    v_depth = tile[DEPTH + i]
                    ws = w * (
                        red * v_red + green * v_green + blue * v_blue + depth * v_depth + tile[COVERAGE + i]
                    )
                    remaining = tile[REMAINING + i] - ws
                    tile[REMAINING + i] = remaining
                    g = ws - alpha * remaining / (ONE - alpha)
                    gu, gv = g * u, g * v
                    sums[SUM + j] += g
                    sums[SUM_U + j] += gu
                    sums[SUM_V + j] += gv
                    sums[SUM_UU + j] += gu * u
                    sums[SUM_UV + j] += gu * v
                    sums[SUM_VV + j] += gv * v
                    sums[SUM_RED + j] += w * v_red
                    sums[SUM_GREEN + j] += w * v_green
                    sums[SUM_BLUE + j] += w * v_blue
                    sums[SUM_DEPTH + j] += w * v_depth
                    sums[SUM_WEIGHT + j] += w * tile[WEIGHT + i]
            sum_g = sum_u = sum_v = sum_uu = sum_uv = sum_vv = ZERO
            sum_red = sum_green = sum_blue = sum_depth = sum_weight = ZERO
            for k in range(TILE_WIDTH):  # one loop: short ones would be unrolled instead of vectorised
                sum_g += sums[SUM + u8(k)]
                sum_u += sums[SUM_U + u8(k)]
                sum_v += sums[SUM_V + u8(k)]
                sum_uu += sums[SUM_UU + u8(k)]
                sum_uv += sums[SUM_UV + u8(k)]
                sum_vv += sums[SUM_VV + u8(k)]
                sum_red += sums[SUM_RED + u8(k)]
                sum_green += sums[SUM_GREEN + u8(k)]
                sum_blue += sums[SUM_BLUE + u8(k)]
                sum_depth += sums[SUM_DEPTH + u8(k)]
                sum_weight += sums[SUM_WEIGHT + u8(k)]
            v_pair = v_pairs[pair.slot]
            v_pair.sum = sum_g
            v_pair.u = sum_u
            v_pair.v = sum_v
            v_pair.uu = sum_uu
            v_pair.uv = sum_uv
            v_pair.vv = sum_vv
            v_pair.red = sum_red
            v_pair.green = sum_green
            v_pair.blue = sum_blue
            v_pair.depth = sum_depth
            v_pair.contribution = sum_weight
        for p in range(end, tile_starts[t + 1]):  # hidden behind a finished tile, or nothing is asked of it
            v_pair = v_pairs[pairs[p].slot]
            v_pair.sum = v_pair.u = v_pair.v = v_pair.uu = v_pair.uv = v_pair.vv = ZERO
            v_pair.red = v_pair.green = v_pair.blue = v_pair.depth = v_pair.contribution = ZERO


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
    planes: F32,  # [C 5 H W] of `composite`
    v_planes: F32,  # [C 5 H W]
    weight: F32,  # [C H W]
    v_pairs: Any,  # SPLAT_GRADIENT per slot, written
) -> None:
    next_tile[0] = 0
    for worker in numba.prange(scratch.shape[0]):
        _composite_tiles_backward(
            splats, pairs, tile_starts, tile_ends, drawn, next_tile, scratch[worker], width, height,
            planes, v_planes, weight, v_pairs,
        )  # fmt: skip
