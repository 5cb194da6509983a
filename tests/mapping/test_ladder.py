"""The ladder of quality, on machines that only the tests know: which rung it finds, and how it changes."""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import pytest

from sags_node.config.schema import LaunchConfig, MappingConfig
from sags_node.errors import UsageError
from sags_node.mapping import devices, ladder
from sags_node.mapping.devices import ALL_SKIPS, Skips, make_budget, rungs_of
from sags_node.mapping.ladder import FULL, GPU_RUNGS, RUNGS, USED, Ladder, Prices, Rung, best_scale, price

SECONDS, PERIOD = 0.033, 1 / 30
FIRST_SECOND = round(1 / PERIOD)


@dataclass
class Played:
    """One frame that was taken."""

    number: int
    place: int
    seconds: float


def play(
    slowness: Callable[[float], float],
    frames: int = 900,
    seed: int = 0,
    start: float = 1.0,
    shape: tuple[float, float] = (1.0, 1.0),
    spike: Callable[[int], float] = lambda number: 0.0,
    noise: float = 0.08,
) -> list[Played]:
    """A camera of 30 Hz, the newest image wins. A frame takes what its rung costs, times `slowness` of the
    time (s), with noise; the model has as many Gaussians as the rung allows some frames later.

    Args:
        shape: how much dearer than the prices say Gaussians and images are on this machine.
        spike: s that a frame of this number takes more, on any rung.
    """
    rng = np.random.default_rng(seed)
    ours = Ladder(RUNGS, FULL, SECONDS, start)
    gaussians, now, number, done = USED * ours.rung.gaussians, 0.0, 0, []
    while number < frames:
        now = max(now, number * PERIOD)
        rung = ours.rung
        gaussians += np.clip(USED * rung.gaussians - gaussians, -0.01 * gaussians, 0.01 * gaussians)
        of_pictures = price(rung, 0, FULL)
        of_gaussians = price(rung, gaussians, FULL) - of_pictures
        ms = shape[0] * of_gaussians + shape[1] * of_pictures
        seconds = 1e-3 * ms * slowness(number * PERIOD) * np.exp(noise * rng.normal()) + spike(number)
        now += seconds
        ours.learn(seconds, round(gaussians))
        done.append(Played(number, ours.place, seconds))
        number = max(number + 1, int(now / PERIOD))
    return done


def share_taken(done: list[Played], first: int = FIRST_SECOND, frames: int = 900) -> float:
    return sum(first <= each.number < frames for each in done) / (frames - first)


def changes(done: list[Played]) -> list[tuple[int, int]]:
    """Frame number and size of each change after the first frames."""
    late = [each for each in done if each.number > ladder.FIRST_FRAMES]
    return [(b.number, b.place - a.place) for a, b in itertools.pairwise(late) if a.place != b.place]


@pytest.mark.parametrize(("rungs", "prices"), [(RUNGS, ladder.ON_CPU), (GPU_RUNGS, ladder.ON_GPU)])
def test_every_rung_costs_more_than_the_one_below(rungs: Sequence[Rung], prices: Prices) -> None:
    costs = [price(rung, USED * rung.gaussians, FULL, prices) for rung in rungs]
    assert all(a < b for a, b in itertools.pairwise(costs)), costs


@pytest.mark.parametrize("slow", [0.3, 0.7, 1.0, 1.3, 1.6, 2.0])
@pytest.mark.parametrize("start", [0.5, 1.0, 2.0])
def test_the_cameras_rate_is_held_after_the_first_second_on_any_machine(slow: float, start: float) -> None:
    """Also where the first guess of the machine's speed is off by a factor of two."""
    done = play(lambda now: slow, start=start * slow)
    assert share_taken(done) >= 0.97
    place = done[-1].place
    if place + 1 < len(RUNGS):  # and no more is given away than needed
        rung = RUNGS[min(place + 2, len(RUNGS) - 1)]
        assert slow * price(rung, USED * rung.gaussians, FULL) > 0.8 * 1e3 * SECONDS


@pytest.mark.parametrize("shape", [(2.0, 0.8), (0.5, 1.2)])
def test_a_machine_on_which_other_things_are_dear_holds_the_rate_too(shape: tuple[float, float]) -> None:
    assert share_taken(play(lambda now: 1.0, shape=shape)) >= 0.97


def test_a_machine_at_the_edge_of_two_rungs_does_not_swing() -> None:
    rung = RUNGS[5]
    edge = 1e3 * SECONDS / price(rung, USED * rung.gaussians, FULL)
    for slow in np.linspace(0.85, 1.1, 11) * edge:
        done = play(lambda now, slow=slow: slow, frames=3600)  # two minutes
        assert len(changes(done)) <= 6, (slow, changes(done))


@pytest.mark.fault("CPU: taken for ten seconds (simulated)")
def test_another_process_costs_rungs_while_it_runs_and_none_after() -> None:
    done = play(lambda now: 2.0 if 10 < now < 20 else 1.0, frames=1800)
    before = next(each.place for each in done if each.number >= 290)
    during = next(each.place for each in done if each.number >= 590)
    back = next(each.number for each in done if each.number >= 600 and each.place >= before - 1)
    assert during < before and back < 600 + 2 * FIRST_SECOND and abs(done[-1].place - before) <= 1
    assert share_taken(done, first=300, frames=600) >= 0.9
    assert all(abs(step) == 1 for _, step in changes(done))
    assert min(b - a for (a, _), (b, _) in itertools.pairwise(changes(done))) >= ladder.SETTLING


