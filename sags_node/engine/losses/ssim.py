"""Structural similarity (SSIM) of two pictures and its gradient, fused.

SSIM as in Wang et al. (2004): 11x11 Gaussian window of sigma 1.5, K1 = 0.01, K2 = 0.03, values 0..1.

With s = x + y, d = x - y and local means m and variances v (all of them window averages),

    1 - SSIM = p + q - p q,   p = m_d^2 / ((m_s^2 + m_d^2) / 2 + C1),   q = v_d / ((v_s + v_d) / 2 + C2).

That is the published formula written in sums and differences. It takes four blurs instead of five, is exactly
0 with gradient 0 where the pictures are equal, and cancels nothing. The backward pass takes three.

Borders are mirrored without repeating the edge (OpenCV's default). With G that blur in one direction and
D = diag(1/2, 1, ..., 1, 1/2), the transposed blur is G' = D G D^-1: the same blur between two scalings.

The picture is cut into tiles with a halo. Tile sizes stand here only.
"""

from __future__ import annotations

import math
from typing import Any

import numba
import numpy as np

from sags_node.kernels.jit import aligned, inlined, kernel, parallel_kernel, read_only
from sags_node.kernels.threads import thread_count
from sags_node.types import F32, I64

f4 = np.float32
u8 = np.uint64

RADIUS = 5
TILE_WIDTH, TILE_HEIGHT = 128, 32
MARGIN = 8  # columns kept left and right of a tile, RADIUS of them used: rows start on 32 bytes
STRIDE = TILE_WIDTH + 2 * MARGIN
ROWS = TILE_HEIGHT + 2 * RADIUS
AREA = TILE_HEIGHT * STRIDE  # what remains after the blur along y
PLANE = ROWS * STRIDE + 16  # 64 bytes of padding: planes 4 KiB apart would evict each other
SCRATCH = 6 * PLANE  # floats per worker

# planes of the scratch array; row 0 is picture row y0 - RADIUS before a blur and y0 after it
SUM, DIFFERENCE, SUM2, DIFFERENCE2 = u8(0), u8(PLANE), u8(2 * PLANE), u8(3 * PLANE)
COUNTED, BLURRED_ROWS = u8(4 * PLANE), u8(5 * PLANE)
BY_MEAN, BY_SUM2, BY_DIFFERENCE2 = SUM, SUM2, DIFFERENCE2  # gradients stand where the blurred values stood

_window = np.exp(-0.5 * (np.arange(RADIUS + 1) / 1.5) ** 2)
_window /= 2 * _window.sum() - _window[0]
W0, W1, W2, W3, W4, W5 = (f4(weight) for weight in _window)

C1, C2 = f4(0.01**2), f4(0.03**2)
ZERO, HALF, ONE, TWO = f4(0.0), f4(0.5), f4(1.0), f4(2.0)


@kernel
def _blur(tile: F32, plane: Any) -> None:
    """Blur a plane in place: first along y into a spare plane, then along x back."""
    for k in range(AREA):
        i = plane + u8(k)
        tile[BLURRED_ROWS + u8(k)] = (
            W5 * (tile[i] + tile[i + u8(10 * STRIDE)])
            + W4 * (tile[i + u8(STRIDE)] + tile[i + u8(9 * STRIDE)])
            + W3 * (tile[i + u8(2 * STRIDE)] + tile[i + u8(8 * STRIDE)])
            + W2 * (tile[i + u8(3 * STRIDE)] + tile[i + u8(7 * STRIDE)])
            + W1 * (tile[i + u8(4 * STRIDE)] + tile[i + u8(6 * STRIDE)])
            + W0 * tile[i + u8(5 * STRIDE)]
        )
    for k in range(AREA - 2 * RADIUS):
        i = BLURRED_ROWS + u8(k)
        tile[plane + u8(RADIUS) + u8(k)] = (
            W5 * (tile[i] + tile[i + u8(10)])
            + W4 * (tile[i + u8(1)] + tile[i + u8(9)])
            + W3 * (tile[i + u8(2)] + tile[i + u8(8)])
            + W2 * (tile[i + u8(3)] + tile[i + u8(7)])
            + W1 * (tile[i + u8(4)] + tile[i + u8(6)])
            + W0 * tile[i + u8(5)]
        )


