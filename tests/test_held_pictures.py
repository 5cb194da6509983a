"""A bad picture is not a new scene: the model waits, says why, and is the same afterwards."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sags_node.findings import by_code
from sags_node.mapping.budget import StepBudget
from sags_node.pipeline import Pipeline
from sags_node.session import Session, open_session
from sags_node.types import U8, FrameResult, StereoFrame

SESSION = Path(__file__).parent.parent / "replay/phantom_pull"
FIRST, COUNT, AFTER = 8, 8, 11  # frames, at 10 Hz: before, with the fault, and until the tenth after it
WITHIN = 5  # frames: half a second


@pytest.fixture(scope="module")
def session() -> Session:
    return open_session(SESSION, ["source.pace:=step", "mapping.max_gaussians:=4000"])


@pytest.fixture(scope="module")
def frames(session: Session) -> list[StereoFrame]:
    with session.source as source:
        return [frame for frame, _ in zip(source, range(FIRST + COUNT + AFTER), strict=False)]


def both(frame: StereoFrame, change: Callable[[U8], np.ndarray]) -> StereoFrame:
    assert frame.right is not None
    left, right = (np.clip(change(eye), 0, 255).astype(np.uint8) for eye in (frame.left, frame.right))
    return replace(frame, left=left, right=right)


def bleeding(picture: U8) -> np.ndarray:
    covered = picture.astype(np.float32)
    half = len(picture) // 2
    covered[half:] = 0.05 * covered[half:] + 0.95 * np.array([95, 8, 8], np.float32)
    return covered


def black(picture: U8 | None) -> U8:
    assert picture is not None
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


def play(session: Session, frames: list[StereoFrame]) -> tuple[list[FrameResult], list[set[str]], Pipeline]:
    pipeline = Pipeline(session.config, session.rig)
    results, codes = [], []
    for frame in frames:
        results.append(pipeline.process(frame, StepBudget(2)))
        codes.append(set(by_code(pipeline.warnings)))
    return results, codes, pipeline


def psnr(result: FrameResult, clean: FrameResult) -> float:
    error = (result.views["left"].rgb - clean.observation.image)[clean.observation.tissue]
    return float(-10 * np.log10(np.mean(np.square(error))))


@pytest.fixture(scope="module")
def clean(session: Session, frames: list[StereoFrame]) -> list[FrameResult]:
    results, codes, pipeline = play(session, frames)
    assert set().union(*codes) == set() and pipeline.mapper.restarts == 0
    assert not any(result.held or result.skipped for result in results)
    return results


@pytest.mark.parametrize("code", FAULTS)
def test_a_fault_is_said_and_leaves_no_trace(
    code: str, session: Session, frames: list[StereoFrame], clean: list[FrameResult]
) -> None:
    spoil, what = FAULTS[code]
    during = range(FIRST, FIRST + COUNT)
    given = [spoil(frame, i) if i in during else frame for i, frame in enumerate(frames)]
    results, codes, pipeline = play(session, given)
    assert pipeline.mapper.restarts == 0
    if code:
        assert any(code in codes[i] for i in range(FIRST, FIRST + WITHIN))
    assert not set().union(*codes[:FIRST], *codes[during.stop + WITHIN :])
    if what:
        assert all(what in results[i].skipped for i in during)
        assert all(bool(results[i].held) == (what == "picture") for i in during)
    for i in during:  # of a frame that is held nothing is measured, and nothing old is said to be
        assert not results[i].skipped.get(what, "") or not results[i].observation.depth.any()
    kept = np.isin(clean[FIRST - 1].snapshot.gaussians.ids, results[-1].snapshot.gaussians.ids)
    assert kept.mean() > 0.8
    assert psnr(results[-1], clean[-1]) > psnr(clean[-1], clean[-1]) - 1.0
