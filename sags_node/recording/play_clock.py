"""Which moment of a recording is due while it is played: at another rate, and with pauses."""

from __future__ import annotations

import time


class PlayClock:
    """Runs from `first_ns` of the recording on, `rate` times as fast as the wall clock.

    `at` is a time of `time.monotonic`, s.
    """

    def __init__(self, first_ns: int, rate: float) -> None:
        self._first_ns = first_ns
        self._rate = rate
        self._started, self._started_ns = time.monotonic(), time.time_ns()

    def pause(self, seconds: float) -> None:
        """The last `seconds` did not count."""
        self._started += seconds
        self._started_ns += round(seconds * 1e9)

    def until(self, recorded_ns: int, at: float) -> float:
        """Seconds from `at` until a moment of the recording is due; negative when it was."""
        return self._started + (recorded_ns - self._first_ns) * 1e-9 / self._rate - at

    def wall_ns(self, recorded_ns: int) -> int:
        """When, on the wall clock, a moment of the recording is due."""
        return self._started_ns + round((recorded_ns - self._first_ns) / self._rate)

    def moment_ns(self, at: float) -> int:
        """The moment of the recording that is due at `at`."""
        return self._first_ns + round((at - self._started) * self._rate * 1e9)
