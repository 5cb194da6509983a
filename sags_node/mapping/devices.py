"""What a launch means for the mapper: which device refines, on which rungs, with how many Gaussians."""

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
SAMPLE_MS = 1.9  # for one drawing with its gradients, in a loop, on the machine of the ladder's prices
TRIES = 21

LEAST_PIXELS = 2  # pixels of the image for each Gaussian, where the number of steps is fixed
FIELD_TIMES = 5.0  # factor on prices: first guess of what a frame of the paper's model takes
GAUSSIANS_PER_MS = 1100  # of the frame's time, where the number of steps is fixed; see benchmarks/mapping.md


@dataclass(frozen=True, slots=True)
class Skips:
    """The work that a frame may leave out. All are on, except in an ablation."""

    duplicates: bool = True  # a frame equal to its predecessor is not mapped again
    depth: bool = True  # when time is short, depth is matched in some of the frames only
    still: bool = True  # while nothing moves: no matching, a step where it pays most


ALL_SKIPS = Skips()


def device_of(config: LaunchConfig) -> Device:
    """The device that refines. UsageError: a GPU is wanted and none can be used."""
    return choose_device("cpu" if config.mapping.method == "sags" else config.device)


def backend_of(config: LaunchConfig) -> str:
    """The rasteriser's backend on the launch's device."""
    return "warp" if device_of(config).kind == "cuda" else "numba"


def affordable(config: LaunchConfig, width: int, height: int) -> int:
    """The number of Gaussians that a model may have on the launch's device, for images of a size (px)."""
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
    """The rungs of the ladder, from the cheapest to the best.

    Raises:
        UsageError: `mapping.rung` is not one of them.
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
    """Make the budget of frames: a fixed number of steps where the configuration sets one, else a time.

    Args:
        width, height: px of the working size.
        speed: see `Ladder`; None: it is measured.
        rate: frames per second of the source; None: frames come when they are taken.
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
    """The launch with a number for `vision.scale` where that is "auto".

    In real time on a CPU it follows from the measured speed of this machine; else it is 1: results repeat.

    Args:
        width, height: px of the working size at scale 1.
        rate: frames per second of the source.
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
    """Measure `Ladder.speed` of this machine: the median time of drawing made-up Gaussians with gradients.

    Args:
        rasterizer: for images of `SAMPLE_SIZE`.
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