@inlined
def _mirror_columns(tile: F32, row: Any, x0: int, columns: I64) -> None:
    """Fill the halo of one staged row where it lies beyond the picture."""
    width = columns.size - 2 * RADIUS
    if x0 == 0:
        for k in range(RADIUS):
            tile[row + u8(MARGIN - RADIUS + k)] = tile[row + u8(MARGIN + columns[k])]
    for x in range(width, min(width + RADIUS, x0 + TILE_WIDTH + RADIUS)):
        tile[row + u8(MARGIN + x - x0)] = tile[row + u8(MARGIN + columns[RADIUS + x] - x0)]


@inlined
def _stage_pictures(
    tile: F32, picture: F32, truth: F32, weight: F32, x0: int, y0: int, rows: I64, columns: I64
) -> None:
    """Sum and difference with their halo. Sums are taken around mid-grey: variances cancel less."""
    height, width = picture.shape
    left = max(x0 - MARGIN, 0)
    count = min(x0 + TILE_WIDTH + MARGIN, width) - left
    for r in range(min(ROWS, height - y0 + 2 * RADIUS)):
        y = rows[y0 + r]
        row = u8(r * STRIDE)
        drawn, true, counts = picture[y], truth[y], weight[y]
        first, start = row + u8(left - x0 + MARGIN), u8(left)
        for k in range(count):
            x, i = start + u8(k), first + u8(k)
            difference = drawn[x] - true[x] if counts[x] > ZERO else ZERO
            tile[DIFFERENCE + i] = difference
            tile[SUM + i] = TWO * true[x] - ONE + difference
        _mirror_columns(tile, DIFFERENCE + row, x0, columns)
        _mirror_columns(tile, SUM + row, x0, columns)


@inlined
def _edge(y: int, height: int) -> Any:
    """D^-1 of the module's text."""
    return TWO if height > 1 and (y == 0 or y == height - 1) else ONE


@inlined
def _compare(tile: F32) -> Any:
    """From four blurred planes to three gradient planes; returns the sum of 1 - SSIM where COUNTED."""
    total = ZERO
    for k in range(AREA):
        i = u8(k)
        counted = tile[COUNTED + i]
        mean_d, centred = tile[DIFFERENCE + i], tile[SUM + i]
        mean_s = centred + ONE
        squares = mean_d * mean_d
        variance_d = tile[DIFFERENCE2 + i] - squares
        variance_s = tile[SUM2 + i] - centred * centred
        by_b1 = ONE / (HALF * (mean_s * mean_s + squares) + C1)
        by_b2 = ONE / (HALF * (variance_s + variance_d) + C2)
        p, q = squares * by_b1, variance_d * by_b2
        by_p, by_q = (ONE - q) * by_b1, (ONE - p) * by_b2
        by_difference2 = by_q * (ONE - HALF * q)
        by_sum2 = -HALF * by_q * q
        by_mean = by_p * (mean_d * (TWO - p) - mean_s * p)
        by_mean -= TWO * (mean_d * by_difference2 + centred * by_sum2)
        # a select, not a product: outside the picture a plane may hold anything
        total += p + q - p * q if counted > ZERO else ZERO
        tile[BY_MEAN + i] = by_mean if counted > ZERO else ZERO
        tile[BY_SUM2 + i] = by_sum2 if counted > ZERO else ZERO
        tile[BY_DIFFERENCE2 + i] = by_difference2 if counted > ZERO else ZERO
    return total


@kernel
def _store_gradients(tile: F32, plane: Any, target: F32, x0: int, y0: int) -> None:
    """Write a plane to its place in a picture [H, W], times D^-1 of both directions."""
    height, width = target.shape
    columns = min(TILE_WIDTH, width - x0)
    for r in range(min(TILE_HEIGHT, height - y0)):
        row, first = target[y0 + r], plane + u8(r * STRIDE + MARGIN)
        edge = _edge(y0 + r, height)
        for x in range(columns):
            row[u8(x0) + u8(x)] = edge * tile[first + u8(x)]
        if x0 == 0:
            row[0] *= _edge(0, width)
        if x0 + columns == width:
            row[width - 1] *= _edge(width - 1, width)


