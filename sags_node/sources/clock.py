"""What stamps tell of a live source: how far its clock is from this machine's, and how often frames come.

Nobody can tell how long a picture was on its way. But no picture arrives before it was taken: the smallest
difference between arrival and stamp is the difference of the clocks, and the shortest way. How that smallest
difference grows is how far the clocks drift apart.
"""

import threading
from collections import deque
from statistics import median

import numpy as np

from sags_node.types import ClockStatus, StereoFrame

BIN_NS = 1_000_000_000  # the smallest difference of each second is kept
KEPT = 120  # s
SURE = 20  # s: for less the jitter of the way says more than the drift (1 ms in 20 s: 50 ppm)
SET_NS = 100_000_000  # a difference that much larger is a slow way
SET_S = 10  # unless it is in each of so many seconds: then the clock was set
MEASURED = 30  # periods behind a rate
OTHER = 0.1  # share by which a rate must be another one to count
STARTED_NS = 1_000_000_000  # a stamp so far back: the clock began anew; less: a picture was overtaken


class CaptureClock:
    """Follows the clock of one sender by stamps and arrivals. Any threads may use it."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._bins: deque[tuple[int, int]] = deque(maxlen=KEPT)  # stamp and difference, ns
        self._slow: list[tuple[int, int]] = []  # the last seconds, while the way is slow or the clock was set
        self._begun = 0  # stamp at which the newest bin begins
        self._last = 0
        self._drift = 0.0  # of the line under all differences
        self._lowest = 0.0  # its height at the first bin, ns

    def add(self, stamp_ns: int, arrival_ns: int) -> None:
        """A picture of the sender's time `stamp_ns` arrived at `arrival_ns`, wall clock."""
        difference = arrival_ns - stamp_ns
        with self._lock:
            set_on = bool(self._bins) and difference < self._offset_at(stamp_ns) - SET_NS
            if set_on or stamp_ns < self._last - STARTED_NS:
                self._bins.clear()  # it was set, or the sender was started anew: no slope leads over that
                self._slow.clear()
            elif self._bins and stamp_ns < self._last:
                return  # a picture that was overtaken tells nothing that those before it did not
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
        """A time of the sender's clock on the wall clock, ns, late by the shortest way; None before the first
        picture."""
        with self._lock:
            return stamp_ns + self._offset_at(stamp_ns) if self._bins else None

    def status(self) -> ClockStatus | None:
        """Return what is known of the clock; None before the first picture."""
        with self._lock:
            if not self._bins:
                return None
            seconds = (self._bins[-1][0] - self._bins[0][0]) / BIN_NS
            drift = self._drift * 1e6 if seconds >= SURE else None
            return ClockStatus(self._offset_at(self._last) * 1e-6, drift, seconds)

    def _sort_out(self, stamp_ns: int) -> None:
        """A second is over: one of a slow way must not count, lest what is late seem new."""
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


class FrameRate:
    """The rate of a live source, by the stamps and numbers of the frames that are taken: what a camera, a
    capture card or a program says of it is often wrong, and a camera takes longer pictures in the dark.

    Attributes:
        hz: frames a second.
    """

    def __init__(self, nominal_hz: float) -> None:
        self.hz = nominal_hz
        self._periods: deque[float] = deque(maxlen=MEASURED)  # s
        self._last: StereoFrame | None = None

    def add(self, frame: StereoFrame) -> bool:
        """A frame was taken; True: `hz` has changed."""
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
