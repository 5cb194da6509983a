"""A bad image is not a new scene: the model waits, says why, and is the same afterwards."""

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
import recorded_session
from recorded_session import Frames, both, frames_of, fresh, opened, psnr

from sags_node.confidence import HALVING, SURE
from sags_node.errors import SagsError
from sags_node.mapping.budget import StepBudget
from sags_node.messaging.content import OF_THE_MODEL, tells_of
from sags_node.node.allowance import Allowance
from sags_node.node.health import WAITING_AFTER
from sags_node.node.operations import NodeState, Operations
from sags_node.node.views import Views
from sags_node.pipeline.pipeline import Pipeline
from sags_node.types import U8, Bool, DrawnView, Finding, FrameResult, StereoFrame
from sags_node.vision.watch.match_watch import MatchWatch

FEW = "mapping.max_gaussians:=4000"
FIRST, COUNT, AFTER = 8, 8, 11  # frames, at 10 Hz: before, with the fault, and until the tenth after it
WITHIN = 5  # frames: half a second
DURING = range(FIRST, FIRST + COUNT)
MINUTE = 60 * 10**9  # ns
SPEED = 0.020  # m/s, at which tissue that nobody sees may move


@pytest.fixture(scope="module")
def frames() -> Frames:
    return frames_of(opened())[: FIRST + COUNT + AFTER]


@pytest.fixture
def pipeline() -> Pipeline:
    return fresh(FEW)


def play(frames: Frames) -> tuple[list[FrameResult], list[set[str]], Pipeline]:
    return recorded_session.play(opened(FEW), frames)


def process(pipeline: Pipeline, frames: Iterable[StereoFrame]) -> list[FrameResult]:
    return [pipeline.process(frame, StepBudget(2)) for frame in frames]


def at_steps(frames: Frames, seconds: list[float]) -> Frames:
    """The frames, each so long after the one before."""
    stamps = (10**18 + np.rint(1e9 * np.cumsum(seconds)).astype(np.int64)).tolist()
    return [replace(frame, t_capture_ns=ns) for frame, ns in zip(frames, stamps, strict=True)]


def doubts(results: list[FrameResult]) -> np.ndarray:
    """How far off depth may be, frame by frame, m."""
    return np.array([np.median(result.snapshot.gaussians.depth_errors) for result in results])


def sure(result: FrameResult, where: Bool) -> float:
    """The share of what is drawn there whose depth is sure."""
    confidence = result.views["left"].confidence
    assert confidence is not None
    return float((confidence[where] >= SURE).mean())


def bleeding(picture: U8) -> np.ndarray:
    covered = picture.astype(np.float32)
    half = len(picture) // 2
    covered[half:] = 0.05 * covered[half:] + 0.95 * np.array([95, 8, 8], np.float32)
    return covered


def black(picture: U8 | None) -> U8:
    return np.zeros_like(picture)


def noise(picture: U8) -> np.ndarray:
    return np.random.default_rng(0).integers(0, 256, picture.shape)


Spoil = Callable[[StereoFrame, int], StereoFrame]
# What is done to a frame, the warning that it gives, and what of the frame is not taken in.
FAULTS: dict[str, tuple[Spoil, str, str]] = {
    "right eye black": (lambda f, i: replace(f, right=black(f.right)), "right_eye_black", "depth"),
    "left eye black": (lambda f, i: replace(f, left=black(f.left)), "left_eye_black", "picture"),
    "both black": (lambda f, i: both(f, black), "left_eye_black", "picture"),
    "eyes exchanged": (lambda f, i: replace(f, left=f.right, right=f.left), "eyes_exchanged", "picture"),
    "eyes equal": (lambda f, i: replace(f, right=f.left), "eyes_equal", "depth"),
    "unknown scene": (lambda f, i: both(f, lambda p: 255 - p[::-1]), "picture_unknown_scene", "picture"),
    "bright": (lambda f, i: both(f, lambda p: p * 4.0), "picture_bright", "picture"),
    "white": (lambda f, i: both(f, lambda p: 0 * p + 255), "", "picture"),
    "grey": (lambda f, i: both(f, lambda p: 0 * p + 128), "", "picture"),
    "noise": (lambda f, i: both(f, noise), "", "picture"),
    "smoke": (lambda f, i: both(f, lambda p: p * 0.3 + 120.0), "picture_smoke", ""),
    "covered": (lambda f, i: both(f, bleeding), "picture_covered", ""),
    "all instrument": (lambda f, i: replace(f, tissue=np.zeros(f.left.shape[:2], bool)), "", ""),
    "a mask that misses the instruments": (lambda f, i: replace(f, tissue=np.ones_like(f.tissue)), "", ""),
    "flicker is no event": (lambda f, i: both(f, lambda p: p * (3.0 if i % 2 else 1 / 3)), "", ""),
}


