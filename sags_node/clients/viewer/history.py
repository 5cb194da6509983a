"""Figures over the last minutes, for the plots."""

import time
from collections import deque
from collections.abc import Callable

import numpy as np

from sags_node.clients.viewer.feed import Moment
from sags_node.types import F64

PERIOD = 1.0  # s between two points
GAP = 10.0  # s without a point, after which the older ones are dropped
LENGTH = 120  # points
FIGURES = ("rate", "p50", "p99", "rung")


class History:
    """One point per second. A gap clears all, so that no line is drawn through time that nobody saw."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._points: deque[tuple[float, ...]] = deque(maxlen=LENGTH)  # time, then FIGURES

    def add(self, moment: Moment) -> bool:
        """Take the figures of a moment; False when nothing has changed."""
        now = self._clock()
        since = now - self._points[-1][0] if self._points else 0.0
        if since > GAP:
            self._points.clear()
            return True
        if moment.problem is not None or (self._points and since < PERIOD):
            return False
        status = moment.status
        p50, p99 = (status.latency_ms.get(name) or np.nan for name in ("p50", "p99"))
        rung = np.nan if status.rung is None else float(status.rung.number)
        self._points.append((now, status.rate_hz, p50, p99, rung))
        return True

    def series(self, *figures: str) -> tuple[F64, ...]:
        """Return seconds relative to the newest point (negative), then each figure; all of one length."""
        points = np.array(self._points, np.float64).reshape(-1, 1 + len(FIGURES))
        times = points[:, 0] - (points[-1, 0] if len(points) else 0.0)
        return (times, *(points[:, 1 + FIGURES.index(figure)] for figure in figures))
