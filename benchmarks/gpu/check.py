"""`make gpu-check`: checks all that a GPU should do, once, on a machine that has one.

A part that fails is noted, and the others go on. No part begins after the time is up.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.gpu.drawing import measure_drawing, parity
from benchmarks.kernels.scenes import surface
from benchmarks.kernels.timing import median_ms
from sags_node.engine import device
from sags_node.engine.gpu import runtime
from sags_node.engine.rasterizer.rasterize import make_rasterizer
from sags_node.engine.rasterizer.views import colours_of
from sags_node.errors import SagsError
from sags_node.mapping.mapper import CONTROL_NODES
from sags_node.mapping.optimiser import LearningRates
from sags_node.mapping.refiner import CpuRefiner, Refiner
from sags_node.model.deformation import NodeDeformation
from sags_node.model.gaussians import GaussianModel
from sags_node.tools.evaluation.provenance import machine_name
from sags_node.types import F32, Observation

STILL = LearningRates().scaled(1e-6)  # so small that every step sees the same scene
NODE_STEP = 1e-12  # m, likewise
OPACITY = 0.8
DARKER = 0.9  # brightness of the frame, as a share of what is drawn
STEPS = 4  # that are timed together: only at their end the GPU is waited for

Row = dict[str, Any]
SECONDS = 420.0  # s after which no new part begins
COMMAND = 300.0  # s that one of our commands may take
COUNTS = (10_000, 30_000, 100_000, 300_000, 1_000_000)
SIZES = ((640, 512), (1280, 1024))
LIVE = (
    ("D4D, 30 Hz", ["launch/d4d_pull.yaml"]),
    ("D4D, 60 Hz", ["launch/d4d_pull.yaml", "source.rate:=60"]),
    ("phantom, 30 Hz", ["launch/phantom.yaml"]),
    ("phantom, 60 Hz", ["launch/phantom.yaml", "source.rate:=60"]),
)
LIVE_FIGURES = (
    "frames", "processed", "rate_hz", "latency_ms", "frame_ms", "stage_ms", "iterations_per_frame", "online",
    "shown", "depth", "gaussians", "rungs", "warnings", "settings",
)  # fmt: skip
FIT_FIGURES = ("seconds", "gaussians", "heldout", "train", "depth", "device", "settings")


@dataclass
class GpuCheck:
    """Runs the parts of the check and keeps their results.

    Attributes:
        figures: the results by the name of the part; for one that failed, only `error`.
    """

    seconds: float = SECONDS
    figures: dict[str, Any] = field(default_factory=dict)
    began: float = field(default_factory=time.monotonic)

    def part(self, name: str, run: Callable[[], Any], say: Callable[[str], None]) -> None:
        if time.monotonic() - self.began > self.seconds:
            self.figures[name] = {"error": "left out: the time is up"}
            return
        try:
            self.figures[name] = run()
        except Exception as error:  # whatever it is, the other parts go on
            self.figures[name] = {"error": f"{type(error).__name__}: {error}"[:2000]}
        say(f"{name}: {json.dumps(self.figures[name])[:300]}")


def gpu_check(small: bool, fit: bool, say: Callable[[str], None], seconds: float = SECONDS) -> dict[str, Any]:
    """Run all parts and return their results by name.

    Args:
        small: tiny sizes and no live runs, for Warp's CPU device.
        fit: also the paper's fit.
        say: called with a line for each part.
        seconds: after which no part begins.
    """
    check = GpuCheck(seconds)
    check.part("environment", environment, say)
    counts, sizes, runs = ((300,), ((64, 48),), 1) if small else (COUNTS, SIZES, 21)
    for count, size in ((200, (96, 80)),) if small else ((2_000, (150, 117)), (100_000, (640, 512))):
        check.part(f"parity {count}", partial(parity, count, *size), say)
    for size in sizes:
        for count in counts:
            name = f"{count} at {size[0]}x{size[1]}"
            check.part(f"draw {name}", partial(measure_drawing, count, *size, runs), say)
            if count <= 300_000:
                check.part(f"refine {name}", partial(measure_case, count, *size, runs, 3), say)
    if small:
        return check.figures
    for name, arguments in LIVE:
        for kind in ("cuda", "cpu"):
            check.part(f"live {name}, {kind}", partial(live, arguments, kind), say)
    if fit:
        check.part("fit", paper_fit, say)
    return check.figures


def environment() -> Row:
    """Return the GPU, its driver, and how long compiling our kernels takes."""
    import warp as wp

    chosen = device.gpu()
    begun = time.perf_counter()
    measure_case(8, 32, 16, 1)
    return {
        "machine": machine_name(),
        "device": chosen.name,
        "arch": getattr(chosen, "arch", None),
        "driver_cuda": runtime.driver(),
        "warp": wp.config.version,
        "python": sys.version.split()[0],
        "compile_s": time.perf_counter() - begun,
    }


def live(arguments: list[str], kind: str) -> Row:
    """Return the figures of what a subscriber gets from a node that plays a recording."""
    found = _sags("eval", *arguments, f"device:={kind}")
    return found if "error" in found else {key: found[key] for key in LIVE_FIGURES}


def paper_fit() -> Row:
    """Run the schedule of SAGS on the GPU and return its figures."""
    found = _sags("fit", "launch/d4d_pull.yaml", "--schedule", "paper", "device:=cuda", out="fit")
    return found if "error" in found else {key: found[key] for key in FIT_FIGURES}


def _sags(*arguments: str, out: str = "figures.json") -> Row:
    """Run one of our commands and read the figures that it writes, to a file or into a folder."""
    with tempfile.TemporaryDirectory() as folder:
        written = Path(folder) / out
        command = [sys.executable, "-m", "sags_node", *arguments, "--out", str(written)]
        done = subprocess.run(command, capture_output=True, text=True, timeout=COMMAND, check=False)
        figures = written / "figures.json" if written.is_dir() else written
        if not figures.exists():
            return {"error": f"{done.returncode}: {done.stderr[-1500:]}"}
        found: Row = json.loads(figures.read_text())
        return found


def measure_case(
    count: int, width: int, height: int, runs: int, cpu_runs: int | None = None
) -> dict[str, Any]:
    """Time a frame and a step on CPU and GPU, and compare the results. `cpu_runs`: runs on the CPU, if fewer.

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
        """Process a frame with one step: upload, two drawings, download. Return the first one's planes."""
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
        """Do `STEPS` more steps in that frame."""
        for _ in range(STEPS):
            self.refiner.draw()
            self.refiner.refine(STILL)