@pytest.fixture(scope="module")
def clean(frames: Frames) -> list[FrameResult]:
    results, codes, pipeline = play(frames)
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
@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_is_said_and_leaves_no_trace(name: str, frames: Frames, clean: list[FrameResult]) -> None:
    spoil, code, what = FAULTS[name]
    given = [spoil(frame, i) if i in DURING else frame for i, frame in enumerate(frames)]
    results, codes, _ = play(given)
    if code:
        assert any(code in codes[i] for i in range(FIRST, FIRST + WITHIN))
    assert not set().union(*codes[:FIRST], *codes[DURING.stop + WITHIN :])
    if what:
        assert all(what in results[i].skipped for i in DURING)
        assert all(bool(results[i].held) == (what == "picture") for i in DURING)
    for i in DURING:  # of a frame that is held nothing is measured, and nothing old is said to be
        assert not results[i].skipped.get(what, "") or not results[i].observation.depth.any()
    assert leaves_no_trace(results, clean)


@pytest.mark.fault("image: the first one is black, noise or all instrument")
@pytest.mark.parametrize("name", ["both black", "noise", "all instrument"])
def test_an_unusable_first_picture_only_delays_the_start(name: str, frames: Frames) -> None:
    spoiled = FAULTS[name][0](frames[0], 0)
    assert psnr(play([spoiled, *frames[1:6]])[0][-1]) > 28


@pytest.mark.fault("image: another scene for three seconds")
def test_a_cut_begins_a_new_model_in_a_new_epoch(frames: Frames) -> None:
    """Another scene in front of the same cameras: here, the negative of the first."""
    negative = [both(frame, lambda eye: 255 - eye) for frame in frames[4:7]]
    given = [*frames[:4], *[negative[0]] * 30, *negative[1:]]
    results, _, _ = play(at_steps(given, [0.1] * len(given)))
    before, *during, _, after = results[3:]
    assert {result.epoch for result in during} == {before.epoch} and all(result.held for result in during)
    assert after.epoch == before.epoch + 1 and not after.held
    assert psnr(after) > 30
    assert before.snapshot.gaussians.ids.max() < after.snapshot.gaussians.ids.min()


def frozen(frames: Frames) -> Frames:
    """As a camera gives them; in `DURING` the images of the one before, under new stamps."""
    shown = [both(frames[FIRST - 1] if i in DURING else frame, np.array) for i, frame in enumerate(frames)]
    return [
        replace(frame, left=eyes.left, right=eyes.right, t_arrival_ns=frame.t_capture_ns + 1)
        for frame, eyes in zip(frames, shown, strict=True)
    ]


@pytest.mark.fault("image: both eyes of a live feed are frozen")
def test_a_live_feed_that_freezes_is_held_and_said(frames: Frames, clean: list[FrameResult]) -> None:
    results, codes, _ = play(frozen(frames))
    said = [i for i, found in enumerate(codes) if "picture_frozen" in found]
    held = [i for i, result in enumerate(results) if result.held]
    assert said == held == list(range(FIRST + 2, DURING.stop))  # 10 Hz: unchanged for 0.3 s then
    assert all(not tells_of(results[i], topic) for i in held for topic in OF_THE_MODEL)
    assert all(np.diff(doubts(results)[held[0] - 1 : held[-1] + 1]) > 0)
    assert leaves_no_trace(results, clean)


