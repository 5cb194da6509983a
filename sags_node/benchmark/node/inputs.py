"""`sags bench inputs`: what a live pair costs until the mapper can have it, for each way into the node."""

from __future__ import annotations

import resource
import threading
import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any

import numpy as np

from sags_node.config import GeometryConfig, GstSource
from sags_node.errors import SagsError, UsageError
from sags_node.sources.source import Source, open_source

WIDTH, HEIGHT, RATE = 1280, 1024, 30  # of an eye
WARM_UP_S = 1.0
SILENT_S = 30.0  # a source may give nothing for so long

Opener = Callable[[], AbstractContextManager[Source]]  # of a live source of that size and rate


def _camera(height: int) -> str:
    """Black is made at once; a moving picture of this size takes 18 ms of a core, and falls behind."""
    return (
        "videotestsrc is-live=true pattern=black "
        f"! video/x-raw,format=UYVY,width={WIDTH},height={height},framerate={RATE}/1"
    )


def _gst_two() -> Source:
    return open_source(GstSource(launch=f"{_camera(HEIGHT)} ! tee name=t  t. ! left.  t. ! right."))


def _gst_over_under() -> Source:
    geometry = GeometryConfig(layout="over_under")
    return open_source(GstSource(launch=_camera(2 * HEIGHT), geometry=geometry))


WAYS: dict[str, Opener] = {"gst, two branches": _gst_two, "gst, over-under": _gst_over_under}


def measure_inputs(
    seconds: float, only: str | None, progress: Callable[[int, int], None]
) -> list[dict[str, Any]]:
    """A row for each way: `way`, `pairs`, `unequal` (pairs of unequal stamps), `dropped` (pictures without
    a partner); `node_ms`, the CPU time of a pair in the node's process; `sender_ms`, that of the process
    that makes, converts and sends the pictures; `latency_ms_p50` and `_p99` from the stamp until the pair is
    there.

    Args:
        seconds: to measure, each.
        only: ways whose names begin so.
        progress: called with ways done and in all.

    Raises:
        UsageError: no way has such a name.
        SagsError: a source cannot be opened, or gives nothing.
    """
    ways = {name: opener for name, opener in WAYS.items() if name.startswith(only or "")}
    if not ways:
        raise UsageError(f"--only {only}: the ways are {', '.join(WAYS)}")
    rows = []
    for done, (name, opener) in enumerate(ways.items()):
        progress(done, len(ways))
        rows.append({"way": name, **_measure(opener, seconds)})
    return rows


def _measure(opener: Opener, seconds: float) -> dict[str, Any]:
    children_before = _children_s()
    began = time.monotonic()
    latencies, unequal = [], 0
    with opener() as source:
        timer = threading.Timer(WARM_UP_S + seconds + SILENT_S, source.stop)
        timer.daemon = True
        timer.start()
        cpu, dropped = 0.0, 0
        until = None
        for frame in source:
            now = time.monotonic()
            if until is None:
                if now - began < WARM_UP_S:
                    continue
                until, cpu, dropped = now + seconds, time.process_time(), source.dropped
            latencies.append(time.time_ns() - frame.t_capture_ns)
            unequal += frame.t_capture_ns != frame.t_capture_right_ns
            if now > until:
                break
        cpu, dropped = time.process_time() - cpu, source.dropped - dropped
        timer.cancel()
    if not latencies:
        raise SagsError("the source gave no pair")
    lasted = time.monotonic() - began
    p50, p99 = np.percentile(latencies, (50, 99)) * 1e-6
    return {
        "pairs": len(latencies),
        "unequal": unequal,
        "dropped": dropped,
        "node_ms": round(cpu * 1e3 / len(latencies), 2),
        "sender_ms": round((_children_s() - children_before) * 1e3 / (lasted * RATE), 1),
        "latency_ms_p50": round(p50, 1),
        "latency_ms_p99": round(p99, 1),
    }


def _children_s() -> float:
    """CPU time of processes that have ended."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime
