"""Methods that anchors stand beside: on a picture that moves as a whole, all know where its points are."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import pytest

from benchmarks.quality.followers import Csrt, Follower, dense_flow, lucas_kanade

POINTS = np.array([[60.0, 50], [100, 60], [80, 80]])
STEPS = np.array([[1.5, 0.5], [2.0, -1.0], [0.5, 2.5]])  # px


def picture(moved: np.ndarray) -> np.ndarray:
    rng = np.random.default_rng(0)
    sheet = sum(cv2.GaussianBlur(rng.normal(size=(160, 200)), (0, 0), s) * s for s in (1.5, 3.0, 6.0))
    shifted = cv2.warpAffine(sheet, np.float32([[1, 0, moved[0] - 20], [0, 1, moved[1] - 20]]), (160, 120))
    return np.repeat((120 + 60 * shifted).clip(0, 255).astype(np.uint8)[..., None], 3, axis=2)


@pytest.mark.parametrize(("follower", "most"), [(lucas_kanade, 0.2), (dense_flow, 0.3), (Csrt, 1.5)])
def test_they_follow(follower: Callable[[np.ndarray, np.ndarray], Follower], most: float) -> None:
    moved, following = np.zeros(2), follower(picture(np.zeros(2)), POINTS)
    for step in STEPS:
        moved = moved + step
        pixels, kept = following.follow(picture(moved))
    assert kept.all()
    assert np.linalg.norm(pixels - POINTS - moved, axis=1).max() < most


@pytest.mark.parametrize("follower", [lucas_kanade, dense_flow])
def test_what_was_lost_stays_lost(follower: Callable[[np.ndarray, np.ndarray], Follower]) -> None:
    """The last point leaves the picture and comes back."""
    following = follower(picture(np.zeros(2)), np.array([*POINTS, [2.0, 50]]))
    assert following.follow(picture(np.array([-5.0, 0])))[1].tolist() == [True, True, True, False]
    assert following.follow(picture(np.zeros(2)))[1].tolist() == [True, True, True, False]