@kernel
def _stage_gradients(tile: F32, plane: Any, source: F32, x0: int, y0: int, rows: I64, columns: I64) -> None:
    """Read a tile of a picture [H, W] with its halo."""
    height, width = source.shape
    left = max(x0 - MARGIN, 0)
    count = min(x0 + TILE_WIDTH + MARGIN, width) - left
    for r in range(min(ROWS, height - y0 + 2 * RADIUS)):
        stored, row = source[rows[y0 + r]], plane + u8(r * STRIDE)
        first = row + u8(left - x0 + MARGIN)
        for k in range(count):
            tile[first + u8(k)] = stored[u8(left) + u8(k)]
        _mirror_columns(tile, row, x0, columns)


@kernel
def _forward_tile(
    tile: F32,
    picture: F32,  # [H, W] one channel
    truth: F32,
    weight: F32,
    rows: I64,
    columns: I64,
    x0: int,
    y0: int,
    by_blurred: F32,  # [3, H, W] written
) -> Any:
    height, width = picture.shape
    used_columns = min(TILE_WIDTH, width - x0)
    used_rows = min(TILE_HEIGHT, height - y0)
    _stage_pictures(tile, picture, truth, weight, x0, y0, rows, columns)
    for k in range(ROWS * STRIDE):
        i = u8(k)
        tile[SUM2 + i] = tile[SUM + i] * tile[SUM + i]
        tile[DIFFERENCE2 + i] = tile[DIFFERENCE + i] * tile[DIFFERENCE + i]
    for k in range(AREA):
        tile[COUNTED + u8(k)] = ZERO
    for r in range(used_rows):
        counts, first = weight[y0 + r], COUNTED + u8(r * STRIDE + MARGIN)
        for x in range(used_columns):
            tile[first + u8(x)] = counts[u8(x0) + u8(x)]
    _blur(tile, SUM)
    _blur(tile, DIFFERENCE)
    _blur(tile, SUM2)
    _blur(tile, DIFFERENCE2)
    total = _compare(tile)
    _store_gradients(tile, BY_MEAN, by_blurred[0], x0, y0)
    _store_gradients(tile, BY_SUM2, by_blurred[1], x0, y0)
    _store_gradients(tile, BY_DIFFERENCE2, by_blurred[2], x0, y0)
    return total


@parallel_kernel
def _forward(
    picture: F32,  # [C, H, W]
    truth: F32,  # [C, H, W]
    weight: F32,  # [H, W]
    rows: I64,  # [H + 2 RADIUS] mirrored row numbers
    columns: I64,  # [W + 2 RADIUS]
    scratch: F32,  # [workers, SCRATCH]
    by_blurred: F32,  # [C, 3, H, W] written: gradients of the blurred planes, times D^-1
    tile_sums: F32,  # [C, tiles] written
) -> None:
    channels, _, width = picture.shape
    tiles_x = (width + TILE_WIDTH - 1) // TILE_WIDTH
    tiles = tile_sums.shape[1]
    workers = scratch.shape[0]
    for worker in numba.prange(workers):
        for t in range(worker, channels * tiles, workers):
            c = t // tiles
            x0 = t % tiles % tiles_x * TILE_WIDTH
            y0 = t % tiles // tiles_x * TILE_HEIGHT
            tile_sums[c, t % tiles] = _forward_tile(
                scratch[worker], picture[c], truth[c], weight, rows, columns, x0, y0, by_blurred[c]
            )


