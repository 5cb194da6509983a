"""Whether both eyes show what they should: empty, equal and exchanged images are noticed, others not."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import islice
from pathlib import Path

import cv2
import numpy as np
import pytest
from places import ROOT
from recorded_session import both, noisy
from watching import judged

from sags_node.errors import UsageError
from sags_node.mapping.budget import StepBudget
from sags_node.pipeline.pipeline import Pipeline
from sags_node.pipeline.session import Session, open_session
from sags_node.sources.replay import refuse_one_eye_twice
from sags_node.types import U8, Finding, StereoFrame
from sags_node.vision.rectify import Rectifier
from sags_node.vision.watch.judgement import Judgement
from sags_node.vision.watch.pair_watch import PairWatch, is_blocky
from sags_node.vision.watch.picture_fit import Fit

STEP_NS = 100_000_000
NEEDED = 2  # frames, at that rate
Spoil = Callable[[StereoFrame], StereoFrame]


@pytest.fixture(scope="module")
def session(phantom_session: Path) -> Session:
    return open_session(phantom_session, ["source.pace:=step"])


@pytest.fixture(scope="module")
def moving(session: Session) -> list[StereoFrame]:
    """Three seconds at 10 Hz."""
    with session.source as source:
        return list(islice(source, 30))


@pytest.fixture(scope="module")
def frames(moving: list[StereoFrame]) -> list[StereoFrame]:
    return moving[:6]


def looked_at(session: Session, frames: list[StereoFrame]) -> Iterator[tuple[Judgement, list[Finding]]]:
    """What is judged of each frame, and what is said after it."""
    watch, rectify = PairWatch(), Rectifier(session.rig, *session.working_size)
    for frame in frames:
        yield judged(watch, frame, rectify(frame)), list(watch.findings)


def stamped(frames: list[StereoFrame], step_ns: int = STEP_NS, begin_ns: int = 10**18) -> list[StereoFrame]:
    return [replace(frame, t_capture_ns=begin_ns + n * step_ns) for n, frame in enumerate(frames)]


def watched(session: Session, frames: list[StereoFrame], step_ns: int = STEP_NS) -> list[str]:
    """What is said after each frame."""
    return [in_a_line(found) for _, found in looked_at(session, stamped(frames, step_ns))]


def in_a_line(found: list[Finding]) -> str:
    return "; ".join(finding.text for finding in found)


def codes(found: list[Finding]) -> list[str]:
    return [finding.code for finding in found]


def spoilt(change: Callable[[U8], np.ndarray]) -> Spoil:
    """Both eyes."""
    return lambda frame: both(frame, change)


def _right(frame: StereoFrame) -> U8:
    assert frame.right is not None
    return frame.right


def _noisy(picture: np.ndarray, sigma: float = 4.0) -> U8:
    return noisy(picture, np.random.default_rng(int(picture.sum()) % 1000), sigma)


def _jpeg(picture: U8, quality: int = 50) -> U8:
    data = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
    return cv2.imdecode(data, cv2.IMREAD_COLOR)


def _plain(frame: StereoFrame, color: tuple[int, int, int], sigma: float = 2.0) -> U8:
    return _noisy(np.full(frame.left.shape, color, np.float32), sigma)


# ---- sound pairs -----------------------------------------------------------------------------------------

SOUND: dict[str, Spoil] = {
    "as it is": lambda frame: frame,
    "dim": spoilt(lambda picture: picture * 0.2),
    "bright": spoilt(lambda picture: picture * 1.8),
    "noise": spoilt(lambda picture: _noisy(picture, 12.0)),
    "smoke": spoilt(lambda picture: picture * 0.25 + 150),
    "out of focus": spoilt(lambda picture: cv2.GaussianBlur(picture, (0, 0), 6)),
    "jpeg": spoilt(_jpeg),
    "one eye darker": lambda frame: replace(frame, right=(_right(frame) * 0.6).astype(np.uint8)),
    "one camera": lambda frame: replace(frame, right=None),
}


@pytest.mark.parametrize("name", SOUND)
def test_sound_pairs_are_let_pass(name: str, session: Session, frames: list[StereoFrame]) -> None:
    assert set(watched(session, [SOUND[name](frame) for frame in frames])) == {""}


@pytest.mark.parametrize("launch", ["d4d_pull", "hamlyn_heart"])
def test_real_recordings_are_let_pass_and_exchanged_ones_noticed(launch: str, data_folder: Path) -> None:
    overrides = ["source.pace:=step", "source.stride:=5"]
    session = open_session(ROOT / f"launch/{launch}.yaml", overrides)
    with session.source as source:
        frames = list(islice(source, 20))
    assert set(watched(session, frames)) == {""}
    for name in ("exchanged", "one eye twice"):
        spoil, words = WRONG[name]
        said = watched(session, list(map(spoil, frames)))[NEEDED - 1 :]
        assert all(warning.startswith(words) for warning in said)


# ---- what is wrong ---------------------------------------------------------------------------------------


def _exchanged(frame: StereoFrame) -> StereoFrame:
    return replace(frame, left=_right(frame), right=frame.left)


WRONG: dict[str, tuple[Spoil, str]] = {
    "black left": (lambda f: replace(f, left=np.zeros_like(f.left)), "the left image is black: check"),
    "noisy black": (lambda f: replace(f, right=_plain(f, (4, 4, 4), 6.0)), "the right image is black"),
    "video black": (lambda f: replace(f, right=_plain(f, (16, 16, 16))), "the right image is black"),
    "white": (lambda f: replace(f, right=_plain(f, (255, 255, 255))), "the right image is white: lower"),
    "blue": (lambda f: replace(f, left=_plain(f, (0, 0, 200))), "the left image is of one colour: check"),
    "grey": (lambda f: replace(f, right=_plain(f, (128, 128, 128))), "the right image is of one colour"),
    "both black": (spoilt(np.zeros_like), "the left image is black"),
    "one eye twice": (lambda f: replace(f, right=f.left), "both eyes show the same image"),
    "captured twice": (
        lambda f: replace(f, left=_noisy(f.left), right=_jpeg(_noisy(f.left * 0.8 + 10))),
        "both eyes show the same image",
    ),
    "exchanged": (_exchanged, "left and right seem to be exchanged: exchange"),
}


@pytest.mark.parametrize("name", WRONG)
def test_what_is_wrong_is_said_and_how_to_fix_it(
    name: str, session: Session, frames: list[StereoFrame]
) -> None:
    spoil, said = WRONG[name]
    warnings = watched(session, [spoil(frame) for frame in frames])
    assert warnings[: NEEDED - 1] == [""] * (NEEDED - 1)  # one bad frame is none
    assert all(warning.startswith(said) for warning in warnings[NEEDED - 1 :]), warnings
    if name == "both black":
        assert "the right image is black" in warnings[-1]
    else:
        assert len(set(warnings[NEEDED - 1 :])) == 1 and ";" not in warnings[-1]


@pytest.mark.parametrize("rate", [10, 30, 60])
def test_a_warning_begins_and_ends_within_half_a_second(
    rate: int, session: Session, frames: list[StereoFrame]
) -> None:
    black = replace(frames[0], left=np.zeros_like(frames[0].left))
    said = watched(session, [frames[0]] * rate + [black] * rate + [frames[0]] * rate, 10**9 // rate)
    warned = [number for number, text in enumerate(said) if text]
    assert rate < warned[0] <= 1.5 * rate and 2 * rate <= warned[-1] < 2.5 * rate
    assert warned == list(range(warned[0], warned[-1] + 1))


def test_a_clock_may_jump_back(session: Session, frames: list[StereoFrame]) -> None:
    black = stamped([replace(frame, left=np.zeros_like(frame.left)) for frame in frames])
    *_, (_, found) = looked_at(session, [*black, *black])
    assert codes(found) == ["left_eye_black"]


def _fogged(picture: U8) -> U8:
    return (cv2.GaussianBlur(picture, (0, 0), 4) * 0.4 + 100).astype(np.uint8)


NO_LEFT, NO_RIGHT, NOT_LEARNT = (
    Judgement(hold="x", no_stereo="x"), Judgement(no_stereo="x"), Judgement(learn=False)
)  # fmt: skip
BLURRED = spoilt(lambda picture: cv2.GaussianBlur(picture, (0, 0), 4))
BLOCKY = spoilt(lambda picture: _jpeg(picture, 6))
LASTING: dict[str, tuple[Callable[[StereoFrame, StereoFrame], StereoFrame], str, Judgement]] = {
    "right fogged": (lambda f, _: replace(f, right=_fogged(_right(f))), "right_eye_fogged", NO_RIGHT),
    "left fogged": (lambda f, _: replace(f, left=_fogged(f.left)), "left_eye_fogged", NO_LEFT),
    "right frozen": (lambda f, before: replace(f, right=before.right), "right_eye_frozen", NO_RIGHT),
    "left frozen": (lambda f, before: replace(f, left=before.left), "left_eye_frozen", NO_LEFT),
    "both blurred": (lambda f, _: BLURRED(f), "picture_blurred", NOT_LEARNT),
    "both veiled": (lambda f, _: both(f, lambda eye: eye * 0.3 + 120), "picture_smoke", NOT_LEARNT),
    "both compressed": (lambda f, _: BLOCKY(f), "picture_compressed", Judgement()),
}


@pytest.mark.fault("image: the left eye is frozen")
@pytest.mark.fault("image: the right eye is frozen")
@pytest.mark.parametrize("name", LASTING)
def test_an_eye_is_compared_with_the_other_and_with_a_moment_ago(
    name: str, session: Session, moving: list[StereoFrame]
) -> None:
    """At once it is not used; and it is said when it lasts."""
    spoil, code, expected = LASTING[name]
    given = [spoil(frame, moving[9]) if 10 <= n < 20 else frame for n, frame in enumerate(moving)]
    for number, (verdict, found) in enumerate(looked_at(session, given)):
        if 11 <= number < 20:  # the first may be taken for the other eye's fault
            assert bool(verdict.hold) == bool(expected.hold)
            assert bool(verdict.no_stereo) == bool(expected.no_stereo)
            assert verdict.learn == expected.learn
        elif number not in (10, 20):
            assert verdict == Judgement()
        if 14 <= number < 20:
            assert codes(found) == [code]
        if number < 10 or number >= 24:
            assert not found


@pytest.mark.fault("image: blurred after the lens was out for cleaning")
@pytest.mark.parametrize("between", ["black", "nothing"])
def test_a_blur_that_begins_while_nobody_looks_has_not_lasted(
    between: str, session: Session, moving: list[StereoFrame]
) -> None:
    """Twelve seconds in which no image was seen make no blur usual."""
    first, out = moving[:10], [both(moving[9], np.zeros_like)] * 120
    given = stamped([*first, *out, *map(BLURRED, moving[10:20])])
    if between == "nothing":
        del given[10:130]
    seen = list(looked_at(session, given))
    assert not any(verdict.learn for verdict, _ in seen[-10:])
    assert codes(seen[-1][1]) == ["picture_blurred"]


def test_what_is_compressed_hard_from_the_first_picture_on_is_said_too(
    session: Session, moving: list[StereoFrame]
) -> None:
    seen = list(looked_at(session, list(map(BLOCKY, moving[:10]))))
    assert all(verdict == Judgement() for verdict, _ in seen)
    assert codes(seen[-1][1]) == ["picture_compressed"]


@pytest.mark.parametrize("across", [2, 4])
def test_a_picture_that_was_enlarged_has_no_blocks(across: int, moving: list[StereoFrame]) -> None:
    small = np.ascontiguousarray(moving[0].left[::across, ::across])
    large = small.repeat(across, 0).repeat(across, 1)
    assert not is_blocky(large) and is_blocky(_jpeg(large, 6))


def test_one_eye_that_is_fed_to_both_inputs_is_refused_at_the_start(frames: list[StereoFrame]) -> None:
    """Noise and compression of two captures are no second eye; an image of nothing tells nothing."""
    rng = np.random.default_rng(0)
    once, again = (noisy(frames[0].left, rng, 3) for _ in range(2))
    with pytest.raises(UsageError):
        refuse_one_eye_twice(once, _jpeg(again, 60))
    for level in (0, 128, 255):
        plain = _noisy(np.full((512, 640, 3), level, np.uint8), 3)
        for other in (plain, None):
            refuse_one_eye_twice(plain, other)


# ---- in the node -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("noise", [0.0, 2.0, 12.0], ids=["duplicates", "still", "all mapped"])
def test_the_pipeline_warns_also_while_frames_are_skipped(
    noise: float, session: Session, frames: list[StereoFrame]
) -> None:
    """A cable is pulled, and nothing moves any more: equal images are left out, and where depth comes with
    the session those that are equal but for noise are not matched."""
    pipeline = Pipeline(session.config, session.rig)
    rng = np.random.default_rng(0)
    skipped = set()
    for number, frame in enumerate(stamped([*frames[:2], *[frames[2]] * 8])):
        pulled = number >= 2
        right = np.zeros_like(frame.left) if pulled else frame.right
        left = noisy(frame.left, rng, noise)
        depth = np.full(frame.left.shape[:2], 0.08, np.float32)
        shown = replace(frame, left=left, right=right, depth=depth, frame_id=number)
        skipped |= set(pipeline.process(shown, StepBudget(0)).skipped)
        assert ("eyes" in pipeline.warnings) == (number >= 2 + NEEDED - 1)
    assert skipped == {0.0: {"frame"}, 2.0: {"depth", "motion"}, 12.0: set()}[noise]
    assert "the right image is black" in in_a_line(pipeline.warnings["eyes"])


# ---- how well an image agrees with the model: exposure, misfit and structure -----------------------------

GAIN = np.array([1.2, 1.0, 0.8], np.float32)


def test_each_channel_has_an_exposure_of_its_own_and_one_that_tells_nothing_that_of_the_others() -> None:
    """What covers a part is found, and leaves the exposure as it is."""
    noise = np.random.default_rng(3).random((64, 80, 3), np.float32)
    drawn = 0.3 + 0.4 * cv2.blur(noise, (5, 5))  # with structure, no channel of it near black or white
    everywhere = np.ones((64, 80), bool)
    seen = drawn * GAIN
    fit = Fit(seen, drawn, everywhere)
    assert fit.gain == pytest.approx(GAIN, rel=1e-5) and fit.usable == 1 and fit.misfit == 0
    assert fit.contrast == pytest.approx(1, abs=1e-4) and fit.match == pytest.approx(1, abs=1e-4)
    seen[..., 2] = 1.0
    fit = Fit(seen, drawn, everywhere)
    assert fit.gain == pytest.approx([1.2, 1.0, 1.1], rel=1e-5) and fit.usable == pytest.approx(2 / 3)
    covered = drawn.copy()
    covered[:24] = 0.9
    fit = Fit(covered, drawn, everywhere)
    assert fit.gain == pytest.approx(np.ones(3), rel=1e-5)
    assert fit.wrong[:23].all() and not fit.wrong[25:].any()  # the residual is blurred by a pixel
