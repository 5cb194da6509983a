"""Waiting for what comes in its own time."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TypeVar

T = TypeVar("T")


def until(done: Callable[[], T], seconds: float = 60.0) -> T:
    """What `done` says in the end. A guard against waiting for ever, no deadline: other processes may hold
    the machine."""
    deadline = time.monotonic() + seconds
    while not (found := done()):
        assert time.monotonic() < deadline, "waited in vain"
        time.sleep(0.01)
    return found
