"""Front-to-back blending of the splats of each tile, its derivative and the median depth.

Formulas: `engine.rasterizer.compositing`. A block of threads draws a tile of 16x16 px, a thread one pixel,
which is finished when its transmittance falls to `OPAQUE`.
"""

from __future__ import annotations

import warp as wp

from sags_node.engine.gpu.binning import LANES, TILE
from sags_node.engine.gpu.projection import LOG_MIN_ALPHA, vec16

wp.set_module_options({"enable_backward": False})

OPAQUE = 1e-4  # transmittance
BATCH = 8  # pairs that a block takes at a time in the backward pass
GROUP = LANES // BATCH  # threads that then sum one pair's moments
VALUES = 14  # moments of a pair
# Rows of a block's shared memory: six inputs of each pixel; its w for each pair of a batch; its dL/dlog alpha
# for each; partial sums. An odd number of columns avoids bank conflicts.
WEIGHTS, LOGS, PARTS = 6, 6 + BATCH, 6 + 2 * BATCH
ROWS, COLUMNS = PARTS + VALUES + 2, LANES + 1
shelf = wp.tile(dtype=float, shape=(ROWS, COLUMNS))


# Access to single elements of shared memory. With Warp's own functions each write would bring a barrier.
@wp.func_native("t.data(wp::tile_coord(i, j)) = value;")
def put(t: shelf, i: int, j: int, value: float): ...


@wp.func_native("return t.data(wp::tile_coord(i, j));")
def get(t: shelf, i: int, j: int) -> float: ...


@wp.func
def whitened(s: wp.vec4, r: wp.vec4, place_x: float, place_y: float):
    dy = place_y - s[1]
    return s[2] * (place_x - s[0]) + s[3] * dy, r[0] * dy


@wp.kernel(grid_stride=False)
def composite(
    splats: wp.array2d(dtype=wp.vec4), pairs: wp.array(dtype=int), starts: wp.array(dtype=int),
    width: int, height: int, active: wp.array(dtype=int),
    planes: wp.array3d(dtype=float), tile_ends: wp.array(dtype=int),
):  # fmt: skip
    """Write the planes [5, H, W] of active tiles. `tile_ends`: one after the last pair that a tile used."""
    tile, lane = wp.tid()
    tiles_x = (width + TILE - 1) // TILE
    x, y = tile % tiles_x * TILE + lane % TILE, tile // tiles_x * TILE + lane // TILE
    if x >= width or y >= height or active[tile] == 0:
        return
    place_x, place_y = float(x) + 0.5, float(y) + 0.5
    T, depth, color, end = float(1.0), float(0.0), wp.vec3(), int(starts[tile])
    for p in range(starts[tile], starts[tile + 1]):
        i = pairs[p]
        r = splats[i, 1]
        u, v = whitened(splats[i, 0], r, place_x, place_y)
        exponent = r[1] - u * u - v * v
        if exponent >= LOG_MIN_ALPHA:
            w = wp.exp(exponent) * T
            c = splats[i, 2]
            brighter = u * c[3] + v * splats[i, 3][0]
            color += w * wp.vec3(c[0] + brighter, c[1] + brighter, c[2] + brighter)
            depth += w * r[3]
            T -= w
            end = p + 1
            if T <= OPAQUE:
                break
    planes[0, y, x] = color[0]
    planes[1, y, x] = color[1]
    planes[2, y, x] = color[2]
    planes[3, y, x] = depth
    planes[4, y, x] = 1.0 - T
    wp.atomic_max(tile_ends, tile, end)


@wp.kernel(grid_stride=False)
def median(
    splats: wp.array2d(dtype=wp.vec4), pairs: wp.array(dtype=int), starts: wp.array(dtype=int),
    width: int, height: int, active: wp.array(dtype=int),
    depths: wp.array2d(dtype=float), rows: wp.array2d(dtype=int),
):  # fmt: skip
    """Write the depth and Gaussian where the transmittance falls to one half; 0, -1 where it stays above."""
    tile, lane = wp.tid()
    tiles_x = (width + TILE - 1) // TILE
    x, y = tile % tiles_x * TILE + lane % TILE, tile // tiles_x * TILE + lane // TILE
    if x >= width or y >= height or active[tile] == 0:
        return
    T, depth, found = float(1.0), float(0.0), int(-1)
    for p in range(starts[tile], starts[tile + 1]):
        i = pairs[p]
        r = splats[i, 1]
        u, v = whitened(splats[i, 0], r, float(x) + 0.5, float(y) + 0.5)
        exponent = r[1] - u * u - v * v
        if exponent >= LOG_MIN_ALPHA:
            T -= wp.exp(exponent) * T
            if T <= 0.5:
                depth = r[3]
                found = i
                break
    depths[y, x] = depth
    rows[y, x] = found


