"""Motion is remembered: what repeats is foreseen; of what does not, nothing is said that does harm."""

from collections.abc import Callable

import numpy as np
import pytest
from engine_scenes import round_gaussians
from recorded_session import frames_of, fresh, opened

from sags_node.mapping.budget import StepBudget
from sags_node.mapping.motion_field import HORIZONS, STEADY, MotionField
from sags_node.model.forecast import gaussians_ahead, points_ahead, reached
from sags_node.types import F32, Camera, Forecast, MotionState, Snapshot

FRAME_S = 1 / 30
PERIOD = 31.4  # frames: no whole number
NODES = np.random.default_rng(1).uniform(-0.03, 0.03, (200, 3)).astype(np.float32)
SEEN = np.ones(len(NODES), np.float32)
EYE = np.array([0, 0, -0.1], np.float32)  # m
PULL = np.random.default_rng(2).normal(0, 1e-3, (3, len(NODES), 3))  # m


def beating(frame: float) -> F32:
    """Places [M, 3] of nodes that a heart with a quick stroke moves: three harmonics."""
    angle = 2 * np.pi * frame / PERIOD
    moved = sum(PULL[k] * np.sin((k + 1) * angle + k) for k in range(3))
    return np.asarray(NODES + moved, np.float32)


def stamp(frame: int) -> int:
    return 1_000_000_000 + round(frame * FRAME_S * 1e9)


def played(places: Callable[[float], F32], frames: int) -> MotionField:
    field = MotionField()
    for frame in range(frames):
        field.take(places(frame), SEEN, stamp(frame), EYE)
    return field


def off(moves: F32, moved: F32) -> float:
    return float(np.sqrt(np.square(moves - moved).mean()))


def test_what_repeats_is_foreseen_and_its_period_is_told() -> None:
    last = 120
    field = played(beating, last + 1)
    found = field.forecast()
    assert found is not None
    moves, frame_s, state = found
    assert frame_s == pytest.approx(FRAME_S)
    assert state.period == pytest.approx(PERIOD * FRAME_S, abs=FRAME_S)
    assert state.reach == pytest.approx(HORIZONS * FRAME_S) and state.skill > 0.9
    now = beating(last)
    for ahead in range(1, HORIZONS + 1):
        moved = beating(last + ahead) - now
        steady = STEADY * ahead * (now - beating(last - 1))
        assert off(moves[ahead - 1], moved) < 0.3 * min(off(steady, moved), off(np.zeros_like(moved), moved))


def test_what_never_repeats_is_not_said_to_be_foreseen() -> None:
    """Of steps that do not depend on each other nothing can be said: a prediction would only do harm."""
    steps = np.random.default_rng(3).normal(0, 1e-3, (150, len(NODES), 3))
    walked = NODES + np.cumsum(steps, axis=0)
    field = played(lambda frame: walked[int(frame)].astype(np.float32), 150)
    found = field.forecast()
    assert found is not None and found[2].reach == 0
    assert found[2].period is None


def test_noise_of_depth_hides_nothing_of_what_a_camera_sees() -> None:
    """Along a camera's rays each frame's depth has an error of its own, ten times the motion across them."""
    rng = np.random.default_rng(4)

    def measured(frame: float) -> F32:
        rays = NODES + np.float32(frame) * np.array([1e-4, 0, 0], np.float32) - EYE
        return EYE + rays * (1 + rng.normal(0, 1e-2, (len(NODES), 1)).astype(np.float32))

    told = played(measured, 60).forecast()
    assert told is not None and told[2].reach == pytest.approx(HORIZONS * FRAME_S)
    assert told[2].skill > 0.5


def test_motion_that_does_not_repeat_is_said_as_without_a_memory() -> None:
    pull = np.array([1e-3, 0, -5e-4], np.float32)
    found = played(lambda frame: NODES + np.float32(frame) * pull, 20).forecast()
    for ahead in range(HORIZONS):
        np.testing.assert_allclose(found[0][ahead], STEADY * (ahead + 1) * np.tile(pull, (200, 1)), atol=1e-6)


