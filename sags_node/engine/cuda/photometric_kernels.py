"""Kernels of `photometric`: from planes to colour, depth and residuals, and from their gradients back."""

from __future__ import annotations

import triton
import triton.language as tl

from sags_node.engine.cuda.signatures import Compiled
from sags_node.engine.losses import photometric, photometric_kernels, smoothness
from sags_node.engine.losses import tissue as losses

BLOCK = 512  # pixels of a program
PROGRAMS = 256  # whose sums `combine` takes at a time
MAX_RESIDUAL = tl.constexpr(float(losses.MAX_RESIDUAL))
MIN_DEPTH = tl.constexpr(float(photometric_kernels.MIN_DEPTH))
FULL = tl.constexpr(float(losses.FULL))
MAX_DIFFERENCE = tl.constexpr(float(smoothness.MAX_DIFFERENCE))
FLAT = tl.constexpr(photometric.FLAT)
INFINITY, NAN = tl.constexpr(float("inf")), tl.constexpr(float("nan"))

# what a program's pixels add up to, and statistics of their inverse depths, centred for precision
RESIDUALS, PIXELS, DEPTH_RESIDUALS, DEPTHS, LACKS, TISSUES = (tl.constexpr(k) for k in range(6))
DRAWN_MEAN, GIVEN_MEAN, DRAWN_SQUARES, GIVEN_SQUARES, PRODUCTS = (tl.constexpr(k) for k in range(6, 11))
SUMS = tl.constexpr(11)

# what `combine` writes for `backward_pass`: derivatives of the loss by one pixel's colour residual, inverse
# depth residual and lack of coverage; a, b, c, d of the correlation, whose derivative by a drawn inverse
# depth x with the given one y is -a (y - b) + c (x - d); and the derivative by one pixel's 1 - SSIM
BY_COLOR, BY_DEPTH, BY_COVERAGE, BY_GIVEN, DRAWN_BY_GIVEN = (tl.constexpr(k) for k in range(5))
BY_DRAWN, DRAWN_BY_DRAWN, BY_SIMILARITY = (tl.constexpr(k) for k in range(5, 8))
FACTORS = 8
# and the values of the terms as far as they are known by then, and the number of colours behind them
COLOR, INVERSE_DEPTH, CORRELATION, COVERAGE, COLORS = (tl.constexpr(k) for k in range(5))
TERMS = 5


@triton.jit(do_not_specialize=("pixels",))
def compare(
    planes: tl.tensor,  # [5, P]
    image: tl.tensor,  # [P, 3]
    tissue: tl.tensor,  # [P]
    depth: tl.tensor,  # [P]
    drawn: tl.tensor,  # [4, P] written: colour and depth, NaN where the planes say nothing
    truth: tl.tensor,  # [3, P] written: the image, 0 where it is broken
    weight: tl.tensor,  # [P] written
    depth_residual: tl.tensor,  # [P] written: 1/d - 1/depth, NaN where one of them is missing
    sums: tl.tensor,  # [programs, SUMS] written
    pixels: tl.tensor,
    least: tl.tensor,
    least_depth: tl.tensor,
    NORMALISED: tl.constexpr,
    BLOCK: tl.constexpr,
) -> None:
    pixel = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = pixel < pixels
    is_tissue = tl.load(tissue + pixel, inside, other=0) != 0
    coverage = tl.load(planes + 4 * pixels + pixel, inside, other=0.0)
    covered = (coverage < INFINITY) & (coverage > least)
    deep = (coverage < INFINITY) & (coverage > least_depth)
    inverse = 1.0 / coverage if NORMALISED else tl.full([BLOCK], 1.0, tl.float32)
    residual = tl.zeros([BLOCK], tl.float32)
    for k in tl.static_range(3):
        color = tl.load(planes + k * pixels + pixel, inside, other=0.0) * inverse
        true = tl.load(image + 3 * pixel + k, inside, other=0.0)
        residual += tl.abs(color - true)
        tl.store(drawn + k * pixels + pixel, tl.where(covered, color, NAN), inside)
        tl.store(truth + k * pixels + pixel, tl.where(tl.abs(true) < MAX_RESIDUAL, true, 0.0), inside)
    used = is_tissue & covered & (residual < MAX_RESIDUAL)
    d = tl.load(planes + 3 * pixels + pixel, inside, other=0.0) * inverse
    x, y = 1.0 / d, 1.0 / tl.load(depth + pixel, inside, other=0.0)
    measured = is_tissue & deep & (d > MIN_DEPTH) & (y > 0.0) & (tl.abs(x - y) < INFINITY)
    tl.store(drawn + 3 * pixels + pixel, tl.where(deep, d, NAN), inside)
    tl.store(weight + pixel, tl.where(used, inverse, 0.0), inside)
    tl.store(depth_residual + pixel, tl.where(measured, x - y, NAN), inside)

    to = sums + tl.program_id(0) * SUMS
    lack = tl.where(is_tissue & (tl.abs(coverage) < FULL), FULL - coverage, 0.0)
    depths = tl.sum(tl.where(measured, 1.0, 0.0))
    tl.store(to + RESIDUALS, tl.sum(tl.where(used, residual, 0.0)))
    tl.store(to + PIXELS, tl.sum(tl.where(used, 1.0, 0.0)))
    tl.store(to + DEPTH_RESIDUALS, tl.sum(tl.where(measured, tl.abs(x - y), 0.0)))
    tl.store(to + DEPTHS, depths)
    tl.store(to + LACKS, tl.sum(lack))
    tl.store(to + TISSUES, tl.sum(tl.where(is_tissue, 1.0, 0.0)))
    drawn_mean = tl.sum(tl.where(measured, x, 0.0)) / tl.maximum(depths, 1.0)
    given_mean = tl.sum(tl.where(measured, y, 0.0)) / tl.maximum(depths, 1.0)
    x, y = tl.where(measured, x - drawn_mean, 0.0), tl.where(measured, y - given_mean, 0.0)
    tl.store(to + DRAWN_MEAN, drawn_mean)
    tl.store(to + GIVEN_MEAN, given_mean)
    tl.store(to + DRAWN_SQUARES, tl.sum(x * x))
    tl.store(to + GIVEN_SQUARES, tl.sum(y * y))
    tl.store(to + PRODUCTS, tl.sum(x * y))


