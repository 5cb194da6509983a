"""Instruments as objects: drawn masks whose tips are known, and the phantom's grasper."""

from dataclasses import replace
from pathlib import Path

import cv2
import independent_client as client
import numpy as np
import pytest
from instrument_scenes import HEIGHT, WIDTH, bars, filmed
from running_node import RunningNode

from sags_node.confidence import confidence_of, error_of
from sags_node.config.schema import LaunchConfig
from sags_node.instruments.depths import agreements, disparities, eyes
from sags_node.instruments.instruments import Instruments
from sags_node.instruments.outlines import geodesic, outlines
from sags_node.mapping.budget import StepBudget
from sags_node.pipeline.pipeline import FrameRequest, Pipeline
from sags_node.types import Bool, InstrumentStates

EVERYWHERE = np.ones((HEIGHT, WIDTH), np.bool_)
CROSS, SQUARE = (cv2.getStructuringElement(kind, (3, 3)) for kind in (cv2.MORPH_CROSS, cv2.MORPH_RECT))
COARSE = 3  # px: distances from the entry are counted in these
ASKED = FrameRequest(instruments=True)
OUTSIDE = [((-40, 120), (360, 150)), ((300, 300), (360, 220))]  # from edge to edge; the corner of a shaft


def instruments_in(tools: Bool | None, right: bool = True, plane: float = 0.08) -> InstrumentStates:
    """Of the filmed images, before tissue that is a plane at a depth, m."""
    scene = filmed()
    left, there = (cv2.cvtColor(eye, cv2.COLOR_RGB2GRAY) for eye in (scene.pair.left, scene.pair.right))
    surface = replace(scene.surface, depth=np.full_like(scene.surface.depth, plane))
    states = Instruments(EVERYWHERE).update(
        tools, left, there if right else None, scene.pair.camera, scene.pair.baseline, surface
    )
    assert states is not None
    return states


# ---- in the image --------------------------------------------------------------------------------------


@pytest.mark.parametrize("angle", range(0, 360, 30))
def test_the_end_of_a_straight_instrument_is_found_and_the_way_it_points(angle: int) -> None:
    way = np.array([np.cos(np.radians(angle)), np.sin(np.radians(angle))])
    tip = np.array([WIDTH, HEIGHT]) / 2 - 0.5
    (found,) = outlines(bars((tuple(tip - 400 * way), tuple(tip))), EVERYWHERE)
    assert not found.is_outside and found.is_alone
    assert np.linalg.norm(found.far - tip) <= COARSE
    assert (found.far - found.back) @ way / np.linalg.norm(found.far - found.back) > np.cos(np.radians(3))


def test_instruments_that_cross_are_two() -> None:
    tips = np.array([[230, 60], [90, 70]])
    found = outlines(bars(((20, 300), (230, 60)), ((300, 300), (90, 70))), EVERYWHERE)
    assert len(found) == 2 and not any(each.is_alone for each in found)
    for tip in tips:
        assert min(np.linalg.norm(each.far - tip) for each in found) <= 2 * COARSE


def test_the_tip_of_open_jaws_lies_between_them() -> None:
    mask = bars(((160, 300), (160, 150))) | bars(((160, 155), (120, 90)), ((160, 155), (200, 85)), thick=8)
    (found,) = outlines(mask, EVERYWHERE)
    assert abs(found.far[0] - 160) <= 2 * COARSE and abs(found.far[1] - 85) <= 2 * COARSE
    assert found.spread >= 30  # and says how far each of them is


@pytest.mark.parametrize("ends", OUTSIDE)
def test_an_instrument_whose_tip_is_not_in_the_picture_has_none(ends: tuple[tuple[int, int], ...]) -> None:
    (found,) = outlines(bars(ends, thick=60), EVERYWHERE)
    assert found.is_outside


def test_what_does_not_come_from_the_edge_is_no_instrument() -> None:
    mask = bars(((100, 100), (200, 150)))
    assert outlines(mask, EVERYWHERE) == []
    usable = EVERYWHERE.copy()
    usable[:, :110] = False  # e.g. a caption: there the image ends
    assert len(outlines(mask, usable)) == 1


def test_a_masked_frame_around_the_picture_joins_no_instruments() -> None:
    mask = bars(((40, 300), (40, 130)), ((280, 300), (280, 130)))
    mask[:8], mask[-8:], mask[:, :8], mask[:, -8:] = True, True, True, True
    found = outlines(mask, EVERYWHERE)
    assert len(found) == 2 and all(each.is_alone for each in found)
    for tip in ((40, 130), (280, 130)):
        assert min(np.linalg.norm(each.far - tip) for each in found) <= COARSE