def test_hidden_nodes_move_as_they_did_when_the_others_moved_so() -> None:
    last = 100
    field = played(beating, last)
    moved = beating(last) - beating(last - 1)
    hidden = NODES[:, 0] > 0
    seen = np.where(hidden, 0, 1).astype(np.float32)
    recalled = field.recalled(np.where(hidden[:, None], 0, moved).astype(np.float32), seen)
    assert off(recalled[hidden], moved[hidden]) < 0.3 * off(np.zeros_like(moved[hidden]), moved[hidden])


def test_too_few_seen_nodes_recall_nothing() -> None:
    seen = np.zeros_like(SEEN)
    seen[:10] = 1
    assert played(beating, 100).recalled(np.zeros_like(NODES), seen) is None


def test_missed_frames_are_filled_and_a_long_gap_begins_anew() -> None:
    field, whole = MotionField(), played(beating, 121)
    for frame in range(121):
        if frame % 7 != 3:
            field.take(beating(frame), SEEN, stamp(frame), EYE)
    told, same = field.forecast(), whole.forecast()
    assert told is not None and same is not None
    moved = beating(121) - beating(120)
    assert off(told[0][0], moved) < 0.5 * off(np.zeros_like(moved), moved)
    field.take(beating(400), SEEN, stamp(400), EYE)
    assert field.forecast() is None


def test_new_nodes_move_as_their_neighbours_always_did() -> None:
    field = played(beating, 100)
    near = np.concatenate([beating(100), beating(100)[:20] + np.float32(1e-4)])
    field.take(near, np.ones(len(near), np.float32), stamp(100), EYE)
    found = field.forecast()
    np.testing.assert_allclose(found[0][:, -20:], found[0][:, :20], atol=1e-4)


def snapshot(reach: float) -> Snapshot:
    nodes = NODES[:8]
    moves = np.arange(1, HORIZONS + 1, dtype=np.float32)[:, None, None] * np.full((8, 3), 1e-3, np.float32)
    forecast = Forecast(
        MotionState(None, 0.9, reach), FRAME_S, nodes, moves,
        np.zeros((5, 4), np.int32), np.full((5, 4), 0.25, np.float32),
    )  # fmt: skip
    gaussians = round_gaussians(np.zeros((5, 3), np.float32), 1.0)
    camera = Camera(64, 48, np.eye(3), np.eye(4))
    return Snapshot(0, 0, 0, gaussians, np.zeros((5, 3), np.float32), camera, 0.0, forecast=forecast)


def test_nothing_is_moved_further_than_there_is_skill_for() -> None:
    made = snapshot(reach=2 * FRAME_S)
    assert reached(made, 1.0) == pytest.approx(2 * FRAME_S) and reached(made, -1.0) == 0
    assert reached(snapshot(0.0), 1.0) == 0
    seconds = reached(made, 1.5 * FRAME_S)
    moved = gaussians_ahead(made, seconds)
    np.testing.assert_allclose(moved.means, 1.5e-3, rtol=1e-4)
    assert made.gaussians.means.max() == 0  # the snapshot stays as it was
    assert made.forecast is not None
    points = np.array([[0.0, 0.0, 0.0], [np.nan] * 3])
    ahead = points_ahead(made.forecast, points, seconds)
    np.testing.assert_allclose(ahead[0], 1.5e-3, rtol=1e-4)
    assert np.isnan(ahead[1]).all()


def test_motion_is_remembered_once_somebody_wants_it_predicted() -> None:
    """What nobody asks for costs nothing; and `mapping.field:=false` forbids it."""
    expected = {"null": [False, True], "false": [False, False], "true": [True, True]}
    for said, found in expected.items():
        pipeline, forecasts = fresh("mapping.max_gaussians:=2000", f"mapping.field:={said}"), []
        for number, frame in enumerate(frames_of(opened("source.frames:=20"))):
            if number == 10:
                pipeline.predict_motion()
            forecasts.append(pipeline.process(frame, StepBudget(1)).snapshot.forecast is not None)
        assert [any(forecasts[:10]), any(forecasts[10:])] == found, said
