"""The recorded session of `replay/`, changed and played: what tests of the whole pipeline share."""

from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import Any

import numpy as np
from places import SESSION

from sags_node.findings import by_code
from sags_node.mapping.budget import StepBudget
from sags_node.pipeline.pipeline import Pipeline
from sags_node.pipeline.session import Session, open_session
from sags_node.quality import metrics
from sags_node.quality.metrics import as_float
from sags_node.types import U8, FrameResult, Observation, StereoFrame

NOISE = 2.0  # grey levels, standard deviation
Frames = list[StereoFrame]


def opened(*overrides: str) -> Session:
    """The session, each frame to be taken when it is asked for."""
    return open_session(SESSION, ["source.pace:=step", *overrides])


def frames_of(session: Session) -> list[StereoFrame]:
    with session.source as source:
        return list(source)


def fresh(*overrides: str, **how: Any) -> Pipeline:
    """A pipeline for the session. `how`: see `Pipeline`."""
    session = opened(*overrides)
    return Pipeline(session.config, session.rig, **how)


def play(
    session: Session, frames: Iterable[StereoFrame], steps: int = 2
) -> tuple[list[FrameResult], list[set[str]], Pipeline]:
    """What a new pipeline makes of each frame, the codes of its warnings then, and the pipeline."""
    pipeline = Pipeline(session.config, session.rig)
    results, codes = [], []
    for frame in frames:
        results.append(pipeline.process(frame, StepBudget(steps)))
        codes.append(set(by_code(pipeline.warnings)))
    return results, codes, pipeline


def both(frame: StereoFrame, change: Callable[[U8], np.ndarray]) -> StereoFrame:
    """A frame whose images are changed; what is beyond black and white is cut off."""
    assert frame.right is not None
    left, right = (np.clip(change(eye), 0, 255).astype(np.uint8) for eye in (frame.left, frame.right))
    return replace(frame, left=left, right=right)


def noisy(picture: np.ndarray, rng: np.random.Generator, sigma: float = NOISE) -> U8:
    """As a camera takes it."""
    return np.clip(picture + rng.normal(0, sigma, picture.shape), 0, 255).round().astype(np.uint8)


def psnr(result: FrameResult, truth: Observation | None = None) -> float:
    """Of the model drawn for the left eye, dB over tissue; against what the frame showed by default."""
    truth = result.observation if truth is None else truth
    return metrics.psnr(as_float(result.views["left"].rgb), as_float(truth.image), truth.tissue)