@triton.jit(do_not_specialize=("programs",))
def combine(
    sums: tl.tensor,  # [programs, SUMS] of `compare`
    factors: tl.tensor,  # [FACTORS] float32 written
    terms: tl.tensor,  # [TERMS] float64 written
    programs: tl.tensor,
    color: tl.tensor,
    similarity: tl.tensor,
    inverse_depth: tl.tensor,
    correlation: tl.tensor,
    coverage: tl.tensor,
    PROGRAMS: tl.constexpr,
) -> None:
    """One program adds up in double precision, in order; statistics combine as in Chan et al. (1983)."""
    k = tl.arange(0, PROGRAMS)
    residuals, used = tl.zeros([PROGRAMS], tl.float64), tl.zeros([PROGRAMS], tl.float64)
    depth_residuals, measured = tl.zeros([PROGRAMS], tl.float64), tl.zeros([PROGRAMS], tl.float64)
    lacks, tissues = tl.zeros([PROGRAMS], tl.float64), tl.zeros([PROGRAMS], tl.float64)
    drawn, given = tl.zeros([PROGRAMS], tl.float64), tl.zeros([PROGRAMS], tl.float64)
    for first in range(0, programs, PROGRAMS):
        at, ok = sums + (first + k) * SUMS, first + k < programs
        count = tl.load(at + DEPTHS, ok, other=0.0).to(tl.float64)
        residuals += tl.load(at + RESIDUALS, ok, other=0.0)
        used += tl.load(at + PIXELS, ok, other=0.0)
        depth_residuals += tl.load(at + DEPTH_RESIDUALS, ok, other=0.0)
        measured += count
        lacks += tl.load(at + LACKS, ok, other=0.0)
        tissues += tl.load(at + TISSUES, ok, other=0.0)
        drawn += count * tl.load(at + DRAWN_MEAN, ok, other=0.0)
        given += count * tl.load(at + GIVEN_MEAN, ok, other=0.0)
    colors = tl.maximum(3.0 * tl.sum(used), 1.0)
    depths, pixels = tl.maximum(tl.sum(measured), 1.0), tl.maximum(tl.sum(tissues), 1.0)
    drawn_mean, given_mean = tl.sum(drawn) / depths, tl.sum(given) / depths

    drawn_squares, given_squares = tl.zeros([PROGRAMS], tl.float64), tl.zeros([PROGRAMS], tl.float64)
    products = tl.zeros([PROGRAMS], tl.float64)
    for first in range(0, programs, PROGRAMS):
        at, ok = sums + (first + k) * SUMS, first + k < programs
        count = tl.load(at + DEPTHS, ok, other=0.0).to(tl.float64)
        drawn_off = tl.load(at + DRAWN_MEAN, ok, other=0.0) - drawn_mean
        given_off = tl.load(at + GIVEN_MEAN, ok, other=0.0) - given_mean
        drawn_squares += tl.load(at + DRAWN_SQUARES, ok, other=0.0) + count * drawn_off * drawn_off
        given_squares += tl.load(at + GIVEN_SQUARES, ok, other=0.0) + count * given_off * given_off
        products += tl.load(at + PRODUCTS, ok, other=0.0) + count * drawn_off * given_off
    drawn_size, given_size = tl.sum(drawn_squares), tl.sum(given_squares)
    least = FLAT * FLAT * depths
    varied = (drawn_size > least * drawn_mean * drawn_mean) & (given_size > least * given_mean * given_mean)
    by_given = tl.where(varied, 1.0 / tl.sqrt(tl.where(varied, drawn_size * given_size, 1.0)), 0.0)
    value = tl.sum(products) * by_given
    by_drawn = tl.where(varied, value / tl.where(varied, drawn_size, 1.0), 0.0)

    tl.store(factors + BY_COLOR, color / colors)
    tl.store(factors + BY_DEPTH, inverse_depth / depths)
    tl.store(factors + BY_COVERAGE, coverage / pixels)
    tl.store(factors + BY_GIVEN, correlation * by_given)
    tl.store(factors + DRAWN_BY_GIVEN, given_mean)
    tl.store(factors + BY_DRAWN, correlation * by_drawn)
    tl.store(factors + DRAWN_BY_DRAWN, drawn_mean)
    tl.store(factors + BY_SIMILARITY, similarity / colors)
    tl.store(terms + COLOR, tl.sum(residuals) / colors)
    tl.store(terms + INVERSE_DEPTH, tl.sum(depth_residuals) / depths)
    tl.store(terms + CORRELATION, tl.where(varied, 1.0 - value, 0.0))
    tl.store(terms + COVERAGE, tl.sum(lacks) / pixels)
    tl.store(terms + COLORS, colors)