@pytest.mark.parametrize("seed", range(24))
def test_any_mask_gives_places_or_nothing(seed: int) -> None:
    rng = np.random.default_rng(seed)
    height, width = [(256, 320), (128, 160), (33, 40)][seed % 3]
    noise = cv2.GaussianBlur(rng.normal(size=(height, width)), (0, 0), rng.uniform(0.5, width / 8))
    mask = noise > np.quantile(noise, rng.uniform(0, 1))
    gray = rng.integers(0, 255, (height, width), np.uint8)
    seen = eyes(gray, np.roll(gray, -5, 1), mask, 0.3)
    for found in outlines(mask, np.ones_like(mask)):
        assert np.isfinite([*found.far, *found.back, found.spread]).all()
        line = None if found.is_outside else disparities(seen, found, (2.0, 30.0))
        assert line is None or np.isfinite(line.covariance).all()


def test_ways_inside_of_a_mask_are_as_long_as_growing_says() -> None:
    """Against OpenCV, which grows the start by a cross and by a square in turn, and its own source."""
    noise = cv2.GaussianBlur(np.random.default_rng(0).normal(size=(70, 90)), (0, 0), 3)
    inside = (noise > -0.02).astype(np.uint8)
    reached = inside * (np.arange(90) < 3).astype(np.uint8)
    found, expected = np.zeros((2, 70, 90), np.int32)
    rows, columns, steps = geodesic(inside, reached)
    assert all(map(np.array_equal, (rows, columns, steps), geodesic.py_func(inside, reached)))
    found[rows, columns] = steps
    for step in range(1, steps[-1] + 2):
        expected[(reached > 0) & (expected == 0)] = step
        reached = cv2.dilate(reached, CROSS if step % 2 else SQUARE) & inside
    assert steps[-1] > 60 and np.array_equal(found, expected)


def test_a_patch_agrees_where_it_is_found_again() -> None:
    """In an image that is shifted by 7.5 px, 2 down, brighter and flatter; not with what lies beyond it."""
    left = 128 + 700 * cv2.GaussianBlur(np.random.default_rng(0).uniform(-1, 1, (80, 200)), (0, 0), 3)
    right = cv2.warpAffine(left, np.array([[1, 0, -7.5], [0, 1, 2.0]]), (200, 80))
    pictures = np.rint(left).astype(np.uint8), np.rint(0.5 * right + 90).astype(np.uint8)
    counts = np.where(np.arange(200) < 105, 255, np.zeros((80, 1), np.uint8)).astype(np.uint8)
    given = *pictures, counts, 100.25, 40.5, 2.0, 9, 2, np.array([3.5, 7.5, 11.5, 95.0])
    found = agreements(*given)
    assert found[1] > 0.999 and max(found[0], found[2]) < 0.9 and found[3] == -1
    np.testing.assert_allclose(found, agreements.py_func(*given), atol=1e-5)


# ---- in the world ----------------------------------------------------------------------------------------


def test_a_tip_is_where_it_is_told_and_so_is_the_tissue() -> None:
    scene, found = filmed(), instruments_in(filmed().tools, plane=0.065)
    assert len(found) == 1
    told = float(error_of(found.confidence)[0])
    px = scene.tip[2] ** 2 / (scene.pair.camera.K[0, 0] * scene.pair.baseline)  # m, of one px of disparity
    assert np.linalg.norm(found.tips[0] - scene.tip) < min(told, 1.5 * px)
    assert found.axes[0] @ scene.axis > np.cos(np.radians(25))
    ahead, step = 0.065 - found.tips[0, 2], 0.0005
    assert ahead / found.axes[0, 2] <= found.distance[0] < ahead / found.axes[0, 2] + step
    aside = 4 * 0.065 / scene.pair.camera.K[0, 0]  # of every fourth pixel, the nearest
    assert ahead - 1e-6 <= found.clearance[0] < np.hypot(ahead, aside)
    apart = np.linalg.norm(found.nearest[0] - found.tips[0])
    assert apart == pytest.approx(found.clearance[0], rel=1e-5) and found.nearest[0, 2] == np.float32(0.065)
    assert found.distance_confidence[0] <= found.clearance_confidence[0] <= found.confidence[0]