@dataclass
class Node:
    """Operations that are carried out at once, as between two frames."""

    pipeline: Pipeline

    def __post_init__(self) -> None:
        self.shown: list[tuple[str, DrawnView | None]] = []
        config, views = opened().config, Views(Allowance())
        self.state = NodeState(config, self.pipeline, None, views, "")  # type: ignore[arg-type]
        self.operations = Operations(self.state, lambda name, drawn: self.shown.append((name, drawn)))

    def ask(self, operation: str, **args: Any) -> dict[str, Any]:
        asked = self.operations.handlers()[operation](args)
        self.operations.for_mapping.serve()
        self.operations.for_drawing.serve()
        return dict(asked.result(0))

    def take(self, frame: StereoFrame) -> FrameResult:
        (result,) = process(self.pipeline, [frame])
        self.state.statistics.add(result, 40.0, {})
        return result


@pytest.mark.fault("image: both eyes of a live feed are frozen, and an anchor is pinned")
def test_a_pixel_of_a_picture_that_is_held_is_not_pinned(pipeline: Pipeline, frames: Frames) -> None:
    node, given = Node(pipeline), frozen(frames)[: DURING.stop]
    for frame in given[: FIRST + 1]:
        node.take(frame)
    assert node.ask("add_anchor", u=160, v=128)
    for frame in given[FIRST + 1 :]:
        result = node.take(frame)
    assert result.held
    with pytest.raises(SagsError, match=r"frames are held: the same image comes again.*pin when"):
        node.ask("add_anchor", u=160, v=128)
    x, y, z = result.snapshot.gaussians.means[0].tolist()
    depth_confidence = node.ask("add_anchor", x=x, y=y, z=z)["depth_confidence"]
    assert depth_confidence < 0.05  # 0.8 s at 20 mm/s: five times what halves it


@pytest.mark.fault("image: both eyes of a live feed are frozen, and a view is opened")
@pytest.mark.parametrize("why", ["held", "paused", "no frame comes"])
def test_a_view_that_is_opened_while_nothing_new_is_seen_waits(
    pipeline: Pipeline, frames: Frames, monkeypatch: pytest.MonkeyPatch, why: str
) -> None:
    node, (*given, later) = Node(pipeline), frozen(frames[: DURING.stop + 1])
    for frame in given[:2]:
        node.take(frame)
    assert node.ask("open_view", name="once", static=True)["draw_ms"] > 0
    ((name, drawn),) = node.shown
    assert name == "once" and drawn is not None and drawn.eyes[""].t_capture_ns == given[1].t_capture_ns
    for frame in given[2 : DURING.stop if why == "held" else FIRST]:
        node.take(frame)
    node.shown.clear()
    if why == "paused":
        node.ask("pause")
    if why == "no frame comes":
        now = time.monotonic()
        monkeypatch.setattr(time, "monotonic", lambda: now + WAITING_AFTER + 1)
    for view in ({"name": "once", "static": True, "fov": 40}, {"name": "often"}):
        assert "waits for a frame" in node.ask("open_view", **view)["limited_by"]
    assert node.shown == [("once", None), ("often", None)], "what was drawn before is not sent again"
    if why == "paused":
        node.ask("resume")
        node.ask("open_view", name="early", static=True)  # before a frame has come
        assert node.shown[2:] == [("early", None)]
    result = node.take(later)
    assert not result.held
    drawn_now = dict(node.state.views.draw_due(result, set()))
    assert drawn_now.keys() == {"once", "often", *(["early"] if why == "paused" else [])}
    assert {one.eyes[""].t_capture_ns for one in drawn_now.values()} == {later.t_capture_ns}


def test_a_model_made_of_a_frozen_picture_is_not_shown(pipeline: Pipeline, frames: Frames) -> None:
    """A reset while the feed is frozen: the image is old, whatever the model."""
    given = frozen(frames[: DURING.stop + 1])
    results = process(pipeline, given[: FIRST + 4])
    pipeline.reset()
    results += process(pipeline, given[FIRST + 4 :])
    assert [i for i, result in enumerate(results) if result.held] == list(range(FIRST + 2, DURING.stop))
    assert results[-1].epoch == 1 and "frame" not in results[-1].skipped


