"""Front-to-back blending of the splats of each tile, and its derivative.

For a pixel with splats i from near to far: w_i = alpha_i T_i, T_(i+1) = T_i - w_i, out = sum w_i f_i with
f = (r, g, b, z, 1). The backward pass runs front to back too: with g = dL/dout and s_i = f_i . g it keeps
R_i = sum over j > i of w_j s_j, starting from out . g, so that

    dL/dlog alpha_i = w_i s_i - alpha_i R_i / (1 - alpha_i).

Nothing is recovered by dividing, so saturated pixels cannot underflow.

A tile stops when all its pixels have T <= 1e-4. Tile sizes stand here only: see `jit` on the disk cache.
"""

from __future__ import annotations

import math
from typing import Any

import numba
import numpy as np

from sags_node.engine.jit import (
    inlined,
    parallel_kernel,
    prefetch_read,
    prefetch_write,
    round_to_even,
    scale_by_power_of_two,
)
from sags_node.types import F32

f4 = np.float32
u8 = np.uint64
Int32 = np.ndarray[Any, np.dtype[np.int32]]

TILE_WIDTH_BITS, TILE_HEIGHT_BITS = 4, 5
TILE_WIDTH, TILE_HEIGHT = 1 << TILE_WIDTH_BITS, 1 << TILE_HEIGHT_BITS  # 16x32 px
TILE_PIXELS = TILE_WIDTH * TILE_HEIGHT
PLANE = TILE_PIXELS + 16  # 64 bytes of padding: planes 4 KiB apart would evict each other
SCRATCH = 11 * PLANE  # floats per worker

# planes of the scratch array
TRANSMITTANCE = u8(0)
PIXEL_X, PIXEL_Y = u8(PLANE), u8(2 * PLANE)  # centres, relative to the tile
RED, GREEN, BLUE, DEPTH, COVERAGE = u8(3 * PLANE), u8(4 * PLANE), u8(5 * PLANE), u8(6 * PLANE), u8(7 * PLANE)
REMAINING, WEIGHT, STAGED = u8(8 * PLANE), u8(9 * PLANE), u8(10 * PLANE)

ZERO, HALF, ONE = f4(0.0), f4(0.5), f4(1.0)
OPAQUE = f4(1e-4)  # transmittance at which a pixel is finished
LOG2_MIN_ALPHA = f4(math.log2(1.0 / 255.0))
TEST_EVERY = 8  # pairs between two looks at the transmittance
AHEAD = 8  # pairs between prefetch and use

# 2^x on -1/2 <= x <= 1/2, relative error 2.6e-6
P0, P1, P2, P3, P4 = f4(0.999999285), f4(0.693121791), f4(0.240247443), f4(0.0559179001), f4(0.00957010966)


@inlined
def _alpha(exponent: Any) -> Any:
    """2**exponent, and 0 where that is below 1/255."""
    whole = round_to_even(exponent)
    x = exponent - whole
    power = scale_by_power_of_two((((P4 * x + P3) * x + P2) * x + P1) * x + P0, whole)
    return power if exponent >= LOG2_MIN_ALPHA else ZERO


@inlined
def _open_tile(tile: F32, columns: int, rows: int) -> None:
    """Transmittance 1 inside the picture, 0 outside: pixels outside neither draw nor keep a tile open."""
    for i in range(TILE_PIXELS):
        x, y = i % TILE_WIDTH, i // TILE_WIDTH
        tile[PIXEL_X + u8(i)] = f4(x) + HALF
        tile[PIXEL_Y + u8(i)] = f4(y) + HALF
        tile[TRANSMITTANCE + u8(i)] = ONE if x < columns and y < rows else ZERO


@inlined
def _load(tile: F32, plane: Any, picture: F32, x0: int, y0: int, columns: int, rows: int) -> None:
    """Copy the tile's part of a picture [H, W] into a plane of the scratch."""
    for y in range(rows):
        row, first = picture[y0 + y], plane + u8(y * TILE_WIDTH)
        if columns == TILE_WIDTH:  # a constant length vectorises
            for x in range(TILE_WIDTH):
                tile[first + u8(x)] = row[u8(x0) + u8(x)]
        else:
            for x in range(columns):
                tile[first + u8(x)] = row[u8(x0) + u8(x)]


