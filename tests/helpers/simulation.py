"""Threads on a virtual clock: all in one thread, one at a time, in an order that a seed decides.

What waits gives way to another one; time passes only while all wait. So a run takes as long as its work,
repeats exactly, and a wait that nothing can end is found at once.
"""

import math
import random
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Self

from greenlet import getcurrent, greenlet

START_NS = 1_700_000_000_000_000_000  # wall clock at the beginning
MOST_SWITCHES = 200_000  # of one run


class StuckError(AssertionError):
    """All wait for each other, or the run does not come to an end."""


@dataclass
class _Task:
    name: str
    runs: greenlet
    ready: Callable[[], bool] = field(default=lambda: True)
    deadline: float = math.inf


class World:
    """The clock and the threads of one seed.

    Attributes:
        now: s since the beginning.
        wall_ahead: s by which the wall clock was set since then.
    """

    def __init__(self, seed: int) -> None:
        self.random = random.Random(seed)
        self.now = 0.0
        self.wall_ahead = 0.0
        self._tasks: list[_Task] = []
        self._hub = getcurrent()
        self._switches = 0

    # ---- for what is simulated -------------------------------------------------------------------------

    def spawn(self, work: Callable[[], object], name: str) -> _Task:
        task = _Task(name, greenlet(work, self._hub))
        self._tasks.append(task)
        return task

    def wait(self, ready: Callable[[], bool], timeout: float | None = None) -> bool:
        """Others go on until this is true, or the time is over."""
        task = next((one for one in self._tasks if one.runs is getcurrent()), None)
        if task is None:  # before it begins, or after its end
            return ready()
        task.ready = ready
        task.deadline = math.inf if timeout is None else self.now + max(0.0, timeout)
        self._hub.switch()
        return ready()

    def sleep(self, seconds: float) -> None:
        self.wait(lambda: False, seconds)

    def run(self, until: Callable[[], bool]) -> None:
        """Let them all go on until this is true.

        Raises:
            StuckError: it can never become true.
        """
        while not until():
            self._switches += 1
            able = [task for task in self._tasks if task.deadline <= self.now or task.ready()]
            if able:
                chosen = self.random.choice(able)
                chosen.runs.switch()
                if chosen.runs.dead:
                    self._tasks.remove(chosen)
                continue
            next_due = min((task.deadline for task in self._tasks), default=math.inf)
            if next_due == math.inf or self._switches > MOST_SWITCHES:
                raise StuckError(f"at {self.now:.3f} s: {[task.name for task in self._tasks]} wait for ever")
            self.now = next_due

    # ---- in the place of modules -----------------------------------------------------------------------

    def monotonic(self) -> float:
        return self.now

    perf_counter = thread_time = monotonic

    def time_ns(self) -> int:
        return START_NS + round((self.now + self.wall_ahead) * 1e9)

    @property
    def threading(self) -> Any:
        """`Thread`, `Event` and `Condition` on this clock; a lock is never held while another one runs."""
        world = self

        class Thread:
            def __init__(
                self, target: Callable[..., object], args: tuple[Any, ...] = (), name: str = "", **_: Any
            ) -> None:
                self._work, self._name, self.ident = lambda: target(*args), name, None

            def start(self) -> None:
                self._task = world.spawn(self._work, self._name)
                self.ident = id(self._task)

            def join(self, timeout: float | None = None) -> None:
                world.wait(lambda: bool(self._task.runs.dead), timeout)

        class Event:
            def __init__(self) -> None:
                self._set = False

            def set(self) -> None:
                self._set = True

            def clear(self) -> None:
                self._set = False

            def is_set(self) -> bool:
                return self._set

            def wait(self, timeout: float | None = None) -> bool:
                return world.wait(self.is_set, timeout)

        class Condition:
            def __init__(self) -> None:
                self._told = 0

            def __enter__(self) -> Self:
                if world.random.random() < 0.2:  # another thread may come first
                    world.wait(lambda: True)
                return self

            def __exit__(self, *_: object) -> None: ...

            def notify_all(self) -> None:
                self._told += 1

            def wait(self, timeout: float | None = None) -> bool:
                before = self._told
                return world.wait(lambda: self._told > before, timeout)

            def wait_for(self, ready: Callable[[], bool], timeout: float | None = None) -> bool:
                return world.wait(ready, timeout)

        class Module:
            TIMEOUT_MAX = 1e9

        Module.Thread, Module.Event, Module.Condition = Thread, Event, Condition  # type: ignore[attr-defined]
        return Module


class EventFd:
    """`os.eventfd`, for one descriptor."""

    EFD_NONBLOCK = 0

    def __init__(self) -> None:
        self.count = 0

    def eventfd(self, first: int, flags: int = 0) -> int:
        return 1

    def eventfd_write(self, descriptor: int, value: int) -> None:
        self.count += value

    def eventfd_read(self, descriptor: int) -> int:
        count, self.count = self.count, 0
        assert count > 0, "read of an eventfd that nobody wrote to"
        return count
