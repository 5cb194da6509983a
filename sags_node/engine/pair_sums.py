"""From gradients per pair to gradients per splat and per Gaussian."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np

from sags_node.kernels.jit import inlined, kernel, parallel_kernel, prefetch_read, take
from sags_node.types import F32, I64

ZERO = np.float32(0.0)
AHEAD = 8
BLOCK = 256  # Gaussians that a worker takes at a time


@inlined
def _sum_slots(first: int, end: int, v_pairs: Any, v_splat: Any, v_color: F32) -> Any:
    """Sum of a splat's pairs in the order of their slots; returns its contribution."""
    g = u = v = uu = uv = vv = red = green = blue = depth = weight = ZERO
    for slot in range(first, end):
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
    v_splat.sum = g
    v_splat.u = u
    v_splat.v = v
    v_splat.uu = uu
    v_splat.uv = uv
    v_splat.vv = vv
    v_splat.depth = depth
    v_color[0] = red
    v_color[1] = green
    v_color[2] = blue
    return weight


@kernel
def _sum_blocks(
    slots: Any, v_pairs: Any, v_splats: Any, v_view_colors: F32, v_colors: F32, contribution: F32,
    next_block: I64,
) -> None:  # fmt: skip
    count = contribution.size
    while True:
        first = take(next_block, 1) * BLOCK
        if first >= count:
            break
        for gaussian in range(first, min(first + BLOCK, count)):
            red = green = blue = weight = ZERO
            for i in range(gaussian, slots.size, count):
                if i + AHEAD < slots.size:
                    soon = slots[i + AHEAD]
                    prefetch_read(v_pairs, soon.first)
                    prefetch_read(v_pairs, soon.first + 1)
                begin, end = slots[i].first, slots[i].first + slots[i].count
                color = v_view_colors[i]
                if begin < end:
                    weight += _sum_slots(begin, end, v_pairs, v_splats[i], color)
                else:
                    color[0] = color[1] = color[2] = ZERO
                red += color[0]
                green += color[1]
                blue += color[2]
            v_colors[gaussian, 0] = red
            v_colors[gaussian, 1] = green
            v_colors[gaussian, 2] = blue
            contribution[gaussian] = weight


@parallel_kernel
def sum_pairs(
    workers: int,
    slots: Any,  # [C N] SLOTS
    v_pairs: Any,  # SPLAT_GRADIENT per slot
    v_splats: Any,  # [C N] SPLAT_GRADIENT, written where drawn; without colours and contribution, which are
    v_view_colors: F32,  # [C N, 3] written, and summed over the cameras to
    v_colors: F32,  # [N, 3] written
    contribution: F32,  # [N] written
    next_block: I64,  # [1] for the workers
) -> None:
    next_block[0] = 0
    for _ in numba.prange(workers):
        _sum_blocks(slots, v_pairs, v_splats, v_view_colors, v_colors, contribution, next_block)
