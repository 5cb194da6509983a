"""The table of `benchmarks kernels --device cuda`: our rasteriser on a GPU beside that GPU's own peak, and
beside gsplat where that is installed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from importlib.metadata import version
from typing import Any

import torch

from benchmarks.kernels.device_peak import SMALL_PROBE, full_probe, measure_device_peak
from benchmarks.kernels.device_rasterizing import measure_device_rasterizer
from benchmarks.kernels.gsplat import measure_gsplat
from benchmarks.kernels.rasterizing import RasterCase
from benchmarks.kernels.timing import WALL, Clock, EventClock
from sags_node.engine.cuda import gsplat as gsplat_backend
from sags_node.engine.cuda.backend import default_device
from sags_node.engine.device import find_gpu
from sags_node.errors import UsageError
from sags_node.evaluation.provenance import machine_name
from sags_node.kernels.peak import peak_row

Advance = Callable[[int, int, str], None]  # done, total, what comes next


@dataclass(frozen=True, slots=True)
class DeviceSettings:
    """What is measured."""

    counts: tuple[int, ...] = (10_000, 30_000, 100_000, 300_000, 1_000_000)  # Gaussians
    sizes: tuple[tuple[int, int], ...] = ((640, 512), (1280, 1024))  # px
    runs: int = 31  # per median
    gsplat: bool = True  # also time gsplat


QUICK = DeviceSettings(counts=(8,), sizes=((32, 16),), runs=1)


def measure_device_kernels(settings: DeviceSettings, advance: Advance) -> dict[str, Any]:
    """Everything that `settings` ask for; keys as benchmarks/gpu.md lists them.

    Raises:
        UsageError: there is no GPU that can be used, or only Triton's interpreter for a scene of real size.
    """
    found = find_gpu()
    if found.kind == "cpu":
        raise UsageError(f"--device cuda cannot be used: {found.reason}; {found.fix}, or leave it out")
    device = default_device()
    interpreted = device.type == "cpu"
    if interpreted and settings.counts != QUICK.counts:
        raise UsageError(
            "Triton's interpreter is thousands of times too slow for this; add --quick, or unset "
            "TRITON_INTERPRET where there is a GPU"
        )
    clock: Clock = WALL if interpreted else EventClock()
    peak = measure_device_peak(device, SMALL_PROBE if interpreted else full_probe(device), clock)
    beside, gsplat_is = find_gsplat(settings.gsplat)
    table: dict[str, Any] = {
        "machine": machine_name(),
        "device": found.name,
        "clock": "interpreter: wall clock, says nothing of a GPU" if interpreted else "device events",
        "gsplat": gsplat_is,
        "threads": 1,
        "settings": asdict(settings),
        "peaks": [peak_row(peak)],
        "rasterize": [],
    }
    cases = [RasterCase(count, *size, threads=1) for size in settings.sizes for count in settings.counts]
    for done, case in enumerate(cases):
        advance(done, len(cases), f"{case.count} Gaussians at {case.width}x{case.height}")
        row = measure_device_rasterizer(case, settings.runs, peak, clock, device)
        if beside:
            row["gsplat"] = measure_gsplat(case, settings.runs, clock, device)
        table["rasterize"].append(row)
    return table


def find_gsplat(wanted: bool) -> tuple[bool, str]:
    """Whether gsplat is measured, and its version, or why it is not."""
    if not wanted:
        return False, "not asked for"
    try:
        gsplat_backend.usable_device()
    except UsageError as error:
        return False, f"left out: {error}"
    return True, f"gsplat {version('gsplat')}, torch {torch.__version__}"
