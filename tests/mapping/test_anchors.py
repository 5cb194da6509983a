"""Points pinned to tissue: known motion, hidden tissue, removed Gaussians, and the phantom's exact points."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from flat_scene import Scene, camera_in_front, flat_means, flat_scene

from sags_node.errors import SagsError
from sags_node.geometry import project
from sags_node.mapping import anchors as module
from sags_node.mapping.anchors import Anchors
from sags_node.mapping.budget import StepBudget
from sags_node.pipeline.pipeline import Pipeline
from sags_node.pipeline.session import open_session
from sags_node.sources.source import open_source
from sags_node.types import AnchorStates, Forecast, MotionState

WIDTH, HEIGHT, FOCAL, DEPTH = 128, 96, 100.0, 0.08
CENTRE = (WIDTH - 1) / 2, (HEIGHT - 1) / 2
PERIOD_NS = 100_000_000


def texture(shift: tuple[int, int] = (0, 0)) -> np.ndarray:
    """Smooth random grey values, moved by (x, y) px."""
    noise = np.random.default_rng(3).uniform(0, 255, (HEIGHT + 40, WIDTH + 40)).astype(np.float32)
    smooth = cv2.normalize(cv2.GaussianBlur(noise, (0, 0), 2), None, 20, 230, cv2.NORM_MINMAX)
    x, y = 20 - shift[0], 20 - shift[1]
    return smooth[y : y + HEIGHT, x : x + WIDTH].astype(np.uint8)


def scene(frame: int = 0, gray: np.ndarray | None = None, drawn: float = DEPTH) -> Scene:
    """The plane, all of it tissue."""
    camera = camera_in_front(WIDTH, HEIGHT, FOCAL)
    picture = texture() if gray is None else gray
    return flat_scene(camera, flat_means(camera, DEPTH, 2.0), picture, drawn, frame, frame * PERIOD_NS)


def moved(one: Scene, by: np.ndarray, kept: np.ndarray | None = None) -> Scene:
    """The scene with its Gaussians moved by [N, 3] or [3] m, and only some of them."""
    observation, snapshot, view = one
    old = snapshot.gaussians
    rows = np.arange(len(old)) if kept is None else np.flatnonzero(kept)
    arrays = {name: getattr(old, name)[rows] for name in ("quats", "scales", "opacities", "colors", "ids")}
    means = (old.means + by).astype(np.float32)[rows]
    return observation, replace(snapshot, gaussians=replace(old, means=means, **arrays)), view


def flat(frame: int) -> Scene:
    """An image in which nothing can be found again: only the Gaussians tell where the tissue went."""
    return scene(frame, np.full((HEIGHT, WIDTH), 90, np.uint8))


def at(anchors: Anchors, stamp_ns: int, **how: bool) -> AnchorStates:
    """As they are when a frame of that time was taken in."""
    anchors.age(stamp_ns, **how)
    return anchors.states()


def only(states: AnchorStates) -> tuple[np.ndarray, np.ndarray, float, float]:
    """Point, pixel, visibility and confidence of the only anchor."""
    assert len(states) == 1
    return states.points[0], states.pixels[0], float(states.visibility[0]), float(states.confidence[0])


def pinned(one: Scene, u: float = 60, v: float = 45) -> Anchors:
    """The only anchor, pinned to a pixel."""
    anchors = Anchors()
    assert anchors.add_pixel(u, v, *one) == 1
    return anchors


def few_left(i: int) -> np.ndarray:
    """Of every Gaussian's kind less than one in three is left at the end of eleven frames."""
    gone = np.random.default_rng(0).uniform(size=(i, len(scene()[1].gaussians))) < 0.1
    return ~gone.any(0)


@pytest.mark.parametrize(
    ("pixel", "frames", "by", "kept", "expected"),
    [
        pytest.param((40.3, 50.6), 3, (4e-4, -8e-4, 0), None, (12e-4, -24e-4, 0), id="with those around it"),
        pytest.param((60, 45), 11, (1e-4, 0, 0), few_left, (11e-4, 0, 0), id="with those that are left"),
        pytest.param((30, 50), 1, "right half", None, (0, 0, 0), id="not with those far away"),
        pytest.param((4, 45), 1, (-8e-3, 0, 0), None, (-8e-3, 0, 0), id="out of the picture"),
    ],
)
def test_an_anchor_moves_with_its_gaussians(
    pixel: tuple[float, float], frames: int, by: Any, kept: Any, expected: tuple[float, ...]
) -> None:
    """And not with others. `by`: m for each frame."""
    anchors = pinned(flat(0), *pixel)
    start, first, visibility, _ = only(at(anchors, 0))
    assert np.allclose(first, pixel, atol=1e-3) and visibility == 1 and start[2] == pytest.approx(DEPTH)
    for i in range(1, frames + 1):
        one = flat(i)
        moves = [0.01, 0, 0] * (one[1].gaussians.means[:, :1] > 0) if by == "right half" else by
        anchors.update(*moved(one, i * np.asarray(moves), kept and kept(i)))
    point, last, visibility, _ = only(at(anchors, frames * PERIOD_NS))
    assert np.allclose(point - start, expected, atol=1e-6)
    assert np.allclose(last, np.add(pixel, FOCAL / DEPTH * np.array(expected[:2])), atol=1e-2)
    assert visibility == (last > 0).all()