@kernel
def _backward_tile(
    tile: F32,
    picture: F32,
    truth: F32,
    weight: F32,
    rows: I64,
    columns: I64,
    x0: int,
    y0: int,
    by_blurred: F32,
    scale: Any,
    v_picture: F32,  # [H, W] written
) -> None:
    height, width = picture.shape
    used_columns = min(TILE_WIDTH, width - x0)
    _stage_gradients(tile, BY_MEAN, by_blurred[0], x0, y0, rows, columns)
    _stage_gradients(tile, BY_SUM2, by_blurred[1], x0, y0, rows, columns)
    _stage_gradients(tile, BY_DIFFERENCE2, by_blurred[2], x0, y0, rows, columns)
    _blur(tile, BY_MEAN)
    _blur(tile, BY_SUM2)
    _blur(tile, BY_DIFFERENCE2)
    for r in range(min(TILE_HEIGHT, height - y0)):
        y = y0 + r
        drawn, true, counts, target = picture[y], truth[y], weight[y], v_picture[y]
        factor = scale / _edge(y, height)
        first = u8(r * STRIDE + MARGIN)
        for k in range(used_columns):
            x, i = u8(x0) + u8(k), first + u8(k)
            difference = drawn[x] - true[x]
            centred = TWO * true[x] - ONE + difference
            gradient = tile[BY_MEAN + i] + TWO * (
                centred * tile[BY_SUM2 + i] + difference * tile[BY_DIFFERENCE2 + i]
            )
            target[x] = factor * gradient if counts[x] > ZERO else ZERO
        if x0 == 0:
            target[0] /= _edge(0, width)
        if x0 + used_columns == width:
            target[width - 1] /= _edge(width - 1, width)


@parallel_kernel
def _backward(
    picture: F32,
    truth: F32,
    weight: F32,
    rows: I64,
    columns: I64,
    scratch: F32,
    by_blurred: F32,  # [C, 3, H, W] of `_forward`
    scale: Any,
    v_picture: F32,  # [C, H, W] written
) -> None:
    channels, height, width = picture.shape
    tiles_x = (width + TILE_WIDTH - 1) // TILE_WIDTH
    tiles = tiles_x * ((height + TILE_HEIGHT - 1) // TILE_HEIGHT)
    workers = scratch.shape[0]
    for worker in numba.prange(workers):
        for t in range(worker, channels * tiles, workers):
            c = t // tiles
            x0 = t % tiles % tiles_x * TILE_WIDTH
            y0 = t % tiles // tiles_x * TILE_HEIGHT
            _backward_tile(
                scratch[worker], picture[c], truth[c], weight, rows, columns, x0, y0,
                by_blurred[c], scale, v_picture[c],
            )  # fmt: skip


class Dissimilarity:
    """1 - SSIM between pictures of one size, with its gradient. Memory is taken once, 36 bytes per pixel.

    Pixels that do not count are set to the truth in both pictures, so that an instrument, which the model
    does not draw, costs nothing at the tissue beside it. The mean runs over the pixels that count and the
    three channels. `evaluation.metrics.ssim` defines its figure the same way.
    """

    def __init__(self, width: int, height: int) -> None:
        self._rows, self._columns = (np.pad(np.arange(n), RADIUS, mode="reflect") for n in (height, width))
        self._by_blurred = aligned((3, 3, height, width))
        tiles = math.ceil(width / TILE_WIDTH) * math.ceil(height / TILE_HEIGHT)
        self._tile_sums = np.zeros((3, tiles), np.float32)
        self._scratch = aligned((thread_count(), SCRATCH))

    def forward(self, picture: F32, truth: F32, weight: F32) -> float:
        """Sum of 1 - SSIM over the pixels that count and the channels; the same for any number of threads.

        Args:
            picture: [3, H, W] RGB 0..1; finite where it counts.
            truth: [3, H, W] RGB 0..1, finite everywhere.
            weight: [H, W] a pixel counts where this is positive; its size does not matter.
        """
        if len(self._scratch) != thread_count():
            self._scratch = aligned((thread_count(), SCRATCH))
        self._inputs = read_only(picture), read_only(truth), read_only(weight)
        _forward(
            *self._inputs,
            self._rows,
            self._columns,
            self._scratch,
            self._by_blurred,
            self._tile_sums,
        )
        return float(self._tile_sums.sum(dtype=np.float64))

    def backward(self, scale: float, v_picture: F32) -> None:
        """Write `scale` times the gradient of the last `forward`, whose arrays must be unchanged.

        Args:
            scale: 1 / (3 times the number of pixels that count) makes it the gradient of the mean.
            v_picture: [3, H, W] written; 0 where a pixel does not count.
        """
        _backward(
            *self._inputs,
            self._rows,
            self._columns,
            self._scratch,
            read_only(self._by_blurred),
            f4(scale),
            v_picture,
        )
