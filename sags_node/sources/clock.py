"""The clock that stamped the pictures, against this machine's wall clock.

Nobody can tell how long a picture was on its way. But no picture arrives before it was taken: the smallest
difference between arrival and stamp is the difference of the clocks, and the shortest way. How that smallest
difference grows is how far the clocks drift apart.
"""

from __future__ import annotations

from collections import deque

import numpy as np

from sags_node.types import ClockStatus

BIN_NS = 1_000_000_000  # the smallest difference of each second is kept
KEPT = 120  # s
SURE = 20  # s: for less the jitter of the way says more than the drift (1 ms in 20 s: 50 ppm)
SET_NS = 100_000_000  # a difference that much larger for a whole second: the clock was set, not a slow way


class CaptureClock:
    """Follows the clock of one sender by stamps and arrivals. Not safe for threads by itself."""

    def __init__(self) -> None:
        self._bins: deque[tuple[int, int]] = deque(maxlen=KEPT)  # stamp and difference, ns
        self._begun = 0  # stamp at which the newest bin begins
        self._last = 0

    def add(self, stamp_ns: int, arrival_ns: int) -> None:
        """A picture of the sender's time `stamp_ns` arrived at `arrival_ns`, wall clock."""
        difference = arrival_ns - stamp_ns
        if stamp_ns < self._last:
            self._bins.clear()  # it was set back, or the sender was started anew
        self._last = stamp_ns
        if not self._bins or stamp_ns - self._begun >= BIN_NS:
            if len(self._bins) > 1 and self._bins[-1][1] - self._offset_at(stamp_ns) > SET_NS:
                newest = self._bins[-1]
                self._bins.clear()
                self._bins.append(newest)
            self._bins.append((stamp_ns, difference))
            self._begun = stamp_ns
        elif difference < self._bins[-1][1]:
            self._bins[-1] = stamp_ns, difference

    def to_wall(self, stamp_ns: int) -> int:
        """A time of the sender's clock on the wall clock, ns: late by the shortest way."""
        return stamp_ns + self._offset_at(stamp_ns)

    def status(self) -> ClockStatus | None:
        """What is known of the clock; None before the first picture."""
        if not self._bins:
            return None
        seconds = (self._bins[-1][0] - self._bins[0][0]) / BIN_NS
        drift = self._drift() * 1e6 if seconds >= SURE else None
        return ClockStatus(self._offset_at(self._last) * 1e-6, drift, seconds)

    def _offset_at(self, stamp_ns: int) -> int:
        """The line under all differences, at a stamp."""
        drift, first = self._drift(), self._bins[0][0]
        lowest = min(difference - drift * (at - first) for at, difference in self._bins)
        return round(lowest + drift * (stamp_ns - first))

    def _drift(self) -> float:
        """Theil and Sen: the median slope between all pairs of bins; 0 for too short a time."""
        if self._bins[-1][0] - self._bins[0][0] < SURE * BIN_NS:
            return 0.0
        at, differences = (np.array(column, np.float64) for column in zip(*self._bins, strict=True))
        i, j = np.triu_indices(len(at), len(at) // 4)
        return float(np.median((differences[j] - differences[i]) / (at[j] - at[i])))
