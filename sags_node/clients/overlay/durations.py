"""How long the newest frames took, in memory that never grows."""

from __future__ import annotations

import numpy as np

from sags_node.types import F32

REMEMBERED = 54_000  # half an hour at 30 Hz


class Durations:
    """The newest half hour of one duration, milliseconds."""

    def __init__(self) -> None:
        self._ms = np.full(REMEMBERED, np.nan, np.float32)  # written once, so that its pages are there
        self._count = 0

    def add(self, ms: float) -> None:
        """Remember it in the place of the oldest."""
        self._ms[self._count % REMEMBERED] = ms
        self._count += 1

    def last(self, count: int = REMEMBERED) -> F32:
        """The newest `count` [N <= count], the newest last."""
        known = min(count, self._count, REMEMBERED)
        return self._ms[np.arange(self._count - known, self._count) % REMEMBERED]

    def percentiles(self, count: int = REMEMBERED) -> dict[str, float | None]:
        """p50, p90 and p99 of the newest `count`; None before there is one."""
        values = self.last(count)
        known = len(values) > 0
        return {f"p{q}": round(float(np.percentile(values, q)), 2) if known else None for q in (50, 90, 99)}
