"""The clock that stamped the pictures, against this machine's wall clock.

Nobody can tell how long a picture was on its way. But no picture arrives before it was taken: the smallest
difference between arrival and stamp is the difference of the clocks, and the shortest way. How that smallest
difference grows is how far the clocks drift apart.
"""

from __future__ import annotations

import threading
from collections import deque

import numpy as np

from sags_node.types import ClockStatus

BIN_NS = 1_000_000_000  # the smallest difference of each second is kept
KEPT = 120  # s
SURE = 20  # s: for less the jitter of the way says more than the drift (1 ms in 20 s: 50 ppm)
SET_NS = 100_000_000  # a difference that much larger for a whole second: the clock was set, not a slow way


class CaptureClock:
    """Follows the clock of one sender by stamps and arrivals. Any threads may use it."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._bins: deque[tuple[int, int]] = deque(maxlen=KEPT)  # stamp and difference, ns
        self._begun = 0  # stamp at which the newest bin begins
        self._last = 0
        self._drift = 0.0  # of the line under all differences
        self._lowest = 0.0  # its height at the first bin, ns

    def add(self, stamp_ns: int, arrival_ns: int) -> None:
        """A picture of the sender's time `stamp_ns` arrived at `arrival_ns`, wall clock."""
        difference = arrival_ns - stamp_ns
        with self._lock:
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
                self._fit()
            elif difference < self._bins[-1][1]:
                self._bins[-1] = stamp_ns, difference
                self._lowest = min(self._lowest, difference - self._drift * (stamp_ns - self._bins[0][0]))

    def to_wall(self, stamp_ns: int) -> int:
        """A time of the sender's clock on the wall clock, ns, late by the shortest way; after an `add`."""
        with self._lock:
            return stamp_ns + self._offset_at(stamp_ns)

    def status(self) -> ClockStatus | None:
        """What is known of the clock; None before the first picture."""
        with self._lock:
            if not self._bins:
                return None
            seconds = (self._bins[-1][0] - self._bins[0][0]) / BIN_NS
            drift = self._drift * 1e6 if seconds >= SURE else None
            return ClockStatus(self._offset_at(self._last) * 1e-6, drift, seconds)

    def _fit(self) -> None:
        """The line under all differences. Its slope: the median of those between far bins (Theil, Sen)."""
        at, differences = (np.array(column, np.float64) for column in zip(*self._bins, strict=True))
        at -= at[0]
        self._drift = 0.0
        if at[-1] >= SURE * BIN_NS:
            i, j = np.triu_indices(len(at), max(1, len(at) // 4))  # few bins: pictures did not come for long
            self._drift = float(np.median((differences[j] - differences[i]) / (at[j] - at[i])))
        self._lowest = float(np.min(differences - self._drift * at))

    def _offset_at(self, stamp_ns: int) -> int:
        return round(self._lowest + self._drift * (stamp_ns - self._bins[0][0]))
