"""`make gpu-check`: checks all that a GPU should do, once, on a machine that has one.

Each part runs in a process of its own, with a time limit: a failure, a crash or a hang spoils only that part.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table

from benchmarks.gpu.drawing import measure_drawing, parity
from benchmarks.kernels.scenes import surface
from benchmarks.kernels.timing import median_ms
from sags_node.cli import fit_folder
from sags_node.cli.main import main as sags
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
from sags_node.processes import end
from sags_node.terminal import text
from sags_node.tools.evaluation.provenance import machine_name
from sags_node.types import F32, Observation

STILL = LearningRates().scaled(1e-6)  # so small that every step sees the same scene
NODE_STEP = 1e-12  # m, likewise
OPACITY = 0.8
DARKER = 0.9  # brightness of the frame, as a share of what is drawn
STEPS = 4  # that are timed together: only at their end the GPU is waited for

Row = dict[str, Any]
COUNTS = (10_000, 30_000, 100_000, 300_000, 1_000_000)
SIZES = ((640, 512), (1280, 1024))
D4D, PHANTOM = "launch/d4d_pull.yaml", "replay/phantom_pull"  # the second is here, and was rendered before
LIVE = {
    "D4D, 60 Hz": [D4D, "source.rate:=60"],
    "D4D, 30 Hz": [D4D],
    "phantom, 60 Hz": [PHANTOM, "source.rate:=60"],
    "phantom, 30 Hz": [PHANTOM, "source.rate:=30"],
}
LIVE_FIGURES = (
    "frames", "processed", "rate_hz", "latency_ms", "frame_ms", "stage_ms", "iterations_per_frame", "online",
    "shown", "depth", "gaussians", "rungs", "warnings", "settings",
)  # fmt: skip
FIT_FIGURES = ("seconds", "gaussians", "heldout", "train", "depth", "device", "settings")
SMALL = [PHANTOM, "source.frames:=4", "vision.width:=64", "vision.height:=48"]
SMALL_LIVE = [*SMALL, "--pace", "step", "--iterations", "1", "--hold-out", "0"]
SMALL_FIT = [*SMALL, "--warm-up", "1", "--iterations", "1", "--max-gaussians", "200", "--hold-out", "2"]

Goal = tuple[str, float, float]  # a figure by its path, the least and the most that it should be
ANY = float("inf")
PARITY: tuple[Goal, ...] = (("pixels_apart", 0, 1e-4), ("gradients_apart", 0, 1e-4), ("repeats", 1, 1))
SPEED_GOAL: tuple[Goal, ...] = (
    ("gpu_frame_ms", 0, 6.0), ("by_gsplat_forward", 0, 1.5), ("by_gsplat_backward", 0, 1.5)
)  # fmt: skip
SPEED: tuple[Goal, ...] = tuple((figure, 0, ANY) for figure, _, _ in SPEED_GOAL)
LIVE_GOAL: tuple[Goal, ...] = (
    ("rate_hz", 0, ANY), ("latency_ms.p50", 0, ANY), ("latency_ms.p99", 0, ANY), ("online.psnr", 0, ANY)
)  # fmt: skip
FAST_GOAL: tuple[Goal, ...] = (("rate_hz", 59, ANY), *LIVE_GOAL[1:3], ("online.psnr", 42, ANY))
FIT_GOAL: tuple[Goal, ...] = (("seconds", 0, 300), ("heldout.psnr", 0, ANY))


@dataclass(frozen=True)
class Part:
    """What is run, the seconds that it may take, and the figures of it that are shown."""

    run: Callable[[], Row]
    goals: tuple[Goal, ...] = ()
    limit: float = 120.0


def parts(small: bool, schedule: str) -> dict[str, Part]:
    """The parts by their names, in their order: first what has a goal. `small`: tiny sizes."""
    found = {"environment": Part(environment, limit=180.0)}
    for count, size in ((200, (96, 80)),) if small else ((2_000, (150, 117)), (100_000, (640, 512))):
        found[f"parity {count}"] = Part(partial(parity, count, *size), PARITY)
    counts, sizes, runs = ((300,), ((64, 48),), 1) if small else (COUNTS, SIZES, 21)
    drawn = {
        f"draw {count} at {size[0]}x{size[1]}": Part(
            partial(speed, count, *size, runs), SPEED_GOAL if (count, size) == (100_000, SIZES[0]) else SPEED
        )
        for size in sizes
        for count in counts
    }
    goal = f"draw {counts[min(2, len(counts) - 1)]} at {sizes[0][0]}x{sizes[0][1]}"
    found[goal] = drawn.pop(goal)
    found[f"fit {schedule}"] = Part(
        partial(fit, SMALL_FIT if small else [D4D], schedule),
        FIT_GOAL if schedule == "paper" else FIT_GOAL[1:],
        360.0,
    )
    for name, arguments in LIVE.items():
        goals = FAST_GOAL if name == "D4D, 60 Hz" else LIVE_GOAL
        found[f"live {name}"] = Part(partial(live, SMALL_LIVE if small else arguments), goals)
    return found | drawn


def run_part(name: str, device_name: str, small: bool, schedule: str) -> Row:
    """Run a part in this process; "cpu": Warp's CPU device stands in for a GPU."""
    if device_name == "cpu":
        for module, function, found in (
            (device, "find_gpu", device.Device("cuda", "Warp's CPU device")),
            (device, "gpu", runtime.device_named("cpu")),
            (fit_folder, "device_of", "cpu"),
        ):
            setattr(module, function, lambda *_, found=found: found)
    return parts(small, schedule)[name].run()


