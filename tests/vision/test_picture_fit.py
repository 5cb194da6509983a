"""How well a picture agrees with the model: exposure, misfit and structure."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from rounding import after

from sags_node.vision.pyramid import gray_pyramid, inner
from sags_node.vision.watch.clarity import LOCAL, small_level, structure
from sags_node.vision.watch.pair_watch import row_correlation
from sags_node.vision.watch.picture_fit import Fit, middle_of

GAIN = np.array([1.2, 1.0, 0.8], np.float32)


@pytest.fixture
def drawn() -> np.ndarray:
    """[64, 80, 3] with structure, no channel of it near black or white."""
    noise = np.random.default_rng(3).random((64, 80, 3), np.float32)
    return 0.3 + 0.4 * cv2.blur(noise, (5, 5))


def test_each_channel_has_an_exposure_of_its_own(drawn: np.ndarray) -> None:
    fit = Fit(drawn * GAIN, drawn, np.ones((64, 80), bool))
    assert fit.gain == pytest.approx(GAIN, rel=1e-5)
    assert fit.usable == 1 and fit.misfit == 0
    assert fit.contrast == pytest.approx(1, abs=1e-4) and fit.match == pytest.approx(1, abs=1e-4)


def test_a_channel_that_tells_nothing_has_the_exposure_of_the_others(drawn: np.ndarray) -> None:
    seen = drawn * GAIN
    seen[..., 2] = 1.0
    fit = Fit(seen, drawn, np.ones((64, 80), bool))
    assert fit.gain == pytest.approx([1.2, 1.0, 1.1], rel=1e-5)
    assert fit.usable == pytest.approx(2 / 3)


def test_what_covers_a_part_is_found_and_leaves_the_exposure(drawn: np.ndarray) -> None:
    seen = drawn.copy()
    seen[:24] = 0.9
    fit = Fit(seen, drawn, np.ones((64, 80), bool))
    assert fit.gain == pytest.approx(np.ones(3), rel=1e-5)
    assert fit.wrong[:23].all() and not fit.wrong[25:].any()  # the residual is blurred by a pixel


@pytest.mark.parametrize("shift", [-7, 0, 12])
def test_rows_correlate_where_they_lie(shift: int) -> None:
    scene = np.random.default_rng(4).normal(0, 20, (64, 120)).astype(np.float32)
    left, right = scene[:, 20:100], scene[:, 20 + shift : 100 + shift]
    match = row_correlation(left, right)
    assert len(match) == 81 and np.argmax(match) == 40 + shift
    assert match.max() == pytest.approx(1, abs=1e-5)


def test_structure_is_what_a_small_picture_has_beside_the_mean_around() -> None:
    noise = np.random.default_rng(5).integers(0, 256, (512, 640), np.uint8)
    pyramid = gray_pyramid(cv2.GaussianBlur(noise, (0, 0), 5))
    small = inner(small_level(pyramid))
    around = cv2.blur(small, (LOCAL, LOCAL), borderType=cv2.BORDER_REPLICATE)
    np.testing.assert_allclose(structure(pyramid), small - around, atol=255 * after(LOCAL**2))


@pytest.mark.parametrize("count", [0, 1, 2, 7, 100])
def test_middle_of_is_the_upper_median(count: int) -> None:
    values = np.random.default_rng(count).normal(size=count).astype(np.float32)
    assert middle_of(values) == (np.sort(values)[count // 2] if count else 0)
