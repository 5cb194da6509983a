"""What counts as a scene in which nothing moves, and what as an image that was sent twice."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
from recorded_session import NOISE, noisy

from sags_node.types import F32, Camera, RectifiedPair
from sags_node.vision.change import StillScene, is_repeat

SIZES = pytest.mark.parametrize(("width", "height"), [(320, 256), (640, 512)])
EYES = pytest.mark.parametrize("eyes", [1, 2])


def texture(width: int, height: int) -> F32:
    """[H, W, 3] smooth random texture as of tissue, grey levels."""
    rng = np.random.default_rng(0)
    smooth = cv2.GaussianBlur(rng.normal(0, 1, (height, width, 3)).astype(np.float32), (0, 0), 3)
    return np.asarray(128 + 25 * smooth / smooth.std(), np.float32)


def pair(left: np.ndarray, right: np.ndarray | None, T_world_cam: Any = None) -> RectifiedPair:
    height, width = left.shape[:2]
    pose = np.eye(4) if T_world_cam is None else T_world_cam
    return RectifiedPair(0, 0, Camera(width, height, np.eye(3), pose), 0.004, left, right)


class Watched:
    """A `StillScene` that is shown images with fresh camera noise."""

    def __init__(self, sigma: float = NOISE, eyes: int = 2) -> None:
        self._scene, self._rng = StillScene(), np.random.default_rng(1)
        self._sigma, self._eyes = sigma, eyes

    def __call__(self, left: F32, right: F32 | None = None, T_world_cam: Any = None) -> int:
        eyes = [noisy(eye, self._rng, self._sigma) for eye in (left, left if right is None else right)]
        return self._scene(pair(eyes[0], eyes[1] if self._eyes == 2 else None, T_world_cam))


def with_a_shifted_patch(picture: F32, x: int, y: int, side: int = 64) -> F32:
    """By a pixel."""
    shifted, place = picture.copy(), np.s_[y : y + side, x : x + side]
    shifted[place] = np.roll(picture, 1, axis=1)[place]
    return shifted


@SIZES
@EYES
@pytest.mark.parametrize("sigma", [0.0, 3.0, 4.0])
def test_noise_is_no_motion(width: int, height: int, eyes: int, sigma: float) -> None:
    watched, picture = Watched(sigma, eyes), texture(width, height)
    assert [watched(picture) for _ in range(15)] == list(range(15))


CHANGES: dict[str, Callable[[F32], F32]] = {
    "a patch in the first corner": lambda p: with_a_shifted_patch(p, 0, 0),
    "a patch within": lambda p: with_a_shifted_patch(p, 100, 131),
    "a patch in the last corner": lambda p: with_a_shifted_patch(p, p.shape[1] - 64, p.shape[0] - 64),
    "less light": lambda p: p - 5,
    "more light": lambda p: p + 5,
}


@SIZES
@EYES
@pytest.mark.parametrize("what", CHANGES)
def test_what_changes_moves_once_and_then_stays(width: int, height: int, eyes: int, what: str) -> None:
    watched, picture = Watched(eyes=eyes), texture(width, height)
    changed = CHANGES[what](picture)
    assert [watched(each) for each in (picture, picture, changed, changed)] == [0, 1, 0, 1]


@SIZES
def test_what_only_the_right_eye_sees_moves_too(width: int, height: int) -> None:
    watched, picture = Watched(), texture(width, height)
    assert [watched(picture), watched(picture), watched(picture, np.roll(picture, 2, axis=0))] == [0, 1, 0]


@pytest.mark.parametrize(
    ("width", "height", "speed"), [*((320, 256, speed) for speed in (0.05, 0.1, -0.1)), (640, 512, 0.1)]
)
def test_slow_drift_adds_up_and_is_seen(width: int, height: int, speed: float) -> None:
    """Each frame alone differs from its predecessor by less than the noise."""
    watched, picture = Watched(), texture(width + 16, height)
    seen = []
    for i in range(41):
        shift = np.array([[1, 0, -8 + speed * i], [0, 1, 0]])
        shown = cv2.warpAffine(picture, shift, (width, height), flags=cv2.INTER_LANCZOS4)
        if watched(shown) == 0:
            seen.append(i)
    gaps = np.diff(seen) * abs(speed)
    assert len(seen) > 2 and gaps.max() <= 0.5, seen  # px


def test_a_camera_that_moves_before_an_even_wall_moves() -> None:
    """The image does not show it, the pose does."""
    watched, picture, T = Watched(), np.full((256, 320, 3), 128, np.float32), np.eye(4)
    assert [watched(picture), watched(picture)] == [0, 1]
    T[0, 3] = 0.01
    assert [watched(picture, T_world_cam=T), watched(picture, T_world_cam=T)] == [0, 1]


def test_what_is_forgotten_and_other_eyes_are_no_predecessor() -> None:
    picture, scene = np.full((64, 96, 3), 100, np.uint8), StillScene()
    seen = pair(picture, picture)
    assert [scene(seen), scene(seen)] == [0, 1]
    scene.forget()
    assert [scene(seen), scene(seen), scene(replace(seen, right=None))] == [0, 1, 0]


@pytest.mark.parametrize(("x", "y"), [(0, 0), (131, 100), (640 - 45, 512 - 45)])
def test_a_small_piece_that_moved_is_no_repeat(x: int, y: int) -> None:
    """A twentieth of the width, by a pixel, in an image without noise: over all it is less than what a codec
    does to a repeat."""
    picture = texture(640, 512).round().astype(np.uint8)
    moved = with_a_shifted_patch(picture, x, y, 32)
    before, after = (cv2.cvtColor(each, cv2.COLOR_RGB2GRAY).astype(np.float32) for each in (picture, moved))
    assert 52 < -10 * np.log10(np.mean((after - before) ** 2) / 255**2) < 62  # dB
    assert not is_repeat(pair(moved, moved), pair(picture, picture))


@SIZES
def test_a_picture_coded_again_is_a_repeat_and_one_taken_again_is_not(width: int, height: int) -> None:
    picture, rng = texture(width, height), np.random.default_rng(0)
    coded = [noisy(picture, rng, 0.25) for _ in range(2)]
    taken = [noisy(picture, rng, 1.0) for _ in range(2)]
    for (a, b), repeats in ((coded, True), ((coded[0], coded[0]), True), (taken, False)):
        assert is_repeat(pair(a, a), pair(b, b)) == repeats
