"""Front-to-back blending of the splats of each tile, its derivative, and the median depth: the sums of
`engine.rasterizer.compositing` and `engine.rasterizer.median`.

A program of one warp walks through the list of its tile. The backward pass walks front to back too and
writes the sums of each pair to the pair's slot, which nobody else writes: no atomics, so the same bits every
time. That is 48 bytes per pair, written once and read once, in the place of eleven atomic additions.
"""

from __future__ import annotations

import triton
import triton.language as tl

from sags_node.engine.cuda.layout import (
    BLUE,
    DEPTH,
    GREEN,
    LOG2_OPACITY,
    MEAN_X,
    MEAN_Y,
    RED,
    SPLAT_FLOATS,
    TILE_HEIGHT_BITS,
    TILE_PIXELS,
    TILE_WARPS,
    TILE_WIDTH,
    TILE_WIDTH_BITS,
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
    WHITEN_XX,
    WHITEN_XY,
    WHITEN_YY,
)
from sags_node.engine.cuda.projection import LOG2_MIN_ALPHA
from sags_node.engine.cuda.signatures import Compiled

OPAQUE = tl.constexpr(1e-4)  # transmittance at which a pixel is finished
TEST_EVERY = tl.constexpr(8)  # pairs between two looks at the transmittance


@triton.jit
def tile_pixels(tile: tl.tensor, active: tl.tensor, width: tl.tensor, height: tl.tensor) -> tl.tuple:
    """Of a tile's pixels: the centres, px; their places in a picture [H W]; whether they are drawn."""
    tiles_x = (width + TILE_WIDTH - 1) >> TILE_WIDTH_BITS
    nth = tl.arange(0, TILE_PIXELS)
    x = (tile % tiles_x << TILE_WIDTH_BITS) + nth % TILE_WIDTH
    y = (tile // tiles_x << TILE_HEIGHT_BITS) + (nth >> TILE_WIDTH_BITS)
    inside = (x < width * tl.load(active + tile)) & (y < height)  # a tile that is not active has no width
    centres = x.to(tl.float32) + 0.5, y.to(tl.float32) + 0.5
    return centres, y.to(tl.int64) * width + x, inside


@triton.jit
def alpha_at(splat: tl.tensor, x: tl.tensor, y: tl.tensor) -> tl.tuple:
    """Alpha of a splat (a pointer to its record) at pixels, 0 below 1/255, and their u and v."""
    dx, dy = x - tl.load(splat + MEAN_X), y - tl.load(splat + MEAN_Y)
    u = tl.load(splat + WHITEN_XX) * dx + tl.load(splat + WHITEN_XY) * dy
    v = tl.load(splat + WHITEN_YY) * dy
    exponent = tl.load(splat + LOG2_OPACITY) - v * v - u * u
    return tl.where(exponent >= LOG2_MIN_ALPHA, tl.exp2(exponent), 0.0), u, v


@triton.jit(do_not_specialize=["width", "height"])
def composite(
    splats: tl.tensor,  # [N, SPLAT_FLOATS]
    pairs: tl.tensor,  # [P] the splats of the tiles, near to far in each
    tile_starts: tl.tensor,  # [tiles + 1]
    active: tl.tensor,  # [tiles] 1: this tile is drawn
    planes: tl.tensor,  # [5, H, W] written where drawn
    tile_ends: tl.tensor,  # [tiles] first pair of a tile that was not blended, written
    width: tl.tensor,
    height: tl.tensor,
) -> None:
    tile = tl.program_id(0)
    (x, y), at, inside = tile_pixels(tile, active, width, height)
    transmittance = tl.where(inside, 1.0, 0.0)  # pixels outside neither draw nor keep a tile open
    red, green, blue, depth = (tl.zeros_like(x), tl.zeros_like(x), tl.zeros_like(x), tl.zeros_like(x))
    p, end = tl.load(tile_starts + tile), tl.load(tile_starts + tile + 1)
    while (p < end) & (tl.max(transmittance, 0) > OPAQUE):
        stop = tl.minimum(p + TEST_EVERY, end)
        for q in range(p, stop):
            splat = splats + tl.load(pairs + q).to(tl.int64) * SPLAT_FLOATS
            alpha, _, _ = alpha_at(splat, x, y)
            w = alpha * transmittance
            transmittance -= w
            red += w * tl.load(splat + RED)
            green += w * tl.load(splat + GREEN)
            blue += w * tl.load(splat + BLUE)
            depth += w * tl.load(splat + DEPTH)
        p = stop
    tl.store(tile_ends + tile, p)
    plane = height.to(tl.int64) * width
    at += planes
    tl.store(at, red, mask=inside)
    tl.store(at + plane, green, mask=inside)
    tl.store(at + 2 * plane, blue, mask=inside)
    tl.store(at + 3 * plane, depth, mask=inside)
    tl.store(at + 4 * plane, 1.0 - transmittance, mask=inside)


@triton.jit(do_not_specialize=["width", "height"])
def composite_backward(
    splats: tl.tensor,  # as in `composite`
    pairs: tl.tensor,
    slots: tl.tensor,  # [P] where these pairs' gradients go
    tile_starts: tl.tensor,
    tile_ends: tl.tensor,
    active: tl.tensor,
    planes: tl.tensor,  # [5, H, W] of `composite`
    v_planes: tl.tensor,  # [5, H, W]
    weight: tl.tensor,  # [H, W]
    v_pairs: tl.tensor,  # [P, V_SPLAT_FLOATS] written for what was blended where anything is asked
    width: tl.tensor,
    height: tl.tensor,
) -> None:
    """With s = (color, depth, 1) . v_planes, `remaining` is the sum of w s over the pairs behind, starting
    from planes . v_planes: nothing is recovered by dividing."""
    tile = tl.program_id(0)
    (x, y), at, inside = tile_pixels(tile, active, width, height)
    plane = height.to(tl.int64) * width
    to_v, to_planes = v_planes + at, planes + at
    v_red = tl.load(to_v, mask=inside, other=0.0)
    v_green = tl.load(to_v + plane, mask=inside, other=0.0)
    v_blue = tl.load(to_v + 2 * plane, mask=inside, other=0.0)
    v_depth = tl.load(to_v + 3 * plane, mask=inside, other=0.0)
    v_coverage = tl.load(to_v + 4 * plane, mask=inside, other=0.0)
    remaining = v_red * tl.load(to_planes, mask=inside, other=0.0)
    remaining += v_green * tl.load(to_planes + plane, mask=inside, other=0.0)
    remaining += v_blue * tl.load(to_planes + 2 * plane, mask=inside, other=0.0)
    remaining += v_depth * tl.load(to_planes + 3 * plane, mask=inside, other=0.0)
    remaining += v_coverage * tl.load(to_planes + 4 * plane, mask=inside, other=0.0)
    pixel_weight = tl.load(weight + at, mask=inside, other=0.0)
    asked = tl.abs(v_red) + tl.abs(v_green) + tl.abs(v_blue) + tl.abs(v_depth) + tl.abs(v_coverage)
    start, end = tl.load(tile_starts + tile), tl.load(tile_ends + tile)
    end = tl.where(tl.sum(asked + tl.abs(pixel_weight), 0) != 0.0, end, start)  # NaN is not 0
    transmittance = tl.where(inside, 1.0, 0.0)
    for p in range(start, end):
        splat = splats + tl.load(pairs + p).to(tl.int64) * SPLAT_FLOATS
        alpha, u, v = alpha_at(splat, x, y)
        w = alpha * transmittance
        transmittance -= w
        s = tl.load(splat + RED) * v_red + tl.load(splat + GREEN) * v_green + tl.load(splat + BLUE) * v_blue
        s += tl.load(splat + DEPTH) * v_depth + v_coverage
        remaining -= w * s
        g = w * s - alpha * remaining / (1.0 - alpha)
        v_pair = v_pairs + tl.load(slots + p) * V_SPLAT_FLOATS
        tl.store(v_pair + V_SUM, tl.sum(g, 0))
        tl.store(v_pair + V_U, tl.sum(g * u, 0))
        tl.store(v_pair + V_V, tl.sum(g * v, 0))
        tl.store(v_pair + V_UU, tl.sum(g * u * u, 0))
        tl.store(v_pair + V_UV, tl.sum(g * u * v, 0))
        tl.store(v_pair + V_VV, tl.sum(g * v * v, 0))
        tl.store(v_pair + V_RED, tl.sum(w * v_red, 0))
        tl.store(v_pair + V_GREEN, tl.sum(w * v_green, 0))
        tl.store(v_pair + V_BLUE, tl.sum(w * v_blue, 0))
        tl.store(v_pair + V_DEPTH, tl.sum(w * v_depth, 0))
        tl.store(v_pair + V_WEIGHT, tl.sum(w * pixel_weight, 0))


@triton.jit(do_not_specialize=["width", "height"])
def median(
    splats: tl.tensor,  # as in `composite`
    pairs: tl.tensor,
    tile_starts: tl.tensor,
    tile_ends: tl.tensor,
    active: tl.tensor,
    depths: tl.tensor,  # [H, W] m, written where drawn: where the transmittance falls to 1/2, or 0
    gaussians: tl.tensor,  # [H, W] likewise: row of its Gaussian, or -1
    width: tl.tensor,
    height: tl.tensor,
) -> None:
    tile = tl.program_id(0)
    (x, y), at, inside = tile_pixels(tile, active, width, height)
    transmittance = tl.where(inside, 1.0, 0.0)
    depth, gaussian = tl.zeros_like(x), tl.full([TILE_PIXELS], -1, tl.int32)
    p, end = tl.load(tile_starts + tile), tl.load(tile_ends + tile)
    while (p < end) & (tl.max(transmittance, 0) > 0.5):
        stop = tl.minimum(p + TEST_EVERY, end)
        for q in range(p, stop):
            index = tl.load(pairs + q)
            splat = splats + index.to(tl.int64) * SPLAT_FLOATS
            alpha, _, _ = alpha_at(splat, x, y)
            after = transmittance - alpha * transmittance
            crossed = (transmittance > 0.5) & (after <= 0.5)
            depth = tl.where(crossed, tl.load(splat + DEPTH), depth)
            gaussian = tl.where(crossed, index, gaussian)
            transmittance = after
        p = stop
    tl.store(depths + at, depth, mask=inside)
    tl.store(gaussians + at, gaussian, mask=inside)


_LISTS = {"splats": "*fp32", "pairs": "*i32", "tile_starts": "*i32", "tile_ends": "*i32", "active": "*i32"}
_SIZE = {"width": "i32", "height": "i32"}
SIGNATURES = (
    Compiled(composite, {**_LISTS, "planes": "*fp32", **_SIZE}, num_warps=TILE_WARPS),
    Compiled(
        composite_backward,
        {
            **_LISTS, "slots": "*i64", "planes": "*fp32", "v_planes": "*fp32", "weight": "*fp32",
            "v_pairs": "*fp32", **_SIZE,
        },
        num_warps=TILE_WARPS,
    ),
    Compiled(
        median,
        {**_LISTS, "depths": "*fp32", "gaussians": "*i32", **_SIZE},
        num_warps=TILE_WARPS,
    ),
)  # fmt: skip
