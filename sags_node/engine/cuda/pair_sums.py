"""From gradients per pair to gradients per splat and per Gaussian."""

from __future__ import annotations

import triton
import triton.language as tl

from sags_node.engine.cuda.layout import (
    V_BLUE,
    V_DEPTH,
    V_GREEN,
    V_RED,
    V_SPLAT_FLOATS,
    V_SUM,
    V_U,
    V_UU,
    V_UV,
    V_V,
    V_VV,
    V_WEIGHT,
)
from sags_node.engine.cuda.signatures import Compiled
from sags_node.engine.cuda.vectors import store3

BLOCK = 32  # Gaussians per program: one warp, which waits for the one with the most pairs
WARPS = 1


@triton.jit(do_not_specialize=["count", "camera_count"])
def sum_pairs(
    first_slots: tl.tensor,  # [C N]
    counts: tl.tensor,  # [C N]
    v_pairs: tl.tensor,  # [P, V_SPLAT_FLOATS] per slot
    v_splats: tl.tensor,  # [C N, V_SPLAT_FLOATS] written
    v_colors: tl.tensor,  # [N, 3] written: the sum over the cameras
    contribution: tl.tensor,  # [N] likewise
    count: tl.tensor,  # N
    camera_count: tl.tensor,  # C
    BLOCK: tl.constexpr,
) -> None:
    """Pairs are added in the order of their slots, cameras in theirs."""
    rows = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    inside = rows < count
    zero = tl.zeros([BLOCK], tl.float32)
    all_red, all_green, all_blue, all_weight = zero, zero, zero, zero
    for camera in range(camera_count):
        splats = camera * count + rows
        first = tl.load(first_slots + splats, mask=inside, other=0).to(tl.int64)
        length = tl.load(counts + splats, mask=inside, other=0)
        g, u, v, uu, uv, vv = zero, zero, zero, zero, zero, zero
        red, green, blue, depth, weight = zero, zero, zero, zero, zero
        for k in range(tl.max(length, 0)):
            v_pair = v_pairs + (first + k) * V_SPLAT_FLOATS
            has = k < length
            g += tl.load(v_pair + V_SUM, mask=has, other=0.0)
            u += tl.load(v_pair + V_U, mask=has, other=0.0)
            v += tl.load(v_pair + V_V, mask=has, other=0.0)
            uu += tl.load(v_pair + V_UU, mask=has, other=0.0)
            uv += tl.load(v_pair + V_UV, mask=has, other=0.0)
            vv += tl.load(v_pair + V_VV, mask=has, other=0.0)
            red += tl.load(v_pair + V_RED, mask=has, other=0.0)
            green += tl.load(v_pair + V_GREEN, mask=has, other=0.0)
            blue += tl.load(v_pair + V_BLUE, mask=has, other=0.0)
            depth += tl.load(v_pair + V_DEPTH, mask=has, other=0.0)
            weight += tl.load(v_pair + V_WEIGHT, mask=has, other=0.0)
        v_splat = v_splats + splats * V_SPLAT_FLOATS
        tl.store(v_splat + V_SUM, g, mask=inside)
        tl.store(v_splat + V_U, u, mask=inside)
        tl.store(v_splat + V_V, v, mask=inside)
        tl.store(v_splat + V_UU, uu, mask=inside)
        tl.store(v_splat + V_UV, uv, mask=inside)
        tl.store(v_splat + V_VV, vv, mask=inside)
        tl.store(v_splat + V_RED, red, mask=inside)
        tl.store(v_splat + V_GREEN, green, mask=inside)
        tl.store(v_splat + V_BLUE, blue, mask=inside)
        tl.store(v_splat + V_DEPTH, depth, mask=inside)
        all_red += red
        all_green += green
        all_blue += blue
        all_weight += weight
    store3(v_colors + 3 * rows, (all_red, all_green, all_blue), inside)
    tl.store(contribution + rows, all_weight, mask=inside)


SIGNATURES = (
    Compiled(
        sum_pairs,
        {
            "first_slots": "*i32", "counts": "*i32", "v_pairs": "*fp32", "v_splats": "*fp32",
            "v_colors": "*fp32", "contribution": "*fp32", "count": "i32", "camera_count": "i32",
        },
        {"BLOCK": BLOCK},
        WARPS,
    ),
)  # fmt: skip
