"""Estimates from stamps how far a live source's clock is from this machine's, and at which rate frames come.

The transit time of a single image is unknown. But no image arrives before it was taken: so the smallest
difference between arrival and stamp is the offset of the clocks plus the shortest transit time. The growth of
that smallest difference is the drift.
"""

import threading
from collections import deque
from statistics import median

import numpy as np

from sags_node.types import ClockStatus, StereoFrame

BIN_NS = 1_000_000_000  # ns; of each such bin the smallest difference is kept
KEPT = 120  # bins
SURE = 20  # s: in less time, jitter outweighs the drift (1 ms in 20 s is 50 ppm)
SET_NS = 100_000_000  # ns: a difference larger by this is a delayed image,
SET_S = 10  # unless it lasts for so many seconds: then the clock was set
MEASURED = 30  # periods from which the rate is measured
OTHER = 0.1  # relative change of the rate from which on it counts
STARTED_NS = 1_000_000_000  # ns: a stamp that goes back by more means a restarted clock; by less, wrong order


class CaptureClock:
    """Tracks the clock of one sender by stamps and arrivals. Thread-safe."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._bins: deque[tuple[int, int]] = deque(maxlen=KEPT)  # stamp and difference, ns
        self._slow: list[tuple[int, int]] = []  # bins that came late; if that lasts, the clock was set
        self._begun = 0  # stamp at which the newest bin begins
        self._last = 0
        self._drift = 0.0  # slope of the line below all differences
        self._lowest = 0.0  # that line at the first bin, ns

    def add(self, stamp_ns: int, arrival_ns: int) -> None:
        """Take in an image with the sender's stamp `stamp_ns` that arrived at `arrival_ns`, wall clock."""
        difference = arrival_ns - stamp_ns
        with self._lock:
            set_on = bool(self._bins) and difference < self._offset_at(stamp_ns) - SET_NS
            if set_on or stamp_ns < self._last - STARTED_NS:
                self._bins.clear()  # the clock was set, or the sender restarted: begin anew
                self._slow.clear()
            elif self._bins and stamp_ns < self._last:
                return  # an image in the wrong order adds nothing
            self._last = stamp_ns
            if not self._bins or stamp_ns - self._begun >= BIN_NS:
                self._sort_out(stamp_ns)
                is_slow = bool(self._bins) and difference - self._offset_at(stamp_ns) > SET_NS
                self._bins.append((stamp_ns, difference))
                self._begun = stamp_ns
                if not is_slow:
                    self._fit()
            elif difference < self._bins[-1][1]:
                self._bins[-1] = stamp_ns, difference
                self._lowest = min(self._lowest, difference - self._drift * (stamp_ns - self._bins[0][0]))

    def to_wall(self, stamp_ns: int) -> int | None:
        """Convert a time of the sender's clock to the wall clock, ns; late by the shortest transit time. None
        before the first image."""
        with self._lock:
            return stamp_ns + self._offset_at(stamp_ns) if self._bins else None

    def status(self) -> ClockStatus | None:
        """Return the offset and drift of the clock; None before the first image."""
        with self._lock:
            if not self._bins:
                return None
            seconds = (self._bins[-1][0] - self._bins[0][0]) / BIN_NS
            drift = self._drift * 1e6 if seconds >= SURE else None
            return ClockStatus(self._offset_at(self._last) * 1e-6, drift, seconds)

    def _sort_out(self, stamp_ns: int) -> None:
        """Leave the finished bin out if it is late: otherwise late images would seem new."""
        if len(self._bins) < 2 or self._bins[-1][1] - self._offset_at(stamp_ns) <= SET_NS:
            self._slow.clear()
            return
        self._slow.append(self._bins.pop())
        if len(self._slow) == SET_S:
            self._bins.clear()
            self._bins.extend(self._slow)
            self._slow.clear()
            self._fit()

    def _fit(self) -> None:
        """Fit the line below all differences. Its slope is the median over distant bins (Theil-Sen)."""
        at, differences = (np.array(column, np.float64) for column in zip(*self._bins, strict=True))
        at -= at[0]
        self._drift = 0.0
        if at[-1] >= SURE * BIN_NS:
            i, j = np.triu_indices(len(at), max(1, len(at) // 4))  # there may be few bins: images paused
            self._drift = float(np.median((differences[j] - differences[i]) / (at[j] - at[i])))
        self._lowest = float(np.min(differences - self._drift * at))

    def _offset_at(self, stamp_ns: int) -> int:
        return round(self._lowest + self._drift * (stamp_ns - self._bins[0][0]))


class FrameRate:
    """The rate of a live source, measured by stamps and numbers of its frames. What a camera, a capture card
    or a program tells is often wrong, and in the dark a camera exposes longer.

    Attributes:
        hz: frames per second.
    """

    def __init__(self, nominal_hz: float) -> None:
        self.hz = nominal_hz
        self._periods: deque[float] = deque(maxlen=MEASURED)  # s
        self._last: StereoFrame | None = None

    def add(self, frame: StereoFrame) -> bool:
        """Take a frame in; return whether `hz` has changed."""
        last, self._last = self._last, frame
        if last is None or frame.epoch != last.epoch or frame.frame_id <= last.frame_id:
            return False
        seconds = (frame.t_capture_ns - last.t_capture_ns) * 1e-9
        self._periods.append(seconds / (frame.frame_id - last.frame_id))
        measured = 1 / max(median(self._periods), 1e-3)
        if len(self._periods) < MEASURED or abs(measured / self.hz - 1) < OTHER:
            return False
        self.hz = measured
        return True
