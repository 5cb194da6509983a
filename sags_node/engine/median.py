"""Median depth: that of the splat at which a pixel's transmittance falls to one half.

Unlike the mean it does not lie between two surfaces where one shines through the other.
"""

from __future__ import annotations

from typing import Any

import numba
import numpy as np

from sags_node.engine.compositing import (
    AHEAD,
    DEPTH,
    HALF,
    REMAINING,
    ROW_EXPONENT,
    ROW_U,
    TEST_EVERY,
    TILE_PIXELS,
    TILE_WIDTH,
    TRANSMITTANCE,
    ZERO,
    alpha_of,
    any_above,
    open_tile,
    place_of,
    store,
    write_rows,
)
from sags_node.kernels.jit import kernel, parallel_kernel, prefetch_read, take
from sags_node.types import F32, I32, I64

f4 = np.float32
u8 = np.uint64
FOUND = REMAINING  # the plane of the scratch that holds rows of Gaussians, as integers


@kernel
def _median_tiles(
    splats: Any, pairs: Any, tile_starts: I32, tile_ends: I32, drawn: I32, next_tile: I64, tile: F32,
    width: int, height: int, depths: F32, rows_of: I32,
) -> None:  # fmt: skip
    count = splats.size // (depths.size // (width * height))  # Gaussians
    gaussians = tile.view(np.int32)
    while True:
        turn = take(next_tile, 1)
        if turn >= drawn.size:
            break
        t = drawn[turn]
        camera, x0, y0, columns, rows = place_of(t, width, height)
        open_tile(tile, columns, rows)
        for k in range(TILE_PIXELS):
            tile[DEPTH + u8(k)] = ZERO
            gaussians[FOUND + u8(k)] = -1
        until_test = TEST_EVERY
        for p in range(tile_starts[t], tile_ends[t]):
            if p + AHEAD < tile_ends[t]:
                prefetch_read(splats, pairs[p + AHEAD].splat)
            pair = pairs[p]
            splat = splats[pair.splat]
            a, depth = splat.whiten_xx, splat.depth
            gaussian = np.int32(pair.splat - camera * count)
            write_rows(tile, splat, x0, y0)
            for row in range(pair.row_begin, pair.row_end):
                row_u, row_exponent = tile[ROW_U + u8(row)], tile[ROW_EXPONENT + u8(row)]
                first = u8(row * TILE_WIDTH)
                for k in range(TILE_WIDTH):
                    i = first + u8(k)
                    u = a * (f4(k) + HALF) + row_u
                    before = tile[TRANSMITTANCE + i]
                    after = before - alpha_of(row_exponent - u * u) * before
                    crossed = (before > HALF) & (after <= HALF)
                    tile[TRANSMITTANCE + i] = after
                    tile[DEPTH + i] = depth if crossed else tile[DEPTH + i]
                    gaussians[FOUND + i] = gaussian if crossed else gaussians[FOUND + i]
            until_test -= 1
            if until_test == 0:
                until_test = TEST_EVERY
                if not any_above(tile, HALF):
                    break
        start = (camera * height + y0) * width + x0
        store(tile, DEPTH, depths, start, width, columns, rows)
        store(gaussians, FOUND, rows_of, start, width, columns, rows)


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
    depths: F32,  # [C H W] m, written where drawn: of the splat that brings the transmittance to 1/2, or 0
    gaussians: I32,  # [C H W] likewise: row of its Gaussian, or -1
) -> None:
    next_tile[0] = 0
    for worker in numba.prange(scratch.shape[0]):
        _median_tiles(
            splats, pairs, tile_starts, tile_ends, drawn, next_tile, scratch[worker], width, height, depths,
            gaussians,
        )  # fmt: skip
