"""What a launch's device means for the mapper: who refines, and how many Gaussians."""

from __future__ import annotations

from sags_node.config import LaunchConfig
from sags_node.engine.device import Device, choose_device
from sags_node.engine.rasterize import make_rasterizer
from sags_node.mapping.budget import capacity
from sags_node.mapping.refiner import CpuRefiner, Refiner

GPU_SPEED = 10.0  # times two CPU cores, in Gaussians per ms of the budget: an ESTIMATE, never run on a GPU


def device_of(config: LaunchConfig) -> Device:
    """The device that refines. UsageError: a GPU is wanted and none can be used."""
    return choose_device(config.device if config.engine.backend == "numba" else "cpu")


def affordable(config: LaunchConfig, width: int, height: int) -> int:
    """How many Gaussians a model of pictures of this size may have on the launch's device."""
    mapping = config.mapping
    if device_of(config).kind == "cuda":
        mapping = mapping.model_copy(update={"budget_ms": GPU_SPEED * mapping.budget_ms})
    return capacity(mapping, width, height)


def make_refiner(config: LaunchConfig, width: int, height: int) -> Refiner:
    """The refiner for pictures of this size (px).

    Raises:
        UsageError: a GPU is wanted and none can be used.
    """
    cpu = CpuRefiner(make_rasterizer(config.engine.backend, width, height))
    if device_of(config).kind == "cpu":
        return cpu
    from sags_node.mapping.cuda_refiner import CudaRefiner
    from sags_node.mapping.guarded_refiner import GuardedRefiner

    cpu_share = capacity(config.mapping, width, height) / affordable(config, width, height)
    return GuardedRefiner(CudaRefiner(width, height), cpu, cpu_share)
