"""What a recorder holds in memory: bounded in bytes, so that a slow disk costs messages and never memory."""

from __future__ import annotations

import threading
from collections import deque
from dataclasses import dataclass

from sags_node.messaging.wire import Message


@dataclass(frozen=True, slots=True)
class Arrived:
    """One message and when it came."""

    message: Message
    received_ns: int

    @property
    def size(self) -> int:
        """Bytes of its parts."""
        return sum(memoryview(part).nbytes for part in self.message.parts)


class Backlog:
    """A queue between the thread that receives and the one that writes.

    Args:
        most_bytes: a message that would lead beyond is refused.
    """

    def __init__(self, most_bytes: int) -> None:
        self._most_bytes = most_bytes
        self._changed = threading.Condition()
        self._waiting: deque[Arrived] = deque()
        self._bytes = 0
        self._closed = False

    def put(self, arrived: Arrived) -> bool:
        """Queue a message; False when there is no room."""
        with self._changed:
            if self._bytes + arrived.size > self._most_bytes:
                return False
            self._waiting.append(arrived)
            self._bytes += arrived.size
            self._changed.notify()
            return True

    def take(self, timeout: float) -> Arrived | None:
        """The oldest message; None after `timeout` seconds, or when closed and empty."""
        with self._changed:
            self._changed.wait_for(lambda: self._waiting or self._closed, timeout)
            if not self._waiting:
                return None
            arrived = self._waiting.popleft()
            self._bytes -= arrived.size
            return arrived

    def close(self) -> None:
        with self._changed:
            self._closed = True
            self._changed.notify()

    @property
    def finished(self) -> bool:
        """Closed, and all has been taken."""
        with self._changed:
            return self._closed and not self._waiting


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

    @property
    def seconds(self) -> float:
        """From the oldest message that is kept to the newest; latched ones may be older."""
        return (self._kept[-1].received_ns - self._kept[0].received_ns) * 1e-9 if self._kept else 0.0

    def content(self) -> list[Arrived]:
        """All that is kept, oldest first."""
        since = self._kept[0].received_ns if self._kept else 2**63 - 1
        older = [arrived for arrived in self._latched.values() if arrived.received_ns < since]
        return sorted(older, key=lambda arrived: arrived.received_ns) + list(self._kept)

    def _pop(self) -> Arrived:
        arrived = self._kept.popleft()
        self._bytes -= arrived.size
        return arrived
