"""Anchors that were out of sight for long: found by what surrounds them, and only there."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import cv2
import numpy as np
import pytest
from flat_scene import Scene, camera_in_front, flat_means, flat_scene

from sags_node.mapping.anchors import Anchors
from sags_node.mapping.recall import MOST_PICTURES, Recall
from sags_node.types import AnchorStates
from sags_node.vision.landmarks import features_of
from sags_node.vision.pyramid import pyramid_of

WIDTH, HEIGHT, FOCAL, DEPTH = 320, 256, 250.0, 0.08
CENTRE = np.array([(WIDTH - 1) / 2, (HEIGHT - 1) / 2])
CAMERA = camera_in_front(WIDTH, HEIGHT, FOCAL)
AWAY = 10.0  # s
PINNED = [(100, 100), (160, 128), (200, 150), (150, 180), (220, 90)]


@cache
def texture(seed: int) -> np.ndarray:
    """Random blots of many sizes, on a sheet larger than the image."""
    rng = np.random.default_rng(seed)
    sheet = np.zeros((HEIGHT + 200, WIDTH + 200), np.float32)
    for size in (1.5, 3, 6, 12):
        sheet += cv2.normalize(
            cv2.GaussianBlur(rng.normal(size=sheet.shape), (0, 0), size), None, 0, 60, cv2.NORM_MINMAX
        )
    return sheet.clip(0, 255).astype(np.uint8)


def motion(turn: float, scale: float, shift: tuple[float, float]) -> np.ndarray:
    """[2, 3]: pixels of the first image -> pixels now."""
    matrix = cv2.getRotationMatrix2D((float(CENTRE[0]), float(CENTRE[1])), turn, scale)
    matrix[:, 2] += shift
    return matrix


STILL = motion(0, 1, (0, 0))


def scene(
    seconds: float, moved: np.ndarray = STILL, seed: int = 0, depth: float = DEPTH, kept: bool = True
) -> Scene:
    """A plane with a texture that was `moved`; its Gaussians stay (`kept`), or are others."""
    onto = moved.copy()
    onto[:, 2] -= moved[:, :2] @ [100.0, 100.0]
    gray = cv2.warpAffine(texture(seed), onto, (WIDTH, HEIGHT), flags=cv2.INTER_AREA)
    first_id = 0 if kept else 10**6
    stamp = round((1 + seconds) * 1e9)
    return flat_scene(CAMERA, flat_means(CAMERA, depth, 3.0), gray, depth, 0, stamp, first_id)


Look = Callable[..., Scene]


def follow(anchors: Anchors, *scenes: Scene) -> AnchorStates:
    for each in scenes:
        anchors.update(*each)
        anchors.age(each[0].t_capture_ns)
    return anchors.states()


def pinned(look: Look = scene, frames: int = 25) -> Anchors:
    """Anchors that were seen for a while."""
    anchors = Anchors()
    for u, v in PINNED:
        anchors.add_pixel(u, v, *look(0))
    seen = follow(anchors, *(look(0.1 * i) for i in range(1, frames)))
    assert (seen.confidence > 0.9).all()
    return anchors


def gone(look: Look = scene) -> Anchors:
    """Those that are out of sight now: another tissue is there."""
    anchors = pinned(look)
    found = follow(anchors, *(look(2.5 + 0.5 * i, seed=9) for i in range(round(AWAY / 0.5))))
    assert (found.confidence < 0.2).all()
    return anchors


def back(anchors: Anchors, seconds: float = 3.0, **how: object) -> AnchorStates:
    return follow(anchors, *(scene(20 + 0.25 * i, **how) for i in range(round(seconds / 0.25))))  # type: ignore[arg-type]


@pytest.mark.parametrize("kept", [True, False], ids=["its Gaussians stayed", "the model is another one"])
@pytest.mark.parametrize(
    ("turn", "scale", "shift"),
    [
        (0.0, 1.0, (50.0, -30.0)),
        (20.0, 1.0, (10.0, 20.0)),
        (-10.0, 1.15, (-20.0, 10.0)),
        (0.0, 1.0, (-85.0, 0.0)),  # the first one 15 px from the image's edge
    ],
)
def test_they_come_back_wherever_the_tissue_is(
    turn: float, scale: float, shift: tuple[float, float], kept: bool
) -> None:
    moved = motion(turn, scale, shift)
    states = back(gone(), moved=moved, depth=DEPTH / scale, kept=kept)
    truth = np.array(PINNED) @ moved[:, :2].T + moved[:, 2]
    assert np.linalg.norm(states.pixels - truth, axis=1).max() < 1.0  # px
    assert (states.confidence > 0.7).all() and (states.visibility == 1).all()
    assert states.points[:, 2] == pytest.approx(DEPTH / scale, rel=1e-4)


def test_a_new_model_is_told_before_they_come_back() -> None:
    """However its first frame falls between two looks: who takes the newest frame only must see it."""
    for more in range(6):  # tenths of a second: a look comes every five
        anchors = pinned(frames=25 + more)
        start = 2.4 + 0.1 * more
        for i in range(1, 6):
            told = follow(anchors, scene(start + i / 30, kept=False))
            assert np.isnan(told.points).all() and (told.confidence == 0).all(), (more, i)
        states = follow(anchors, *(scene(start + 0.3 + 0.1 * i, kept=False) for i in range(7)))
        assert np.isfinite(states.points).all() and (states.confidence > 0.7).all()


@pytest.mark.parametrize(
    "how",
    [
        {"seed": 5},
        {"moved": motion(0, 1, (0, 0)) * [[-1], [1]] + [[0, 0, WIDTH - 1], [0, 0, 0]]},
        {"moved": motion(0, 1.5, (0, 0))},
    ],
    ids=["other tissue", "mirrored", "nearer in the image and not in depth"],
)
def test_what_is_not_the_same_tissue_is_refused(how: dict[str, object]) -> None:
    """Better no anchor than one on another place."""
    confidence = back(gone(), **how).confidence
    assert (confidence < 0.2).all(), confidence


def test_along_an_edge_it_could_be_anywhere_and_does_not_say_to_be_sure() -> None:
    """Folds and vessels look alike along themselves."""

    def edges(seconds: float, moved: float = 0, seed: int = 0) -> Scene:
        observation, *rest = scene(seconds, motion(0, 1, (moved, 0)), seed)
        gray = observation.gray.astype(np.float32)
        if seed == 0:
            rows = gray.mean(1, keepdims=True)
            gray = np.float32(128) + 4 * np.repeat(rows - rows.mean(), WIDTH, axis=1)
        noise = np.random.default_rng(round(seconds * 1e3)).normal(0, 1, gray.shape)  # grey levels
        return replace(observation, gray=np.rint(gray + noise).clip(0, 255).astype(np.uint8)), *rest

    anchors = gone(edges)
    states = follow(anchors, *(edges(20 + 0.25 * i, 8.0) for i in range(12)))
    away = np.linalg.norm(states.pixels - np.add(PINNED, [8, 0]), axis=1)
    assert (states.confidence[away > 4] < 0.2).all() and (away > 4).sum() >= 3


def test_depth_is_what_the_model_or_the_frame_says_there_and_never_guessed() -> None:
    """Turned by so much that a patch alone is not found; the second one is in the middle, and stays there."""
    moved = motion(20, 1, (0, 0))

    def without_depth(seconds: float, measured: float) -> Scene:
        observation, snapshot, view = scene(seconds, moved)
        nothing = np.zeros_like(view.depth)
        return (
            replace(observation, depth=nothing + np.float32(measured)),
            snapshot,
            replace(view, depth=nothing),
        )

    anchors = gone()
    states = follow(anchors, *(without_depth(20 + 0.25 * i, 0) for i in range(12)))
    assert (states.confidence > 0.7).tolist() == [False, True, False, False, False]
    assert states.points[1, 2] == pytest.approx(DEPTH, rel=1e-4)
    states = follow(anchors, *(without_depth(30 + 0.25 * i, DEPTH) for i in range(12)))
    assert (states.confidence > 0.7).all()
    assert states.points[:, 2] == pytest.approx(DEPTH, rel=1e-4)


def test_nothing_is_looked_for_while_all_are_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    """It would cost some milliseconds each time."""
    anchors = Anchors()
    anchors.add_pixel(160, 128, *scene(0))
    monkeypatch.setattr(Recall, "look", lambda *_: pytest.fail("looked"))
    follow(anchors, *(scene(0.2 * i) for i in range(1, 30)))


def test_one_that_was_removed_does_not_come_back(monkeypatch: pytest.MonkeyPatch) -> None:
    remembered, ids = Recall(), np.arange(1, len(PINNED) + 1)
    monkeypatch.setattr("sags_node.mapping.anchors.Recall", lambda: remembered)
    anchors, (observation, *_) = gone(), scene(0)
    features = features_of(pyramid_of(observation), observation.tissue)

    def recalled() -> int:
        """How many anchors, by any of the images remembered: one at a time."""
        return max(len(remembered.look(features, ids)) for _ in range(MOST_PICTURES))

    assert recalled() == len(PINNED)
    for anchor in (1, 2, 3):
        anchors.remove(anchor)
    assert back(anchors).ids.tolist() == [4, 5]
    for anchor in (4, 5):
        anchors.remove(anchor)
    assert recalled() == 0


def test_the_first_state_of_the_tissue_is_not_forgotten() -> None:
    """However many others came after it."""
    anchors = gone()
    for seed in range(20, 40):
        anchors.add_pixel(160, 128, *scene(30 + 20 * seed, seed=seed))
        follow(anchors, *(scene(30 + 20 * seed + 0.1 * i, seed=seed) for i in range(1, 4)))
    states = follow(anchors, *(scene(1000 + 0.6 * i) for i in range(20)))
    assert (states.confidence[: len(PINNED)] > 0.5).all()
