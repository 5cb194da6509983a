"""The last seconds of what arrived, bounded in time and in bytes."""

from __future__ import annotations

from collections import deque

from sags_node.recording.backlog import Arrived


class Ring:
    """Keeps messages of the last `seconds`, and of latched topics the last one however old it is."""

    def __init__(self, seconds: float, most_bytes: int) -> None:
        self._span_ns = round(seconds * 1e9)
        self._most_bytes = most_bytes
        self._kept: deque[Arrived] = deque()
        self._bytes = 0
        self._latched: dict[str, Arrived] = {}

    def add(self, arrived: Arrived, latched: bool) -> list[Arrived]:
        """Keep a message; returns those that had to go for want of room, although they are young enough."""
        self._kept.append(arrived)
        self._bytes += arrived.size
        while self._kept[0].received_ns < arrived.received_ns - self._span_ns:
            self._pop()
        pushed_out = []
        while self._bytes > self._most_bytes:
            pushed_out.append(self._pop())
        if latched:
            self._latched[arrived.message.topic] = arrived
        return pushed_out

    def content(self) -> list[Arrived]:
        """All that is kept, oldest first."""
        since = self._kept[0].received_ns if self._kept else 2**63 - 1
        older = [arrived for arrived in self._latched.values() if arrived.received_ns < since]
        return sorted(older, key=lambda arrived: arrived.received_ns) + list(self._kept)

    def _pop(self) -> Arrived:
        arrived = self._kept.popleft()
        self._bytes -= arrived.size
        return arrived
