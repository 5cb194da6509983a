"""What the node says of itself: rates, latencies and costs of its last frames."""

from __future__ import annotations

import os
import threading
import time
from collections import deque
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from sags_node.types import FrameResult, NodeHealth, RungState, ViewStatus

WAITING_AFTER = 1.0  # s without a frame
WINDOW = 150  # frames behind the published rates and latencies


class Statistics:
    """What the last frames tell of rate, latency and cost."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._published: deque[float] = deque(maxlen=WINDOW)
        self._latency: deque[float] = deque(maxlen=WINDOW)
        self._stages: dict[str, deque[float]] = {}
        self._skipped: dict[str, int] = {}
        self._gaussians = 0
        self._rung: RungState | None = None
        self._started = False

    def add(self, result: FrameResult, latency_ms: float) -> None:
        with self._lock:
            self._started = True
            self._published.append(time.monotonic())
            self._latency.append(latency_ms)
            for stage, ms in result.timings_ms.items():
                self._stages.setdefault(stage, deque(maxlen=WINDOW)).append(ms)
            for what in result.skipped:
                self._skipped[what] = self._skipped.get(what, 0) + 1
            self._gaussians = len(result.snapshot.gaussians)
            self._rung = result.rung

    def forget_rate(self) -> None:
        """After a pause the time without frames says nothing."""
        with self._lock:
            self._published.clear()

    def health(
        self,
        dropped: dict[str, int],
        stopping: bool,
        paused: bool,
        error: BaseException | None,
        warnings: dict[str, str],
        connections: dict[str, dict[str, int]],
        views: Mapping[str, ViewStatus],
    ) -> NodeHealth:
        with self._lock:
            now = time.monotonic()
            waiting = not self._published or now - self._published[-1] > WAITING_AFTER
            span = self._published[-1] - self._published[0] if len(self._published) > 1 else 0.0
            if stopping:
                state = "stopping"
            elif error is not None:
                state = "degraded"
            elif paused:
                state = "paused"
            elif waiting:
                state = "waiting" if self._started else "starting"
            else:
                state = "running"
            latency = np.array(self._latency) if self._latency else np.zeros(1)
            return NodeHealth(
                state=state,
                rate_hz=(len(self._published) - 1) / span if span > 0 and not (waiting or paused) else 0.0,
                latency_ms={
                    "p50": float(np.percentile(latency, 50)),
                    "p90": float(np.percentile(latency, 90)),
                    "p99": float(np.percentile(latency, 99)),
                    "max": float(latency.max()),
                },
                stage_ms={stage: float(np.median(ms)) for stage, ms in self._stages.items()},
                dropped=dropped,
                gaussians=self._gaussians,
                rss_mb=resident_mb(),
                skipped=dict(self._skipped),
                last_error=str(error) if error else None,
                warnings=warnings,
                connections=connections,
                views=views,
                rung=self._rung,
            )


def resident_mb() -> float:
    """Resident memory of this process, MB."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6