@inlined
def _store(tile: F32, plane: Any, picture: F32, x0: int, y0: int, columns: int, rows: int) -> None:
    """Copy a plane of the scratch into the tile's part of a picture [H, W]."""
    for y in range(rows):
        row, first = picture[y0 + y], plane + u8(y * TILE_WIDTH)
        if columns == TILE_WIDTH:
            for x in range(TILE_WIDTH):
                row[u8(x0) + u8(x)] = tile[first + u8(x)]
        else:
            for x in range(columns):
                row[u8(x0) + u8(x)] = tile[first + u8(x)]


@parallel_kernel
def composite(
    splats: Any,  # [N] SPLAT
    pairs: Any,  # PAIR
    tile_starts: Int32,  # [tiles + 1]
    scratch: F32,  # [workers, SCRATCH]
    planes: F32,  # [5, H, W] written
    tile_ends: Int32,  # [tiles] first pair of a tile that was not blended, written
) -> None:
    _, height, width = planes.shape
    tiles_x = (width + TILE_WIDTH - 1) // TILE_WIDTH
    tiles = tile_starts.size - 1
    workers = scratch.shape[0]
    for worker in numba.prange(workers):
        tile = scratch[worker]
        for t in range(worker, tiles, workers):
            x0, y0 = t % tiles_x * TILE_WIDTH, t // tiles_x * TILE_HEIGHT
            columns, rows = min(TILE_WIDTH, width - x0), min(TILE_HEIGHT, height - y0)
            _open_tile(tile, columns, rows)
            for k in range(4 * PLANE):
                tile[RED + u8(k)] = ZERO
            p = tile_starts[t]
            end = tile_starts[t + 1]
            until_test = TEST_EVERY
            while p < end:
                if p + AHEAD < end:
                    prefetch_read(splats, pairs[p + AHEAD].splat)
                pair = pairs[p]
                splat = splats[pair.splat]
                a, b, c = splat.whiten_xx, splat.whiten_xy, splat.whiten_yy
                log2_opacity = splat.log2_opacity
                red, green, blue, depth = splat.red, splat.green, splat.blue, splat.depth
                from_x, from_y = f4(x0) - splat.mean_x, f4(y0) - splat.mean_y
                first = u8(pair.row_begin * TILE_WIDTH)
                for k in range((pair.row_end - pair.row_begin) * TILE_WIDTH):
                    i = first + u8(k)
                    dy = tile[PIXEL_Y + i] + from_y
                    u = a * (tile[PIXEL_X + i] + from_x) + b * dy
                    v = c * dy
                    transmittance = tile[TRANSMITTANCE + i]
                    w = _alpha(log2_opacity - u * u - v * v) * transmittance
                    tile[RED + i] += w * red
                    tile[GREEN + i] += w * green
                    tile[BLUE + i] += w * blue
                    tile[DEPTH + i] += w * depth
                    tile[TRANSMITTANCE + i] = transmittance - w
                p += 1
                until_test -= 1
                if until_test == 0:
                    until_test = TEST_EVERY
                    unfinished = ZERO  # counted in float: an integer or a maximum would not vectorise
                    for k in range(TILE_PIXELS):
                        unfinished += ONE if tile[TRANSMITTANCE + u8(k)] > OPAQUE else ZERO
                    if unfinished == ZERO:
                        break
            tile_ends[t] = p
            for k in range(TILE_PIXELS):
                tile[COVERAGE + u8(k)] = ONE - tile[TRANSMITTANCE + u8(k)]
            for k in range(5):
                _store(tile, RED + u8(k * PLANE), planes[k], x0, y0, columns, rows)


