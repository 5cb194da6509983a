"""What waits to be written: bounded in bytes, so that a slow disk costs messages and never memory."""

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
