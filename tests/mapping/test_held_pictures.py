"""A bad image is not a new scene: the model waits, says why, and is the same afterwards."""

import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from recorded_session import both, frames_of, opened, play, psnr

from sags_node.confidence import HALVING, SURE
from sags_node.errors import SagsError
from sags_node.mapping.budget import StepBudget
from sags_node.messaging.content import OF_THE_MODEL, tells_of
from sags_node.node.allowance import Allowance
from sags_node.node.health import WAITING_AFTER
from sags_node.node.operations import NodeState, Operations
from sags_node.node.views import Views
from sags_node.pipeline.pipeline import Pipeline
from sags_node.pipeline.session import Session
from sags_node.types import U8, DrawnView, Finding, FrameResult, StereoFrame
from sags_node.vision.watch.match_watch import MatchWatch

FIRST, COUNT, AFTER = 8, 8, 11  # frames, at 10 Hz: before, with the fault, and until the tenth after it
WITHIN = 5  # frames: half a second


@pytest.fixture(scope="module")
def session() -> Session:
    return opened("mapping.max_gaussians:=4000")


@pytest.fixture(scope="module")
def frames(session: Session) -> list[StereoFrame]:
    return frames_of(session)[: FIRST + COUNT + AFTER]


def bleeding(picture: U8) -> np.ndarray:
    covered = picture.astype(np.float32)
    half = len(picture) // 2
    covered[half:] = 0.05 * covered[half:] + 0.95 * np.array([95, 8, 8], np.float32)
    return covered


def black(picture: U8 | None) -> U8:
    return np.zeros_like(picture)


Spoil = Callable[[StereoFrame, int], StereoFrame]
FAULTS: dict[str, tuple[Spoil, str]] = {
    "right_eye_black": (lambda f, i: replace(f, right=black(f.right)), "depth"),
    "left_eye_black": (lambda f, i: replace(f, left=black(f.left)), "picture"),
    "eyes_exchanged": (lambda f, i: replace(f, left=f.right, right=f.left), "picture"),
    "eyes_equal": (lambda f, i: replace(f, right=f.left), "depth"),
    "picture_unknown_scene": (lambda f, i: both(f, lambda p: 255 - p[::-1]), "picture"),
    "picture_bright": (lambda f, i: both(f, lambda p: p * 4.0), "picture"),
    "picture_smoke": (lambda f, i: both(f, lambda p: p * 0.3 + 120.0), ""),
    "picture_covered": (lambda f, i: both(f, bleeding), ""),
    "": (lambda f, i: both(f, lambda p: p * (3.0 if i % 2 else 1 / 3)), ""),  # flicker is no event
}


@pytest.fixture(scope="module")
def clean(session: Session, frames: list[StereoFrame]) -> list[FrameResult]:
    results, codes, pipeline = play(session, frames)
    assert set().union(*codes) == set() and pipeline.map.restarts == 0
    assert not any(result.held or result.skipped for result in results)
    return results


def leaves_no_trace(results: list[FrameResult], clean: list[FrameResult]) -> bool:
    """Whether the model and its image are in the end what they were before, and would have been."""
    kept = np.isin(clean[FIRST - 1].snapshot.gaussians.ids, results[-1].snapshot.gaussians.ids)
    as_good = psnr(results[-1], clean[-1].observation) > psnr(clean[-1]) - 1.0
    return results[-1].epoch == 0 and bool(kept.mean() > 0.8) and as_good


@pytest.mark.fault("image: the right eye is black")
@pytest.mark.fault("image: the left eye is black")
@pytest.mark.fault("image: the eyes are exchanged")
@pytest.mark.fault("image: one eye twice")
@pytest.mark.fault("image: of another scene")
@pytest.mark.fault("image: far too bright")
@pytest.mark.fault("image: smoke")
@pytest.mark.fault("image: blood")
@pytest.mark.parametrize("code", FAULTS)
def test_a_fault_is_said_and_leaves_no_trace(
    code: str, session: Session, frames: list[StereoFrame], clean: list[FrameResult]
) -> None:
    spoil, what = FAULTS[code]
    during = range(FIRST, FIRST + COUNT)
    given = [spoil(frame, i) if i in during else frame for i, frame in enumerate(frames)]
    results, codes, _ = play(session, given)
    if code:
        assert any(code in codes[i] for i in range(FIRST, FIRST + WITHIN))
    assert not set().union(*codes[:FIRST], *codes[during.stop + WITHIN :])
    if what:
        assert all(what in results[i].skipped for i in during)
        assert all(bool(results[i].held) == (what == "picture") for i in during)
    for i in during:  # of a frame that is held nothing is measured, and nothing old is said to be
        assert not results[i].skipped.get(what, "") or not results[i].observation.depth.any()
    assert leaves_no_trace(results, clean)


