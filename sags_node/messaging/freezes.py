"""Freezes of an image that is being shown, as WebRTC counts them: an interval of at least three times the
mean of those before, and at least 150 ms more than it (W3C, "Identifiers for WebRTC's Statistics API",
`freezeCount`)."""

from collections import deque
from collections.abc import Iterable

WINDOW = 30  # intervals in the mean
LONGER = 3.0  # times the mean
MORE = 0.15  # s more than the mean


class Freezes:
    """Counts the freezes of one stream.

    Attributes:
        count: since the start.
        seconds: how long all of them took.
    """

    def __init__(self) -> None:
        self.count = 0
        self.seconds = 0.0
        self._last: float | None = None
        self._intervals: deque[float] = deque(maxlen=WINDOW)

    def add(self, now: float) -> None:
        """Note that an image was shown at `now`, s of any monotonic clock."""
        before, self._last = self._last, now
        if before is None:
            return
        interval = now - before
        if self._intervals:
            mean = sum(self._intervals) / len(self._intervals)
            if interval >= max(LONGER * mean, mean + MORE):
                self.count += 1
                self.seconds += interval
        self._intervals.append(interval)

    def status(self) -> dict[str, float]:
        """The figures for a status message."""
        return {"count": self.count, "seconds": round(self.seconds, 3)}


def freezes_of(moments: Iterable[float]) -> Freezes:
    """The freezes of a stream whose images were shown at these moments, s."""
    counted = Freezes()
    for moment in moments:
        counted.add(moment)
    return counted
