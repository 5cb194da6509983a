"""The table of `benchmarks kernels --device cuda`: the mapper's refinement of a frame, GPU beside CPU."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial
from importlib.metadata import version
from typing import Any

import numpy as np
from rich.table import Table

from benchmarks.kernels.report import new_table
from benchmarks.kernels.scenes import surface
from benchmarks.kernels.timing import median_ms
from sags_node.engine.device import choose_device
from sags_node.engine.rasterizer.rasterize import make_rasterizer
from sags_node.engine.rasterizer.views import colours_of
from sags_node.errors import SagsError
from sags_node.evaluation.provenance import machine_name
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

Advance = Callable[[int, int, str], None]  # done, total, what comes next


@dataclass(frozen=True, slots=True)
class GpuSettings:
    """What is measured."""

    counts: tuple[int, ...] = (10_000, 30_000, 100_000, 300_000)  # Gaussians
    sizes: tuple[tuple[int, int], ...] = ((640, 512), (1280, 1024))  # px
    runs: int = 31  # per median


QUICK = GpuSettings(counts=(8,), sizes=((32, 16),), runs=1)


def measure_gpu(settings: GpuSettings, advance: Advance) -> dict[str, Any]:
    """Everything that `settings` ask for; keys as benchmarks/gpu.md lists them.

    Raises:
        UsageError: there is no GPU that can be used.
        SagsError: it failed.
    """
    device = choose_device("cuda")
    cases = [(count, *size) for size in settings.sizes for count in settings.counts]
    rows = []
    for done, (count, width, height) in enumerate(cases):
        advance(done, len(cases), f"{count} Gaussians at {width}x{height}")
        rows.append(measure_case(count, width, height, settings.runs))
    return {
        "machine": machine_name(),
        "device": device.name,
        "warp": version("warp-lang"),
        "settings": asdict(settings),
        "refine": rows,
    }


def measure_case(
    count: int, width: int, height: int, runs: int, cpu_runs: int | None = None
) -> dict[str, Any]:
    """A row of the table. `cpu_runs`: fewer, of the CPU."""
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


def gpu_table(measured: dict[str, Any]) -> Table:
    """`measured` as `measure_gpu` returns it."""
    made = new_table(
        f"{measured['device']}, Warp {measured['warp']}", "frame ms", "CPU", "faster", "step ms", "CPU",
        "faster", "planes apart", "colours apart",
    )  # fmt: skip
    for row in measured["refine"]:
        cells = []
        for what in ("frame", "step"):
            gpu, cpu = row[f"gpu_{what}_ms"], row[f"cpu_{what}_ms"]
            cells += [f"{gpu:.2f}", f"{cpu:.2f}", f"{cpu / gpu:.2f}x"]
        apart = (f"{row[key]:.1e}" for key in ("planes_apart", "colors_apart"))
        made.add_row(f"{row['n']} at {row['width']}x{row['height']}", *cells, *apart)
    return made
