"""The rasteriser's time after idle pauses, and beside another process on the same cores."""

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from benchmarks.kernels.rasterizing import Drawing, RasterCase
from benchmarks.kernels.timing import times_ms
from sags_node.processes import end

CAMERA_PERIOD_S = 1 / 30


def measure_rhythm(case: RasterCase, runs: int) -> dict[str, Any]:
    """Time calls back to back, and once per camera frame with a pause between, as the node calls it."""
    function = Drawing(case).forward_backward
    return {
        **_named(case),
        "back_to_back_ms": _spread(times_ms(function, runs)),
        "every_33_ms": _spread(times_ms(function, runs, period_s=CAMERA_PERIOD_S)),
    }


def measure_contention(case: RasterCase, runs: int) -> dict[str, Any]:
    """Time calls alone, and beside another process that keeps one core busy."""
    function = Drawing(case).forward_backward
    alone = _spread(times_ms(function, runs))
    with burning_core():
        beside = _spread(times_ms(function, runs))
    return {**_named(case), "alone_ms": alone, "beside_busy_process_ms": beside}


def _named(case: RasterCase) -> dict[str, Any]:
    return {"n": case.count, "width": case.width, "height": case.height, "threads": case.threads}


@contextmanager
def burning_core() -> Iterator[subprocess.Popen[bytes]]:
    process = subprocess.Popen([sys.executable, "-c", "while True: pass"])
    try:
        yield process
    finally:
        end(process, grace=0.0)


def _spread(times: list[float]) -> dict[str, float]:
    p50, p90 = np.percentile(times, [50, 90])
    return {"p50": float(p50), "p90": float(p90)}