@parallel_kernel
def composite_backward(
    splats: Any,
    pairs: Any,
    tile_starts: Int32,
    tile_ends: Int32,
    scratch: F32,
    planes: F32,  # [5, H, W] of `composite`
    v_planes: F32,  # [5, H, W]
    weight: F32,  # [H, W]
    v_pairs: Any,  # SPLAT_GRADIENT per slot, written
) -> None:
    _, height, width = planes.shape
    tiles_x = (width + TILE_WIDTH - 1) // TILE_WIDTH
    tiles = tile_starts.size - 1
    workers = scratch.shape[0]
    for worker in numba.prange(workers):
        tile = scratch[worker]
        for t in range(worker, tiles, workers):
            x0, y0 = t % tiles_x * TILE_WIDTH, t // tiles_x * TILE_HEIGHT
            columns, rows = min(TILE_WIDTH, width - x0), min(TILE_HEIGHT, height - y0)
            _open_tile(tile, columns, rows)
            if columns < TILE_WIDTH or rows < TILE_HEIGHT:
                for k in range(8 * PLANE):
                    tile[RED + u8(k)] = ZERO
            for k in range(TILE_PIXELS):
                tile[REMAINING + u8(k)] = ZERO
            for k in range(5):
                plane = RED + u8(k * PLANE)
                _load(tile, plane, v_planes[k], x0, y0, columns, rows)
                _load(tile, STAGED, planes[k], x0, y0, columns, rows)
                for j in range(TILE_PIXELS):
                    i = u8(j)
                    tile[REMAINING + i] += tile[plane + i] * tile[STAGED + i]
            _load(tile, WEIGHT, weight, x0, y0, columns, rows)
            end = tile_ends[t]
            for p in range(tile_starts[t], end):
                if p + AHEAD < end:
                    prefetch_read(splats, pairs[p + AHEAD].splat)
                    prefetch_write(v_pairs, pairs[p + 2].slot)
                pair = pairs[p]
                splat = splats[pair.splat]
                a, b, c = splat.whiten_xx, splat.whiten_xy, splat.whiten_yy
                log2_opacity = splat.log2_opacity
                red, green, blue, depth = splat.red, splat.green, splat.blue, splat.depth
                from_x, from_y = f4(x0) - splat.mean_x, f4(y0) - splat.mean_y
                first = u8(pair.row_begin * TILE_WIDTH)
                sum_g = sum_u = sum_v = sum_uu = sum_uv = sum_vv = ZERO
                sum_red = sum_green = sum_blue = sum_depth = sum_weight = ZERO
                for k in range((pair.row_end - pair.row_begin) * TILE_WIDTH):
                    i = first + u8(k)
                    dy = tile[PIXEL_Y + i] + from_y
                    u = a * (tile[PIXEL_X + i] + from_x) + b * dy
                    v = c * dy
                    alpha = _alpha(log2_opacity - u * u - v * v)
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
                    sum_g += g
                    sum_u += gu
                    sum_v += gv
                    sum_uu += gu * u
                    sum_uv += gu * v
                    sum_vv += gv * v
                    sum_red += w * v_red
                    sum_green += w * v_green
                    sum_blue += w * v_blue
                    sum_depth += w * v_depth
                    sum_weight += w * tile[WEIGHT + i]
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
            for p in range(end, tile_starts[t + 1]):  # hidden behind a finished tile
                v_pair = v_pairs[pairs[p].slot]
                v_pair.sum = v_pair.u = v_pair.v = v_pair.uu = v_pair.uv = v_pair.vv = ZERO
                v_pair.red = v_pair.green = v_pair.blue = v_pair.depth = v_pair.contribution = ZERO


@parallel_kernel
def sum_pairs(
    first_slots: Int32,  # [N]
    slot_counts: Int32,  # [N]
    v_pairs: Any,  # SPLAT_GRADIENT per slot
    v_splats: Any,  # [N] SPLAT_GRADIENT, written; its colours and contribution go to arrays of their own:
    v_colors: F32,  # [N, 3] written
    contribution: F32,  # [N] written
) -> None:
    """Add up each Gaussian's pairs, in the order of their slots."""
    for i in numba.prange(first_slots.size):
        g = u = v = uu = uv = vv = red = green = blue = depth = weight = ZERO
        for slot in range(first_slots[i], first_slots[i] + slot_counts[i]):
            v_pair = v_pairs[slot]
            g += v_pair.sum
            u += v_pair.u
            v += v_pair.v
            uu += v_pair.uu
            uv += v_pair.uv
            vv += v_pair.vv
            red += v_pair.red
            green += v_pair.green
            blue += v_pair.blue
            depth += v_pair.depth
            weight += v_pair.contribution
        v_splat = v_splats[i]
        v_splat.sum = g
        v_splat.u = u
        v_splat.v = v
        v_splat.uu = uu
        v_splat.uv = uv
        v_splat.vv = vv
        v_splat.depth = depth
        v_colors[i, 0] = red
        v_colors[i, 1] = green
        v_colors[i, 2] = blue
        contribution[i] = weight
