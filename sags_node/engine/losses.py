"""What a drawn picture should have been: one fused pass from planes to their cotangent."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np

from sags_node.engine.jit import parallel_kernel, read_only
from sags_node.types import F32, Bool

f4 = np.float32
ZERO, ONE, HALF = f4(0.0), f4(1.0), f4(0.5)
COVERED = f4(0.05)  # below this coverage the normalised colour means nothing
DEPTH_COVERED = f4(0.3)  # the same for depth
FULL = f4(0.9)  # coverage that tissue should reach
MAX_RESIDUAL = f4(1e3)  # also rejects NaN in the picture


@parallel_kernel
def _tissue_loss(
    planes: F32,
    image: F32,
    tissue: Bool,
    depth: F32,
    v_planes: F32,
    weight: F32,
    depth_weight: Any,
    depth_scale: Any,
    coverage_weight: Any,
    row_sums: F32,  # [H, 2] written: sum of absolute colour residuals, pixels
) -> None:
    _, height, width = planes.shape
    inverse_scale = ONE / depth_scale
    for y in numba.prange(height):
        residuals = ZERO
        pixels = ZERO
        for x in range(width):
            coverage = planes[4, y, x]
            covered = tissue[y, x] and coverage > COVERED
            inverse = ONE / coverage if covered else ZERO
            c0, c1, c2 = planes[0, y, x] * inverse, planes[1, y, x] * inverse, planes[2, y, x] * inverse
            r0, r1, r2 = c0 - image[y, x, 0], c1 - image[y, x, 1], c2 - image[y, x, 2]
            residual = abs(r0) + abs(r1) + abs(r2)
            used = covered and residual < MAX_RESIDUAL
            share = inverse if used else ZERO
            r0, r1, r2 = (r0, r1, r2) if used else (ZERO, ZERO, ZERO)
            residuals += residual if used else ZERO
            pixels += ONE if used else ZERO
            v_coverage = -share * (r0 * c0 + r1 * c1 + r2 * c2)
            v_depth = ZERO
            if used and coverage > DEPTH_COVERED and depth[y, x] > ZERO:
                d = planes[3, y, x] * inverse
                slope = min(max((d - depth[y, x]) * inverse_scale, -ONE), ONE)
                v_depth = depth_weight * inverse_scale * slope * inverse
                v_coverage -= v_depth * d
            if tissue[y, x] and coverage < FULL:
                v_coverage -= coverage_weight
            v_planes[0, y, x] = share * r0
            v_planes[1, y, x] = share * r1
            v_planes[2, y, x] = share * r2
            v_planes[3, y, x] = v_depth
            v_planes[4, y, x] = v_coverage
            weight[y, x] = share
        row_sums[y, 0] = residuals
        row_sums[y, 1] = pixels


def tissue_loss(
    planes: F32,
    image: F32,
    tissue: Bool,
    depth: F32,
    v_planes: F32,
    weight: F32,
    depth_weight: float,
    depth_scale: float,
    coverage_weight: float = 2e-3,
) -> float:
    """Compare planes with a frame and write the loss's gradient. With coverage A, colour c = C / A and depth
    d = D / A, summed over tissue pixels:

        1/2 |c - image|^2                                  where A > 0.05
        + depth_weight huber((d - depth) / depth_scale)    where A > 0.3 and depth > 0
        + coverage_weight max(0, 0.9 - A)

    huber(x) is x^2 / 2 up to 1 and |x| - 1/2 beyond. Pixels whose residual is NaN or infinite are left out.

    Args:
        planes: [5, H, W] of `Rasterizer.forward`.
        image: [H, W, 3] RGB 0..1.
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
    row_sums = np.empty((planes.shape[1], 2), np.float32)
    _tissue_loss(
        read_only(planes),
        read_only(image),
        read_only(tissue),
        read_only(depth),
        v_planes,
        weight,
        f4(depth_weight),
        f4(depth_scale),
        f4(coverage_weight),
        row_sums,
    )
    residuals, pixels = row_sums.sum(axis=0, dtype=np.float64)
    return float(residuals / (3.0 * pixels)) if pixels > 0 else 0.0
