"""Waiting for what comes in its own time."""

import itertools
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TypeVar

from sags_node.errors import SagsError

T = TypeVar("T")

LONGEST_LISTENING = 60.0  # s
START_SECONDS = 240  # a guard for a node's start: the first on a busy machine compiles kernels


def until(done: Callable[[], T], seconds: float = 60.0) -> T:
    """What `done` says in the end. A guard against waiting for ever, no deadline: other processes may hold
    the machine."""
    deadline = time.monotonic() + seconds
    while not (found := done()):
        assert time.monotonic() < deadline, "waited in vain"
        time.sleep(0.01)
    return found


def heard(listen: Callable[[float], T], seconds: float = 1.0) -> T:
    """What `listen` finds in so many seconds; on a machine that stood still meanwhile, in more of them."""
    while True:
        try:
            if found := listen(seconds):
                return found
        except SagsError:  # it heard too little
            if seconds > LONGEST_LISTENING:
                raise
        assert seconds < LONGEST_LISTENING, "listened in vain"
        seconds *= 2


@contextmanager
def beside(work: Callable[[], object], end: Callable[[], object] = lambda: None) -> Iterator[list[Exception]]:
    """Does this in a thread that has ended when it is left. Gives what it failed with, and raises it then."""
    failed: list[Exception] = []

    def do() -> None:
        try:
            work()
        except Exception as error:  # told to the test below
            failed.append(error)

    thread = threading.Thread(target=do)
    thread.start()
    try:
        yield failed
    finally:
        end()
        thread.join(60)
        assert not thread.is_alive()
        if failed:
            raise failed[0]


@contextmanager
def repeating(step: Callable[[int], object]) -> Iterator[None]:
    """Calls `step` with 0, 1, 2 and so on, from a thread of its own."""
    stop = threading.Event()
    calls = itertools.takewhile(lambda _: not stop.is_set(), itertools.count())
    with beside(lambda: [step(number) for number in calls], stop.set):
        yield
