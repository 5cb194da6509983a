"""What the GPU rasteriser takes and gives: tensors on its device."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from sags_node.engine.cuda.layout import CAMERA_FLOATS
from sags_node.engine.interface import Pinhole
from sags_node.errors import UsageError
from sags_node.types import Gaussians


@dataclass(frozen=True, slots=True)
class DeviceGaussians:
    """`types.Gaussians` on a device: contiguous float32, not copied."""

    means: Tensor  # [N, 3] m, world
    quats: Tensor  # [N, 4] wxyz
    scales: Tensor  # [N, 3] m
    opacities: Tensor  # [N]
    colors: Tensor  # [N, 3]
    sh_rest: Tensor | None = None  # [N, 3 or 8 or 15, 3]
    smoothing: Tensor | None = None  # [N] m^2

    def __post_init__(self) -> None:
        """Raises UsageError where a kernel would read the wrong memory."""
        n = len(self.means)
        shapes: dict[str, tuple[int, ...]] = {
            "means": (n, 3), "quats": (n, 4), "scales": (n, 3), "opacities": (n,), "colors": (n, 3),
            "sh_rest": (n, self.terms, 3), "smoothing": (n,),
        }  # fmt: skip
        for name, shape in shapes.items():
            tensor = getattr(self, name)
            if tensor is not None:
                check_tensor(tensor, shape, self.means.device, name)
        if self.terms not in (0, 3, 8, 15):
            raise UsageError(f"sh_rest has {self.terms} terms, expected 0, 3, 8 or 15")

    def __len__(self) -> int:
        return len(self.means)

    @property
    def terms(self) -> int:
        """Spherical harmonics without the constant one."""
        return 0 if self.sh_rest is None else self.sh_rest.shape[1]

    @staticmethod
    def from_host(gaussians: Gaussians, device: torch.device) -> DeviceGaussians:
        """A copy on the device."""
        names = ("means", "quats", "scales", "opacities", "colors", "sh_rest", "smoothing")
        arrays = {name: getattr(gaussians, name) for name in names}
        return DeviceGaussians(
            **{
                name: torch.tensor(array, dtype=torch.float32, device=device)
                for name, array in arrays.items()
                if array is not None
            }
        )


@dataclass(frozen=True, slots=True)
class DeviceGradients:
    """`interface.Gradients` on a device."""

    means: Tensor  # [N, 3]
    quats: Tensor  # [N, 4]
    scales: Tensor  # [N, 3]
    opacities: Tensor  # [N]
    colors: Tensor  # [N, 3]
    sh_rest: Tensor  # [N, K - 1, 3]
    contribution: Tensor  # [N]


def check_tensor(tensor: Tensor, shape: tuple[int, ...], device: torch.device, name: str) -> None:
    """Raises UsageError unless a kernel may read it as contiguous float32 of this shape."""
    if tuple(tensor.shape) != shape or tensor.dtype != torch.float32:
        raise UsageError(
            f"{name} is {tensor.dtype} {list(tensor.shape)}, expected torch.float32 {list(shape)}"
        )
    if tensor.device != device or not tensor.is_contiguous():
        raise UsageError(
            f"{name} is on {tensor.device}, contiguous: {tensor.is_contiguous()}; "
            f"it must be contiguous and on {device}"
        )


def camera_record(pinhole: Pinhole, device: torch.device) -> Tensor:
    """[CAMERA_FLOATS]; see `layout`."""
    record = np.zeros(CAMERA_FLOATS.value, np.float32)
    centre = -pinhole.R.T @ pinhole.t
    intrinsics = (pinhole.fx, pinhole.fy, pinhole.cx, pinhole.cy)
    record[:23] = [*pinhole.R.ravel(), *pinhole.t, *intrinsics, *pinhole.limits, *centre]
    return torch.from_numpy(record).to(device)
