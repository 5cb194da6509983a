"""The loss of drawn planes against a frame: one fused pass from the planes to their cotangents."""

from typing import Any

import numba
import numpy as np

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
    load_frame,
    store,
)
from sags_node.kernels.jit import aligned, kernel, parallel_kernel, read_only
from sags_node.kernels.threads import thread_count
from sags_node.types import F32, U8, Bool

f4 = np.float32
u8 = np.uint64
ZERO, ONE, INFINITY = f4(0.0), f4(1.0), f4(np.inf)
COVERED = f4(0.05)  # below this coverage the normalised colour means nothing
DEPTH_COVERED = f4(0.3)  # the same for depth
FULL = f4(0.9)  # coverage that tissue should reach
COVERAGE_WEIGHT = 2e-3  # of the push towards that coverage, relative to the colour term
MAX_RESIDUAL = f4(1e3)  # also rejects NaN in the image

WEIGHT = u8(FREE * PLANE)  # planes beyond those of `pieces`
RESIDUAL, USED = TRUE_RED, TISSUE  # results overwrite the inputs
SCRATCH = (FREE + 1) * PLANE  # floats per worker


@kernel
def _piece_loss(
    scratch: F32,  # [SCRATCH]
    planes: F32,  # [5, P]
    image: U8,  # [3 P]
    tissue: Bool,  # [P]
    depth: F32,
    v_planes: F32,
    weight: F32,
    start: Any,
    count: int,
    depth_weight: Any,
    inverse_scale: Any,
    coverage_weight: Any,
    sums: F32,  # [2] written
) -> None:
    if count == PIECE:  # a constant length vectorises
        load_frame(scratch, planes, image, tissue, depth, start, PIECE)
    else:
        load_frame(scratch, planes, image, tissue, depth, start, count)
        clear(scratch, TISSUE, count, PIECE)
    depth_slope = depth_weight * inverse_scale
    for k in range(PIECE):
        i = u8(k)
        coverage, is_tissue = scratch[COVERAGE + i], scratch[TISSUE + i] > ZERO
        inverse = ONE / coverage
        c0, c1, c2 = scratch[RED + i] * inverse, scratch[GREEN + i] * inverse, scratch[BLUE + i] * inverse
        r0, r1, r2 = c0 - scratch[TRUE_RED + i], c1 - scratch[TRUE_GREEN + i], c2 - scratch[TRUE_BLUE + i]
        residual = abs(r0) + abs(r1) + abs(r2)
        # selects, not branches or products: they vectorise, and keep NaN out
        used = is_tissue & (coverage > COVERED) & (coverage < INFINITY) & (residual < MAX_RESIDUAL)
        scratch[RESIDUAL + i] = residual if used else ZERO
        scratch[USED + i] = ONE if used else ZERO
        d = scratch[DEPTH + i] * inverse
        true_depth = scratch[TRUE_DEPTH + i]
        depth_residual = (d - true_depth) * inverse_scale
        measured = used & (coverage > DEPTH_COVERED) & (true_depth > ZERO) & (abs(depth_residual) < INFINITY)
        slope = min(max(depth_residual, -ONE), ONE)
        v_red, v_green, v_blue, v_depth = (
            inverse * r0,
            inverse * r1,
            inverse * r2,
            inverse * depth_slope * slope,
        )
        by_color, by_depth = v_red * c0 + v_green * c1 + v_blue * c2, v_depth * d
        scratch[RED + i] = v_red if used else ZERO
        scratch[GREEN + i] = v_green if used else ZERO
        scratch[BLUE + i] = v_blue if used else ZERO
        scratch[DEPTH + i] = v_depth if measured else ZERO
        push = coverage_weight if is_tissue & (abs(coverage) < FULL) else ZERO
        scratch[COVERAGE + i] = -(by_color if used else ZERO) - (by_depth if measured else ZERO) - push
        scratch[WEIGHT + i] = inverse if used else ZERO
    residuals = pixels = ZERO
    for k in range(PIECE):  # in the loop above, two conditional sums would not vectorise
        residuals += scratch[RESIDUAL + u8(k)]
        pixels += scratch[USED + u8(k)]
    sums[0] = residuals
    sums[1] = pixels
    store(scratch, RED, v_planes[0], start, count)
    store(scratch, GREEN, v_planes[1], start, count)
    store(scratch, BLUE, v_planes[2], start, count)
    store(scratch, DEPTH, v_planes[3], start, count)
    store(scratch, COVERAGE, v_planes[4], start, count)
    store(scratch, WEIGHT, weight, start, count)


