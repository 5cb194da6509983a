"""A one-place slot between two threads: the newest value wins, so lag cannot build up."""

import threading
from collections.abc import Callable
from typing import Generic, TypeVar

T = TypeVar("T")


class Latest(Generic[T]):
    """Hand the newest value from one thread to another.

    `put` replaces a value that was not taken yet and counts it as dropped. `get` waits for a value
    newer than the last one taken. `close` wakes every waiter; `get` then returns None for good.
    """

    def __init__(self, on_put: Callable[[], None] | None = None) -> None:
        self._condition = threading.Condition()
        self._value: T | None = None
        self._closed = False
        self._on_put = on_put
        self.dropped = 0

    def put(self, value: T) -> None:
        with self._condition:
            if self._value is not None:
                self.dropped += 1
            self._value = value
            self._condition.notify_all()
        if self._on_put is not None:
            self._on_put()

    def hand_over(self, value: T) -> None:
        """Wait until the slot is free, then put: nothing is dropped. For recordings not played live."""
        with self._condition:
            self._condition.wait_for(lambda: self._value is None or self._closed)
            if self._closed:
                return
            self._value = value
            self._condition.notify_all()
        if self._on_put is not None:
            self._on_put()

    def get(self, timeout: float | None = None) -> T | None:
        """The newest untaken value; None after `timeout` seconds or when the slot is closed and empty."""
        with self._condition:
            self._condition.wait_for(lambda: self._value is not None or self._closed, timeout)
            value, self._value = self._value, None
            self._condition.notify_all()
            return value

    def close(self) -> None:
        with self._condition:
            self._closed = True
            self._condition.notify_all()
        if self._on_put is not None:
            self._on_put()

    @property
    def closed(self) -> bool:
        """Tell whether it is closed and empty: nothing will come any more."""
        with self._condition:
            return self._closed and self._value is None
