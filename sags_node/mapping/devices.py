"""What a launch means for the mapper: who refines, on which rungs, with how many Gaussians."""

import time
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from sags_node.config.schema import LaunchConfig
from sags_node.engine.device import Device, choose_device
from sags_node.engine.rasterizer.rasterize import Rasterizer, make_rasterizer
from sags_node.errors import UsageError
from sags_node.geometry import unproject
from sags_node.mapping.budget import Budget, StepBudget, TimeBudget
from sags_node.mapping.ladder import (
    EVERYTHING,
    GPU_RUNGS,
    ON_CPU,
    ON_GPU,
    PIXELS_PER_GAUSSIAN,
    RUNGS,
    Ladder,
    Rung,
    best_scale,
)
from sags_node.mapping.refiner import CpuRefiner, Refiner
from sags_node.types import Camera, Gaussians

SAMPLE_SIZE = 320, 256  # px
SAMPLE_GAUSSIANS = 8000
SAMPLE_MS = 1.9  # of one drawing and its gradients, back to back, where live frames take their prices
TRIES = 21

LEAST_PIXELS = 2  # of the picture for each Gaussian, where time does not count
FIELD_TIMES = 5.0  # as long as prices say, a frame of the paper's model takes: where its ladder begins
GAUSSIANS_PER_MS = 1100  # of the budget, where the number of steps is fixed; see benchmarks/mapping.md


@dataclass(frozen=True, slots=True)
class Skips:
    """What a frame may leave out. All of it, but in an ablation."""

    duplicates: bool = True  # a frame equal to its predecessor is not mapped again
    depth: bool = True  # when time is short, depth is matched in some of the frames only
    still: bool = True  # while nothing moves: no matching, a step where it pays most


ALL_SKIPS = Skips()


def device_of(config: LaunchConfig) -> Device:
    """The device that refines. UsageError: a GPU is wanted and none can be used."""
    return choose_device("cpu" if config.mapping.method == "sags" else config.device)


def backend_of(config: LaunchConfig) -> str:
    """The rasteriser's backend on that device."""
    return "warp" if device_of(config).kind == "cuda" else "numba"


