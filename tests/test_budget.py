"""How long a frame is refined and how many Gaussians are afforded, on a clock that only the tests move."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest

from sags_node.config import MappingConfig
from sags_node.launch_file import with_parameters
from sags_node.mapping.budget import (
    GAUSSIANS_PER_MS,
    LEAST_SHARE,
    MOST_PARTLY,
    PIXELS_PER_GAUSSIAN,
    StepBudget,
    TimeBudget,
    capacity,
    make_budget,
)
from sags_node.mapping.densify import SHED
from sags_node.pipeline import Pipeline
from sags_node.session import open_session

BUDGET, PERIOD = 0.033, 1 / 30  # s
SESSION = Path(__file__).parent.parent / "replay/phantom_pull"


@dataclass
class Machine:
    """Frames on a made-up clock: `before`, the first step and `after` must be, depth every other time, what a
    first step on the whole picture costs more (`rest`) where there is time, and further steps may be."""

    seconds: float = BUDGET
    before: float = 0.010
    depth: float = 0.0
    step: float = 0.004
    rest: float = 0.0
    after: float = 0.005
    now: float = 0.0
    budget: TimeBudget = field(init=False)
    matched: list[bool] = field(default_factory=list)  # whether there was time for depth, frame by frame
    whole: list[bool] = field(default_factory=list)  # and for a first step on the whole picture

    def __post_init__(self) -> None:
        self.budget = TimeBudget(self.seconds, clock=lambda: self.now)

    def frame(self, waited: float = 0.0, spike: str = "") -> tuple[int, float]:
        """One frame, in the named part of which another process takes 80 ms: its steps and its time, s."""
        started, steps = self.now, 0
        self.budget.start(waited)
        self.now += self.before + 0.080 * (spike == "before")
        if self.depth:
            self.matched.append(self.budget.affords_depth())
            self.now += self.depth * self.matched[-1]
        while self.budget.more():
            steps += 1
            if steps == 1:
                self.whole.append(self.budget.affords_whole())
                self.now += self.rest * self.whole[-1]
            self.now += self.step + 0.080 * (spike == "step" and steps == 2)
        self.now += self.after + 0.080 * (spike == "after")
        self.budget.finish()
        return steps, self.now - started

    def play(self, frames: int, spike_at: int = -1, spike: str = "") -> list[tuple[int, int, float]]:
        """A camera of 30 Hz and a slot in which the newest picture wins: number, steps and age when done, s,
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


def test_step_budget_counts() -> None:
    budget = StepBudget(3)
    for _ in range(2):
        budget.start()
        assert [budget.more() for _ in range(5)] == [True, True, True, False, False]


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
    machine.budget.finish()
    assert machine.budget.share == 1.0
    for _ in range(3):
        assert machine.frame()[0] == fresh.frame()[0] > 1


def test_two_frames_in_a_row_are_never_without_depth_whatever_came_of_the_first() -> None:
    machine = Machine(before=0.050)
    for _ in range(5):
        machine.budget.start()
        machine.budget.affords_depth()
        machine.now += machine.before
        machine.budget.more()
        machine.budget.finish()
    answers = []
    for _ in range(6):
        machine.budget.start()
        answers.append(machine.budget.affords_depth())
        machine.budget.finish()  # no step was asked for: there was no model to refine
    assert set(itertools.pairwise(answers)) == {(True, False), (False, True)}


def test_the_time_that_a_frame_waited_is_gone() -> None:
    machine = Machine()
    for _ in range(20):
        punctual, _ = machine.frame()
    steps, _ = machine.frame(waited=2 * machine.step)
    assert steps == punctual - 2
    assert machine.frame(waited=1.0)[0] == 1


@pytest.mark.parametrize("part", ["before", "step", "after"])
def test_one_spike_delays_no_frame_for_long_and_leaves_no_trace(part: str) -> None:
    """After 80 ms more, three pictures have gone by; of those that are taken then, few are late."""
    machine = Machine()
    done = machine.play(200, spike_at=100, spike=part)
    spiked = next(i for i, (number, _, _) in enumerate(done) if number >= 100)
    usual = done[spiked - 1][1]
    assert usual == 4 and done[spiked][2] > 0.080
    late = [number for number, _, age in done[spiked + 1 :] if age > PERIOD]
    assert len(late) <= 2, late
    assert done[-1][1] == usual, [steps for _, steps, _ in done]
    assert machine.budget.share == 1.0


def test_under_lasting_overload_every_newest_frame_is_taken_without_waiting_longer_and_longer() -> None:
    machine = Machine(before=0.040)
    done = machine.play(300)
    assert max(age for _, _, age in done) < machine.before + machine.step + machine.after + PERIOD
    assert {steps for _, steps, _ in done[1:]} == {1}


