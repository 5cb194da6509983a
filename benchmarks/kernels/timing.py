"""Stop watches: medians of repeated calls, and the stages inside a call; of the CPU's work and of a GPU's."""

from __future__ import annotations

import inspect
import statistics
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from types import ModuleType
from typing import Any, Protocol

WARM_UP_CALLS = 3

Stages = Mapping[tuple[ModuleType | type, str], str]  # (module or class, name of a function in it) -> stage


class Clock(Protocol):
    def now(self) -> Any:
        """A moment."""

    def ms_between(self, start: Any, end: Any) -> float: ...


class WallClock:
    def now(self) -> float:
        return time.perf_counter()

    def ms_between(self, start: float, end: float) -> float:
        return 1e3 * (end - start)


class EventClock:
    """Moments are events in the current CUDA stream: the time that the GPU takes, and waits for the host."""

    def now(self) -> Any:
        import torch

        event = torch.cuda.Event(enable_timing=True)  # type: ignore[no-untyped-call]  # torch has no types
        event.record()
        return event

    def ms_between(self, start: Any, end: Any) -> float:
        end.synchronize()
        passed: float = start.elapsed_time(end)
        return passed


WALL = WallClock()


def times_ms(
    function: Callable[[], object],
    runs: int,
    warm_up: int = WARM_UP_CALLS,
    period_s: float = 0.0,
    clock: Clock = WALL,
) -> list[float]:
    """Times of `runs` calls, after `warm_up` calls that do not count.

    Args:
        period_s: sleep after each call until so much time has passed since it began: the rhythm of a camera.
    """
    times = []
    for run in range(-warm_up, runs):
        start = clock.now()
        function()
        taken = clock.ms_between(start, clock.now())
        if run >= 0:
            times.append(taken)
        if taken < 1e3 * period_s:
            time.sleep(period_s - 1e-3 * taken)
    return times


def median_ms(
    function: Callable[[], object], runs: int, warm_up: int = WARM_UP_CALLS, clock: Clock = WALL
) -> float:
    return statistics.median(times_ms(function, runs, warm_up, clock=clock))


class StageTimes:
    """What `stage_clock` has seen."""

    def __init__(self, clock: Clock = WALL) -> None:
        self._clock = clock
        self._spans: dict[str, list[tuple[Any, Any]]] = {}  # stage -> its calls, since it was emptied last
        self.arguments: dict[str, dict[str, Any]] = {}  # function -> arguments of its last call, by name

    def watched(self, function: Any, name: str, stage: str) -> Any:
        """`function`, or a Triton kernel that is launched as function[grid](...), with its times and its
        arguments noted here."""
        signature = inspect.signature(getattr(function, "py_func", getattr(function, "fn", function)))

        def timed_call(call: Callable[..., Any], args: Any, kwargs: Any) -> Any:
            start = self._clock.now()
            result = call(*args, **kwargs)
            self._spans.setdefault(stage, []).append((start, self._clock.now()))
            known = {key: value for key, value in kwargs.items() if key in signature.parameters}
            self.arguments[name] = signature.bind(*args, **known).arguments
            return result

        def timed(*args: Any, **kwargs: Any) -> Any:  # a function: it may take the place of a method
            return timed_call(function, args, kwargs)

        if not hasattr(function, "__getitem__"):
            return timed
        return _Kernel(lambda grid: lambda *args, **kwargs: timed_call(function[grid], args, kwargs))

    def medians_ms(self, function: Callable[[], object], runs: int) -> dict[str, float]:
        """Stage -> median time in it over `runs` calls of `function`, after some that do not count."""
        found: dict[str, list[float]] = {}
        for run in range(-WARM_UP_CALLS, runs):
            self._spans.clear()
            function()
            if run >= 0:
                for stage, spans in self._spans.items():
                    passed = sum(self._clock.ms_between(*span) for span in spans)
                    found.setdefault(stage, []).append(passed)
        return {stage: statistics.median(times) for stage, times in found.items()}


class _Kernel:
    """In the place of a Triton kernel: `kernel[grid]` is what launches it."""

    def __init__(self, launcher: Callable[[Any], Callable[..., Any]]) -> None:
        self._launcher = launcher

    def __getitem__(self, grid: Any) -> Callable[..., Any]:
        return self._launcher(grid)


@contextmanager
def stage_clock(stages: Stages, clock: Clock = WALL) -> Iterator[StageTimes]:
    """Time functions where their callers look them up, in their modules or classes, until the block ends.

    So stages are timed inside the whole, one after the other with the caches as they are there, and what is
    timed carries no stop watch of its own. Several functions may be one stage.
    """
    times = StageTimes(clock)
    originals = {(module, name): getattr(module, name) for module, name in stages}
    try:
        for (module, name), stage in stages.items():
            setattr(module, name, times.watched(originals[module, name], name, stage))
        yield times
    finally:
        for (module, name), function in originals.items():
            setattr(module, name, function)
