"""Learned perceptual image distance (LPIPS v0.1, SqueezeNet backbone).

R. Zhang et al., "The Unreasonable Effectiveness of Deep Features as a Perceptual Metric", CVPR 2018.
"""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sags_node.errors import UsageError
from sags_node.types import F32, Bool

if TYPE_CHECKING:
    from torch import Tensor

BACKBONE = "lpips_squeeze"

_FIRE_LAYERS = (3, 4, 6, 7, 9, 10, 11, 12)
_POOL_LAYERS = (2, 5, 8)
_TAPS = (1, 4, 7, 9, 10, 11, 12)  # SqueezeNet 1.1 layers whose output is compared
_SHIFT = (-0.030, -0.088, -0.188)  # ImageNet mean and deviation for inputs in -1..1
_SCALE = (0.458, 0.448, 0.450)


class Lpips:
    """The distance of two images; 0 for identical ones, about 0.5 for unrelated ones."""

    def __init__(self, weights: Path) -> None:
        """Read the weights: an npz with the arrays of the original network under their own names.

        Raises:
            UsageError: the file is missing, is no npz, or lacks an array.
        """
        import torch

        try:
            with np.load(weights, allow_pickle=False) as arrays:
                self._weights = {name: torch.from_numpy(arrays[name]) for name in arrays.files}
        except (OSError, ValueError, TypeError, EOFError, zipfile.BadZipFile) as error:
            raise UsageError(f"cannot read LPIPS weights {weights}: {error}") from None
        missing = [name for name in _expected_names() if name not in self._weights]
        if missing:
            raise UsageError(f"{weights} is no LPIPS SqueezeNet file: it lacks {missing[0]}")

    def __call__(self, picture: F32, truth: F32, tissue: Bool) -> float:
        """Distance of two images [H, W, 3] RGB 0..1, both multiplied by the mask [H, W] first.

        NaN when the mask is empty.
        """
        import torch

        if not tissue.any():
            return float("nan")
        with torch.inference_mode():
            pair = torch.from_numpy(np.stack([picture, truth]) * tissue[None, :, :, None])
            taps = self._features(pair.permute(0, 3, 1, 2).float() * 2 - 1)
            return sum(self._distance(tap, index) for index, tap in enumerate(taps))

    def _distance(self, features: Tensor, index: int) -> float:
        length = features.square().sum(1, keepdim=True).sqrt()
        unit = features / (length + 1e-10)
        difference = (unit[0] - unit[1]).square()
        head = self._weights[f"lin.lin{index}.model.1.weight"][0]
        return float((difference * head).sum(0).mean())

    def _features(self, pictures: Tensor) -> list[Tensor]:
        import torch
        from torch.nn.functional import conv2d, max_pool2d

        def conv(x: Tensor, name: str, **how: int) -> Tensor:
            return conv2d(x, self._weights[f"{name}.weight"], self._weights[f"{name}.bias"], **how).relu()

        shift, scale = (torch.tensor(each)[:, None, None] for each in (_SHIFT, _SCALE))
        x = conv((pictures - shift) / scale, "net.0", stride=2)
        taps = [x]
        for layer in range(2, 13):
            if layer in _POOL_LAYERS:
                x = max_pool2d(x, 3, stride=2, ceil_mode=True)
                continue
            narrow = conv(x, f"net.{layer}.squeeze")
            wide = conv(narrow, f"net.{layer}.expand3x3", padding=1)
            x = torch.cat([conv(narrow, f"net.{layer}.expand1x1"), wide], 1)
            if layer in _TAPS:
                taps.append(x)
        return taps


def _expected_names() -> list[str]:
    names = ["net.0.weight", "net.0.bias"]
    for layer in _FIRE_LAYERS:
        for part in ("squeeze", "expand1x1", "expand3x3"):
            names += [f"net.{layer}.{part}.weight", f"net.{layer}.{part}.bias"]
    return names + [f"lin.lin{index}.model.1.weight" for index in range(len(_TAPS))]
