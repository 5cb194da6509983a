"""What a recorder holds in memory: bounded in bytes, so that a slow disk costs messages and never memory."""

import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from math import inf
from operator import itemgetter

from sags_node.messaging.wire import Message


@dataclass(frozen=True, slots=True)
class Arrived:
    """One message and when it came."""

    message: Message
    received_ns: int

    @property
    def size(self) -> int:
        """The bytes of its parts."""
        return sum(memoryview(part).nbytes for part in self.message.parts)


class Backlog:
    """A queue between the thread that receives and the one that writes.

    Args:
        most_bytes: a message that would exceed it is refused.
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
        """Tell whether it is closed and all has been taken."""
        with self._changed:
            return self._closed and not self._waiting


class Ring:
    """Keeps messages of the last `seconds`, and of latched topics the last one however old it is.

    Args:
        clock: s, monotonic: when a wall clock is set, all that is kept could get old at once.
    """

    def __init__(self, seconds: float, most_bytes: int, clock: Callable[[], float] = time.monotonic) -> None:
        self._span = seconds
        self._most_bytes = most_bytes
        self._clock = clock
        self._kept: deque[tuple[float, Arrived]] = deque()  # s when it came, and the message
        self._bytes = 0
        self._latched: dict[str, tuple[float, Arrived]] = {}

    def add(self, arrived: Arrived, latched: bool) -> list[Arrived]:
        """Keep a message; return those that were dropped for lack of room although they are young enough."""
        came = self._clock()
        self._kept.append((came, arrived))
        self._bytes += arrived.size
        while self._kept[0][0] < came - self._span:
            self._pop()
        pushed_out = []
        while self._bytes > self._most_bytes:
            pushed_out.append(self._pop())
        if latched:
            self._latched[arrived.message.topic] = came, arrived
        return pushed_out

    @property
    def seconds(self) -> float:
        """The seconds from the oldest message that is kept to the newest; latched ones may be older."""
        return self._kept[-1][0] - self._kept[0][0] if self._kept else 0.0

    def content(self) -> list[Arrived]:
        """All that is kept, oldest first."""
        since = self._kept[0][0] if self._kept else inf
        older = [latched for latched in self._latched.values() if latched[0] < since]
        return [arrived for _, arrived in (*sorted(older, key=itemgetter(0)), *self._kept)]

    def _pop(self) -> Arrived:
        _, arrived = self._kept.popleft()
        self._bytes -= arrived.size
        return arrived
