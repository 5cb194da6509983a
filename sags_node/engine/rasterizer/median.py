"""Median depth: that of the splat at which a pixel's transmittance falls to one half.

Unlike the mean it does not lie between two surfaces where one shines through the other.
"""

from typing import Any

import numba
import numpy as np

from sags_node.engine.rasterizer.compositing import (
    AHEAD,
    BLOCK_HEIGHT,
    BLOCKS,
    DEPTH,
    DRAWN,
    HALF,
    TEST_EVERY,
    TRANSMITTANCE,
    ZERO,
    alpha_of,
    any_above,
    open_tile,
    place_of,
    whitened,
    write_plane,
)
from sags_node.engine.rasterizer.layout import COLUMNS
from sags_node.kernels.jit import kernel, parallel_kernel, prefetch_read, take
from sags_node.kernels.vectors import (
    BLOCK_WIDTH,
    LANES,
    block_x,
    block_y,
    load,
    select,
    spread,
    spread_bits,
    store,
)
from sags_node.types import F32, I32, I64

f4 = np.float32
NOBODY = np.int32(-1)
FOUND = 2 * LANES  # the plane of a block that holds rows of Gaussians


@kernel
def _median_tiles(
    splats: Any, pairs: Any, tile_starts: I32, tile_ends: I32, drawn: I32, next_tile: I64, tile: F32,
    width: int, height: int, depths: F32, rows_of: I32,
) -> None:  # fmt: skip
    while True:
        turn = take(next_tile, 1)
        if turn >= drawn.size:
            break
        t = drawn[turn]
        x0, y0, columns, rows = place_of(t, width, height)
        open_tile(tile, DRAWN, columns, rows)
        for block in range(COLUMNS * BLOCKS):
            store(tile, block * DRAWN + DEPTH, spread(ZERO))
            store(tile, block * DRAWN + FOUND, spread_bits(NOBODY))
        until_test = TEST_EVERY
        for p in range(tile_starts[t], tile_ends[t]):
            if p + AHEAD < tile_ends[t]:
                prefetch_read(splats, pairs[p + AHEAD].splat)
            pair = pairs[p]
            splat = splats[pair.splat]
            a, b, c, log2_opacity = splat.whiten_xx, splat.whiten_xy, splat.whiten_yy, splat.log2_opacity
            depth, gaussian = splat.depth, spread_bits(np.int32(pair.splat))
            for column in range(COLUMNS):
                first, beyond = pair.begin[column] // BLOCK_HEIGHT, pair.end[column]
                blocks = (beyond + BLOCK_HEIGHT - 1) // BLOCK_HEIGHT - first
                dx = block_x() + (f4(x0 + column * BLOCK_WIDTH) + HALF - splat.mean_x)
                dy = block_y() + (f4(y0 + first * BLOCK_HEIGHT) + HALF - splat.mean_y)
                _, u, v = whitened(a, b, c, dx, dy)
                at = (column * BLOCKS + first) * DRAWN
                for _ in range(blocks):
                    before = load(tile, at + TRANSMITTANCE)
                    after = before - alpha_of(log2_opacity - v * v - u * u) * before
                    crossed = (before > HALF) & (after <= HALF)
                    store(tile, at + TRANSMITTANCE, after)
                    store(tile, at + DEPTH, select(crossed, depth, load(tile, at + DEPTH)))
                    store(tile, at + FOUND, select(crossed, gaussian, load(tile, at + FOUND)))
                    u += b * f4(BLOCK_HEIGHT)
                    v += c * f4(BLOCK_HEIGHT)
                    at += DRAWN
            until_test -= 1
            if until_test == 0:
                until_test = TEST_EVERY
                if not any_above(tile, DRAWN, HALF):
                    break
        start = y0 * width + x0
        write_plane(tile, DEPTH, DRAWN, depths, start, width, columns, rows)
        write_plane(tile.view(np.int32), FOUND, DRAWN, rows_of, start, width, columns, rows)


@parallel_kernel
def median(
    splats: Any,  # as in `composite`
    pairs: Any,
    tile_starts: I32,
    tile_ends: I32,
    drawn: I32,
    next_tile: I64,
    scratch: F32,
    width: int,
    height: int,
    depths: F32,  # [H W] m, written where drawn: of the splat that brings the transmittance to 1/2, or 0
    gaussians: I32,  # [H W] likewise: row of its Gaussian, or -1
) -> None:
    next_tile[0] = 0
    for worker in numba.prange(scratch.shape[0]):
        _median_tiles(
            splats, pairs, tile_starts, tile_ends, drawn, next_tile, scratch[worker], width, height, depths,
            gaussians,
        )  # fmt: skip
