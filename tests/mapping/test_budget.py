"""What a frame gets while its time lasts, on a clock that only the tests move."""

from dataclasses import dataclass, field

import numpy as np
import pytest
from recorded_session import frames_of, opened

from sags_node.config.launch_file import with_parameters
from sags_node.config.schema import LaunchConfig, MappingConfig
from sags_node.mapping.budget import FIRST_SECONDS, LEAST_FIRST_STEPS, Budget, StepBudget, TimeBudget
from sags_node.mapping.devices import make_budget
from sags_node.mapping.ladder import FULL, Ladder, Rung
from sags_node.pipeline.pipeline import Pipeline

BUDGET, PERIOD = 0.033, 1 / 30  # s
USUAL = Rung(10_000)


@dataclass
class Machine:
    """Frames on a made-up clock, on one rung: `before`, the first step and `after` must be, depth as often as
    the rung says, and further steps may be."""

    rung: Rung = USUAL
    seconds: float = BUDGET
    before: float = 0.010
    depth: float = 0.0
    step: float = 0.004
    after: float = 0.005
    now: float = 0.0
    budget: TimeBudget = field(init=False)
    matched: list[bool] = field(default_factory=list)  # whether depth was, frame by frame

    def __post_init__(self) -> None:
        self.budget = TimeBudget(Ladder((self.rung,), FULL, self.seconds), clock=lambda: self.now)

    def frame(self, waited: float = 0.0, spike: str = "") -> tuple[int, float]:
        """One frame, in the named part of which another process takes 80 ms: its steps and its time, s."""
        started, steps = self.now, 0
        plan = self.budget.start(waited)
        self.now += self.before + 0.080 * (spike == "before")
        if self.depth:
            self.matched.append(plan.depth)
            self.now += self.depth * self.matched[-1]
        while self.budget.more():
            self.budget.step()
            steps += 1
            self.now += self.step + 0.080 * (spike == "step" and steps == 2)
        self.budget.end_steps()
        self.now += self.after + 0.080 * (spike == "after")
        self.budget.finish(8000, matched=bool(self.depth) and plan.depth)
        return steps, self.now - started

    def play(self, frames: int, spike_at: int = -1, spike: str = "") -> list[tuple[int, int, float]]:
        """A camera of 30 Hz and a slot in which the newest image wins: number, steps and age when done, s,
        of each frame that was taken."""
        done: list[tuple[int, int, float]] = []
        began, number = self.now, 0
        while number < frames:
            self.now = max(self.now, began + number * PERIOD)
            number = max(number, int((self.now - began) / PERIOD + 1e-6))
            came = began + number * PERIOD
            spiked = spike_at >= 0 and number >= spike_at and not any(n >= spike_at for n, _, _ in done)
            steps, _ = self.frame(self.now - came, spike if spiked else "")
            done.append((number, steps, self.now - came))
            number += 1
        return done


def steps_of(budget: Budget) -> int:
    """How many there are; to ask twice changes nothing."""
    steps = 0
    while budget.more() and budget.more():
        budget.step()
        steps += 1
    budget.end_steps()
    return steps


def test_steps_fill_the_time_and_leave_room_for_drawing() -> None:
    machine = Machine(before=0.006, step=0.005, after=0.006)
    for _ in range(30):
        steps, spent = machine.frame()
    assert steps == 4 and BUDGET - machine.step < spent <= BUDGET


def test_a_step_is_taken_even_when_there_is_no_time_for_one() -> None:
    machine = Machine(before=0.050)
    assert [machine.frame()[0] for _ in range(5)][1:] == [1] * 4


def test_a_first_frame_that_never_asks_teaches_nothing() -> None:
    """It makes the model, 30 steps long: no later frame costs that."""
    fresh, machine = Machine(), Machine()
    machine.budget.start()
    machine.now += 1.0
    machine.budget.finish(8000)
    assert machine.budget.speed == fresh.budget.speed
    for _ in range(3):
        assert machine.frame()[0] == fresh.frame()[0] > 1