def test_it_knows_its_depth_as_well_as_the_tissue_that_carries_it() -> None:
    """Said when it is pinned and while it is followed: a guess does not look like a measurement."""
    observation, snapshot, view = flat(0)
    for error, expected in ((0.0, 1.0), (3e-3, 0.5), (9e-3, 0.125)):
        errors = np.full(len(snapshot.gaussians), error, np.float32)
        known = replace(snapshot, gaussians=replace(snapshot.gaussians, depth_errors=errors))
        anchors = Anchors()
        pinned = anchors.add_pixel(40, 50, observation, known, view)
        assert anchors.depth_confidence(pinned) == pytest.approx(expected, rel=1e-3)
        better = replace(known.gaussians, depth_errors=np.full_like(errors, 1e-3))
        anchors.update(observation, replace(known, gaussians=better), view)
        assert at(anchors, PERIOD_NS).depth_confidence[0] == pytest.approx(2 ** (-1 / 3), rel=1e-3)


def test_a_speck_without_depth_takes_the_nearest_depth_of_tissue() -> None:
    """Drawn surfaces have such specks; a finger points no better than to some pixels."""
    observation, snapshot, view = flat(0)
    observation.depth[47:54, 37:44] = view.depth[47:54, 37:44] = 0
    view.depth[50, 36] = 0.99 * DEPTH
    for row, column in ((46, 40), (50, 44), (54, 40)):  # as near
        observation.tissue[row, column] = False
    anchors = pinned((observation, snapshot, view), 40, 50)
    point, pixel, _, _ = only(at(anchors, 0))
    assert point[2] == pytest.approx(0.99 * DEPTH) and np.allclose(pixel, [40, 50], atol=1e-3)


def test_what_the_picture_shows_corrects_what_the_gaussians_missed() -> None:
    """The tissue moves by whole pixels, the Gaussians stay: the anchor is found again on its texture."""
    anchors = pinned(scene(0))
    for i, shift in enumerate([(2, -1), (4, -3), (7, -3)]):
        anchors.update(*scene(i + 1, texture(shift)))
    point, pixel, visibility, confidence = only(at(anchors, 3 * PERIOD_NS))
    assert np.allclose(pixel, [67, 42], atol=0.1)
    assert np.allclose(point[:2], (np.array([67, 42]) - CENTRE) / FOCAL * DEPTH, atol=1e-4)
    assert visibility == 1 and confidence > 0.8


def test_it_keeps_its_distance_to_the_drawn_surface() -> None:
    anchors = Anchors()
    anchors.add_point(np.array([0, 0, DEPTH + 1e-3]), *flat(0))
    for i in range(1, 60):
        observation, snapshot, view = flat(i)
        anchors.update(observation, snapshot, replace(view, depth=view.depth + np.float32(5e-4)))
    assert only(at(anchors, 0))[0][2] == pytest.approx(DEPTH + 1.5e-3, abs=2e-5)


@pytest.mark.parametrize("below", [0.0, 2e-3, 4e-3])
def test_what_lies_under_tissue_is_in_sight_with_it(below: float) -> None:
    """As a vessel: the tissue that carries it does not hide it, also where the drawn surface is 2 mm wrong.
    Other tissue does, at the pinning, too."""
    place = np.array([0, 0, DEPTH + below])
    anchors = Anchors()
    anchors.add_point(place, *scene(0))
    for i in range(1, 6):
        anchors.update(*scene(i, texture((i, 0)), DEPTH - 2e-3))
        _, pixel, visibility, confidence = only(at(anchors, i * PERIOD_NS))
        assert np.allclose(pixel, CENTRE + np.array([i, 0]), atol=0.1)
        assert visibility == 1 and confidence > 0.8
    anchors.update(*scene(6, texture((5, 0)), DEPTH - 6e-3))
    assert only(at(anchors, 6 * PERIOD_NS))[2] == 0
    covered = Anchors()
    covered.add_point(place, *scene(0, drawn=DEPTH - 6e-3))
    assert only(at(covered, 0))[2] == 0