def affordable(config: LaunchConfig, width: int, height: int) -> int:
    """How many Gaussians a model of pictures of this size may have on the launch's device."""
    if config.mapping.max_gaussians is not None:
        return config.mapping.max_gaussians
    on_gpu = device_of(config).kind == "cuda"
    per_ms = GAUSSIANS_PER_MS * (ON_CPU.per_thousand / ON_GPU.per_thousand if on_gpu else 1.0)
    # Where time is short, steps show more than Gaussians that share few pixels (`benchmarks/ladder.md`).
    each = PIXELS_PER_GAUSSIAN if config.mapping.iterations is None else LEAST_PIXELS
    most = max(100, width * height // each)
    number = config.mapping.rung
    if config.mapping.iterations is None or number is not None:
        return min(most, rungs_of(config)[-1 if number is None else number].gaussians)
    return max(100, min(most, round(per_ms * config.mapping.frame_ms())))


def rungs_of(config: LaunchConfig, skips: Skips = ALL_SKIPS) -> tuple[Rung, ...]:
    """The ladder's, from the cheapest to the best.

    Raises:
        UsageError: `mapping.rung` names none.
    """
    number = config.mapping.rung
    rungs: tuple[Rung, ...] = RUNGS if device_of(config).kind == "cpu" else GPU_RUNGS
    if number is not None and number >= len(rungs):
        raise UsageError(f"mapping.rung {number}: the ladder's rungs are 0 to {len(rungs) - 1}")
    return rungs if skips.depth else tuple(replace(rung, depth_every=1) for rung in rungs)


def make_budget(
    config: LaunchConfig, width: int, height: int, speed: float | None = None, rate: float | None = None,
    skips: Skips = ALL_SKIPS,
) -> Budget:  # fmt: skip
    """Fixed steps where the configuration names them, else its time.

    Args:
        width, height: px of the working size.
        speed: see `Ladder`; None: it is measured.
        rate: frames that come a second; None: they come when they are taken.
    """
    mapping = config.mapping
    if mapping.iterations is not None:
        rung = EVERYTHING if mapping.rung is None else rungs_of(config, skips)[mapping.rung]
        return StepBudget(mapping.iterations, rung)
    if speed is None:
        speed = _measured_speed(config)
    prices = ON_CPU if device_of(config).kind == "cpu" else ON_GPU
    seconds = 1e-3 * mapping.frame_ms(rate)
    rungs = rungs_of(config, skips)
    return TimeBudget(Ladder(rungs, width * height, seconds, speed, prices, mapping.rung))


def with_scale(config: LaunchConfig, width: int, height: int, rate: float | None) -> LaunchConfig:
    """The launch with its `vision.scale` chosen, where that is still to be done.

    In real time on a CPU by the speed of this machine, which is measured; else 1, so that results repeat.

    Args:
        width, height: px of the working size at scale 1.
        rate: frames that come a second.
    """
    if config.vision.scale != "auto":
        return config
    scale = 1.0
    if config.in_real_time and config.mapping.iterations is None and device_of(config).kind == "cpu":
        seconds = 1e-3 * config.mapping.frame_ms(rate)
        scale = best_scale(rungs_of(config), width * height, seconds, _measured_speed(config))
    return config.model_copy(update={"vision": config.vision.model_copy(update={"scale": scale})})


def make_refiner(config: LaunchConfig, width: int, height: int) -> Refiner:
    """The refiner of a launch whose working size is this (px).

    Raises:
        UsageError: a GPU is wanted and none can be used.
    """
    cpu = CpuRefiner(partial(make_rasterizer, "numba"))
    if device_of(config).kind == "cpu":
        return cpu
    from sags_node.mapping.gpu.refiner import GpuRefiner

    on_cpu = affordable(config.model_copy(update={"device": "cpu"}), width, height)
    return GpuRefiner(cpu, on_cpu / affordable(config, width, height))


def _measured_speed(config: LaunchConfig) -> float:
    """`Ladder.speed` before the first frame."""
    times = FIELD_TIMES if config.mapping.method == "sags" else 1.0
    return times * measured_speed(make_rasterizer("numba", *SAMPLE_SIZE))


def measured_speed(rasterizer: Rasterizer) -> float:
    """`Ladder.speed` of this machine: the median of some drawings of made-up Gaussians with their gradients.

    Args:
        rasterizer: for pictures of `SAMPLE_SIZE`.
    """
    width, height = SAMPLE_SIZE
    rng = np.random.default_rng(0)
    depths = rng.uniform(0.06, 0.08, SAMPLE_GAUSSIANS).astype(np.float32)
    pixels = rng.uniform(0, [width, height], (SAMPLE_GAUSSIANS, 2)).astype(np.float32)
    focal = float(width)
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    camera = Camera(width, height, K, np.eye(4))
    gaussians = Gaussians(
        means=unproject(camera, pixels, depths),
        quats=np.tile(np.array([1, 0, 0, 0], np.float32), (SAMPLE_GAUSSIANS, 1)),
        scales=np.full((SAMPLE_GAUSSIANS, 3), np.float32(3e-4)),
        opacities=np.full(SAMPLE_GAUSSIANS, np.float32(0.9)),
        colors=rng.uniform(0, 1, (SAMPLE_GAUSSIANS, 3)).astype(np.float32),
        ids=np.arange(SAMPLE_GAUSSIANS),
    )
    v_planes, weight = np.ones((5, height, width), np.float32), np.ones((height, width), np.float32)
    times = []
    for _ in range(TRIES):
        started = time.perf_counter()
        rasterizer.forward(gaussians, camera)
        rasterizer.backward(v_planes, weight)
        times.append(time.perf_counter() - started)
    return 1e3 * float(np.median(times)) / SAMPLE_MS
