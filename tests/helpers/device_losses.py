"""The device's losses with arrays of the host in and out, as the CPU engine's."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from sags_node.engine.cuda import losses
from sags_node.engine.cuda.backend import default_device
from sags_node.engine.cuda.photometric import PhotometricLoss
from sags_node.engine.losses.photometric import LossTerms, LossWeights
from sags_node.engine.losses.pieces import LEVEL
from sags_node.types import F32

DEVICE = default_device()


def tensors(inputs: dict[str, Any]) -> dict[str, Any]:
    return {
        name: None if array is None else torch.tensor(as_colors(array), device=DEVICE)
        for name, array in inputs.items()
    }


def as_colors(array: Any) -> Any:
    """A picture's bytes as the device takes them, 0..1; other arrays stay."""
    return array * LEVEL if array.dtype == np.uint8 else array


def unwritten(inputs: dict[str, Any]) -> dict[str, Any]:
    """Room for the results; every value must be written."""
    height, width = inputs["tissue"].shape
    return {
        "v_planes": torch.full((5, height, width), torch.nan, device=DEVICE),
        "weight": torch.full((height, width), torch.nan, device=DEVICE),
    }


def tissue_loss(inputs: dict[str, Any], **scales: float) -> tuple[float, F32, F32]:
    written = unwritten(inputs)
    mean = losses.tissue_loss(**tensors(inputs), **written, **scales)
    return mean.item(), written["v_planes"].cpu().numpy(), written["weight"].cpu().numpy()


def photometric(
    inputs: dict[str, Any], weights: LossWeights, normalised: bool = True
) -> tuple[LossTerms, F32, F32]:
    height, width = inputs["tissue"].shape
    loss = PhotometricLoss(width, height, weights, DEVICE, normalised)
    written = unwritten(inputs)
    loss.evaluate(**tensors(inputs), **written)
    return loss.terms(), written["v_planes"].cpu().numpy(), written["weight"].cpu().numpy()
