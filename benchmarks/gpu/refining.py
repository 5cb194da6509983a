"""The mapper's refinement of a frame: a GPU beside the CPU."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np

from benchmarks.kernels.scenes import surface
from benchmarks.kernels.timing import median_ms
from sags_node.engine.rasterizer.rasterize import make_rasterizer
from sags_node.engine.rasterizer.views import colours_of
from sags_node.errors import SagsError
from sags_node.mapping.mapper import CONTROL_NODES
from sags_node.mapping.optimiser import LearningRates
from sags_node.mapping.refiner import CpuRefiner, Refiner
from sags_node.model.deformation import NodeDeformation
from sags_node.model.gaussians import GaussianModel
from sags_node.types import F32, Observation

STILL = LearningRates().scaled(1e-6)  # so small that every step sees the same scene
NODE_STEP = 1e-12  # m, likewise
OPACITY = 0.8
DARKER = 0.9  # what is to be shown, against what is drawn
STEPS = 4  # that are timed together: a GPU is waited for at their end


def measure_case(
    count: int, width: int, height: int, runs: int, cpu_runs: int | None = None
) -> dict[str, Any]:
    """Times, and how far both are apart. `cpu_runs`: fewer, of the CPU.

    Raises:
        SagsError: the GPU failed.
    """
    from sags_node.mapping.gpu.refiner import GpuRefiner  # Warp takes a second to import

    def on_cpu() -> CpuRefiner:
        return CpuRefiner(partial(make_rasterizer, "numba"))

    cpu = Refining(on_cpu(), count, width, height)
    gpu = Refining(GpuRefiner(on_cpu(), 1.0), count, width, height)
    truth, found = (each.frame() for each in (cpu, gpu))  # before any other step
    moved, moved_on_gpu = (each.model.colors - each.before for each in (cpu, gpu))
    row: dict[str, Any] = {"n": cpu.model.count, "width": width, "height": height}
    for name, each, times in (("cpu", cpu, cpu_runs or runs), ("gpu", gpu, runs)):
        row[f"{name}_frame_ms"] = median_ms(each.frame, times)
        row[f"{name}_step_ms"] = median_ms(each.steps, times) / STEPS
    if gpu.refiner.problem is not None:  # else the CPU's times would stand as the GPU's
        raise SagsError(gpu.refiner.problem.text)
    return row | {
        "planes_apart": float(np.abs(found - truth).max() / np.abs(truth).max()),
        "colors_apart": float(np.linalg.norm(moved_on_gpu - moved) / np.linalg.norm(moved)),
    }


class Refining:
    """A refiner with a model of the tissue-like surface, and a frame that shows it a little darker."""

    def __init__(self, refiner: Refiner, count: int, width: int, height: int) -> None:
        drawn, camera = surface(count, width, height)
        self.refiner, self.model = refiner, GaussianModel(len(drawn))
        rows = self.model.append(drawn.means, drawn.scales, drawn.colors, OPACITY)
        self.before = self.model.colors.copy()
        self._deformation = NodeDeformation(self.model.means, CONTROL_NODES)
        self._deformation.attach(self.model, rows)
        planes = make_rasterizer("numba", width, height).forward(self.model.gaussians(), camera)
        image = (DARKER * 255 * colours_of(planes)).astype(np.uint8)
        everywhere = np.ones((height, width), np.float32)
        depth = np.where(planes[4] > 0, planes[3] / np.maximum(planes[4], 1e-6), 0.0).astype(np.float32)
        self._observation = Observation(
            0, 0, camera, image, image[..., 1].copy(), everywhere > 0, depth, everywhere
        )

    def frame(self) -> F32:
        """What a frame with one step costs: the model there and back, two drawings. Returns the first."""
        refiner = self.refiner
        refiner.begin(self.model, self._deformation, self._observation, NODE_STEP)
        refiner.draw()
        planes = refiner.planes().copy()
        refiner.refine(STILL)
        refiner.download()
        refiner.draw()
        refiner.planes()
        return planes

    def steps(self) -> None:
        """More steps in that frame."""
        for _ in range(STEPS):
            self.refiner.draw()
            self.refiner.refine(STILL)
