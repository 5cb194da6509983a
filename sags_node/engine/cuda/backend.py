"""GPU rasterisers as `interface.Backend`: arrays of the host in and out, copied on every call."""

from __future__ import annotations

from typing import Protocol

import torch
import triton
from torch import Tensor

from sags_node.engine.cuda.rasterizer import CudaRasterizer
from sags_node.engine.cuda.scene import DeviceGaussians, DeviceGradients
from sags_node.engine.interface import Gradients, Pinhole
from sags_node.errors import UsageError
from sags_node.types import F32, I32, Bool, Gaussians


class DeviceRasterizer(Protocol):
    """What `CudaRasterizer` explains, over tensors on `device`."""

    device: torch.device

    def draw(self, gaussians: DeviceGaussians, pinhole: Pinhole, tiles: Tensor | None = None) -> Tensor: ...

    def backward_pass(self, v_planes: Tensor, weight: Tensor) -> DeviceGradients: ...

    def median_depth(self) -> tuple[Tensor, Tensor]: ...


def default_device() -> torch.device:
    """The current GPU, or the CPU where Triton's interpreter runs the kernels.

    Raises:
        UsageError: there is no GPU.
    """
    if triton.knobs.runtime.interpret:
        return torch.device("cpu")
    if not torch.cuda.is_available():
        raise UsageError(
            "the cuda backend found no GPU: this torch has no CUDA build or sees no driver (try nvidia-smi); "
            "fix that, or choose the numba backend"
        )
    return torch.device("cuda", torch.cuda.current_device())


def cuda_backend(width: int, height: int, antialias: bool) -> DeviceBackend:
    """Backend `cuda`, of our own kernels. UsageError: there is no GPU."""
    return DeviceBackend(CudaRasterizer(width, height, antialias, default_device()))


class DeviceBackend:
    """For arrays that live on the host; what stays on the device uses the rasteriser itself."""

    def __init__(self, rasterizer: DeviceRasterizer) -> None:
        self._rasterizer = rasterizer

    def forward(self, gaussians: Gaussians, pinhole: Pinhole, tiles: Bool | None) -> F32:
        planes: F32 = (
            self._rasterizer.draw(
                DeviceGaussians.from_host(gaussians, self._rasterizer.device),
                pinhole,
                None if tiles is None else torch.tensor(tiles),
            )
            .cpu()
            .numpy()
        )
        return planes

    def backward(self, v_planes: F32, weight: F32) -> Gradients:
        device = self._rasterizer.device
        found = self._rasterizer.backward_pass(
            torch.tensor(v_planes, device=device), torch.tensor(weight, device=device)
        )
        return Gradients(
            means=found.means.cpu().numpy(),
            quats=found.quats.cpu().numpy(),
            scales=found.scales.cpu().numpy(),
            opacities=found.opacities.cpu().numpy(),
            colors=found.colors.cpu().numpy(),
            sh_rest=found.sh_rest.cpu().numpy(),
            contribution=found.contribution.cpu().numpy(),
        )

    def median(self) -> tuple[F32, I32]:
        depths, rows = self._rasterizer.median_depth()
        return depths.cpu().numpy(), rows.cpu().numpy()
