"""How long a frame may be refined. The clock is an argument, so that results are reproducible."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Protocol

from sags_node.config import MappingConfig


class Budget(Protocol):
    """Asked once before every refinement step."""

    def start(self) -> None:
        """A new frame begins."""

    def more(self) -> bool:
        """True when one more step may be taken."""

    def finish(self) -> None:
        """The frame is done."""


class StepBudget:
    """A fixed number of steps per frame: deterministic."""

    def __init__(self, steps: int) -> None:
        self._steps = steps
        self._left = steps

    def start(self) -> None:
        self._left = self._steps

    def more(self) -> bool:
        self._left -= 1
        return self._left >= 0

    def finish(self) -> None:
        pass


class TimeBudget:
    """Wall time per frame, at least one step.

    A step is taken when the time it is expected to cost, and the time expected after the last step (drawing),
    both learnt from the frames before, still fit.
    """

    def __init__(self, seconds: float, clock: Callable[[], float] = time.perf_counter) -> None:
        self.seconds = seconds
        self._clock = clock
        self._started = self._asked = clock()
        self._first = True
        self._step_cost = 0.0
        self._after_cost = 0.0

    def start(self) -> None:
        self._started = self._clock()
        self._first = True

    def more(self) -> bool:
        now = self._clock()
        first, self._first = self._first, False
        if not first:
            self._step_cost += 0.3 * (now - self._asked - self._step_cost)
        self._asked = now
        return first or now - self._started + self._step_cost + self._after_cost <= self.seconds

    def finish(self) -> None:
        """What came after the last refusal is the cost to reserve in the next frame."""
        self._after_cost += 0.3 * (self._clock() - self._asked - self._after_cost)


def make_budget(config: MappingConfig) -> Budget:
    """Fixed steps where the configuration names them, else its time."""
    if config.iterations is not None:
        return StepBudget(config.iterations)
    return TimeBudget(config.budget_ms * 1e-3)
