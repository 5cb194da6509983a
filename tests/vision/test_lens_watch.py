"""A drop on one lens is noticed, held out of the model, and soon over; what both eyes see is no drop."""

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
import pytest
from recorded_session import both, frames_of, opened, play

from sags_node.pipeline.session import Session
from sags_node.quality.metrics import as_float
from sags_node.types import F32, U8, Bool, FrameResult, StereoFrame

FIRST, COUNT, AFTER = 6, 8, 6  # frames, at 10 Hz: before, with a drop, after
WITHIN = 5  # frames: half a second
RADIUS = 36  # px of 320
CENTRE = 180, 130


@pytest.fixture(scope="module")
def session() -> Session:
    return opened("mapping.max_gaussians:=4000")


@pytest.fixture(scope="module")
def frames(session: Session) -> list[StereoFrame]:
    return frames_of(session)[: FIRST + COUNT + AFTER]


def _disc(shape: tuple[int, ...], radius: float) -> Bool:
    y, x = np.indices(shape[:2])
    return np.asarray(np.hypot(x - CENTRE[0], y - CENTRE[1]) < radius)


def _wet(picture: U8 | None) -> U8:
    """Blurred, and turned upside down, as through a drop."""
    blurred = cv2.GaussianBlur(picture[::-1, ::-1], (0, 0), 5).astype(np.float32)
    inside: F32 = cv2.GaussianBlur(_disc(picture.shape, RADIUS).astype(np.float32), (0, 0), 2)
    return np.asarray(np.rint(picture + inside[..., None] * (blurred - picture)), np.uint8)


def _play(
    session: Session, frames: list[StereoFrame], spoil: Callable[[StereoFrame], StereoFrame]
) -> tuple[list[FrameResult], list[set[str]]]:
    spoilt = range(FIRST, FIRST + COUNT)
    given = [spoil(frame) if number in spoilt else frame for number, frame in enumerate(frames)]
    results, codes, pipeline = play(session, given, 1)
    assert pipeline.map.restarts == 0
    return results, codes


def _with_a_drop(eye: str, session: Session, frames: list[StereoFrame]) -> list[FrameResult]:
    """It is told of within half a second, and not before or longer."""
    results, codes = _play(session, frames, lambda frame: replace(frame, **{eye: _wet(getattr(frame, eye))}))
    assert any(f"{eye}_eye_drops" in found for found in codes[FIRST : FIRST + WITHIN])
    assert not set().union(*codes[:FIRST], *codes[FIRST + COUNT + WITHIN :])
    return results


@pytest.fixture(scope="module")
def clean(session: Session, frames: list[StereoFrame]) -> list[FrameResult]:
    results, codes = _play(session, frames, lambda frame: frame)
    assert not set().union(*codes)
    return results


@pytest.mark.fault("lens: a drop on the left one")
def test_a_drop_on_the_left_lens_is_no_tissue(
    session: Session, frames: list[StereoFrame], clean: list[FrameResult]
) -> None:
    results = _with_a_drop("left", session, frames)
    for i in range(FIRST + 1, FIRST + COUNT):
        tissue, true = results[i].observation.tissue, clean[i].observation.tissue
        far = ~_disc(tissue.shape, 2 * RADIUS)
        assert tissue[_disc(tissue.shape, RADIUS)].mean() < 0.1
        assert tissue[far].mean() > 0.95 * true[far].mean()
    truth = frames[FIRST + COUNT - 1].left.astype(np.float32) / 255
    drawn = as_float(results[FIRST + COUNT - 1].views["left"].rgb)
    inner = _disc(truth.shape, 0.7 * RADIUS)
    wet = _wet(frames[FIRST + COUNT - 1].left).astype(np.float32) / 255
    assert np.square(drawn - truth)[inner].mean() < 0.5 * np.square(drawn - wet)[inner].mean()


@pytest.mark.fault("lens: a drop on the right one")
def test_where_a_drop_on_the_right_lens_hides_it_no_depth_is_measured(
    session: Session, frames: list[StereoFrame]
) -> None:
    results = _with_a_drop("right", session, frames)
    before, now = results[FIRST - 1], results[FIRST + COUNT - 1]
    camera, baseline = before.observation.camera, before.pair.baseline
    depth = before.views["left"].depth
    rows, columns = np.nonzero(depth > 0)
    there = columns - camera.K[0, 0] * baseline / depth[rows, columns], rows
    hidden = np.hypot(there[0] - CENTRE[0], there[1] - CENTRE[1]) < 0.8 * RADIUS
    rows, columns = rows[hidden], columns[hidden]
    assert len(rows) > 1000
    assert (before.observation.depth[rows, columns] > 0).mean() > 0.5
    assert (now.observation.depth[rows, columns] > 0).mean() < 0.1
    assert now.observation.tissue[rows, columns].mean() > 0.9


def veiled(sigma: float) -> Callable[[StereoFrame], StereoFrame]:
    return lambda frame: replace(frame, left=np.asarray(cv2.GaussianBlur(frame.left, (0, 0), sigma)))


NO_DROPS: dict[str, Callable[[StereoFrame], StereoFrame]] = {
    **{f"the left lens veiled by {sigma} px": veiled(sigma) for sigma in (0.8, 1.2, 1.6, 2.0)},
    "both shaken": lambda frame: both(frame, lambda eye: cv2.blur(eye, (9, 1))),
    "both darker": lambda frame: both(frame, lambda eye: 0.5 * eye),
}


@pytest.mark.parametrize("name", NO_DROPS)
def test_a_veil_and_what_both_eyes_lose_is_no_drop(
    name: str, session: Session, frames: list[StereoFrame], clean: list[FrameResult]
) -> None:
    """Frames that are not held keep their tissue."""
    results, codes = _play(session, frames[: FIRST + COUNT], NO_DROPS[name])
    assert not {code for code in set().union(*codes) if code.endswith("drops")}
    for result, true in zip(results, clean, strict=False):
        assert result.held or result.observation.tissue.mean() > 0.95 * true.observation.tissue.mean()