def test_depth_is_matched_where_it_fits_else_in_every_other_frame_and_again_when_it_fits() -> None:
    machine = Machine(before=0.010, depth=0.008)
    machine.play(20)
    assert all(machine.matched)
    machine.before = 0.020  # 37 ms with depth, 29 without
    machine.matched.clear()
    done = machine.play(60)
    assert 28 <= sum(machine.matched) <= 40
    assert all(any(pair) for pair in zip(machine.matched, machine.matched[1:], strict=False))
    assert np.median([age for _, _, age in done[20:]]) < PERIOD + machine.depth
    machine.before = 0.010
    machine.play(30)
    assert all(machine.matched[-10:])


def test_the_first_step_is_on_the_whole_picture_where_that_fits_and_again_when_it_fits() -> None:
    machine = Machine(before=0.015, rest=0.006)
    machine.play(20)
    assert all(machine.whole[5:])
    machine.before = 0.021  # 36 ms with all of it, 30 without
    machine.whole.clear()
    done = machine.play(60)
    assert sum(machine.whole) < 20  # it is tried now and then, as a further step is
    assert np.mean([age for _, _, age in done[10:]]) < 0.035
    machine.before = 0.015
    machine.play(30)
    assert all(machine.whole[-10:])


def test_a_machine_that_is_always_late_still_steps_on_the_whole_picture_now_and_then() -> None:
    """Else nobody knows which Gaussians show, and the model loses 0.14 dB in 1000 frames."""
    machine = Machine(before=0.050, rest=0.006)
    machine.play(200)
    between = np.diff(np.flatnonzero(machine.whole))
    assert len(between) > 5 and set(between[1:]) == {MOST_PARTLY + 1}


def test_the_rule_that_leaves_out_what_fits_can_be_switched_off() -> None:
    machine = Machine(before=0.050, rest=0.006)
    machine.budget = TimeBudget(BUDGET, skip_fitted=False, clock=lambda: machine.now)
    machine.play(20)
    assert all(machine.whole)


@pytest.mark.parametrize("floor", [0.004, 0.030])
def test_the_share_falls_to_what_fits_and_recovers(floor: float) -> None:
    """A frame costs `floor` and up to 20 ms for the Gaussians, which are shed as fast as the mapper does."""
    machine = Machine(seconds=0.025, after=0.003)
    gaussians, shares = 1.0, []

    def play(frames: int, slowness: float) -> None:
        nonlocal gaussians
        for _ in range(frames):
            gaussians = max(min(gaussians, machine.budget.share), gaussians * (1 - SHED))
            machine.before = slowness * (floor + 0.017 * gaussians)
            machine.step = slowness * 0.003 * gaussians
            machine.frame()
            shares.append(machine.budget.share)

    play(400, slowness=1.0)
    if floor < 0.025:
        fits = (0.025 - 0.003 - floor) / 0.020
        assert LEAST_SHARE < 0.9 * fits < gaussians <= 1.02 * fits, (gaussians, fits)
    else:  # nothing fits: it goes no lower than that
        assert gaussians == pytest.approx(LEAST_SHARE)
    settled = shares[-100:]
    assert max(settled) - min(settled) < 0.05
    play(600, slowness=0.4)
    assert machine.budget.share == 1.0


def test_capacity_follows_budget_and_picture_but_never_beats_what_is_asked_for() -> None:
    assert capacity(MappingConfig(budget_ms=20), 4000, 4000) == GAUSSIANS_PER_MS * 20
    assert capacity(MappingConfig(budget_ms=1000), 300, 200) == 300 * 200 // PIXELS_PER_GAUSSIAN
    assert capacity(MappingConfig(budget_ms=0.01), 64, 64) == 100
    assert capacity(MappingConfig(budget_ms=20, max_gaussians=777), 4000, 4000) == 777


def test_fixed_steps_go_before_time() -> None:
    steps = make_budget(MappingConfig(iterations=2, budget_ms=1))
    assert [steps.more() for _ in range(4)] == [True, True, False, False] and steps.share == 1.0
    assert isinstance(make_budget(MappingConfig(budget_ms=1)), TimeBudget)


def test_a_budget_that_is_changed_while_running_is_as_if_it_had_been_so() -> None:
    """With time for several steps these are shorter and the flow is finer, whenever that became so."""

    def play(*budgets: float) -> list[np.ndarray]:
        settings = ["source.pace:=step", "mapping.max_gaussians:=4000", f"mapping.budget_ms:={budgets[0]}"]
        session = open_session(SESSION, settings)
        pipeline = Pipeline(session.config, session.rig)
        for budget in budgets[1:]:
            pipeline.reconfigure(with_parameters(session.config, {"mapping.budget_ms": budget}))
        with session.source as source:
            frames = [frame for frame, _ in zip(source, range(3), strict=False)]
        return [pipeline.process(frame, StepBudget(2)).snapshot.gaussians.means for frame in frames]

    changed, patient, hurried = play(33, 100), play(100), play(100, 33)
    assert all(np.array_equal(a, b) for a, b in zip(changed, patient, strict=True))
    assert not np.array_equal(hurried[-1], patient[-1])
