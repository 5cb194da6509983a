"""The camera's gain against the model, found on the device."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch

if TYPE_CHECKING:
    from torch import Tensor


@dataclass(frozen=True, slots=True)
class ExposureRule:
    """Which pixels tell the gain; the values are the mapper's."""

    every: int  # px between the pixels that are looked at
    covered: float  # coverage from which a pixel tells something
    dark: float  # beyond these, a pixel tells noise or saturation
    bright: float
    least_pixels: int
    largest: float  # gain, and one over the smallest


def exposure_gain(planes: Tensor, image: Tensor, tissue: Tensor, rule: ExposureRule) -> Tensor:
    """Factor [3] by which a picture is brighter than the model, for each channel; 1 where too little tells.
    The median over fair pixels, as `mapping.exposure` takes it. Nothing is read back to the host.

    Args:
        planes: [5, H, W] of the rasteriser, drawn for that picture.
        image: [H, W, 3] RGB 0..1.
        tissue: [H, W] bool, where to compare.
    """
    some = slice(None, None, rule.every)
    coverage = planes[4, some, some]
    drawn, seen = planes[:3, some, some] / coverage, image[some, some].permute(2, 0, 1)
    colors = torch.stack([drawn, seen])
    fair = ((colors > rule.dark) & (colors < rule.bright)).all(dim=0).all(dim=0)
    fair &= tissue[some, some] & (coverage > rule.covered)
    ratios = torch.where(fair, seen / drawn, torch.nan).flatten(1)
    gain = torch.nanquantile(ratios, 0.5, dim=1).clamp(1 / rule.largest, rule.largest)
    return torch.where(fair.sum() < rule.least_pixels, torch.ones_like(gain), gain)