def frozen(frames: list[StereoFrame], during: range) -> list[StereoFrame]:
    """The frames as a camera gives them; in `during` the images of the one before, under new stamps."""
    last = frames[during.start - 1]
    shown = [both(last, np.array) if i in during else frame for i, frame in enumerate(frames)]
    return [
        replace(frame, left=eyes.left, right=eyes.right, t_arrival_ns=frame.t_capture_ns + 1)
        for frame, eyes in zip(frames, shown, strict=True)
    ]


@pytest.mark.fault("image: both eyes of a live feed are frozen")
def test_a_live_feed_that_freezes_is_held_and_said(
    session: Session, frames: list[StereoFrame], clean: list[FrameResult]
) -> None:
    during = range(FIRST, FIRST + COUNT)
    results, codes, _ = play(session, frozen(frames, during))
    said = [i for i, found in enumerate(codes) if "picture_frozen" in found]
    held = [i for i, result in enumerate(results) if result.held]
    assert said == held == list(range(FIRST + 2, during.stop))  # 10 Hz: unchanged for 0.3 s then
    assert all(not tells_of(results[i], topic) for i in held for topic in OF_THE_MODEL)
    doubts = [np.median(result.snapshot.gaussians.depth_errors) for result in results]
    assert all(np.diff(doubts[held[0] - 1 : held[-1] + 1]) > 0)
    assert leaves_no_trace(results, clean)


@pytest.mark.fault("image: both eyes of a live feed are frozen, and an anchor is pinned")
def test_a_pixel_of_a_picture_that_is_held_is_not_pinned(session: Session, frames: list[StereoFrame]) -> None:
    pipeline = Pipeline(session.config, session.rig)
    operations = Operations(NodeState(session.config, pipeline, None, None, ""), lambda *_: None)  # type: ignore[arg-type]

    def pin(**place: float) -> dict[str, Any]:
        asked = operations.handlers()["add_anchor"](place)
        operations.for_mapping.serve()
        return dict(asked.result(0))

    for i, frame in enumerate(frozen(frames, range(FIRST, FIRST + COUNT))[: FIRST + COUNT]):
        result = pipeline.process(frame, StepBudget(2))
        if i == FIRST:
            assert pin(u=160, v=128)
    assert result.held
    with pytest.raises(SagsError, match=r"frames are held: the same image comes again.*pin when"):
        pin(u=160, v=128)
    x, y, z = result.snapshot.gaussians.means[0].tolist()
    assert pin(x=x, y=y, z=z)["depth_confidence"] < 0.05  # 0.8 s at 20 mm/s: five times what halves it


