"""Kernels of `photometric`: from planes to colour, depth and residuals, and from their gradients back."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np

from sags_node.engine import interface
from sags_node.engine.losses.pieces import (
    BLUE,
    COVERAGE,
    DEPTH,
    FREE,
    GREEN,
    PIECE,
    PLANE,
    RED,
    TISSUE,
    TRUE_BLUE,
    TRUE_DEPTH,
    TRUE_GREEN,
    TRUE_RED,
    clear,
    load,
    load_frame,
    load_mask,
    store,
)
from sags_node.engine.losses.tissue import FULL, MAX_RESIDUAL
from sags_node.kernels.jit import inlined, kernel, parallel_kernel
from sags_node.types import F32, U8, Bool

f4 = np.float32
u8 = np.uint64
ZERO, ONE, INFINITY, NAN = f4(0.0), f4(1.0), f4(np.inf), f4(np.nan)
MIN_DEPTH = f4(interface.NEAR_PLANE)  # m; nothing is drawn nearer

# planes beyond those of `pieces`
WEIGHT, DEPTH_RESIDUAL = (u8((FREE + k) * PLANE) for k in range(2))
# of `_compare_piece`; some results stand where inputs stood
RESIDUAL, USED, MEASURED, DRAWN_INVERSE = (u8((FREE + k) * PLANE) for k in range(2, 6))
GIVEN_INVERSE, LACK = TRUE_DEPTH, COVERAGE
# of `_pull_back_piece`
V_RED, V_GREEN, V_BLUE, V_DEPTH = TRUE_DEPTH, RESIDUAL, USED, MEASURED
SCRATCH = (FREE + 6) * PLANE  # floats per worker

# what the pixels of a piece add up to, and statistics of their inverse depths, centred for precision
RESIDUALS, PIXELS, DEPTH_RESIDUALS, DEPTHS, LACKS, TISSUES = range(6)
DRAWN_MEAN, GIVEN_MEAN, DRAWN_SQUARES, GIVEN_SQUARES, PRODUCTS = range(6, 11)
SUMS = 11


@inlined
def _add_up(scratch: F32, sums: F32) -> None:
    residuals = pixels = depth_residuals = depths = lacks = tissues = drawn = given = ZERO
    for k in range(PIECE):  # plain sums: two conditional ones in a loop would not vectorise
        i = u8(k)
        residuals += scratch[RESIDUAL + i]
        pixels += scratch[USED + i]
        depth_residuals += abs(scratch[DRAWN_INVERSE + i] - scratch[GIVEN_INVERSE + i])
        depths += scratch[MEASURED + i]
        lacks += scratch[LACK + i]
        tissues += scratch[TISSUE + i]
        drawn += scratch[DRAWN_INVERSE + i]
        given += scratch[GIVEN_INVERSE + i]
    drawn /= max(depths, ONE)
    given /= max(depths, ONE)
    drawn_squares = given_squares = products = ZERO
    for k in range(PIECE):
        i = u8(k)
        x = scratch[MEASURED + i] * (scratch[DRAWN_INVERSE + i] - drawn)
        y = scratch[MEASURED + i] * (scratch[GIVEN_INVERSE + i] - given)
        drawn_squares += x * x
        given_squares += y * y
        products += x * y
    sums[RESIDUALS] = residuals
    sums[PIXELS] = pixels
    sums[DEPTH_RESIDUALS] = depth_residuals
    sums[DEPTHS] = depths
    sums[LACKS] = lacks
    sums[TISSUES] = tissues
    sums[DRAWN_MEAN] = drawn
    sums[GIVEN_MEAN] = given
    sums[DRAWN_SQUARES] = drawn_squares
    sums[GIVEN_SQUARES] = given_squares
    sums[PRODUCTS] = products


@kernel
def _compare_piece(
    scratch: F32,  # [SCRATCH]
    planes: F32,  # [5, P]
    image: U8,  # [3 P]
    tissue: Bool,  # [P]
    depth: F32,
    normalised: bool,
    least: Any,
    least_depth: Any,
    start: Any,
    count: int,
    drawn: F32,  # [4, P] written: colour and depth, NaN where the planes say nothing
    truth: F32,  # [3, P] written: the image, 0 where it is broken
    weight: F32,  # [P] written
    depth_residual: F32,  # [P] written: 1/d - 1/depth, NaN where one of them is missing
    sums: F32,  # [SUMS] written
) -> None:
    if count == PIECE:  # a constant length vectorises
        load_frame(scratch, planes, image, tissue, depth, start, PIECE)
    else:
        load_frame(scratch, planes, image, tissue, depth, start, count)
        clear(scratch, TISSUE, count, PIECE)
    for k in range(PIECE):
        i = u8(k)
        coverage, is_tissue = scratch[COVERAGE + i], scratch[TISSUE + i] > ZERO
        sound = coverage < INFINITY
        covered, deep = sound & (coverage > least), sound & (coverage > least_depth)
        inverse = ONE / (coverage if normalised else ONE)
        c0, c1, c2 = scratch[RED + i] * inverse, scratch[GREEN + i] * inverse, scratch[BLUE + i] * inverse
        t0, t1, t2 = scratch[TRUE_RED + i], scratch[TRUE_GREEN + i], scratch[TRUE_BLUE + i]
        residual = abs(c0 - t0) + abs(c1 - t1) + abs(c2 - t2)
        used = is_tissue & covered & (residual < MAX_RESIDUAL)
        d, true_depth = scratch[DEPTH + i] * inverse, scratch[TRUE_DEPTH + i]
        inverse_d = ONE / d
        given_inverse = ONE / true_depth
        difference = inverse_d - given_inverse
        measured = is_tissue & deep & (d > MIN_DEPTH) & (given_inverse > ZERO) & (abs(difference) < INFINITY)
        scratch[RED + i] = c0 if covered else NAN
        scratch[GREEN + i] = c1 if covered else NAN
        scratch[BLUE + i] = c2 if covered else NAN
        scratch[DEPTH + i] = d if deep else NAN
        scratch[TRUE_RED + i] = t0 if abs(t0) < MAX_RESIDUAL else ZERO
        scratch[TRUE_GREEN + i] = t1 if abs(t1) < MAX_RESIDUAL else ZERO
        scratch[TRUE_BLUE + i] = t2 if abs(t2) < MAX_RESIDUAL else ZERO
        scratch[WEIGHT + i] = inverse if used else ZERO
        scratch[RESIDUAL + i] = residual if used else ZERO
        scratch[USED + i] = ONE if used else ZERO
        scratch[DEPTH_RESIDUAL + i] = difference if measured else NAN
        scratch[MEASURED + i] = ONE if measured else ZERO
        scratch[DRAWN_INVERSE + i] = inverse_d if measured else ZERO
        scratch[GIVEN_INVERSE + i] = given_inverse if measured else ZERO
        scratch[LACK + i] = FULL - coverage if is_tissue & (abs(coverage) < FULL) else ZERO
    _add_up(scratch, sums)
    for plane in range(4):
        store(scratch, u8(plane * PLANE), drawn[plane], start, count)
    for plane in range(3):
        store(scratch, TRUE_RED + u8(plane * PLANE), truth[plane], start, count)
    store(scratch, WEIGHT, weight, start, count)
    store(scratch, DEPTH_RESIDUAL, depth_residual, start, count)


@parallel_kernel
def compare(
    planes: F32, image: U8, tissue: Bool, depth: F32, normalised: bool, least: Any, least_depth: Any,
    scratch: F32, drawn: F32, truth: F32, weight: F32, depth_residual: F32, sums: F32,
) -> None:  # fmt: skip
    """Read all pixels; `_compare_piece` says what is written."""
    pixels = tissue.size
    workers = scratch.shape[0]
    flat_planes, flat_image = planes.reshape(5, pixels), image.reshape(3 * pixels)
    flat_tissue, flat_depth, flat_weight = (
        tissue.reshape(pixels),
        depth.reshape(pixels),
        weight.reshape(pixels),
    )
    for worker in numba.prange(workers):
        for p in range(worker, sums.shape[0], workers):
            _compare_piece(
                scratch[worker], flat_planes, flat_image, flat_tissue, flat_depth,
                normalised, least, least_depth, u8(p * PIECE), min(PIECE, pixels - p * PIECE),
                drawn, truth, flat_weight, depth_residual, sums[p],
            )  # fmt: skip


@inlined
def _sign(x: Any) -> Any:
    """Derivative of |x|; 0 of NaN."""
    return (ONE if x > ZERO else ZERO) - (ONE if x < ZERO else ZERO)


@kernel
def _pull_back_piece(
    scratch: F32,
    planes: F32,
    tissue: Bool,
    drawn: F32,
    truth: F32,
    weight: F32,
    depth_residual: F32,
    v_drawn: F32,  # [4, P] of the other terms
    normalised: bool,
    factors: F32,  # [7], see `backward_pass`
    start: Any,
    count: int,
    v_planes: F32,  # [5, P] written
) -> None:
    load(scratch, RED, drawn[0], start, count)
    load(scratch, GREEN, drawn[1], start, count)
    load(scratch, BLUE, drawn[2], start, count)
    load(scratch, DEPTH, drawn[3], start, count)
    load(scratch, COVERAGE, planes[4], start, count)
    load(scratch, TRUE_RED, truth[0], start, count)
    load(scratch, TRUE_GREEN, truth[1], start, count)
    load(scratch, TRUE_BLUE, truth[2], start, count)
    load(scratch, WEIGHT, weight, start, count)
    load(scratch, DEPTH_RESIDUAL, depth_residual, start, count)
    load(scratch, V_RED, v_drawn[0], start, count)
    load(scratch, V_GREEN, v_drawn[1], start, count)
    load(scratch, V_BLUE, v_drawn[2], start, count)
    load(scratch, V_DEPTH, v_drawn[3], start, count)
    load_mask(scratch, TISSUE, tissue, start, count)
    by_color, by_depth, by_coverage = factors[0], factors[1], factors[2]
    by_given, given_mean, by_drawn, drawn_mean = factors[3], factors[4], factors[5], factors[6]
    chained = ONE if normalised else ZERO
    for k in range(PIECE):
        i = u8(k)
        coverage = scratch[COVERAGE + i]
        inverse = ONE / (coverage if normalised else ONE)
        color_slope = by_color if scratch[WEIGHT + i] > ZERO else ZERO
        c0, c1, c2 = scratch[RED + i], scratch[GREEN + i], scratch[BLUE + i]
        v0 = inverse * (scratch[V_RED + i] + color_slope * _sign(c0 - scratch[TRUE_RED + i]))
        v1 = inverse * (scratch[V_GREEN + i] + color_slope * _sign(c1 - scratch[TRUE_GREEN + i]))
        v2 = inverse * (scratch[V_BLUE + i] + color_slope * _sign(c2 - scratch[TRUE_BLUE + i]))
        d, difference = scratch[DEPTH + i], scratch[DEPTH_RESIDUAL + i]
        x = ONE / d
        v_x = (
            by_depth * _sign(difference)
            - by_given * (x - difference - given_mean)
            + by_drawn * (x - drawn_mean)
        )
        v_d = inverse * (scratch[V_DEPTH + i] - (x * x * v_x if abs(difference) < INFINITY else ZERO))
        covered, deep = abs(c0) + abs(c1) + abs(c2) < INFINITY, abs(d) < INFINITY  # NaN says nothing
        by_inverse = c0 * v0 + c1 * v1 + c2 * v2
        by_inverse_depth = d * v_d
        push = by_coverage if (scratch[TISSUE + i] > ZERO) & (abs(coverage) < FULL) else ZERO
        scratch[RED + i] = v0 if covered else ZERO
        scratch[GREEN + i] = v1 if covered else ZERO
        scratch[BLUE + i] = v2 if covered else ZERO
        scratch[DEPTH + i] = v_d if deep else ZERO
        through_inverse = (by_inverse if covered else ZERO) + (by_inverse_depth if deep else ZERO)
        scratch[COVERAGE + i] = -chained * through_inverse - push
    store(scratch, RED, v_planes[0], start, count)
    store(scratch, GREEN, v_planes[1], start, count)
    store(scratch, BLUE, v_planes[2], start, count)
    store(scratch, DEPTH, v_planes[3], start, count)
    store(scratch, COVERAGE, v_planes[4], start, count)


@parallel_kernel
def backward_pass(
    planes: F32, tissue: Bool, drawn: F32, truth: F32, weight: F32, depth_residual: F32, v_drawn: F32,
    normalised: bool, factors: F32, scratch: F32, v_planes: F32,
) -> None:  # fmt: skip
    """Write the gradient by the planes. `factors`: derivative of the loss by one pixel's colour residual,
    inverse depth residual and lack of coverage; and a, b, c, d of the correlation, whose derivative by a
    drawn inverse depth x with the given one y is -a (y - b) + c (x - d)."""
    pixels = tissue.size
    workers = scratch.shape[0]
    flat_planes, flat_v_planes = planes.reshape(5, pixels), v_planes.reshape(5, pixels)
    flat_tissue, flat_weight = tissue.reshape(pixels), weight.reshape(pixels)
    pieces = (pixels + PIECE - 1) // PIECE
    for worker in numba.prange(workers):
        for p in range(worker, pieces, workers):
            _pull_back_piece(
                scratch[worker], flat_planes, flat_tissue, drawn, truth, flat_weight, depth_residual, v_drawn,
                normalised, factors, u8(p * PIECE), min(PIECE, pixels - p * PIECE), flat_v_planes,
            )  # fmt: skip