@pytest.mark.fault("CPU: every sixth frame takes 30 ms more (simulated)")
def test_late_frames_cost_rungs_whatever_the_mean_says() -> None:
    def spike(number: int) -> float:
        return 0.030 if 300 <= number < 900 and number % 6 == 0 else 0.0

    done = play(lambda now: 1.0, frames=1500, spike=spike)
    before = next(each.place for each in done if each.number >= 299)
    during = [each for each in done if 600 <= each.number < 900]
    # Each rung that leaves less free is given up; 8 % of noise in ten frames are 8 % of the speed, at most.
    ms = [price(rung, USED * rung.gaussians, FULL) for rung in RUNGS]
    most = (1 - ladder.SPARE) * 1e3 * SECONDS
    assert all(each.place < before and ms[each.place] < most < 1.08 * ms[each.place + 1] for each in during)
    assert len(during) == 300  # none is missed
    assert [step for number, step in changes(done) if 300 <= number < 900 and step > 0] == []
    back = next(each.number for each in done if each.number >= 900 and each.place >= before - 1)
    assert back < 900 + 4 * FIRST_SECOND


def test_a_few_late_frames_change_nothing() -> None:
    """Three of sixty, which is what is done twice a second and meets a neighbour; and one that takes thrice
    as long as usual."""
    done = play(lambda now: 1.0, spike=lambda number: 0.030 if number % 20 == 0 else 0.0, noise=0.0)
    assert sum(each.seconds > SECONDS for each in done) > 40 and changes(done) == []
    done = play(lambda now: 3.0 if 10 <= now < 10.03 else 1.0)
    assert not [frame for frame, _ in changes(done) if 300 <= frame <= 330]


def test_what_a_launch_pins_and_switches_off() -> None:
    def rungs(rung: int | None = None, skips: Skips = ALL_SKIPS) -> tuple[Rung, ...]:
        return rungs_of(LaunchConfig(device="cpu", mapping=MappingConfig(rung=rung)), skips)

    assert rungs() == rungs(rung=3) == RUNGS
    assert {rung.depth_every for rung in rungs(skips=Skips(depth=False))} == {1}
    with pytest.raises(UsageError, match=r"mapping\.rung 99: the ladder's rungs are 0 to \d+"):
        rungs(rung=99)


def test_a_pinned_rung_stays_and_says_its_number() -> None:
    budget = make_budget(LaunchConfig(device="cpu", mapping=MappingConfig(rung=4)), 640, 512, speed=1.0)
    for _ in range(3 * ladder.FIRST_FRAMES):
        budget.start()
        budget.step()
        budget.finish(50_000)  # in no time
    state = budget.start().state
    assert state is not None and (state.number, state.of) == (4, len(RUNGS))
    assert state.reason == "by mapping.rung" and state.gaussians == RUNGS[4].gaussians


def test_how_many_gaussians_a_model_may_have() -> None:
    def most(width: int = 640, height: int = 512, **mapping: object) -> int:
        config = LaunchConfig(device="cpu", mapping=MappingConfig.model_validate(mapping))
        return devices.affordable(config, width, height)

    assert most() == FULL // ladder.PIXELS_PER_GAUSSIAN
    assert most(1280, 1024) == RUNGS[-1].gaussians
    assert most(100, 100, iterations=1) == 100 * 100 // devices.LEAST_PIXELS
    assert most(max_gaussians=777) == 777
    assert most(rung=2) == RUNGS[2].gaussians
    assert most(iterations=1, budget_ms=20) == 22_000
    assert most(20, 10, iterations=1, budget_ms=1) == 100


def test_a_new_budget_goes_on_at_the_speed_of_the_one_before() -> None:
    config = LaunchConfig(device="cpu")
    fast, slow = (make_budget(config, 640, 512, speed).plan.state for speed in (0.5, 2.0))
    assert fast is not None and slow is not None and fast.number > slow.number


@pytest.mark.parametrize("pixels", [FULL, 1280 * 1024, 720 * 576, 640 * 480])
def test_the_slower_a_machine_the_smaller_its_pictures(pixels: int) -> None:
    scales = [best_scale(RUNGS, pixels, SECONDS, speed) for speed in np.geomspace(0.1, 50, 500)]
    assert scales == sorted(scales, reverse=True)
    smaller = [scale for scale in ladder.SCALES if scale**2 * pixels >= ladder.SMALLEST]
    assert (scales[0], scales[-1]) == (1, smaller[-1]) and smaller[-1] < 1  # at the last nothing fits
    assert best_scale(RUNGS, 320 * 256, SECONDS, 50) == 1  # small already


def test_the_scale_is_chosen_in_real_time_only_and_never_over_a_person(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(devices, "measured_speed", lambda rasterizer: 2.0)

    def chosen(**asked: object) -> object:
        config = LaunchConfig.model_validate({"device": "cpu", **asked})
        return devices.with_scale(config, 640, 512, 30.0).vision.scale

    assert chosen() == best_scale(RUNGS, FULL, 1e-3 * MappingConfig().frame_ms(30.0), 2.0) < 1
    assert chosen(mapping={"method": "sags"}) == 0.75  # its frames take several times as long
    assert chosen(source={"kind": "phantom", "pace": "step"}) == 1.0  # results repeat
    assert chosen(mapping={"iterations": 2}) == 1.0
    assert chosen(vision={"scale": 0.5}) == 0.5 and chosen(vision={"scale": 1}) == 1