@triton.jit
def _sign(x: tl.tensor) -> tl.tensor:
    """Derivative of |x|; 0 of NaN."""
    return tl.where(x > 0.0, 1.0, 0.0) - tl.where(x < 0.0, 1.0, 0.0)


@triton.jit
def _step(here: tl.tensor, plane: tl.tensor, to: tl.tensor, counted: tl.tensor) -> tl.tensor:
    """Derivative of |here - neighbour| by `here`; 0 where the pair does not count or is not finite."""
    difference = here - tl.load(plane + to, counted, other=0.0)
    return tl.where(counted & (tl.abs(difference) < MAX_DIFFERENCE), _sign(difference), 0.0)


@triton.jit(do_not_specialize=("height", "width"))
def backward_pass(
    planes: tl.tensor,  # [5, P]
    tissue: tl.tensor,  # [P]
    region: tl.tensor,  # [P] where the total variation applies; not read if EVERYWHERE
    drawn: tl.tensor,  # [4, P] of `compare`
    truth: tl.tensor,  # [3, P]
    weight: tl.tensor,  # [P]
    depth_residual: tl.tensor,  # [P]
    v_similar: tl.tensor,  # [3, P] gradient of the similarity by the drawn colours; not read unless SIMILAR
    factors: tl.tensor,  # [FACTORS] of `combine`
    v_planes: tl.tensor,  # [5, P] written
    sums: tl.tensor,  # [programs, 2] written: total variation of the colours, and of the depth
    height: tl.tensor,
    width: tl.tensor,
    smoothness: tl.tensor,  # derivative of the loss by the total variation of a colour
    depth_smoothness: tl.tensor,
    NORMALISED: tl.constexpr,
    SIMILAR: tl.constexpr,
    EVERYWHERE: tl.constexpr,
    BLOCK: tl.constexpr,
) -> None:
    pixels = height * width
    pixel = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = pixel < pixels
    y, x = pixel // width, pixel % width
    left, right = inside & (x > 0), inside & (x < width - 1)
    above, below = inside & (y > 0), inside & (y < height - 1)
    if not EVERYWHERE:  # a pair counts if one of the two lies in the region
        counted = tl.load(region + pixel, inside, other=0) != 0
        left &= counted | (tl.load(region + pixel - 1, left, other=0) != 0)
        right &= counted | (tl.load(region + pixel + 1, right, other=0) != 0)
        above &= counted | (tl.load(region + pixel - width, above, other=0) != 0)
        below &= counted | (tl.load(region + pixel + width, below, other=0) != 0)
    coverage = tl.load(planes + 4 * pixels + pixel, inside, other=0.0)
    inverse = 1.0 / coverage if NORMALISED else tl.full([BLOCK], 1.0, tl.float32)
    used = tl.load(weight + pixel, inside, other=0.0) > 0.0
    by_color = tl.where(used, tl.load(factors + BY_COLOR), 0.0)
    c0 = tl.load(drawn + pixel, inside, other=0.0)
    c1 = tl.load(drawn + pixels + pixel, inside, other=0.0)
    c2 = tl.load(drawn + 2 * pixels + pixel, inside, other=0.0)
    covered = tl.abs(c0) + tl.abs(c1) + tl.abs(c2) < INFINITY  # NaN says nothing
    by_inverse, variation = tl.zeros([BLOCK], tl.float32), tl.zeros([BLOCK], tl.float32)
    for k in tl.static_range(3):
        color = c0 if k == 0 else (c1 if k == 1 else c2)
        at = k * pixels + pixel
        slope = _step(color, drawn, at - 1, left) + _step(color, drawn, at + 1, right)
        slope += _step(color, drawn, at - width, above) + _step(color, drawn, at + width, below)
        # a sum over edges of |a - b| is a sum over pixels of value * gradient
        variation += tl.where(slope != 0.0, color * slope, 0.0)
        v = smoothness * slope + by_color * _sign(color - tl.load(truth + at, inside, other=0.0))
        if SIMILAR:
            v += tl.load(v_similar + at, inside, other=0.0)
        by_inverse += tl.where(covered, color * (inverse * v), 0.0)
        tl.store(v_planes + at, tl.where(covered, inverse * v, 0.0), inside)

    at = 3 * pixels + pixel
    d, difference = (
        tl.load(drawn + at, inside, other=0.0),
        tl.load(depth_residual + pixel, inside, other=0.0),
    )
    slope = _step(d, drawn, at - 1, left) + _step(d, drawn, at + 1, right)
    slope += _step(d, drawn, at - width, above) + _step(d, drawn, at + width, below)
    inverse_d = 1.0 / d
    given_off = inverse_d - difference - tl.load(factors + DRAWN_BY_GIVEN)
    v_inverse = tl.load(factors + BY_DEPTH) * _sign(difference) - tl.load(factors + BY_GIVEN) * given_off
    v_inverse += tl.load(factors + BY_DRAWN) * (inverse_d - tl.load(factors + DRAWN_BY_DRAWN))
    by_terms = tl.where(tl.abs(difference) < INFINITY, inverse_d * inverse_d * v_inverse, 0.0)
    v = inverse * (depth_smoothness * slope - by_terms)
    deep = tl.abs(d) < INFINITY
    by_inverse += tl.where(deep, d * v, 0.0)
    push = (tl.load(tissue + pixel, inside, other=0) != 0) & (tl.abs(coverage) < FULL)
    v_coverage = tl.where(push, -tl.load(factors + BY_COVERAGE), 0.0)
    tl.store(v_planes + at, tl.where(deep, v, 0.0), inside)
    tl.store(v_planes + 4 * pixels + pixel, v_coverage - by_inverse if NORMALISED else v_coverage, inside)
    tl.store(sums + 2 * tl.program_id(0), tl.sum(variation))
    tl.store(sums + 2 * tl.program_id(0) + 1, tl.sum(tl.where(slope != 0.0, d * slope, 0.0)))


