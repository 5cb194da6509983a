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


@triton.jit(do_not_specialize=["count"])
def sum_pairs(
    first_slots: tl.tensor,  # [N]
    counts: tl.tensor,  # [N]
    v_pairs: tl.tensor,  # [P, V_SPLAT_FLOATS] per slot
    v_splats: tl.tensor,  # [N, V_SPLAT_FLOATS] written
    v_colors: tl.tensor,  # [N, 3] written
    contribution: tl.tensor,  # [N] written
    count: tl.tensor,  # N
    BLOCK: tl.constexpr,
) -> None:
    """Pairs are added in the order of their slots."""
    rows = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    inside = rows < count
    first = tl.load(first_slots + rows, mask=inside, other=0).to(tl.int64)
    length = tl.load(counts + rows, mask=inside, other=0)
    zero = tl.zeros([BLOCK], tl.float32)
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
    v_splat = v_splats + rows * V_SPLAT_FLOATS
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
    store3(v_colors + 3 * rows, (red, green, blue), inside)
    tl.store(contribution + rows, weight, mask=inside)


SIGNATURES = (
    Compiled(
        sum_pairs,
        {
            "first_slots": "*i32", "counts": "*i32", "v_pairs": "*fp32", "v_splats": "*fp32",
            "v_colors": "*fp32", "contribution": "*fp32", "count": "i32",
        },
        {"BLOCK": BLOCK},
        WARPS,
    ),
)  # fmt: skip
