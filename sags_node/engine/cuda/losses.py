"""What a drawn picture should have been, on the device: one fused pass from planes to their cotangent.

The loss of `engine.losses.tissue`, pixel by pixel the same. Each program adds its pixels up by itself, and
torch adds up the programs' sums, both in a fixed order: the same bits every time.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
import triton
import triton.language as tl

from sags_node.engine.cuda.signatures import Compiled
from sags_node.engine.losses import tissue as losses

if TYPE_CHECKING:
    from torch import Tensor

BLOCK = 512  # pixels of a program
COVERED = tl.constexpr(float(losses.COVERED))
DEPTH_COVERED = tl.constexpr(float(losses.DEPTH_COVERED))
FULL = tl.constexpr(float(losses.FULL))
MAX_RESIDUAL = tl.constexpr(float(losses.MAX_RESIDUAL))
INFINITY = tl.constexpr(float("inf"))


@triton.jit(do_not_specialize=("pixels",))
def _tissue_loss(
    planes: tl.tensor,  # [5, P]
    image: tl.tensor,  # [P, 3]
    tissue: tl.tensor,  # [P]
    depth: tl.tensor,  # [P]
    v_planes: tl.tensor,  # [5, P] written
    weight: tl.tensor,  # [P] written
    sums: tl.tensor,  # [programs, 2] written: sum of absolute colour residuals, pixels
    pixels: tl.tensor,
    depth_weight: tl.tensor,
    inverse_scale: tl.tensor,
    coverage_weight: tl.tensor,
    BLOCK: tl.constexpr,
) -> None:
    pixel = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = pixel < pixels
    is_tissue = tl.load(tissue + pixel, inside, other=0) != 0
    coverage = tl.load(planes + 4 * pixels + pixel, inside, other=0.0)
    inverse = 1.0 / coverage
    c0 = tl.load(planes + pixel, inside, other=0.0) * inverse
    c1 = tl.load(planes + pixels + pixel, inside, other=0.0) * inverse
    c2 = tl.load(planes + 2 * pixels + pixel, inside, other=0.0) * inverse
    d = tl.load(planes + 3 * pixels + pixel, inside, other=0.0) * inverse
    r0 = c0 - tl.load(image + 3 * pixel, inside, other=0.0)
    r1 = c1 - tl.load(image + 3 * pixel + 1, inside, other=0.0)
    r2 = c2 - tl.load(image + 3 * pixel + 2, inside, other=0.0)
    residual = tl.abs(r0) + tl.abs(r1) + tl.abs(r2)
    used = is_tissue & (coverage > COVERED) & (coverage < INFINITY) & (residual < MAX_RESIDUAL)
    true_depth = tl.load(depth + pixel, inside, other=0.0)
    depth_residual = (d - true_depth) * inverse_scale
    measured = used & (coverage > DEPTH_COVERED) & (true_depth > 0.0) & (tl.abs(depth_residual) < INFINITY)
    slope = tl.minimum(tl.maximum(depth_residual, -1.0), 1.0)
    v_red = tl.where(used, inverse * r0, 0.0)
    v_green = tl.where(used, inverse * r1, 0.0)
    v_blue = tl.where(used, inverse * r2, 0.0)
    v_depth = tl.where(measured, inverse * depth_weight * inverse_scale * slope, 0.0)
    by_inverse = tl.where(used, v_red * c0 + v_green * c1 + v_blue * c2, 0.0)  # selects keep NaN out
    by_inverse += tl.where(measured, v_depth * d, 0.0)
    push = tl.where(is_tissue & (tl.abs(coverage) < FULL), coverage_weight, 0.0)
    tl.store(v_planes + pixel, v_red, inside)
    tl.store(v_planes + pixels + pixel, v_green, inside)
    tl.store(v_planes + 2 * pixels + pixel, v_blue, inside)
    tl.store(v_planes + 3 * pixels + pixel, v_depth, inside)
    tl.store(v_planes + 4 * pixels + pixel, -by_inverse - push, inside)
    tl.store(weight + pixel, tl.where(used, inverse, 0.0), inside)
    tl.store(sums + 2 * tl.program_id(0), tl.sum(tl.where(used, residual, 0.0)))
    tl.store(sums + 2 * tl.program_id(0) + 1, tl.sum(tl.where(used, 1.0, 0.0)))


def tissue_loss(
    planes: Tensor,
    image: Tensor,
    tissue: Tensor,
    depth: Tensor,
    v_planes: Tensor,
    weight: Tensor,
    depth_weight: float,
    depth_scale: float,
    coverage_weight: float = 2e-3,
) -> Tensor:
    """Compare planes with a frame and write the gradient of the loss, `engine.losses.tissue.tissue_loss`.

    All tensors lie contiguous on one device, float32 where nothing else is said.

    Args:
        planes: [5, H, W] of the rasteriser, one camera.
        image: [H, W, 3] RGB 0..1.
        tissue: [H, W] bool, True where the pixel is to be explained.
        depth: [H, W] m, 0 unknown.
        v_planes: [5, H, W] written: the gradient with respect to `planes`.
        weight: [H, W] written: 1 / coverage where the colour counts, else 0.
        depth_weight: weight of the depth term against the colour term, 1.
        depth_scale: m; depth residuals beyond it count linearly.
        coverage_weight: weight of the push towards full coverage.

    Returns:
        [] float64 on the device: mean absolute colour residual over the tissue pixels that count; 0 if there
        are none. Reading it waits for the device.
    """
    pixels = tissue.numel()
    programs = triton.cdiv(pixels, BLOCK)
    sums = torch.empty((programs, 2), dtype=torch.float32, device=planes.device)
    _tissue_loss[(programs,)](
        planes, image, tissue, depth, v_planes, weight, sums,
        pixels, depth_weight, 1.0 / depth_scale, coverage_weight, BLOCK=BLOCK,
    )  # fmt: skip
    residuals, used = sums.sum(dim=0, dtype=torch.float64)
    mean: Tensor = residuals / (3.0 * used).clamp(min=1.0)
    return mean


SIGNATURES = (
    Compiled(
        _tissue_loss,
        {
            **dict.fromkeys(("planes", "image"), "*fp32"),
            "tissue": "*i1",
            **dict.fromkeys(("depth", "v_planes", "weight", "sums"), "*fp32"),
            "pixels": "i32",
            **dict.fromkeys(("depth_weight", "inverse_scale", "coverage_weight"), "fp32"),
        },
        {"BLOCK": BLOCK},
    ),
)
