"""Whether both eyes show what they should: empty, equal and exchanged pictures are noticed, others not."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import islice
from pathlib import Path

import cv2
import numpy as np
import pytest
from synthetic import health

from sags_node.mapping.budget import StepBudget
from sags_node.messaging.cdr import decode
from sags_node.messaging.content import diagnostics
from sags_node.pipeline import Pipeline
from sags_node.session import Session, open_session
from sags_node.types import U8, StereoFrame
from sags_node.vision.pair_watch import LOOKS, NEEDED, PERIOD_NS, PairWatch
from sags_node.vision.rectify import Rectifier

ROOT = Path(__file__).parent.parent
STEP_NS = 160_000_000  # every frame is looked at
Spoil = Callable[[StereoFrame], StereoFrame]


@pytest.fixture(scope="module")
def session(phantom_session: Path) -> Session:
    return open_session(phantom_session, ["source.pace:=step"])


@pytest.fixture(scope="module")
def frames(session: Session) -> list[StereoFrame]:
    with session.source as source:
        return list(islice(source, 6))


def watched(session: Session, frames: list[StereoFrame], step_ns: int = STEP_NS) -> Iterator[str]:
    """What is said after each frame."""
    watch = PairWatch()
    rectify = Rectifier(session.rig, *session.working_size)
    for number, frame in enumerate(frames):
        stamped = replace(frame, t_capture_ns=10**18 + number * step_ns)
        watch(stamped, rectify(stamped))
        yield "; ".join(finding.text for finding in watch.findings)


def both(change: Callable[[U8], U8]) -> Spoil:
    return lambda frame: replace(frame, left=change(frame.left), right=change(_right(frame)))


def _right(frame: StereoFrame) -> U8:
    assert frame.right is not None
    return frame.right


def _noisy(picture: np.ndarray, sigma: float = 4.0) -> U8:
    noise = np.random.default_rng(int(picture.sum()) % 1000).normal(0, sigma, picture.shape)
    return np.clip(picture + noise, 0, 255).round().astype(np.uint8)


def _jpeg(picture: U8) -> U8:
    return cv2.imdecode(cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 50])[1], cv2.IMREAD_COLOR)


def _plain(frame: StereoFrame, color: tuple[int, int, int], sigma: float = 2.0) -> U8:
    return _noisy(np.full(frame.left.shape, color, np.float32), sigma)


# ---- sound pairs -----------------------------------------------------------------------------------------

SOUND: dict[str, Spoil] = {
    "as it is": lambda frame: frame,
    "dim": both(lambda picture: (picture * 0.2).astype(np.uint8)),
    "bright": both(lambda picture: np.clip(picture * 1.8, 0, 255).astype(np.uint8)),
    "noise": both(lambda picture: _noisy(picture, 12.0)),
    "smoke": both(lambda picture: (picture * 0.25 + 150).astype(np.uint8)),
    "out of focus": both(lambda picture: cv2.GaussianBlur(picture, (0, 0), 6)),
    "jpeg": both(_jpeg),
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
    said = list(watched(session, [_exchanged(frame) for frame in frames]))
    assert all("exchanged" in warning for warning in said[NEEDED - 1 :])
    said = list(watched(session, [replace(frame, right=frame.left) for frame in frames]))
    assert all("the same picture" in warning for warning in said[NEEDED - 1 :])


# ---- what is wrong ---------------------------------------------------------------------------------------


def _exchanged(frame: StereoFrame) -> StereoFrame:
    return replace(frame, left=_right(frame), right=frame.left)


WRONG: dict[str, tuple[Spoil, str]] = {
    "black left": (lambda f: replace(f, left=np.zeros_like(f.left)), "the left picture is black: see to"),
    "noisy black": (lambda f: replace(f, right=_plain(f, (4, 4, 4), 6.0)), "the right picture is black"),
    "video black": (lambda f: replace(f, right=_plain(f, (16, 16, 16))), "the right picture is black"),
    "white": (lambda f: replace(f, right=_plain(f, (255, 255, 255))), "the right picture is white: lower"),
    "blue": (lambda f: replace(f, left=_plain(f, (0, 0, 200))), "the left picture is of one colour: see to"),
    "grey": (lambda f: replace(f, right=_plain(f, (128, 128, 128))), "the right picture is of one colour"),
    "both black": (both(np.zeros_like), "the left picture is black"),
    "one eye twice": (lambda f: replace(f, right=f.left), "both eyes show the same picture"),
    "captured twice": (
        lambda f: replace(f, left=_noisy(f.left), right=_jpeg(_noisy(f.left * 0.8 + 10))),
        "both eyes show the same picture",
    ),
    "exchanged": (_exchanged, "left and right seem to be exchanged: swap"),
}


@pytest.mark.parametrize("name", WRONG)
def test_what_is_wrong_is_said_and_how_to_mend_it(
    name: str, session: Session, frames: list[StereoFrame]
) -> None:
    spoil, said = WRONG[name]
    warnings = list(watched(session, [spoil(frame) for frame in frames]))
    assert warnings[: NEEDED - 1] == [""] * (NEEDED - 1)  # one bad frame is none
    assert all(warning.startswith(said) for warning in warnings[NEEDED - 1 :]), warnings
    if name == "both black":
        assert "the right picture is black" in warnings[-1]
    else:
        assert len(set(warnings[NEEDED - 1 :])) == 1 and ";" not in warnings[-1]


def test_a_warning_ends_soon_after_what_caused_it(session: Session, frames: list[StereoFrame]) -> None:
    black = [replace(frame, left=np.zeros_like(frame.left)) for frame in frames]
    *_, last = watched(session, [*black, *frames[: LOOKS - NEEDED + 1]])
    assert last == ""


def test_two_looks_are_a_while_apart_and_a_clock_may_jump(
    session: Session, frames: list[StereoFrame]
) -> None:
    black = [replace(frame, left=np.zeros_like(frame.left)) for frame in frames]
    per_look = 5  # frames at 30 Hz
    said = list(watched(session, NEEDED * per_look * black, PERIOD_NS // per_look + 1))
    first = next(number for number, warning in enumerate(said) if warning)
    assert first == (NEEDED - 1) * per_look
    assert list(watched(session, black, -(10**9)))[-1]


# ---- in the node -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("noise", [0.0, 2.0, 40.0], ids=["duplicates", "still", "all mapped"])
def test_the_pipeline_warns_also_while_frames_are_skipped(
    noise: float, session: Session, frames: list[StereoFrame]
) -> None:
    """A cable is pulled, and nothing moves any more: equal pictures are left out, and where depth comes with
    the session those that are equal but for noise are not matched."""
    pipeline = Pipeline(session.config, session.rig)
    rng = np.random.default_rng(0)
    shown = [*frames[:2], *[frames[2]] * 8]
    skipped = set()
    for number, frame in enumerate(shown):
        pulled = number >= 2
        left = np.zeros_like(frame.left) if pulled else frame.left
        noisy = np.clip(_right(frame) + rng.normal(0, noise, left.shape), 0, 255).astype(np.uint8)
        spoilt = replace(frame, left=left, right=noisy, depth=np.full(left.shape[:2], 0.08, np.float32))
        stamped = replace(spoilt, frame_id=number, t_capture_ns=number * STEP_NS)
        skipped |= set(pipeline.process(stamped, StepBudget(0)).skipped)
        assert ("eyes" in pipeline.warnings) == (number >= 2 + NEEDED - 1)
    assert skipped == {0.0: {"frame"}, 2.0: {"depth", "motion"}, 40.0: set()}[noise]
    content = diagnostics(replace(health(), warnings=pipeline.warnings), 0)
    statuses = decode(b"".join(content.parts), "diagnostic_msgs/msg/DiagnosticArray").status
    assert "the left picture is black" in " ".join(status.message for status in statuses)
