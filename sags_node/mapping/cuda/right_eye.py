"""What the right eye's picture says of the model, on the device; `mapping.right_eye` has the reasons."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch

from sags_node.engine.cuda.losses import tissue_loss
from sags_node.mapping.cuda.exposure import ExposureRule, exposure_gain

if TYPE_CHECKING:
    from torch import Tensor


@dataclass(frozen=True, slots=True)
class RightEyeRule:
    """How far the right eye is trusted; the values are the mapper's."""

    far_margin: float  # of the disparity, below the furthest tissue drawn
    near_margin: float  # of the disparity, above the nearest
    share: float  # of a right pixel against a left one
    every: int  # px between the pixels that tell the range of depths
    exposure: ExposureRule


def right_eye_loss(
    planes: Tensor,
    image: Tensor,
    tissue: Tensor,
    focal_px: float,
    baseline: float,
    rule: RightEyeRule,
    v_planes: Tensor,
    weight: Tensor,
) -> None:
    """Loss of the right eye's picture, and its gradient. Nothing is read back to the host.

    Args:
        planes: [2, 5, H, W] of the rasteriser, left and right.
        image: [H, W, 3] RGB 0..1 of the right eye.
        tissue: [H, W] bool of the left picture.
        focal_px: of the rectified pair.
        baseline: m.
        v_planes: [5, H, W] written: the gradient by the right eye's planes.
        weight: [H, W] written, as `losses.tissue_loss` does.
    """
    some = slice(None, None, rule.every)
    coverage = planes[0, 4, some, some]
    depth = planes[0, 3, some, some] / coverage
    known = torch.where(tissue[some, some] & (coverage > 0.5) & (depth > 0), depth, torch.nan)
    mask = right_eye_mask(tissue, known, focal_px, baseline, rule)
    gain = exposure_gain(planes[1], image, mask, rule.exposure)
    nothing = torch.zeros_like(weight)
    tissue_loss(planes[1], image / gain, mask, nothing, v_planes, weight, 0.0, 1.0, share=rule.share)


def right_eye_mask(
    tissue: Tensor, depths: Tensor, focal_px: float, baseline: float, rule: RightEyeRule
) -> Tensor:
    """The right eye's pixels [H, W] bool that show tissue for certain: every disparity that tissue and
    instruments can have takes them to a tissue pixel of the left picture.

    Args:
        tissue: [H, W] bool of the left picture.
        depths: m, of tissue as it is drawn for the left eye, NaN where it is not.
        focal_px: of the rectified pair.
        baseline: m.
    """
    height, width = tissue.shape
    nearest, furthest = torch.nanquantile(depths, 0.01), torch.nanquantile(depths, 0.99)
    lowest = torch.floor(focal_px * baseline / furthest * (1 - rule.far_margin))
    highest = torch.ceil(focal_px * baseline / nearest * (1 + rule.near_margin))
    # where no depth is known both are NaN: as wide a range as the picture leaves no pixel
    lowest, highest = (torch.nan_to_num(d, nan=width).clamp(0, width).long() for d in (lowest, highest))
    others = torch.zeros((height, width + 1), dtype=torch.int32, device=tissue.device)
    torch.cumsum(~tissue, dim=1, dtype=torch.int32, out=others[:, 1:])  # non-tissue pixels left of a column
    column = torch.arange(width, device=tissue.device)
    first, end = (column + lowest).clamp(max=width), (column + highest + 1).clamp(max=width)
    return (others[:, first] == others[:, end]) & (column + highest < width)