@wp.func
def weight_and_log(
    s: wp.vec4, r: wp.vec4, c: wp.vec4, slope_v: float, place_x: float, place_y: float, cotangent: wp.vec4,
    luminance: float, v_coverage: float, T: float, remaining: float,
):  # fmt: skip
    """Return w and dL/dlog alpha of a splat at a pixel, and the pixel's T and `remaining` (R) behind it."""
    u, v = whitened(s, r, place_x, place_y)
    exponent = r[1] - u * u - v * v
    w, g = float(0.0), float(0.0)
    if exponent >= LOG_MIN_ALPHA:
        alpha = wp.exp(exponent)
        w = alpha * T
        value = cotangent[0] * c[0] + cotangent[1] * c[1] + cotangent[2] * c[2]
        value += luminance * (u * c[3] + v * slope_v) + cotangent[3] * r[3] + v_coverage
        remaining -= w * value
        T -= w
        g = w * value - alpha / (1.0 - alpha) * remaining
    return w, g, T, remaining


@wp.func
def pixel_moments(
    s: wp.vec4, r: wp.vec4, place_x: float, place_y: float, w: float, g: float, v_color: wp.vec4,
    luminance: float, weight: float,
):  # fmt: skip
    """Return what a pixel adds to a pair's sums."""
    u, v = whitened(s, r, place_x, place_y)
    lit, counted = w * luminance, w * weight
    return vec16(
        g, g * u, g * v, g * u * u, g * u * v, g * v * v, w * v_color[0], w * v_color[1], w * v_color[2],
        w * v_color[3], counted, lit * u, lit * v, counted * (u * u + v * v), 0.0, 0.0,
    )  # fmt: skip


@wp.kernel(grid_stride=False)
def composite_backward(
    splats: wp.array2d(dtype=wp.vec4), pairs: wp.array(dtype=int), starts: wp.array(dtype=int),
    tile_ends: wp.array(dtype=int), width: int, height: int, active: wp.array(dtype=int),
    planes: wp.array3d(dtype=float), v_planes: wp.array3d(dtype=float), weights: wp.array2d(dtype=float),
    slots: wp.array(dtype=int), sums: wp.array2d(dtype=float),
):  # fmt: skip
    """Sum each pair's moments over a tile's pixels. Each thread finds w and dL/dlog alpha of its pixel for a
    batch of pairs. Then a group of threads sums the moments of one pair, and one thread adds up each moment.
    The order of every sum is fixed, so results repeat to the bit. Needs blocks of 256 threads."""
    tile, lane = wp.tid()
    if active[tile] == 0:
        return
    tiles_x = (width + TILE - 1) // TILE
    left, top = tile % tiles_x * TILE, tile // tiles_x * TILE
    x, y = left + lane % TILE, top + lane // TILE
    live = x < width and y < height
    place_x, place_y = float(x) + 0.5, float(y) + 0.5
    cotangent, v_coverage, remaining, weight = wp.vec4(), float(0.0), float(0.0), float(0.0)
    if live:
        cotangent = wp.vec4(v_planes[0, y, x], v_planes[1, y, x], v_planes[2, y, x], v_planes[3, y, x])
        v_coverage = v_planes[4, y, x]
        for k in range(5):
            remaining += planes[k, y, x] * v_planes[k, y, x]
        weight = weights[y, x]
    luminance = cotangent[0] + cotangent[1] + cotangent[2]
    shared = wp.tile_zeros(shape=(38, 257), dtype=float, storage="shared")
    for k in range(4):
        put(shared, k, lane, cotangent[k])
    put(shared, 4, lane, luminance)
    put(shared, 5, lane, weight)
    T = float(1.0)
    group, part = lane // GROUP, lane % GROUP
    end = tile_ends[tile]
    for first in range(starts[tile], end, BATCH):
        for k in range(wp.min(end - first, BATCH)):
            i = pairs[first + k]
            w, g = float(0.0), float(0.0)
            if live and T > OPAQUE:
                w, g, T, remaining = weight_and_log(
                    splats[i, 0], splats[i, 1], splats[i, 2], splats[i, 3][0], place_x, place_y, cotangent,
                    luminance, v_coverage, T, remaining,
                )  # fmt: skip
            put(shared, WEIGHTS + k, lane, w)
            put(shared, LOGS + k, lane, g)
        wp.tile_scatter_masked(shared, 0, 0, 0.0, False)  # a barrier
        if first + group < end:
            mine = pairs[first + group]
            m = vec16()
            for pixel in range(part, LANES, GROUP):
                share = get(shared, WEIGHTS + group, pixel)
                if share > 0.0:
                    m += pixel_moments(
                        splats[mine, 0], splats[mine, 1], float(left + pixel % TILE) + 0.5,
                        float(top + pixel // TILE) + 0.5, share, get(shared, LOGS + group, pixel),
                        wp.vec4(
                            get(shared, 0, pixel), get(shared, 1, pixel), get(shared, 2, pixel),
                            get(shared, 3, pixel),
                        ),
                        get(shared, 4, pixel), get(shared, 5, pixel),
                    )  # fmt: skip
            for k in range(VALUES):
                put(shared, PARTS + k, lane, m[k])
        wp.tile_scatter_masked(shared, 0, 0, 0.0, False)
        pair, value = lane // 16, lane % 16
        if pair < BATCH and first + pair < end and value < VALUES:
            total = float(0.0)
            for row in range(pair * GROUP, pair * GROUP + GROUP):
                total += get(shared, PARTS + value, row)
            sums[slots[first + pair], value] = total
