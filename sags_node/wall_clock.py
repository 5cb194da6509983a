"""The wall clock at a time of a clock that nobody sets: stamps are even, and right again after it was set."""

import threading
import time
from collections.abc import Callable

DRIFT_NS = 1_000_000
QUICK_NS = DRIFT_NS // 10  # a measurement in which no other process came between
TRIES = 10  # for one


class WallClock:
    """When another clock was zero, the same for all who ask: equal times stay equal. Any threads may ask."""

    def __init__(self) -> None:
        self._held_ns = 0
        self._lock = threading.Lock()

    def at_zero(self, measured_ns: int, took_ns: int) -> int:
        """Return what is held, until a measurement is a millisecond off: one of the clocks was set, stood
        still while the machine slept, or drifts.

        Args:
            took_ns: to measure; where that is long, another process came between.
        """
        with self._lock:
            if not self._held_ns or (took_ns < QUICK_NS and abs(measured_ns - self._held_ns) > DRIFT_NS):
                self._held_ns = measured_ns
            return self._held_ns

    def at(
        self,
        seconds: float,
        clock: Callable[[], float] = time.monotonic,
        wall_ns: Callable[[], int] = time.time_ns,
    ) -> int:
        """The wall clock, ns, at a time of `clock`, s, as both stand to each other now."""
        for _ in range(TRIES):
            before, wall, after = clock(), wall_ns(), clock()
            took_ns = round((after - before) * 1e9)
            if took_ns < QUICK_NS:
                break
        zero_ns = self.at_zero(wall - round((before + after) * 0.5e9), took_ns)
        return zero_ns + round(seconds * 1e9)