def gpu_check(
    arguments: list[str], chosen: dict[str, Part], keep: Callable[[Row], None], seconds: float
) -> Row:
    """Run parts, each in a process of its own, and return their results by name; of one that failed only
    `error`.

    Args:
        arguments: of `python -m benchmarks gpu`, which runs one.
        keep: called with all results after each part.
        seconds: after which no part begins.
    """
    figures: Row = {}
    began = time.monotonic()
    for name, part in chosen.items():
        if time.monotonic() - began > seconds:
            figures[name] = {"error": "left out: the time is up"}
        else:
            command = [sys.executable, "-m", "benchmarks", "gpu", *arguments, "--part", name]
            figures[name] = in_a_process(command, part.limit)
        keep(figures)
    return figures


def in_a_process(command: list[str], limit: float) -> Row:
    """Run a command that prints JSON on its last line, and end it and all that it started after `limit` s."""
    with tempfile.TemporaryFile("w+") as said, tempfile.TemporaryFile("w+") as problems:
        process = subprocess.Popen(command, stdout=said, stderr=problems, start_new_session=True)
        try:
            code = process.wait(limit)
        except subprocess.TimeoutExpired:
            return {"error": f"it did not end within {limit:g} s"}
        finally:
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            end(process, grace=0.0)
        said.seek(0)
        problems.seek(0)
        if code != 0:
            return {"error": f"exit code {code}: {problems.read()[-1500:].strip()}"}
        found: Row = json.loads(said.read().splitlines()[-1])
        return found


def table(figures: Row, chosen: dict[str, Part]) -> Table:
    """What was measured, and whether it is what it should be."""
    made = text.table("part", "figure", "value", "goal", "reached")
    for name, found in figures.items():
        if "error" in found:
            made.add_row(name, "failed", found["error"].splitlines()[-1], "", "no")
        for path, least, most in () if "error" in found else chosen[name].goals:
            value: Any = found
            for key in path.split("."):
                value = None if value is None else value.get(key)
            if value is None:  # gsplat is not installed
                continue
            goal = f"at most {most:g}" if most < ANY else f"at least {least:g}" if least > 0 else ""
            reached = ("yes" if least <= value <= most else "no") if goal else ""
            made.add_row(name, path, f"{value:.4g}", goal, reached)
    return made


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


def speed(count: int, width: int, height: int, runs: int) -> Row:
    """Time drawings, and frames where a model may be so large; ours beside gsplat's and the CPU's."""
    row = measure_drawing(count, width, height, runs)
    for way in ("forward", "backward"):
        if f"gsplat_{way}_ms" in row:
            row[f"by_gsplat_{way}"] = row[f"{way}_ms"] / row[f"gsplat_{way}_ms"]
    return row if count > 300_000 else row | measure_case(count, width, height, runs, 3)


def live(arguments: list[str]) -> Row:
    """Return the figures of what a subscriber gets from a node that plays a recording."""
    return _sags("figures.json", LIVE_FIGURES, "eval", *arguments, "device:=cuda")


def fit(arguments: list[str], schedule: str) -> Row:
    """Fit on the GPU and return its figures."""
    return _sags("fit/figures.json", FIT_FIGURES, "fit", *arguments, "--schedule", schedule, "device:=cuda")


def _sags(written: str, names: tuple[str, ...], *arguments: str) -> Row:
    """Run one of our commands and read figures that it writes."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / written.partition("/")[0]
        if code := sags([*arguments, "--out", str(out)], standalone_mode=False):
            sys.exit(code)  # it has said why
        found = json.loads((Path(folder) / written).read_text())
    return {name: found[name] for name in names if name in found}


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