@pytest.mark.fault("image: both eyes of a live feed are frozen, and a view is opened")
@pytest.mark.parametrize("why", ["held", "paused", "no frame comes"])
def test_a_view_that_is_opened_while_nothing_new_is_seen_waits(
    session: Session, frames: list[StereoFrame], monkeypatch: pytest.MonkeyPatch, why: str
) -> None:
    pipeline, shown = Pipeline(session.config, session.rig), list[tuple[str, DrawnView | None]]()
    state = NodeState(session.config, pipeline, None, Views(Allowance()), "")  # type: ignore[arg-type]
    operations = Operations(state, lambda name, drawn: shown.append((name, drawn)))

    def ask(operation: str, **args: Any) -> dict[str, Any]:
        asked = operations.handlers()[operation](args)
        operations.for_mapping.serve()
        operations.for_drawing.serve()
        return dict(asked.result(0))

    def process(frame: StereoFrame) -> FrameResult:
        result = pipeline.process(frame, StepBudget(2))
        state.statistics.add(result, 40.0, {})
        return result

    *given, later = frozen(frames[: FIRST + COUNT + 1], range(FIRST, FIRST + COUNT))
    for frame in given[: FIRST + COUNT if why == "held" else FIRST]:
        process(frame)
        if frame is given[1]:
            assert ask("open_view", name="once", static=True)["draw_ms"] > 0
            (name, drawn), *more = shown
            assert drawn is not None and drawn.eyes[""].t_capture_ns == frame.t_capture_ns
            assert (name, more) == ("once", [])
    shown.clear()
    if why == "paused":
        ask("pause")
    if why == "no frame comes":
        now = time.monotonic()
        monkeypatch.setattr(time, "monotonic", lambda: now + WAITING_AFTER + 1)
    assert "waits for a frame" in ask("open_view", name="once", static=True, fov=40)["limited_by"]
    assert "waits for a frame" in ask("open_view", name="often")["limited_by"]
    assert shown == [("once", None), ("often", None)], "what was drawn before is not sent again"
    if why == "paused":
        ask("resume")
        ask("open_view", name="early", static=True)  # before a frame has come
        assert shown[2:] == [("early", None)]
    result = process(later)
    assert not result.held
    drawn_now = dict(state.views.draw_due(result, set()))
    assert drawn_now.keys() == {"once", "often", *(["early"] if why == "paused" else [])}
    assert {one.eyes[""].t_capture_ns for one in drawn_now.values()} == {later.t_capture_ns}


def test_a_model_made_of_a_frozen_picture_is_not_shown(session: Session, frames: list[StereoFrame]) -> None:
    """A reset while the feed is frozen: the image is old, whatever the model."""
    given = frozen(frames[: FIRST + COUNT + 1], range(FIRST, FIRST + COUNT))
    pipeline, budget = Pipeline(session.config, session.rig), StepBudget(2)
    for i, frame in enumerate(given):
        if i == FIRST + 4:
            pipeline.reset()
        result = pipeline.process(frame, budget)
        assert bool(result.held) == (FIRST + 2 <= i < FIRST + COUNT)
    assert result.epoch == 1 and "frame" not in result.skipped


