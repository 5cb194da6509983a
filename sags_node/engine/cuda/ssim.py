"""Structural similarity (SSIM) and its gradient on the device; `engine.losses.ssim` has the formulas.

The window is separable: each blur runs along y into planes that stay in the device's L2 cache, and along x
out of them, 11 taps each. So forward and backward are two kernels each. A program is a tile of one channel:
its taps along y meet rows that its other pixels have brought to the L1 cache.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch
import triton
import triton.language as tl

from sags_node.engine.cuda.signatures import Compiled
from sags_node.engine.losses import ssim

if TYPE_CHECKING:
    from torch import Tensor

ROWS, COLUMNS = 16, 64  # of a tile, px
WARPS = 8  # 4 pixels a thread: with twice as many, registers leave room for few programs
RADIUS = tl.constexpr(ssim.RADIUS)
C1, C2 = tl.constexpr(float(ssim.C1)), tl.constexpr(float(ssim.C2))


@triton.jit
def _mirror(i: tl.tensor, size: tl.tensor) -> tl.tensor:
    """Row or column number, mirrored without repeating the edge, as often as it takes."""
    period = tl.maximum(2 * size - 2, 1)
    i = tl.abs(i) % period
    return tl.minimum(i, period - i)


@triton.jit
def _edge(i: tl.tensor, size: tl.tensor) -> tl.tensor:
    """D^-1 of `engine.losses.ssim`."""
    return tl.where((size > 1) & ((i == 0) | (i == size - 1)), 2.0, 1.0)


@triton.jit
def _tile(down: tl.tensor, across: tl.tensor, ROWS: tl.constexpr, COLUMNS: tl.constexpr) -> tl.tuple:
    """Rows [ROWS, 1] and columns [1, COLUMNS] of a tile, given which it is."""
    return down * ROWS + tl.arange(0, ROWS)[:, None], across * COLUMNS + tl.arange(0, COLUMNS)[None, :]


@triton.jit(do_not_specialize=("height", "width"))
def _blur_pictures(
    picture: tl.tensor,  # [C, H, W]
    truth: tl.tensor,  # [C, H, W]
    weight: tl.tensor,  # [H, W]
    window: tl.tensor,  # [11]
    blurred: tl.tensor,  # [C, 4, H, W] written: sum, difference and their squares, blurred along y
    height: tl.tensor,
    width: tl.tensor,
    ROWS: tl.constexpr,
    COLUMNS: tl.constexpr,
) -> None:
    y, x = _tile(tl.program_id(1), tl.program_id(0), ROWS, COLUMNS)
    inside, pixels, channel = (y < height) & (x < width), height * width, tl.program_id(2)
    mean_s, mean_d = tl.zeros([ROWS, COLUMNS], tl.float32), tl.zeros([ROWS, COLUMNS], tl.float32)
    square_s, square_d = tl.zeros([ROWS, COLUMNS], tl.float32), tl.zeros([ROWS, COLUMNS], tl.float32)
    for tap in range(2 * RADIUS + 1):
        at = _mirror(y + (tap - RADIUS), height) * width + x
        share = tl.load(window + tap)
        true = tl.load(truth + channel * pixels + at, inside, other=0.0)
        drawn = tl.load(picture + channel * pixels + at, inside, other=0.0)
        d = tl.where(tl.load(weight + at, inside, other=0.0) > 0.0, drawn - true, 0.0)
        s = 2.0 * true - 1.0 + d  # around mid-grey: variances cancel less
        mean_s += share * s
        mean_d += share * d
        square_s += share * (s * s)
        square_d += share * (d * d)
    at = blurred + 4 * channel * pixels + y * width + x
    tl.store(at, mean_s, inside)
    tl.store(at + pixels, mean_d, inside)
    tl.store(at + 2 * pixels, square_s, inside)
    tl.store(at + 3 * pixels, square_d, inside)


@triton.jit(do_not_specialize=("height", "width"))
def _compare(
    blurred: tl.tensor,  # [C, 4, H, W] of `_blur_pictures`
    weight: tl.tensor,  # [H, W]
    window: tl.tensor,  # [11]
    by_blurred: tl.tensor,  # [C, 3, H, W] written: gradients by mean and by the squares, times D^-1
    sums: tl.tensor,  # [programs] written: 1 - SSIM
    height: tl.tensor,
    width: tl.tensor,
    ROWS: tl.constexpr,
    COLUMNS: tl.constexpr,
) -> None:
    y, x = _tile(tl.program_id(1), tl.program_id(0), ROWS, COLUMNS)
    inside, pixels, channel = (y < height) & (x < width), height * width, tl.program_id(2)
    centred, mean_d = tl.zeros([ROWS, COLUMNS], tl.float32), tl.zeros([ROWS, COLUMNS], tl.float32)
    square_s, square_d = tl.zeros([ROWS, COLUMNS], tl.float32), tl.zeros([ROWS, COLUMNS], tl.float32)
    for tap in range(2 * RADIUS + 1):
        at = blurred + 4 * channel * pixels + y * width + _mirror(x + (tap - RADIUS), width)
        share = tl.load(window + tap)
        centred += share * tl.load(at, inside, other=0.0)
        mean_d += share * tl.load(at + pixels, inside, other=0.0)
        square_s += share * tl.load(at + 2 * pixels, inside, other=0.0)
        square_d += share * tl.load(at + 3 * pixels, inside, other=0.0)
    mean_s, squares = centred + 1.0, mean_d * mean_d
    variance_d, variance_s = square_d - squares, square_s - centred * centred
    by_b1 = 1.0 / (0.5 * (mean_s * mean_s + squares) + C1)
    by_b2 = 1.0 / (0.5 * (variance_s + variance_d) + C2)
    p, q = squares * by_b1, variance_d * by_b2
    by_p, by_q = (1.0 - q) * by_b1, (1.0 - p) * by_b2
    by_square_d, by_square_s = by_q * (1.0 - 0.5 * q), -0.5 * by_q * q
    by_mean = by_p * (mean_d * (2.0 - p) - mean_s * p) - 2.0 * (mean_d * by_square_d + centred * by_square_s)
    counted = tl.load(weight + y * width + x, inside, other=0.0) > 0.0
    edge = _edge(y, height) * _edge(x, width)
    at = by_blurred + 3 * channel * pixels + y * width + x
    tl.store(at, tl.where(counted, edge * by_mean, 0.0), inside)
    tl.store(at + pixels, tl.where(counted, edge * by_square_s, 0.0), inside)
    tl.store(at + 2 * pixels, tl.where(counted, edge * by_square_d, 0.0), inside)
    tile = (channel * tl.num_programs(1) + tl.program_id(1)) * tl.num_programs(0) + tl.program_id(0)
    tl.store(sums + tile, tl.sum(tl.where(counted, p + q - p * q, 0.0)))


@triton.jit(do_not_specialize=("height", "width"))
def _blur_gradients(
    by_blurred: tl.tensor,  # [C, 3, H, W] of `_compare`
    window: tl.tensor,  # [11]
    blurred: tl.tensor,  # [C, 3, H, W] written: the same, blurred along y
    height: tl.tensor,
    width: tl.tensor,
    ROWS: tl.constexpr,
    COLUMNS: tl.constexpr,
) -> None:
    y, x = _tile(tl.program_id(1), tl.program_id(0), ROWS, COLUMNS)
    inside, pixels = (y < height) & (x < width), height * width
    for plane in tl.static_range(3):
        first = (3 * tl.program_id(2) + plane) * pixels
        total = tl.zeros([ROWS, COLUMNS], tl.float32)
        for tap in range(2 * RADIUS + 1):
            at = first + _mirror(y + (tap - RADIUS), height) * width + x
            total += tl.load(window + tap) * tl.load(by_blurred + at, inside, other=0.0)
        tl.store(blurred + first + y * width + x, total, inside)


@triton.jit(do_not_specialize=("height", "width"))
def _pull_back(
    picture: tl.tensor,  # [C, H, W]
    truth: tl.tensor,  # [C, H, W]
    weight: tl.tensor,  # [H, W]
    blurred: tl.tensor,  # [C, 3, H, W] of `_blur_gradients`
    window: tl.tensor,  # [11]
    scale: tl.tensor,  # [1]
    v_picture: tl.tensor,  # [C, H, W] written
    height: tl.tensor,
    width: tl.tensor,
    ROWS: tl.constexpr,
    COLUMNS: tl.constexpr,
) -> None:
    y, x = _tile(tl.program_id(1), tl.program_id(0), ROWS, COLUMNS)
    inside, pixels, channel = (y < height) & (x < width), height * width, tl.program_id(2)
    by_mean, by_square_s = tl.zeros([ROWS, COLUMNS], tl.float32), tl.zeros([ROWS, COLUMNS], tl.float32)
    by_square_d = tl.zeros([ROWS, COLUMNS], tl.float32)
    for tap in range(2 * RADIUS + 1):
        at = blurred + 3 * channel * pixels + y * width + _mirror(x + (tap - RADIUS), width)
        share = tl.load(window + tap)
        by_mean += share * tl.load(at, inside, other=0.0)
        by_square_s += share * tl.load(at + pixels, inside, other=0.0)
        by_square_d += share * tl.load(at + 2 * pixels, inside, other=0.0)
    at = channel * pixels + y * width + x
    true = tl.load(truth + at, inside, other=0.0)
    difference = tl.load(picture + at, inside, other=0.0) - true
    gradient = by_mean + 2.0 * ((2.0 * true - 1.0 + difference) * by_square_s + difference * by_square_d)
    factor = tl.load(scale) / (_edge(y, height) * _edge(x, width))
    counted = tl.load(weight + y * width + x, inside, other=0.0) > 0.0
    tl.store(v_picture + at, tl.where(counted, factor * gradient, 0.0), inside)


class Dissimilarity:
    """1 - SSIM between pictures [3, H, W] of one size on one device, with its gradient; the same bits every
    time. What counts, and how borders are taken, is that of `engine.losses.ssim.Dissimilarity`. Memory is
    taken once, 84 bytes per pixel."""

    def __init__(self, width: int, height: int, device: torch.device) -> None:
        window = [ssim.W5, ssim.W4, ssim.W3, ssim.W2, ssim.W1, ssim.W0]
        taps = [float(tap) for tap in window + window[-2::-1]]
        self._window = torch.tensor(taps, dtype=torch.float32, device=device)
        self._size = height, width
        self._grid = triton.cdiv(width, COLUMNS), triton.cdiv(height, ROWS), 3
        self._blurred = torch.empty((3, 4, height, width), device=device)
        self._by_blurred = torch.empty((3, 3, height, width), device=device)
        self._sums = torch.empty(self._grid, device=device)

    def forward(self, picture: Tensor, truth: Tensor, weight: Tensor) -> Tensor:
        """Sum of 1 - SSIM over the pixels that count and the channels: [] float64 on the device.

        Args:
            picture: [3, H, W] RGB 0..1; finite where it counts.
            truth: [3, H, W] RGB 0..1, finite everywhere.
            weight: [H, W] a pixel counts where this is positive; its size does not matter.
        """
        self._inputs = picture, truth, weight
        _blur_pictures[self._grid](
            *self._inputs,
            self._window,
            self._blurred,
            *self._size,
            ROWS=ROWS,
            COLUMNS=COLUMNS,
            num_warps=WARPS,
        )
        _compare[self._grid](
            self._blurred, weight, self._window, self._by_blurred, self._sums, *self._size,
            ROWS=ROWS, COLUMNS=COLUMNS, num_warps=WARPS,
        )  # fmt: skip
        return self._sums.sum(dtype=torch.float64)

    def backward(self, scale: Tensor, v_picture: Tensor) -> None:
        """Write `scale` times the gradient of the last `forward`, whose tensors must be unchanged.

        Args:
            scale: [] on the device; 1 / (3 times the number of pixels that count) makes it the gradient of
                the mean.
            v_picture: [3, H, W] written; 0 where a pixel does not count.
        """
        _blur_gradients[self._grid](
            self._by_blurred,
            self._window,
            self._blurred,
            *self._size,
            ROWS=ROWS,
            COLUMNS=COLUMNS,
            num_warps=WARPS,
        )
        _pull_back[self._grid](
            *self._inputs, self._blurred, self._window, scale, v_picture, *self._size,
            ROWS=ROWS, COLUMNS=COLUMNS, num_warps=WARPS,
        )  # fmt: skip


def _compiled(kernel: Any, *tables: str) -> Compiled:
    signature = {**dict.fromkeys(tables, "*fp32"), "height": "i32", "width": "i32"}
    return Compiled(kernel, signature, {"ROWS": ROWS, "COLUMNS": COLUMNS}, WARPS)


SIGNATURES = (
    _compiled(_blur_pictures, "picture", "truth", "weight", "window", "blurred"),
    _compiled(_compare, "blurred", "weight", "window", "by_blurred", "sums"),
    _compiled(_blur_gradients, "by_blurred", "window", "blurred"),
    _compiled(_pull_back, "picture", "truth", "weight", "blurred", "window", "scale", "v_picture"),
)