def test_the_time_that_a_frame_waited_is_gone() -> None:
    machine = Machine()
    for _ in range(20):
        punctual, _ = machine.frame()
    steps, _ = machine.frame(waited=2 * machine.step)
    assert steps == punctual - 2
    assert machine.frame(waited=1.0)[0] == 1


@pytest.mark.parametrize("part", ["before", "step", "after"])
def test_one_spike_delays_no_frame_for_long_and_leaves_no_trace(part: str) -> None:
    """After 80 ms more, three images have gone by; of those that are taken then, few are late."""
    machine = Machine()
    done = machine.play(200, spike_at=100, spike=part)
    spiked = next(i for i, (number, _, _) in enumerate(done) if number >= 100)
    usual = done[spiked - 1][1]
    assert usual == 4 and done[spiked][2] > 0.080
    late = [number for number, _, age in done[spiked + 1 :] if age > PERIOD]
    assert len(late) <= 2, late
    assert done[-1][1] == usual, [steps for _, steps, _ in done]


def test_under_lasting_overload_every_newest_frame_is_taken_without_waiting_longer_and_longer() -> None:
    machine = Machine(before=0.040)
    done = machine.play(300)
    assert max(age for _, _, age in done) < machine.before + machine.step + machine.after + PERIOD
    assert {steps for _, steps, _ in done[1:]} == {1}


def test_depth_is_matched_as_often_as_the_rung_says_and_a_frame_later_where_one_is_late() -> None:
    machine = Machine(Rung(10_000, depth_every=2), depth=0.008)
    machine.play(20)
    assert machine.matched == [True, False] * 10
    machine.matched.clear()
    for waited in (0.0, 0.030, 0.030, 0.0, 0.0, 0.0):
        machine.frame(waited)
    assert machine.matched == [True, False, False, True, False, True]


def test_a_new_model_gets_its_first_steps_in_one_frame_or_leaves_them_to_the_next() -> None:
    """30 steps of a slow machine would keep the first image back for a second."""
    for cost, expected in ((0.030, 1 + int(FIRST_SECONDS / 0.030)), (0.5, LEAST_FIRST_STEPS)):
        machine, steps = Machine(), 0
        machine.budget.start()
        while machine.budget.more_at_first(steps):
            steps += 1
            machine.now += cost
        assert steps == expected
    assert all(StepBudget(1).more_at_first(steps) for steps in range(30))


def test_fixed_steps_go_before_time() -> None:
    def budget(**mapping: object) -> object:
        return make_budget(LaunchConfig(mapping=MappingConfig.model_validate(mapping)), 640, 512, 1.0)

    steps, timed = budget(iterations=2, budget_ms=1), budget(budget_ms=1)
    assert isinstance(steps, StepBudget) and isinstance(timed, TimeBudget)
    for _ in range(2):
        steps.start()
        assert steps_of(steps) == 2 and not steps.more()


def test_a_budget_that_is_changed_while_running_is_as_if_it_had_been_so() -> None:
    """With time for several steps these are shorter and the flow is finer, whenever that became so."""

    def play(*budgets: float) -> list[np.ndarray]:
        session = opened(
            "source.frames:=3", "mapping.max_gaussians:=4000", f"mapping.budget_ms:={budgets[0]}"
        )
        pipeline = Pipeline(session.config, session.rig)
        if budgets[1:]:
            pipeline.reconfigure(with_parameters(session.config, {"mapping.budget_ms": budgets[1]}))
        results = [pipeline.process(frame, StepBudget(2)) for frame in frames_of(session)]
        return [result.snapshot.gaussians.means for result in results]

    changed, patient, hurried = play(33, 100), play(100), play(100, 33)
    assert all(np.array_equal(a, b) for a, b in zip(changed, patient, strict=True))
    assert not np.array_equal(hurried[-1], patient[-1])