def test_after_a_restart_of_the_model_it_is_lost_for_good_and_says_so() -> None:
    anchors = pinned(flat(0))
    observation, snapshot, view = flat(1)
    fresh = replace(snapshot.gaussians, ids=snapshot.gaussians.ids + 100_000)
    for gaussians in (fresh, snapshot.gaussians):
        anchors.update(observation, replace(snapshot, gaussians=gaussians), view)
        point, pixel, visibility, confidence = only(at(anchors, PERIOD_NS))
        assert np.isnan(point).all() and np.isnan(pixel).all() and visibility == confidence == 0
    anchors.remove(1)
    assert len(at(anchors, PERIOD_NS)) == 0


def test_visibility_tells_what_hides_it_and_confidence_falls_meanwhile() -> None:
    anchors = pinned(scene(0))
    assert only(at(anchors, 0))[2:] == (1.0, 1.0)
    observation, snapshot, view = scene(1)
    observation.tissue[:, 60:] = False  # an instrument over the right half of the 5 x 5 px around it
    anchors.update(observation, snapshot, view)
    assert only(at(anchors, 0))[2] == pytest.approx(0.4)
    anchors.update(*scene(2, drawn=0.9 * DEPTH))  # other tissue in front
    assert only(at(anchors, 0))[2] == 0
    observation, snapshot, view = scene(3)
    observation.tissue[:] = False
    seconds = 3
    for i in range(1, seconds + 1):
        anchors.update(observation, snapshot, view)
        states = at(anchors, i * 10 * PERIOD_NS)
    assert states.confidence[0] == pytest.approx(0.5 ** (seconds / module.HALF_LIFE))
    assert states.ages[0] == pytest.approx(seconds)
    anchors.update(*scene(4))
    assert only(at(anchors, seconds * 10 * PERIOD_NS))[2:] == (1.0, pytest.approx(1.0, abs=0.01))


def test_while_the_picture_stays_the_same_what_was_found_in_it_stays_sure() -> None:
    """Not what was not found in it, nor what is hidden."""
    for shown, other in ((True, False), (True, True), (False, False)):
        anchors = pinned(scene(0))
        observation, snapshot, view = scene(1, texture()[:, ::-1].copy() if other else None)
        observation.tissue[:] = shown
        anchors.update(observation, snapshot, view)
        first = at(anchors, 0)
        for i in range(1, 5):
            states = at(anchors, i * 10 * PERIOD_NS, equal=True)
        halvings = 0 if shown and not other else 4 / module.HALF_LIFE
        assert states.confidence[0] == pytest.approx(first.confidence[0] * 0.5**halvings)
        assert states.ages[0] == pytest.approx(4)


def test_what_cannot_be_pinned_is_a_clear_error() -> None:
    usable = np.ones((HEIGHT, WIDTH), bool)
    usable[60:70] = False  # a caption
    anchors = Anchors(usable)
    observation, snapshot, view = scene()
    observation.tissue[:] = usable
    observation.tissue[:, :20] = False
    observation.depth[30:40] = view.depth[30:40] = 0
    for pixel, message in (
        ((-0.6, 5), "outside the left image of 128x96"), ((50, 95.5), "outside"),
        ((10, 50), "instrument"), ((50, 65), "vision.tissue.exclude"), ((50, 35), "no depth"),
    ):  # fmt: skip
        with pytest.raises(SagsError, match=message):
            anchors.add_pixel(*pixel, observation, snapshot, view)
    with pytest.raises(SagsError, match="no tissue within 5 mm"):
        anchors.add_point(np.array([0, 0, DEPTH + 0.006]), observation, snapshot, view)
    with pytest.raises(SagsError, match="no anchor 1"):
        anchors.remove(1)
    assert len(anchors) == 0


def test_who_wants_it_learns_also_where_an_anchor_is_expected() -> None:
    """Never further ahead than motion is predicted, and beside where it was seen, not in its place."""
    observation, snapshot, view = scene()
    nodes = snapshot.gaussians.means[::100].copy()
    steps = np.arange(1, 5, dtype=np.float32)[:, None, None]
    moves = steps * np.full((len(nodes), 3), [1e-3, 0, 0], np.float32)
    rows, motion = np.zeros((1, 4)), MotionState(None, 0.9, 0.1)
    forecast = Forecast(motion, 0.05, nodes, moves, rows.astype(np.int32), rows.astype(np.float32))
    snapshot = replace(snapshot, forecast=forecast)
    anchors = Anchors()
    asked, silent, soon = (anchors.add_pixel(u, 48, observation, snapshot, view) for u in (40, 60, 80))
    anchors.look_ahead(asked, 0.5)  # far beyond 0.1 s
    anchors.look_ahead(soon, None)
    anchors.update(observation, snapshot, view)
    states = anchors.ahead(at(anchors, 0), snapshot, 0.025)
    assert states.ahead is not None and list(states.ids) == [asked, silent, soon]
    np.testing.assert_allclose(states.ahead.seconds, [0.1, 0, 0.025], atol=1e-6)
    np.testing.assert_allclose((states.ahead.points - states.points)[:, 0], [2e-3, 0, 5e-4], atol=1e-6)
    apart = (states.ahead.pixels - states.pixels)[:, 0]
    np.testing.assert_allclose(apart, FOCAL / DEPTH * np.array([2e-3, 0, 5e-4]), atol=1e-2)
    assert anchors.ahead(at(anchors, 0), replace(snapshot, forecast=None), 0.025).ahead is None


