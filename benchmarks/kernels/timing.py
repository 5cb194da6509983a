"""Stop watches: medians of calls, the stages inside a call, and the least time that a machine could need."""

import inspect
import statistics
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from types import ModuleType
from typing import Any

from numpy.typing import NDArray

from sags_node.kernels.peak import Peak

WARM_UP_CALLS = 3

Stages = Mapping[tuple[ModuleType | type, str], str]  # (module or class, name of a function in it) -> stage


def times_ms(
    function: Callable[[], object], runs: int, warm_up: int = WARM_UP_CALLS, period_s: float = 0.0
) -> list[float]:
    """Return the times (ms) of `runs` calls, after `warm_up` calls that do not count.

    Args:
        period_s: sleep after each call until so much time has passed since it began: the rhythm of a camera.
    """
    times = []
    for run in range(-warm_up, runs):
        start = time.perf_counter()
        function()
        taken = 1e3 * (time.perf_counter() - start)
        if run >= 0:
            times.append(taken)
        if taken < 1e3 * period_s:
            time.sleep(period_s - 1e-3 * taken)
    return times


def median_ms(function: Callable[[], object], runs: int, warm_up: int = WARM_UP_CALLS) -> float:
    return statistics.median(times_ms(function, runs, warm_up))


class StageTimes:
    """The times and arguments that `stage_clock` has noted."""

    def __init__(self) -> None:
        self._spent: dict[str, float] = {}  # stage -> ms in it, since it was emptied last
        self.arguments: dict[str, dict[str, Any]] = {}  # function -> arguments of its last call, by name

    def watched(self, function: Any, name: str, stage: str) -> Any:
        """Wrap `function` so that its times and its arguments are noted here."""
        signature = inspect.signature(getattr(function, "py_func", function))

        def timed(*args: Any, **kwargs: Any) -> Any:  # a function: it may take the place of a method
            start = time.perf_counter()
            result = function(*args, **kwargs)
            self._spent[stage] = self._spent.get(stage, 0.0) + 1e3 * (time.perf_counter() - start)
            self.arguments[name] = signature.bind(*args, **kwargs).arguments
            return result

        return timed

    def medians_ms(self, function: Callable[[], object], runs: int) -> dict[str, float]:
        """Return stage -> median ms in it over `runs` calls of `function`, after some that do not count."""
        found: dict[str, list[float]] = {}
        for run in range(-WARM_UP_CALLS, runs):
            self._spent.clear()
            function()
            if run >= 0:
                for stage, passed in self._spent.items():
                    found.setdefault(stage, []).append(passed)
        return {stage: statistics.median(times) for stage, times in found.items()}


@contextmanager
def stage_clock(stages: Stages) -> Iterator[StageTimes]:
    """Time functions by replacing them in their modules or classes until the block ends.

    So stages are timed inside a whole call, with the caches as they are there, and the timed code needs no
    clock of its own. Several functions may be one stage.
    """
    times = StageTimes()
    originals = {(module, name): getattr(module, name) for module, name in stages}
    try:
        for (module, name), stage in stages.items():
            setattr(module, name, times.watched(originals[module, name], name, stage))
        yield times
    finally:
        for (module, name), function in originals.items():
            setattr(module, name, function)


@dataclass(frozen=True, slots=True)
class Work:
    """The work of a kernel. At the machine's peak, it takes the longer of two times: memory or arithmetic."""

    bytes: float  # of all arrays that it reads or writes, each once
    operations: float = 0.0  # on float32, a multiply-add counted once; 0: not counted, few for each byte
    pairs: int | None = None  # pixel-Gaussian pairs evaluated

    def least_ms(self, peak: Peak) -> float:
        return 1e3 * max(self._memory_s(peak), self._arithmetic_s(peak))

    def bound(self, peak: Peak) -> str:
        """Return which of the two times is the longer."""
        return "arithmetic" if self._arithmetic_s(peak) > self._memory_s(peak) else "memory"

    def _memory_s(self, peak: Peak) -> float:
        return self.bytes / peak.bandwidth(self.bytes)

    def _arithmetic_s(self, peak: Peak) -> float:
        return self.operations / peak.operations


def bytes_of(*arrays: NDArray[Any]) -> int:
    return sum(array.nbytes for array in arrays)


def stage_rows(times_ms: Mapping[str, float], work: Mapping[str, Work], peak: Peak) -> list[dict[str, Any]]:
    """Return one record per stage: its time beside the machine's peak."""
    rows = []
    for stage, ms in times_ms.items():
        todo = work[stage]
        row = {"stage": stage, "ms": ms, "bound": todo.bound(peak), "share_of_peak": todo.least_ms(peak) / ms}
        if todo.pairs is not None:
            row["pairs_per_s"] = todo.pairs / (ms * 1e-3)
        rows.append(row)
    return rows


def share_of_peak(ms: float, work: Mapping[str, Work], peak: Peak) -> float:
    """Return the share of the peak of successive stages that took `ms` together."""
    return sum(todo.least_ms(peak) for todo in work.values()) / ms
