"""Joins the pictures of two cameras that are not synchronised by hardware."""

from __future__ import annotations

import logging
from collections import deque

from sags_node.sources.device import Picture

log = logging.getLogger(__name__)

QUEUE_LENGTH = 4  # pictures of one eye that wait for their partner
REPORT_EVERY = 100  # unpaired pictures between two warnings


class Pairing:
    """Joins two streams of pictures by their stamps. Not safe for threads by itself."""

    def __init__(self, tolerance_ns: int) -> None:
        self._tolerance_ns = tolerance_ns
        self._left: deque[tuple[int, Picture]] = deque()  # with the count of left pictures before it
        self._right: deque[tuple[int, Picture]] = deque()
        self._counts = [0, 0]
        self._skew_ns = 0
        self.unpaired = 0

    def add_left(self, picture: Picture) -> None:
        self._add(0, self._left, picture)

    def add_right(self, picture: Picture) -> None:
        self._add(1, self._right, picture)

    def _add(self, eye: int, queue: deque[tuple[int, Picture]], picture: Picture) -> None:
        if len(queue) == QUEUE_LENGTH:
            self._drop(queue)
        queue.append((self._counts[eye], picture))
        self._counts[eye] += 1

    def take(self) -> tuple[int, Picture, Picture] | None:
        """The oldest pair: count of left pictures before it, left, right. None until there is one.

        The older of two pictures is dropped when they are too far apart, or when its successor is nearer.
        """
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
