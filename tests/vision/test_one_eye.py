"""One eye that is fed to both inputs is refused at the start, and nothing else is."""

from __future__ import annotations

from itertools import islice
from pathlib import Path

import cv2
import numpy as np
import pytest
from places import ROOT

from sags_node.config.schema import FoldersSource
from sags_node.errors import UsageError
from sags_node.pipeline.session import open_session
from sags_node.sources.replay import Replay, refuse_one_eye_twice
from sags_node.types import U8


def noisy(picture: U8, seed: int) -> U8:
    noise = np.random.default_rng(seed).normal(0, 3, picture.shape)
    return np.clip(picture + noise, 0, 255).astype(np.uint8)


def jpeg(picture: U8, quality: int) -> U8:
    coded = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
    return np.asarray(cv2.imdecode(coded, cv2.IMREAD_COLOR), np.uint8)


def test_the_same_folder_twice_is_refused(phantom_session: Path) -> None:
    left = phantom_session / "left"
    with Replay(FoldersSource(left=left, right=left, pace="step")) as source:
        with pytest.raises(UsageError, match=r"both eyes get the same picture.*source\.right"):
            next(iter(source))


def test_captured_twice_is_refused(phantom_session: Path) -> None:
    """Noise and compression of two captures are no second eye."""
    picture = np.asarray(cv2.imread(str(phantom_session / "left/0000.jpg")), np.uint8)
    with pytest.raises(UsageError):
        refuse_one_eye_twice(noisy(picture, 0), jpeg(noisy(picture, 1), 60))


@pytest.mark.parametrize("launch", ["d4d_pull", "hamlyn_heart"])
@pytest.mark.usefixtures("data_folder")
def test_two_eyes_pass(launch: str) -> None:
    session = open_session(ROOT / f"launch/{launch}.yaml", ["source.pace:=step", "source.stride:=30"])
    with session.source as source:
        assert len(list(islice(source, 3))) == 3


@pytest.mark.parametrize("level", [0, 128, 255])
def test_a_picture_of_nothing_tells_nothing(level: int) -> None:
    plain = noisy(np.full((512, 640, 3), level, np.uint8), 0)
    refuse_one_eye_twice(plain, plain)
    refuse_one_eye_twice(plain, None)
