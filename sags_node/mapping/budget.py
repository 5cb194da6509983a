"""What a frame gets: a rung of quality, and steps while its time lasts. The clock is an argument, so that
results are reproducible."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from sags_node.mapping.ladder import EVERYTHING, Ladder, Rung
from sags_node.types import RungState

LEARNING = 0.2  # share of a new measurement in a running mean
FORGET = 0.95  # factor on the learnt cost of a step, for each frame in which no further step fitted
LEAST_FIRST_STEPS = 3  # steps of a new model in its first frame, however long they take
FIRST_SECONDS = 0.1  # s, after which a new model's first frame leaves the other first steps to later frames


@dataclass(frozen=True, slots=True)
class FramePlan:
    """What one frame gets, decided when it begins."""

    rung: Rung  # the best that the frame may use
    state: RungState | None  # which rung that is and why; None: there is no ladder
    depth: bool  # whether depth may be matched


class Budget(Protocol):
    """What frames get."""

    @property
    def speed(self) -> float:
        """The time that this machine takes, in units of the prices' machine; see `Ladder`."""

    @property
    def plan(self) -> FramePlan:
        """The plan of the current frame."""

    def start(self, waited: float = 0.0) -> FramePlan:
        """Begin a new frame, `waited` seconds after it came; returns its plan."""

    def more_at_first(self, steps: int) -> bool:
        """Tell whether a new model that has had `steps` steps may have one more in its first frame."""

    def more(self) -> bool:
        """Tell whether one more step may be taken."""

    def step(self) -> None:
        """Begin a step."""

    def end_steps(self) -> None:
        """End the steps of the frame: what follows only draws and shows the model."""

    def finish(self, gaussians: int, matched: bool = False) -> None:
        """End the frame, in which the model has that many Gaussians and depth was `matched` or not."""


class StepBudget:
    """A fixed number of steps per frame: deterministic."""

    speed = 1.0

    def __init__(self, steps: int, rung: Rung = EVERYTHING) -> None:
        self._rung = rung
        self._steps = steps
        self._taken = 0
        self._frames = 0
        self.plan = FramePlan(rung, None, depth=True)

    def start(self, waited: float = 0.0) -> FramePlan:
        self._taken = 0
        self._frames += 1
        self.plan = FramePlan(self._rung, None, self._frames % self._rung.depth_every == 0)
        return self.plan

    def more(self) -> bool:
        return self._taken < self._steps

    def step(self) -> None:
        self._taken += 1

    def end_steps(self) -> None:
        pass

    def more_at_first(self, steps: int) -> bool:
        return True

    def finish(self, gaussians: int, matched: bool = False) -> None:
        pass


class TimeBudget:
    """Wall time per frame, at least one step.

    The rung says what a frame cannot do without. A further step is taken when its cost and that of what
    follows the last step (drawing), both learnt from the frames before, still fit. The time that a frame
    waited is gone, so that one late frame does not make the next late; a late frame may also leave depth to
    the next one.
    """

    def __init__(self, ladder: Ladder, clock: Callable[[], float] = time.perf_counter) -> None:
        self.ladder = ladder
        self._clock = clock
        self._step_cost = _RunningMean()
        self._after_cost = _RunningMean()
        self._cost_with_depth = _RunningMean()
        self._since_depth = 0  # frames, this one included
        self.plan = self.start()

    @property
    def speed(self) -> float:
        return self.ladder.speed

    def start(self, waited: float = 0.0) -> FramePlan:
        rung = self.ladder.rung
        self._started = self._stepped = self._clock()
        self._deadline = self._started + max(0.0, self.ladder.seconds - waited)
        self._steps = 0
        self._since_depth += 1
        self._optional = 0.0  # s, spent on all steps but the first
        late = self._started + self._cost_with_depth.value > self._deadline
        depth = self._since_depth >= rung.depth_every + late
        self.plan = FramePlan(rung, self.ladder.state, depth)
        return self.plan

    def more_at_first(self, steps: int) -> bool:
        return steps < LEAST_FIRST_STEPS or self._clock() - self._started <= FIRST_SECONDS

    def more(self) -> bool:
        needed = self._step_cost.value + self._after_cost.value
        return self._steps == 0 or self._clock() + needed <= self._deadline

    def step(self) -> None:
        self._note_step()
        self._steps += 1

    def end_steps(self) -> None:
        self._note_step()
        if self._steps == 1:  # no further step was measured: expect less, so that one is tried again
            self._step_cost.value *= FORGET

    def _note_step(self) -> None:
        """Learn the duration of the last step, unless it is the frame's first, which includes other work."""
        now = self._clock()
        if self._steps > 1:
            self._step_cost.add(now - self._stepped)
            self._optional += now - self._stepped
        self._stepped = now

    def finish(self, gaussians: int, matched: bool = False) -> None:
        """Learn from this frame. One without steps, since it made a new model, tells nothing."""
        if self._steps == 0:
            return
        now = self._clock()
        self._after_cost.add(now - self._stepped)
        essential = now - self._started - self._optional
        if matched:
            self._since_depth = 0
            self._cost_with_depth.add(essential)
        self.ladder.learn(essential, gaussians)


class _RunningMean:
    """The running mean of times, s; begins with the first."""

    def __init__(self) -> None:
        self.value = 0.0
        self._empty = True

    def add(self, value: float) -> None:
        self.value += (1.0 if self._empty else LEARNING) * (value - self.value)
        self._empty = False