def test_ids_are_never_used_again_and_their_number_is_limited(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "MAX_ANCHORS", 3)
    anchors = Anchors()
    assert [anchors.add_pixel(50, 50, *scene()) for _ in range(3)] == [1, 2, 3]
    with pytest.raises(SagsError, match="3 anchors already"):
        anchors.add_pixel(50, 50, *scene())
    anchors.remove(3)
    assert anchors.add_pixel(50, 50, *scene()) == 4
    assert at(anchors, 0).ids.tolist() == [1, 2, 4]


# ---- on the phantom --------------------------------------------------------------------------------------


def test_exact_surface_points_of_the_phantom_are_followed(phantom_session: Path) -> None:
    """Pinned in the first frame at their true places; nothing about the truth is used after that."""
    session = open_session(phantom_session, ["source.pace:=step"])
    pipeline, budget = Pipeline(session.config, session.rig), StepBudget(2)
    metres, pixels, seen, shown = [], [], [], []
    with open_source(session.config.source) as frames:
        for frame in frames:
            result = pipeline.process(frame, budget)
            truth, visible = frame.reference.points, frame.reference.points_visible
            if frame.frame_id == 0:
                chosen = np.flatnonzero(visible)
                for point in truth[chosen]:
                    pipeline.anchors.add_point(
                        point, result.observation, result.snapshot, result.views["left"]
                    )
                continue
            found, truth = result.anchors, truth[chosen]
            metres.append(np.linalg.norm(found.points - truth, axis=1))
            pixels.append(np.linalg.norm(found.pixels - project(result.pair.camera, truth)[0], axis=1))
            seen.append(visible[chosen])
            shown.append(found.visibility > 0.5)
    mm, px, truly_seen = 1e3 * np.array(metres), np.array(pixels), np.array(seen)
    always = truly_seen.all(0)
    assert always.sum() > 100 and (~truly_seen).sum() > 200
    assert np.median(px[:, always]) < 0.4 and np.median(mm[:, always]) < 0.5
    assert np.percentile(px[:, always], 90) < 2 and np.percentile(mm[:, always], 90) < 2
    assert np.median(mm[~truly_seen]) < 3
    assert np.mean(np.array(shown) == truly_seen) > 0.9


def test_skipped_and_repeated_frames_keep_the_anchors(phantom_session: Path) -> None:
    session = open_session(phantom_session, ["source.pace:=step"])
    pipeline, budget = Pipeline(session.config, session.rig), StepBudget(1)
    with session.source as frames:
        first, *_, later = (frame for frame, _ in zip(frames, range(4), strict=False))
    mapped = pipeline.process(first, budget)
    pipeline.anchors.add_pixel(160, 128, mapped.observation, mapped.snapshot, mapped.views["left"])
    again = pipeline.process(replace(first, frame_id=1, t_capture_ns=first.t_capture_ns + PERIOD_NS), budget)
    assert again.skipped.keys() == {"frame"} and len(again.anchors) == 1 and len(mapped.anchors) == 0
    assert again.anchors.confidence[0] == 1  # the image shows it still
    jumped = pipeline.process(later, budget)
    assert np.isfinite(jumped.anchors.points).all()
    pipeline.reset()
    fresh = pipeline.process(later, budget)
    assert fresh.epoch > jumped.epoch and np.isnan(fresh.anchors.points).all()


def test_the_farther_it_is_carried_out_of_sight_the_less_sure_it_is() -> None:
    """Also where it is in the image, but the image is no good."""
    ways = {}
    for step in (0.0, 1e-3):
        anchors = pinned(flat(0), 64, 48)
        at(anchors, 0)
        for frame in range(1, 6):
            anchors.update(*moved(flat(frame), np.array([frame * step, 0, 0])), clear=False)
            ways[step] = at(anchors, frame * PERIOD_NS)
    assert ways[0.0].confidence[0] > 0.8
    assert ways[1e-3].confidence[0] == pytest.approx(0.5 * ways[0.0].confidence[0], rel=0.05)  # 5 mm
