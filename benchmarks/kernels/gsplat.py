"""gsplat beside our rasteriser: the same scene, and both the same outputs and its own."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from benchmarks.kernels.device_rasterizing import DeviceDrawing
from benchmarks.kernels.rasterizing import RasterCase
from benchmarks.kernels.timing import Clock, median_ms
from sags_node.engine.cuda.gsplat import GsplatRasterizer, camera_matrices
from sags_node.engine.cuda.rasterizer import CudaRasterizer

COMPARED = ("means", "quats", "scales", "opacities", "colors", "contribution")


def measure_gsplat(case: RasterCase, runs: int, clock: Clock, device: torch.device) -> dict[str, float]:
    """What stands under `gsplat` in a row of the table.

    Returns:
        `forward_ms` and `forward_backward_ms` of gsplat's own call, with its own layout and without what only
        we ask for; `same_outputs_...` of the backend, which gives all that ours gives: planes, gradients,
        contribution. `planes_apart`, `gradients_apart`: from ours, relative, the largest.
    """
    rasterizer = GsplatRasterizer(case.width, case.height, True, device)
    same = DeviceDrawing(case, rasterizer)
    plain = PlainCall(same, rasterizer)
    ours = DeviceDrawing(case, CudaRasterizer(case.width, case.height, True, device))
    return {
        "forward_ms": median_ms(plain.forward, runs, clock=clock),
        "forward_backward_ms": median_ms(plain.forward_backward, runs, clock=clock),
        "same_outputs_forward_ms": median_ms(same.forward, runs, clock=clock),
        "same_outputs_forward_backward_ms": median_ms(same.forward_backward, runs, clock=clock),
        **apart(ours, same),
    }


class PlainCall:
    """gsplat as its users call it: colour and depth, gradients of the Gaussians' five arrays."""

    def __init__(self, drawing: DeviceDrawing, rasterizer: GsplatRasterizer) -> None:
        gaussians = drawing.gaussians
        values = (
            gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, gaussians.colors
        )  # fmt: skip
        self._leaves = [value.clone().requires_grad_() for value in values]
        self._arguments = [*self._leaves, *camera_matrices(drawing.pinhole, rasterizer.device)]
        self._rasterizer = rasterizer
        v_planes = drawing.v_planes.permute(1, 2, 0)
        self._cotangents = v_planes[..., :4].contiguous(), v_planes[..., 4:].contiguous()

    def forward(self) -> tuple[Tensor, Tensor]:
        return self._rasterizer.rasterize(*self._arguments)

    def forward_backward(self) -> tuple[Tensor, ...]:
        return torch.autograd.grad(self.forward(), self._leaves, self._cotangents)


def apart(ours: DeviceDrawing, theirs: DeviceDrawing) -> dict[str, float]:
    planes, their_planes = ours.forward(), theirs.forward()
    largest = planes.abs().amax((1, 2))
    gradients: list[Any] = [drawing.forward_backward() for drawing in (ours, theirs)]
    errors = [_relative(*(getattr(each, name) for each in gradients)) for name in COMPARED]
    return {
        "planes_apart": float(((planes - their_planes).abs().amax((1, 2)) / largest).max()),
        "gradients_apart": max(errors),
    }


def _relative(ours: Tensor, theirs: Tensor) -> float:
    return float(torch.linalg.vector_norm(ours - theirs) / torch.linalg.vector_norm(ours))
