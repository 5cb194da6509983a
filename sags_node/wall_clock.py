"""Wall-clock stamps from a monotonic clock: evenly spaced, and right again after the wall clock was set."""

import threading
import time
from collections.abc import Callable

DRIFT_NS = 1_000_000  # ns between two measurements that show that a clock was set or drifts
QUICK_NS = DRIFT_NS // 10  # ns, longest measurement that no other process interrupted
TRIES = 10  # at most, to get one of these


class WallClock:
    """The wall-clock time at which another clock was zero, one for all callers: equal times stay equal."""

    def __init__(self) -> None:
        self._held_ns = 0
        self._lock = threading.Lock()

    def at_zero(self, measured_ns: int, took_ns: int) -> int:
        """Return the stored value, ns. A measurement that is more than a millisecond off replaces it: one of
        the clocks was set, stood still while the machine slept, or drifts.

        Args:
            took_ns: duration of the measurement; a long one was interrupted, and replaces nothing.
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
        """The wall-clock time (ns) at which `clock` shows `seconds`, by the present offset between both."""
        for _ in range(TRIES):
            before, wall, after = clock(), wall_ns(), clock()
            took_ns = round((after - before) * 1e9)
            if took_ns < QUICK_NS:
                break
        zero_ns = self.at_zero(wall - round((before + after) * 0.5e9), took_ns)
        return zero_ns + round(seconds * 1e9)