@pytest.mark.fault("frames: a fifth is lost")
def test_lost_frames_are_no_fault_of_the_others(
    session: Session, frames: list[StereoFrame], clean: list[FrameResult]
) -> None:
    lost = np.random.default_rng(0).permutation(range(1, len(frames) - 1))[: len(frames) // 5]
    results, codes, pipeline = play(session, [f for i, f in enumerate(frames) if i not in lost])
    assert set().union(*codes) == set() and pipeline.map.restarts == 0
    stamps = [frame.t_capture_ns for i, frame in enumerate(frames) if i not in lost]
    assert [result.views["left"].t_capture_ns for result in results] == stamps
    assert not any(result.held for result in results)
    assert psnr(results[-1], clean[-1].observation) > psnr(clean[-1]) - 1.0


def test_what_nobody_watches_is_less_sure(session: Session, frames: list[StereoFrame]) -> None:
    """Depth and anchors of a model that waits: tissue may be pulled meanwhile. A second later at most
    a tenth of what is measured is in doubt."""
    pipeline = Pipeline(session.config, session.rig)
    before = [pipeline.process(frame, StepBudget(2)) for frame in frames[:FIRST]][-1]
    pipeline.anchors.add_pixel(160, 100, before.observation, before.snapshot, before.views["left"])
    sure, errors, held = [], [], []
    for frame in frames[FIRST : FIRST + COUNT]:
        held.append(pipeline.process(replace(frame, left=black(frame.left)), StepBudget(2)))
        view, gaussians = held[-1].views["left"], held[-1].snapshot.gaussians
        assert view.confidence is not None and gaussians.depth_errors is not None
        assert ((view.depth > 0) == (view.confidence > 0)).all()
        sure.append(float((view.confidence >= SURE).mean()))
        errors.append(float(np.median(gaussians.depth_errors)))
    assert all(result.held for result in held)
    assert np.all(np.diff(errors) > 0)
    assert sure[-1] == 0 and sure[0] > 0  # 8 frames of 100 ms at 20 mm/s: 16 mm
    assert held[-1].anchors.confidence[0] < SURE
    after = [pipeline.process(frame, StepBudget(2)) for frame in frames[FIRST + COUNT :]][-1]
    shares = []
    for result in (before, after):
        confidence, measured = result.views["left"].confidence, result.observation.depth > 0
        assert confidence is not None and measured.mean() > 0.3
        shares.append(float((confidence[measured] >= SURE).mean()))
    assert shares[1] > 0.9 * shares[0]


def test_blood_is_seen_where_the_scene_has_its_colour_already(
    session: Session, frames: list[StereoFrame]
) -> None:
    """It rises slowly, and a corner of the image was as red before."""

    def corner(picture: U8) -> U8:
        marked = picture.copy()
        marked[: len(picture) // 6, -picture.shape[1] // 6 :] = (95, 8, 8)
        return marked

    def rising(picture: U8, share: float) -> U8:
        covered = picture.copy()
        covered[round(len(picture) * (1 - share)) :] = (95, 8, 8)
        return covered

    given = [both(frame, corner) for frame in frames[: FIRST + COUNT]]
    for i in range(FIRST, FIRST + COUNT):
        given[i] = both(given[i], lambda picture, i=i: rising(picture, 0.05 * (i - FIRST + 1)))
    _, codes, pipeline = play(session, given)
    assert not set().union(*codes[:FIRST])
    assert any("picture_covered" in code for code in codes[FIRST : FIRST + WITHIN])
    assert pipeline.map.restarts == 0


@pytest.mark.fault("image: one eye is late (simulated)")
def test_what_was_measured_before_a_late_eye_was_noticed_is_doubted_once(
    session: Session, frames: list[StereoFrame], monkeypatch: pytest.MonkeyPatch
) -> None:
    pipeline = Pipeline(session.config, session.rig)
    errors = []
    for i, frame in enumerate(frames[: FIRST + 4]):
        if i == FIRST:
            monkeypatch.setattr(MatchWatch, "__call__", lambda *_: "one eye is late")
        result = pipeline.process(frame, StepBudget(2))
        assert bool(result.skipped.get("depth")) == (i >= FIRST)
        errors.append(float(np.median(result.snapshot.gaussians.depth_errors)))
    steps = np.diff(errors[FIRST - 1 :])
    assert steps[0] >= HALVING  # m: what is so unsure is half as sure
    assert (steps[1:] < HALVING / 3).all()  # 10 Hz: what tissue moves by unseen


def test_a_frame_without_its_pose_is_shown_by_no_new_model(
    session: Session, frames: list[StereoFrame]
) -> None:
    """Also when the model is reset meanwhile: then the next frame that has its pose makes the new one."""
    pipeline = Pipeline(session.config, session.rig)
    problem = Finding("pose_stopped", "no pose comes")
    first = pipeline.process(frames[0], StepBudget(2))
    held = pipeline.process(replace(frames[1], pose_problem=problem), StepBudget(2))
    pipeline.reset()
    after_reset = pipeline.process(replace(frames[2], pose_problem=problem), StepBudget(2))
    for result in (held, after_reset):
        assert result.held == problem.text and result.epoch == first.epoch
        assert result.views["left"].rgb is first.views["left"].rgb
    again = pipeline.process(frames[3], StepBudget(2))
    assert not again.held and again.epoch == first.epoch + 1


def test_where_no_frame_comes_depth_is_doubted_as_where_none_is_taken_in(
    session: Session, frames: list[StereoFrame]
) -> None:
    """A camera that is away for 0.8 s, and then one eye alone: nothing was measured since."""
    last = replace(frames[FIRST + COUNT], right=black(frames[FIRST + COUNT].right))
    for gone, doubted in ((0, False), (COUNT, True)):
        there = frames[: FIRST + COUNT - gone]
        results, _, _ = play(session, [*there, last])
        before, after = (np.median(each.snapshot.gaussians.depth_errors) for each in results[-2:])
        assert (after > before + 0.9 * 0.016) == doubted  # m: 0.8 s at 20 mm/s


@pytest.mark.fault("camera: its rate falls to a quarter, as in the dark")
def test_depth_is_as_sure_as_ever_at_a_rate_that_has_fallen(
    session: Session, frames: list[StereoFrame]
) -> None:
    """Half of the steps that are remembered are long after eight frames: then they are usual."""
    sure = []
    for first in (30.0, 7.5):  # Hz
        steps = [1 / first] * FIRST + [1 / 7.5] * (COUNT + AFTER)
        stamps = (10**18 + np.rint(1e9 * np.cumsum(steps)).astype(np.int64)).tolist()
        given = [replace(frame, t_capture_ns=ns) for frame, ns in zip(frames, stamps, strict=True)]
        last = play(session, given)[0][-1]
        confidence, tissue = last.views["left"].confidence, last.observation.tissue
        assert confidence is not None
        sure.append(float((confidence[tissue] >= SURE).mean()))
    fallen, always = sure
    assert always > 0.5 and fallen > 0.9 * always


@pytest.mark.fault("image: of another scene, before and after a gap")
@pytest.mark.parametrize("between", ["black", "nothing"])
def test_another_scene_has_not_lasted_while_nobody_looked(
    between: str, session: Session, frames: list[StereoFrame]
) -> None:
    """One frame of it, nothing to be seen for four seconds, and one more: the model stays."""
    spoil, _ = FAULTS["picture_unknown_scene"]
    there, back = frames[:FIRST], frames[FIRST : FIRST + 2]
    other, dark = spoil(frames[FIRST], 0), both(frames[FIRST], np.zeros_like)
    given = [*there, other, *([dark] * (40 if between == "black" else 0)), other, *back]
    seconds = [0.1] * len(given)
    if between == "nothing":
        seconds[FIRST + 1] = 4.0
    stamps = (10**18 + np.rint(1e9 * np.cumsum(seconds)).astype(np.int64)).tolist()
    given = [replace(frame, t_capture_ns=ns) for frame, ns in zip(given, stamps, strict=True)]
    results, _, pipeline = play(session, given)
    assert pipeline.map.restarts == 0 and all(result.held for result in results[FIRST:-2])
    assert not results[-1].held


@pytest.mark.fault("clock: set back while frames are held")
def test_what_nobody_watched_is_doubted_whatever_the_clock_says(
    session: Session, frames: list[StereoFrame]
) -> None:
    """Black for 0.8 s, then one eye alone: nothing is measured. A step back counts for no time: it lacks
    0.1 s."""
    last = replace(frames[FIRST + COUNT], right=black(frames[FIRST + COUNT].right))
    given = [*frames[:FIRST], *(both(f, np.zeros_like) for f in frames[FIRST : FIRST + COUNT]), last]
    medians = []
    for back in (0, 60 * 10**9):
        turned = [
            replace(frame, t_capture_ns=frame.t_capture_ns - back, epoch=1) if i >= FIRST + 4 else frame
            for i, frame in enumerate(given)
        ]
        results, _, _ = play(session, turned)
        medians.append([np.median(result.snapshot.gaussians.depth_errors) for result in results[-2:]])
    kept, turned_back = np.array(medians)
    assert (kept > 0.016).all() and (turned_back > 0.014).all()  # m: at 20 mm/s


@pytest.mark.fault("clock: set back while strain is measured")
def test_the_seconds_of_strain_go_on_when_the_clock_is_set_back(
    session: Session, frames: list[StereoFrame]
) -> None:
    pipeline, seconds = Pipeline(session.config, session.rig), []
    hour, (first, second, third) = 3600 * 10**9, frames[:3]
    pipeline.process(first, StepBudget(2))
    pipeline.start_strain()
    again = replace(second, frame_id=7, t_capture_ns=second.t_capture_ns - hour)  # it repeats the one before
    for frame in (second, again, replace(third, t_capture_ns=third.t_capture_ns - hour)):
        result = pipeline.process(frame, StepBudget(2))
        assert result.strain is not None
        seconds.append(1e-9 * (result.snapshot.t_capture_ns - result.strain.since_ns))
        if frame is again:
            pipeline.start_strain()
    np.testing.assert_allclose(seconds, [0.1, 0.1, 0.1], atol=1e-3)