@parallel_kernel
def _tissue_loss(
    planes: F32,
    image: U8,
    tissue: Bool,
    depth: F32,
    v_planes: F32,
    weight: F32,
    depth_weight: Any,
    inverse_scale: Any,
    coverage_weight: Any,
    scratch: F32,  # [workers, SCRATCH]
    sums: F32,  # [pieces, 2] written: sum of absolute colour residuals, pixels
) -> None:
    pixels = tissue.size
    workers = scratch.shape[0]
    flat_planes, flat_v_planes = planes.reshape(5, pixels), v_planes.reshape(5, pixels)
    flat_image, flat_tissue = image.reshape(3 * pixels), tissue.reshape(pixels)
    flat_depth, flat_weight = depth.reshape(pixels), weight.reshape(pixels)
    for worker in numba.prange(workers):
        for p in range(worker, sums.shape[0], workers):
            _piece_loss(
                scratch[worker],
                flat_planes, flat_image, flat_tissue, flat_depth, flat_v_planes, flat_weight,
                u8(p * PIECE), min(PIECE, pixels - p * PIECE),
                depth_weight, inverse_scale, coverage_weight, sums[p],
            )  # fmt: skip


def tissue_loss(
    planes: F32,
    image: U8,
    tissue: Bool,
    depth: F32,
    v_planes: F32,
    weight: F32,
    depth_weight: float,
    depth_scale: float,
    coverage_weight: float = COVERAGE_WEIGHT,
) -> float:
    """Compare planes with a frame and write the loss's gradient. With coverage A, colour c = C / A and depth
    d = D / A, summed over tissue pixels:

        1/2 |c - image|^2                                  where A > 0.05
        + depth_weight huber((d - depth) / depth_scale)    where A > 0.3 and depth > 0
        + coverage_weight max(0, 0.9 - A)

    huber(x) is x^2 / 2 up to 1 and |x| - 1/2 beyond. Pixels whose residual is NaN or infinite are left out.

    Args:
        planes: [5, H, W] of `Rasterizer.forward`.
        image: [H, W, 3] RGB bytes; the formula takes them over 255.
        tissue: [H, W] True where the pixel is to be explained.
        depth: [H, W] m, 0 unknown.
        v_planes: [5, H, W] written: the gradient with respect to `planes`.
        weight: [H, W] written: 1 / A where the colour counts, else 0. With `Gradients.contribution` of this
            weight, colour -= gradient / contribution is one step of SIRT, a closed-form least-squares colour.
        depth_weight: weight of the depth term against the colour term, 1.
        depth_scale: m; depth residuals beyond it count linearly.
        coverage_weight: weight of the push towards full coverage.

    Returns:
        Mean absolute colour residual over the tissue pixels that count; 0 if there are none. It does not
        depend on the number of threads.
    """
    sums = np.empty((-(-tissue.size // PIECE), 2), np.float32)
    _tissue_loss(
        read_only(planes),
        read_only(image),
        read_only(tissue),
        read_only(depth),
        v_planes,
        weight,
        f4(depth_weight),
        f4(1.0 / depth_scale),
        f4(coverage_weight),
        aligned((thread_count(), SCRATCH)),
        sums,
    )
    residuals, pixels = sums.sum(axis=0, dtype=np.float64)
    return float(residuals / (3.0 * pixels)) if pixels > 0 else 0.0