_COMPARE = {
    **dict.fromkeys(("planes", "image"), "*fp32"),
    "tissue": "*i1",
    **dict.fromkeys(("depth", "drawn", "truth", "weight", "depth_residual", "sums"), "*fp32"),
    "pixels": "i32",
    **dict.fromkeys(("least", "least_depth"), "fp32"),
}
_PULL_BACK = {
    "planes": "*fp32",
    **dict.fromkeys(("tissue", "region"), "*i1"),
    **dict.fromkeys(("drawn", "truth", "weight", "depth_residual", "v_similar"), "*fp32"),
    **dict.fromkeys(("factors", "v_planes", "sums"), "*fp32"),
    **dict.fromkeys(("height", "width"), "i32"),
    **dict.fromkeys(("smoothness", "depth_smoothness"), "fp32"),
}
SIGNATURES = (
    *(Compiled(compare, _COMPARE, {"NORMALISED": on, "BLOCK": BLOCK}) for on in (True, False)),
    Compiled(
        combine,
        {
            **dict.fromkeys(("sums", "factors"), "*fp32"),
            "terms": "*fp64",
            "programs": "i32",
            **dict.fromkeys(("color", "similarity", "inverse_depth", "correlation", "coverage"), "fp32"),
        },
        {"PROGRAMS": PROGRAMS},
    ),
    *(
        Compiled(
            backward_pass,
            _PULL_BACK,
            {"NORMALISED": on, "SIMILAR": on, "EVERYWHERE": not on, "BLOCK": BLOCK},
        )
        for on in (True, False)
    ),
)
