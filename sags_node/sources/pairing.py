"""Joins the pictures of two cameras that are not synchronised by hardware."""

from __future__ import annotations

import logging
import time
from collections import deque
from collections.abc import Callable

from sags_node.sources.device import Picture, Shot

log = logging.getLogger(__name__)

QUEUE_LENGTH = 4  # pictures of one eye that wait for their partner
REPORT_EVERY = 100  # unpaired pictures between two warnings


class Pairing:
    """Joins two streams of pictures by their stamps. Not safe for threads by itself."""

    def __init__(self, tolerance_ns: int) -> None:
        self._tolerance_ns = tolerance_ns
        self._left: deque[tuple[int, Picture]] = deque()  # with the count of left pictures before it
        self._right: deque[tuple[int, Picture]] = deque()
        self._pairs: deque[tuple[int, Picture, Picture]] = deque()
        self._counts = [0, 0]
        self._skew_ns = 0
        self.unpaired = 0

    def add_left(self, picture: Picture) -> None:
        self._add(0, self._left, picture)

    def add_right(self, picture: Picture) -> None:
        self._add(1, self._right, picture)

    def add_pair(self, left: Picture, right: Picture) -> None:
        """Two pictures that belong together, whatever their stamps."""
        if len(self._pairs) == QUEUE_LENGTH:
            self._pairs.popleft()
            self.unpaired += 1
        self._pairs.append((self._counts[0], left, right))
        self._counts = [count + 1 for count in self._counts]

    def _add(self, eye: int, queue: deque[tuple[int, Picture]], picture: Picture) -> None:
        if len(queue) == QUEUE_LENGTH:
            self._drop(queue)
        queue.append((self._counts[eye], picture))
        self._counts[eye] += 1

    def take(self) -> tuple[int, Picture, Picture] | None:
        """The oldest pair: count of left pictures before it, left, right. None until there is one.

        The older of two pictures is dropped when they are too far apart, or when its successor is nearer.
        """
        if self._pairs:
            return self._pairs.popleft()
        while self._left and self._right:
            left, right = self._left[0][1], self._right[0][1]
            self._skew_ns = left.t_ns - right.t_ns
            older, newer = (self._left, right) if self._skew_ns < 0 else (self._right, left)
            distance = abs(self._skew_ns)
            nearer_follows = len(older) > 1 and abs(older[1][1].t_ns - newer.t_ns) < distance
            if distance <= self._tolerance_ns and not nearer_follows:
                self._right.popleft()
                return self._left.popleft()[0], left, right
            self._drop(older)
        return None

    def _drop(self, queue: deque[tuple[int, Picture]]) -> None:
        queue.popleft()
        self.unpaired += 1
        if self.unpaired % REPORT_EVERY == 0:
            log.warning(
                "%d pictures without a partner (left %d, right %d so far), last skew %.1f ms; "
                "is one camera away, or source.pair_tolerance_ms too small?",
                *(self.unpaired, *self._counts, self._skew_ns / 1e6),
            )


class Alternation:
    """Joins the pictures of one camera that shows the eyes in turn. Not safe for threads by itself.

    How much time has passed since the picture before tells which eye one shows, so a picture that is lost
    does not exchange the eyes. It passes on the device's clock, or else on one that nobody sets.

    Args:
        period_ns: from picture to picture.
        clock_ns: that nobody sets.
    """

    def __init__(self, period_ns: float, clock_ns: Callable[[], int] = time.monotonic_ns) -> None:
        self._clock_ns = clock_ns
        self._period_ns = period_ns
        self._before: Shot | None = None
        self._arrived_ns = 0  # when that came
        self._turn = -1  # of the picture before; even: the first eye's
        self.alone = 0

    def add(self, picture: Shot) -> tuple[Shot, Shot] | None:
        """The first and the second eye's pictures when this one completes a pair."""
        before, turn = self._before, self._turn
        self._turn, self._before = turn + self._steps(before, picture), picture
        is_second = self._turn % 2 == 1
        if is_second and before is not None and self._turn == turn + 1:
            return before, picture
        self.alone += is_second + (before is not None and turn % 2 == 0)
        return None

    def _steps(self, before: Shot | None, picture: Shot) -> int:
        last_ns, self._arrived_ns = self._arrived_ns, self._clock_ns()
        if before is None:
            return 1
        passed_ns = self._arrived_ns - last_ns
        if picture.device_ns and before.device_ns:
            passed_ns = picture.device_ns - before.device_ns
        return max(1, round(passed_ns / self._period_ns))
