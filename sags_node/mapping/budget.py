"""How long a frame may be refined, and how many Gaussians the machine can afford. The clock is an argument,
so that results are reproducible."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Protocol

from sags_node.config import MappingConfig

PLANNED = 0.92  # of the budget: costs vary, and half of all frames would take longer than what is planned
LEARNING = 0.2  # share of a new measurement in a running mean
FORGET = 0.95  # of the cost of a step, per frame in which it seemed not to fit
LEAST_SHARE = 0.7  # of the model's capacity: fewer would save little, most of a frame does not depend on them
SHRINK, GROW = 0.995, 1.002  # per frame
GAUSSIANS_PER_MS = 1100  # of the budget; measured, see benchmarks/mapping.md
PIXELS_PER_GAUSSIAN = 2  # fewer pixels have no more to tell
MOST_PARTLY = 7  # frames in a row with a first step on part of the picture: a whole one tells what shows
COMFORT = 0.9  # of the time: below it there is room for more Gaussians


class Budget(Protocol):
    """Asked once before every refinement step."""

    @property
    def share(self) -> float:
        """How much of the model's capacity may be used, 0..1."""

    def start(self, waited: float = 0.0) -> None:
        """A new frame begins, `waited` seconds after it came."""

    def affords_depth(self) -> bool:
        """True when depth may be matched in this frame; False never twice in a row."""

    def more(self) -> bool:
        """True when one more step may be taken."""

    def affords_whole(self) -> bool:
        """True when the first step, about to be taken, may be one on the whole picture; often enough for the
        model to know which Gaussians show."""

    def finish(self) -> None:
        """The frame is done."""


class StepBudget:
    """A fixed number of steps per frame: deterministic."""

    share = 1.0

    def __init__(self, steps: int) -> None:
        self._steps = steps
        self._left = steps

    def start(self, waited: float = 0.0) -> None:
        self._left = self._steps

    def affords_depth(self) -> bool:
        return True

    def more(self) -> bool:
        self._left -= 1
        return self._left >= 0

    def affords_whole(self) -> bool:
        return True

    def finish(self) -> None:
        pass


class TimeBudget:
    """Wall time per frame, at least one step.

    The first step is part of what a frame cannot do without. A further one is taken when its cost and that of
    what follows the last step (drawing), both learnt from the frames before, still fit. The time that a frame
    waited is gone, so that one late frame does not make the next late.

    What does not fit is left out in this order: further steps; depth in every other frame, which the model's
    own depth bridges; the part of the picture, in this frame, that needs the first step least; and while that
    is not enough, the share of Gaussians falls. All recover when there is room: the machine may be slow, or
    busy with something else.
    """

    def __init__(
        self, seconds: float, skip_fitted: bool = True, clock: Callable[[], float] = time.perf_counter
    ) -> None:
        """
        Args:
            skip_fitted: False: the first step is on the whole picture, whatever the time.
        """
        self.seconds = seconds
        self._skip_fitted = skip_fitted
        self.share = 1.0
        self._clock = clock
        self._step_cost = _RunningMean()
        self._whole_cost = _RunningMean()  # of a first step on the whole picture, until the second may begin
        self._after_cost = _RunningMean()
        self._essential = _RunningMean()
        self._cost_with_depth = _RunningMean()
        self._had_depth = False
        self._partly = 0  # frames in a row whose first step was on part of the picture
        self.start()

    def start(self, waited: float = 0.0) -> None:
        self._started = self._asked = self._clock()
        self._deadline = self._started + max(0.0, self.seconds - waited)
        self._asks = 0
        self._depth: bool | None = None  # whether it is matched; None: nobody asked
        self._whole = True  # the first step
        self._optional = 0.0  # s, spent on all steps but the first

    def affords_depth(self) -> bool:
        fits = self._started + self._cost_with_depth.value <= self._deadline
        self._depth = fits or not self._had_depth
        return self._depth

    def more(self) -> bool:
        now = self._clock()
        if self._asks == 1 and self._whole:
            self._whole_cost.add(now - self._asked)
        if self._asks > 1:  # what came before the first step, and the first, are no measure of a further one
            self._step_cost.add(now - self._asked)
            self._optional += now - self._asked
        self._asked = now
        self._asks += 1
        if self._asks == 1 or now + self._step_cost.value + self._after_cost.value <= self._deadline:
            return True
        if self._asks == 2:  # nothing is learnt of a step that is never taken: try one again some day
            self._step_cost.value *= FORGET
        return False

    def affords_whole(self) -> bool:
        needed = self._whole_cost.value + self._after_cost.value
        fits = self._clock() + needed <= self._deadline
        self._whole = fits or not self._skip_fitted or self._partly == MOST_PARTLY
        self._partly = 0 if self._whole else self._partly + 1
        return self._whole

    def finish(self) -> None:
        """Learn from this frame. One that never asked, since it made a new model, tells nothing."""
        if self._depth is not None:
            self._had_depth = self._depth
        if self._asks == 0:
            return
        now = self._clock()
        self._after_cost.add(now - self._asked)
        essential = now - self._started - self._optional
        self._essential.add(essential)
        if self._depth:
            self._cost_with_depth.add(essential)
        if self._essential.value > self.seconds:
            self.share = max(LEAST_SHARE, SHRINK * self.share)
        elif self._essential.value + self._step_cost.value < COMFORT * self.seconds:
            self.share = min(1.0, GROW * self.share)


class _RunningMean:
    """Of times, s; begins with the first."""

    def __init__(self) -> None:
        self.value = 0.0
        self._empty = True

    def add(self, value: float) -> None:
        self.value += (1.0 if self._empty else LEARNING) * (value - self.value)
        self._empty = False


def capacity(config: MappingConfig, width: int, height: int) -> int:
    """How many Gaussians a model of pictures of this size may have; a slow machine uses a share of them."""
    if config.max_gaussians is not None:
        return config.max_gaussians
    return max(100, round(min(GAUSSIANS_PER_MS * config.budget_ms, width * height / PIXELS_PER_GAUSSIAN)))


def make_budget(config: MappingConfig) -> Budget:
    """Fixed steps where the configuration names them, else its time."""
    if config.iterations is not None:
        return StepBudget(config.iterations)
    return TimeBudget(PLANNED * config.budget_ms * 1e-3, config.skip_fitted)
