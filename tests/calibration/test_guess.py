"""A rig for eyes that nobody has calibrated."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from sags_node.config.launch_file import load_launch
from sags_node.pipeline.session import rig_of
from sags_node.rig import GUESSED_FOV, guessed_rig
from sags_node.tools.calibration.guess import guess_rig, with_equal_rows
from sags_node.tools.calibration.matches import match_eyes
from sags_node.tools.calibration.rows import rectified_rows
from sags_node.types import U8

SIZE = (480, 384)


def seen(height_px: float, roll_deg: float, zoom: float) -> tuple[U8, U8]:
    """Spots at several depths, and the same 12 to 20 px farther left in an eye that is turned and zoomed."""
    rng = np.random.default_rng(3)
    spots = cv2.resize(rng.integers(30, 230, (96, 120, 3), np.uint8), SIZE, interpolation=cv2.INTER_CUBIC)
    x, y = np.meshgrid(np.arange(SIZE[0], dtype=np.float32), np.arange(SIZE[1], dtype=np.float32))
    shifted = cv2.remap(spots, x + 16 + 4 * np.sin(y / 60), y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
    turn = cv2.getRotationMatrix2D((0.5 * (SIZE[0] - 1), 0.5 * (SIZE[1] - 1)), roll_deg, zoom)
    turn[1, 2] += height_px
    return spots, cv2.warpAffine(shifted, turn, SIZE, flags=cv2.INTER_CUBIC)


@pytest.mark.parametrize(("height", "roll", "zoom"), [(0, 0, 1), (9, 0, 1), (-5, 1.5, 1), (4, -1, 1.02)])
def test_rows_of_pictures_agree_in_it(height: float, roll: float, zoom: float) -> None:
    """To the pixel that rows may differ by in stereo, however the right eye is turned."""
    pair = seen(height, roll, zoom)
    rig = with_equal_rows(guessed_rig(*SIZE), [pair])
    assert rectified_rows(rig, match_eyes(*pair)).median < 1.0
    assert not rig.metric
    before = rectified_rows(guessed_rig(*SIZE), match_eyes(*pair)).median
    assert before > 3.0 or not height


def test_it_has_the_size_of_the_pictures_and_the_field_of_view_that_is_said(phantom_session: Path) -> None:
    source = load_launch(phantom_session).source
    rig, true = guess_rig(source), rig_of(load_launch(phantom_session))
    assert (rig.left.width, rig.left.height) == (true.left.width, true.left.height)
    half = np.arctan(0.5 * rig.left.width / rig.left.K[0, 0])
    assert np.degrees(2 * half) == pytest.approx(GUESSED_FOV)
    assert true.metric and not rig.metric
    assert not replace(rig, name="copied").metric


def test_where_nothing_matches_the_rows_are_as_they_are() -> None:
    black = np.zeros((SIZE[1], SIZE[0], 3), np.uint8)
    rig = guessed_rig(*SIZE)
    assert with_equal_rows(rig, [(black, black)]) is rig and with_equal_rows(rig, []) is rig
