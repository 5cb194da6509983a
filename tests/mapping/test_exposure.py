"""A camera whose exposure changes is still the same camera."""

from dataclasses import replace

import numpy as np
import pytest
from places import SESSION

from sags_node.mapping.budget import StepBudget
from sags_node.mapping.exposure import LARGEST, exposure_gain
from sags_node.pipeline.pipeline import Pipeline
from sags_node.pipeline.session import open_session
from sags_node.quality.metrics import as_float
from sags_node.types import FrameResult, StereoFrame

SIZE = 96
ALL = np.ones((SIZE, SIZE), bool)


def planes_of(image: np.ndarray, coverage: float) -> np.ndarray:
    picture = np.concatenate([image.transpose(2, 0, 1) / 255, np.ones((2, SIZE, SIZE))]) * coverage
    return picture.astype(np.float32)


@pytest.fixture()
def picture() -> np.ndarray:
    """Bytes that stay whole numbers times any of the gains."""
    return 20 * np.random.default_rng(0).integers(3, 8, (SIZE, SIZE, 3), np.uint8)


def test_the_gain_of_each_channel_is_found_whatever_is_new_or_bright(picture: np.ndarray) -> None:
    gain = np.array([1.2, 0.9, 1.05], np.float32)
    seen = np.rint(picture * gain).astype(np.uint8)
    seen[:30] = 26  # something dark came in
    seen[40:50] = 255  # highlights
    assert np.allclose(exposure_gain(planes_of(picture, 0.8), seen, ALL), gain, atol=1e-3)


def test_where_nothing_can_be_compared_the_gain_is_one(picture: np.ndarray) -> None:
    for seen, planes in (
        (picture, planes_of(picture, 0.1)),  # hardly anything is drawn
        (np.zeros_like(picture), planes_of(picture, 1.0)),  # a blackout
        (picture, np.full((5, SIZE, SIZE), np.nan, np.float32)),
    ):
        assert np.array_equal(exposure_gain(planes, seen, ALL), np.ones(3, np.float32))
    bright = np.minimum(3.0 * picture, 240).astype(np.uint8)
    assert exposure_gain(planes_of(picture, 1.0), bright, ALL).max() <= LARGEST


def test_a_jump_of_the_exposure_is_followed_at_once_and_begins_no_new_model() -> None:
    session = open_session(SESSION, ["source.pace:=step", "mapping.max_gaussians:=8000"])
    with session.source as source:
        frames = [frame for frame, _ in zip(source, range(16), strict=False)]

    def play(gain: float) -> list[FrameResult]:
        pipeline = Pipeline(session.config, session.rig)
        return [
            pipeline.process(frame if i < 8 else brighter(frame, gain), StepBudget(1))
            for i, frame in enumerate(frames)
        ]

    plain, jumped = play(1.0), play(0.75)
    assert jumped[-1].epoch == plain[-1].epoch
    for before, after in zip(plain[8:], jumped[8:], strict=True):
        assert psnr(after) > psnr(before) - 0.5  # darker pictures have smaller errors, too


def brighter(frame: StereoFrame, gain: float) -> StereoFrame:
    assert frame.right is not None
    eyes = {"left": frame.left, "right": frame.right}
    return replace(frame, **{eye: np.rint(image * gain).astype(np.uint8) for eye, image in eyes.items()})


def psnr(result: FrameResult) -> float:
    seen = result.observation
    error = (as_float(result.views["left"].rgb) - as_float(seen.image))[seen.tissue]
    return float(-10 * np.log10(np.mean(np.square(error))))