@pytest.mark.fault("frames: a fifth is lost")
def test_lost_frames_are_no_fault_of_the_others(frames: Frames, clean: list[FrameResult]) -> None:
    lost = np.random.default_rng(0).permutation(range(1, len(frames) - 1))[: len(frames) // 5]
    results, codes, pipeline = play([f for i, f in enumerate(frames) if i not in lost])
    assert set().union(*codes) == set() and pipeline.map.restarts == 0
    stamps = [frame.t_capture_ns for i, frame in enumerate(frames) if i not in lost]
    assert [result.views["left"].t_capture_ns for result in results] == stamps
    assert not any(result.held for result in results)
    assert psnr(results[-1], clean[-1].observation) > psnr(clean[-1]) - 1.0


def test_what_nobody_watches_is_less_sure(pipeline: Pipeline, frames: Frames) -> None:
    """Depth and anchors of a model that waits: tissue may be pulled meanwhile. A second later at most
    a tenth of what is measured is in doubt."""
    before = process(pipeline, frames[:FIRST])[-1]
    pipeline.anchors.add_pixel(160, 100, before.observation, before.snapshot, before.views["left"])
    held = process(pipeline, (replace(frames[i], left=black(frames[i].left)) for i in DURING))
    everywhere = np.ones_like(before.observation.tissue)
    for view in (result.views["left"] for result in held):
        assert np.array_equal(view.depth > 0, view.confidence > 0)
    assert all(result.held for result in held) and np.all(np.diff(doubts(held)) > 0)
    assert sure(held[0], everywhere) > 0
    assert sure(held[-1], everywhere) == 0  # 8 frames of 100 ms at 20 mm/s: 16 mm
    assert held[-1].anchors.confidence[0] < SURE
    after = process(pipeline, frames[DURING.stop :])[-1]
    assert all((each.observation.depth > 0).mean() > 0.3 for each in (before, after))
    assert sure(after, after.observation.depth > 0) > 0.9 * sure(before, before.observation.depth > 0)


def test_blood_is_seen_where_the_scene_has_its_colour_already(frames: Frames) -> None:
    """It rises slowly, and a corner of the image was as red before."""

    def bloody(picture: U8, share: float) -> U8:
        height, width = picture.shape[:2]
        covered = picture.copy()
        covered[: height // 6, -width // 6 :] = covered[round(height * (1 - share)) :] = (95, 8, 8)
        return covered

    risen = [0.05 * max(0, i - FIRST + 1) for i in range(DURING.stop)]
    given = [
        both(frame, lambda eye, share=share: bloody(eye, share))
        for frame, share in zip(frames, risen, strict=False)
    ]
    _, codes, pipeline = play(given)
    assert not set().union(*codes[:FIRST])
    assert any("picture_covered" in code for code in codes[FIRST : FIRST + WITHIN])
    assert pipeline.map.restarts == 0


@pytest.mark.fault("image: one eye is late (simulated)")
def test_what_was_measured_before_a_late_eye_was_noticed_is_doubted_once(
    pipeline: Pipeline, frames: Frames, monkeypatch: pytest.MonkeyPatch
) -> None:
    results = process(pipeline, frames[:FIRST])
    monkeypatch.setattr(MatchWatch, "__call__", lambda *_: "one eye is late")
    results += process(pipeline, frames[FIRST : FIRST + 4])
    assert [bool(result.skipped.get("depth")) for result in results] == [False] * FIRST + [True] * 4
    steps = np.diff(doubts(results)[FIRST - 1 :])
    assert steps[0] >= HALVING  # m: what is so unsure is half as sure
    assert (steps[1:] < HALVING / 3).all()  # 10 Hz: what tissue moves by unseen


def test_a_frame_without_its_pose_is_shown_by_no_new_model(pipeline: Pipeline, frames: Frames) -> None:
    """Also when the model is reset meanwhile: then the next frame that has its pose makes the new one."""
    problem = Finding("pose_stopped", "no pose comes")
    lost = [replace(frame, pose_problem=problem) for frame in frames[1:3]]
    first, held = process(pipeline, [frames[0], lost[0]])
    pipeline.reset()
    after_reset, again = process(pipeline, [lost[1], frames[3]])
    for result in (held, after_reset):
        assert result.held == problem.text and result.epoch == first.epoch
        assert result.views["left"].rgb is first.views["left"].rgb
    assert not again.held and again.epoch == first.epoch + 1


@pytest.mark.fault("clock: set back while frames are held")
@pytest.mark.parametrize(
    ("meanwhile", "set_back", "unseen"),
    [
        (lambda frame: [frame], 0, 0.0),
        (lambda frame: [], 0, 0.8),
        (lambda frame: [both(frame, black)], 0, 0.8),
        (lambda frame: [both(frame, black)], MINUTE, 0.7),  # a step back counts for no time: it lacks 0.1 s
    ],
    ids=["nothing happens", "no frame comes", "all is black", "all is black, and the clock is set back"],
)
def test_after_seconds_in_which_nothing_was_measured_depth_is_in_doubt(
    frames: Frames, meanwhile: Callable[[StereoFrame], Frames], set_back: int, unseen: float
) -> None:
    """One eye alone comes after them: it measures nothing either."""
    given = [*frames[:FIRST], *(shown for i in DURING for shown in meanwhile(frames[i]))]
    given.append(replace(frames[DURING.stop], right=black(frames[DURING.stop].right)))
    for i in range(FIRST + 4 if set_back else len(given), len(given)):
        given[i] = replace(given[i], t_capture_ns=given[i].t_capture_ns - set_back, epoch=1)
    found = doubts(play(given)[0])
    grown = found[-1] - found[FIRST - 1]
    assert (grown > 0.9 * SPEED * 0.7) == (unseen > 0) and grown > 0.9 * SPEED * unseen
    assert (found[DURING.stop - 1 :] > SPEED * unseen).all()  # the last that is black, and the one eye


@pytest.mark.fault("camera: its rate falls to a quarter, as in the dark")
def test_depth_is_as_sure_as_ever_at_a_rate_that_has_fallen(frames: Frames) -> None:
    """Half of the steps that are remembered are long after eight frames: then they are usual."""
    shares = []
    for first in (30.0, 7.5):  # Hz
        steps = [1 / first] * FIRST + [1 / 7.5] * (COUNT + AFTER)
        last = play(at_steps(frames, steps))[0][-1]
        shares.append(sure(last, last.observation.tissue))
    fallen, always = shares
    assert always > 0.5 and fallen > 0.9 * always


@pytest.mark.fault("image: of another scene, before and after a gap")
@pytest.mark.parametrize("between", ["black", "nothing"])
def test_another_scene_has_not_lasted_while_nobody_looked(between: str, frames: Frames) -> None:
    """One frame of it, nothing to be seen for four seconds, and one more: the model stays."""
    there, back = frames[:FIRST], frames[FIRST : FIRST + 2]
    other, dark = FAULTS["unknown scene"][0](frames[FIRST], 0), both(frames[FIRST], black)
    given = [*there, other, *([dark] * (40 if between == "black" else 0)), other, *back]
    seconds = [0.1] * len(given)
    if between == "nothing":
        seconds[FIRST + 1] = 4.0
    results, _, pipeline = play(at_steps(given, seconds))
    assert pipeline.map.restarts == 0 and all(result.held for result in results[FIRST:-2])
    assert not results[-1].held


@pytest.mark.fault("clock: set back while strain is measured")
def test_the_seconds_of_strain_go_on_when_the_clock_is_set_back(pipeline: Pipeline, frames: Frames) -> None:
    back = [replace(frame, t_capture_ns=frame.t_capture_ns - 60 * MINUTE) for frame in frames[1:3]]
    process(pipeline, frames[:1])
    pipeline.start_strain()
    results = process(pipeline, [frames[1], replace(back[0], frame_id=7)])  # the second repeats the first
    pipeline.start_strain()
    results += process(pipeline, back[1:])
    seconds = [1e-9 * (each.snapshot.t_capture_ns - each.strain.since_ns) for each in results]
    np.testing.assert_allclose(seconds, [0.1, 0.1, 0.1], atol=1e-3)