@pytest.mark.fault("instruments: the right eye must not be used")
def test_a_depth_that_cannot_be_measured_is_not_guessed() -> None:
    found = instruments_in(filmed().tools, right=False)
    assert len(found) == 1
    for unknown in (found.tips, found.axes, found.pixels, found.distance, found.clearance, found.nearest):
        assert np.isnan(unknown).all()
    assert not any([found.confidence[0], found.distance_confidence[0], found.clearance_confidence[0]])


def test_what_lies_behind_the_tissue_is_not_sure() -> None:
    found = instruments_in(filmed().tools, plane=0.04)
    behind = found.tips[0, 2] - 0.04
    assert behind > 0.01 and found.confidence[0] < confidence_of(np.float32(behind))
    assert found.distance[0] == 0


def test_without_masks_there_are_none() -> None:
    assert len(instruments_in(None)) == 0 == len(instruments_in(np.zeros_like(EVERYWHERE)))


def test_an_instrument_keeps_its_number() -> None:
    scene, found = filmed(), Instruments(EVERYWHERE)
    gray = scene.pair.left[..., 0]

    def numbers(at_s: float, *tips: int) -> list[int]:
        mask = bars(*(((tip, 300), (tip, 128)) for tip in tips)) if tips else ~EVERYWHERE
        view = replace(scene.surface, t_capture_ns=round(at_s * 1e9))
        states = found.update(mask, gray, None, scene.pair.camera, scene.pair.baseline, view)
        assert states is not None
        return sorted(states.ids.tolist())

    assert numbers(0.0, 80) == [1]
    assert numbers(0.1, 90, 240) == [1, 2]
    assert numbers(0.2, 230) == [2]
    assert numbers(0.3, 100, 220) == [1, 2]  # away for less than half a second
    assert numbers(0.4) == []
    assert numbers(1.0, 100) == [3]  # away for longer: it may be another one
    assert numbers(1.1, 300) == [4]  # too far to be the same


@pytest.mark.parametrize(("rate", "looks"), [(8, 80), (10, 100), (15, 100), (60, 100)])
def test_they_are_looked_for_ten_times_a_second(rate: int, looks: int) -> None:
    """In ten seconds, and again when the clock goes back."""
    scene, found = filmed(), Instruments(EVERYWHERE)
    gray = scene.frame.left[..., 0]
    for begins in (100.0, 50.0):
        made = 0
        for frame in range(10 * rate):
            view = replace(scene.surface, t_capture_ns=round((begins + frame / rate) * 1e9))
            made += found.update(None, gray, None, scene.pair.camera, 0.004, view) is not None
        assert abs(made - looks) <= 1


# ---- in the node -----------------------------------------------------------------------------------------


def test_nothing_is_made_until_somebody_asks() -> None:
    scene = filmed()
    size = {"width": WIDTH, "height": HEIGHT}
    pipeline = Pipeline(LaunchConfig.model_validate({"vision": size}), scene.phantom.rig)
    assert pipeline.process(scene.frame, StepBudget(1)).instruments is None
    later = replace(scene.frame, frame_id=1, t_capture_ns=2 * 10**9)  # it equals the one before
    found = pipeline.process(later, StepBudget(1), ASKED).instruments
    assert found is not None and len(found) == 1 and found.confidence[0] > 0
    again = replace(later, frame_id=2, t_capture_ns=3 * 10**9)
    assert pipeline.process(again, StepBudget(1), ASKED).instruments is None  # nothing was looked at
    config = LaunchConfig.model_validate({"vision": {**size, "tissue": {"method": "none"}}})
    without = Pipeline(config, scene.phantom.rig).process(scene.frame, StepBudget(1), ASKED).instruments
    assert without is not None and len(without) == 0


@pytest.mark.live
def test_a_subscriber_gets_them_ten_times_a_second(phantom_session: Path, tmp_path: Path) -> None:
    node = RunningNode(phantom_session, tmp_path, "source.pace:=fast")
    messages = client.collect(node.data, ["instruments"], 5, 60)["instruments"]
    assert node.stop() == 0
    stamps = [message.meta["stamp_ns"] for message in messages]
    assert np.mean(np.diff(stamps)) >= 0.9e8
    for message in messages:
        client.check_meta(message, "sensor_msgs/msg/PointCloud2")
        names = message.meta["encoding"].split(",")
        rows = dict(zip(names, message.array().reshape(-1, len(names)).T, strict=True))
        assert len(rows["x"]) >= 1 and set(rows["source"].tolist()) == {1.0}
        known = np.isfinite(rows["x"])
        assert (rows["confidence"][~known] == 0).all() and (rows["confidence"][known] > 0).all()
