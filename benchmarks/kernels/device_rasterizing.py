"""Times of a rasteriser on a GPU, of ours stage by stage, over the CPU table's scenes."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from benchmarks.kernels.rasterizing import (
    RasterCase,
    arrays_of,
    make_cotangents,
    make_scene,
    time_drawing,
)
from benchmarks.kernels.timing import Clock, Stages, StageTimes
from benchmarks.kernels.work import Work
from sags_node.engine.cuda import compositing, layout, pair_sums, projection, projection_backward, rasterizer
from sags_node.engine.cuda.backend import DeviceRasterizer
from sags_node.engine.cuda.rasterizer import CudaRasterizer
from sags_node.engine.cuda.scene import DeviceGaussians, DeviceGradients
from sags_node.engine.rasterizer.rasterize import as_pinhole
from sags_node.kernels.peak import Peak

STAGES: Stages = {
    (projection, "project"): "project",
    (rasterizer, "bin_splats"): "bin",
    (compositing, "composite"): "composite",
    (compositing, "composite_backward"): "composite backward",
    (pair_sums, "sum_pairs"): "sum",
    (projection_backward, "project_backward"): "project backward",
}
# On one pixel of one pair, counted in the kernels' source: a multiply-add, a comparison, a selection, a
# division, a power of two count as one each, and each sum over a tile as one per pixel.
OPERATIONS_PER_PAIR = {"composite": 16, "composite backward": 43}

_PER_PAIR = {"pairs", "slots", "v_pairs"}  # also hold the tiles of a box that its ellipse misses
_BINS = (  # what `bin_splats` returns, as others were given it
    ("composite", "pairs"), ("composite", "tile_starts"), ("composite_backward", "slots"),
    ("sum_pairs", "first_slots"),
)  # fmt: skip


class DeviceDrawing:
    """One case on a device, drawn by any rasteriser there."""

    def __init__(self, case: RasterCase, rasterizer: DeviceRasterizer) -> None:
        gaussians, camera = make_scene(case)
        v_planes, weight = make_cotangents(case)
        self.rasterizer = rasterizer
        self.gaussians = DeviceGaussians.from_host(gaussians, rasterizer.device)
        self.pinhole = as_pinhole(camera)
        self.v_planes = torch.tensor(v_planes, device=rasterizer.device)
        self._weight = torch.tensor(weight, device=rasterizer.device)

    def forward(self) -> Tensor:
        return self.rasterizer.draw(self.gaussians, self.pinhole)

    def forward_backward(self) -> DeviceGradients:
        self.forward()
        return self.rasterizer.backward_pass(self.v_planes, self._weight)


def measure_device_rasterizer(
    case: RasterCase, runs: int, peak: Peak, clock: Clock, device: torch.device
) -> dict[str, Any]:
    """One row of the table."""
    drawing = DeviceDrawing(case, CudaRasterizer(case.width, case.height, True, device))
    return time_drawing(drawing, case, runs, peak, STAGES, _work, clock)


def _work(stage: str, times: StageTimes) -> Work:
    drawing = times.arguments["composite"]
    starts, ends = drawing["tile_starts"], drawing["tile_ends"]
    used = int(starts[-1])
    arrays = list(arrays_of(stage, STAGES, times))
    if stage == "bin":
        arrays += [(name, times.arguments[function][name]) for function, name in _BINS]
    touched = float(
        sum(used * _row_bytes(tensor) if name in _PER_PAIR else tensor.nbytes for name, tensor in arrays)
    )
    if stage in OPERATIONS_PER_PAIR:
        pairs = int((ends - starts)[:-1].sum()) * layout.TILE_PIXELS.value
        return Work(touched, OPERATIONS_PER_PAIR[stage] * pairs, pairs)
    return Work(touched)


def _row_bytes(tensor: Tensor) -> int:
    return tensor[:1].nbytes
