"""Waiting for what comes in its own time."""

from __future__ import annotations

import itertools
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TypeVar

T = TypeVar("T")


def until(done: Callable[[], T], seconds: float = 60.0) -> T:
    """What `done` says in the end. A guard against waiting for ever, no deadline: other processes may hold
    the machine."""
    deadline, pause = time.monotonic() + seconds, 0.0005
    while not (found := done()):
        assert time.monotonic() < deadline, "waited in vain"
        time.sleep(pause)
        pause = min(2 * pause, 0.01)
    return found


@contextmanager
def repeating(step: Callable[[int], object]) -> Iterator[None]:
    """Calls `step` with 0, 1, 2 and so on, from a thread of its own."""
    stop = threading.Event()
    calls = itertools.takewhile(lambda _: not stop.is_set(), itertools.count())
    thread = threading.Thread(target=lambda: [step(number) for number in calls])
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()
