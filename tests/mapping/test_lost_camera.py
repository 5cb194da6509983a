"""A scope that jumps: it is lost until it is verified, and light that travels with it."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from engine_scenes import rasterize

from sags_node.config.schema import LaunchConfig
from sags_node.geometry import invert
from sags_node.mapping.budget import StepBudget
from sags_node.mapping.camera_pose import exponential
from sags_node.mapping.camera_tracker import DISAGREEING, LOOK_NS, TRIAL
from sags_node.mapping.keyframes import Keyframes
from sags_node.mapping.tissue_map import Learnt, TissueMap
from sags_node.model.light import light_gain
from sags_node.phantom.scene import Phantom, PhantomScene
from sags_node.pipeline.pipeline import Pipeline
from sags_node.quality.metrics import as_float
from sags_node.types import F64, FrameResult, Observation, RenderedView, StereoFrame

SHAPE = PhantomScene(seconds=8, width=320, height=256, still_tissue=True)
PERIOD_NS = 33_000_000
TISSUE = 0.075  # m, to the middle of what the scope sees first


class Scope:
    """A scope over still tissue that is wherever it is put."""

    def __init__(self, phantom: Phantom, pose: str, steps: int = 1) -> None:
        config = LaunchConfig.model_validate({"source": SHAPE, "vision": {"pose": pose}})
        self.pipeline, self._budget = Pipeline(config, phantom.rig), StepBudget(steps)
        self._phantom, self._frames = phantom, 0

    def look(self, T: F64) -> StereoFrame:
        shown = self._phantom.frame(0, 240, T)
        return StereoFrame(0, 0, 0, shown.left, shown.right, T_world_cam=T, tissue=~shown.tool)

    def take(self, frame: StereoFrame) -> FrameResult:
        self._frames += 1
        stamp = self._frames * PERIOD_NS
        now = replace(frame, frame_id=self._frames, t_capture_ns=stamp, t_capture_right_ns=stamp)
        return self.pipeline.process(now, self._budget)


@pytest.fixture(scope="module")
def swaying() -> tuple[Phantom, list[StereoFrame]]:
    phantom = Phantom(SHAPE)
    return phantom, [Scope(phantom, "estimate").look(sway(k)) for k in range(12)]


@pytest.fixture
def ours(swaying: tuple[Phantom, list[StereoFrame]]) -> Scope:
    """One that has swayed, and estimates where it is."""
    phantom, frames = swaying
    scope = Scope(phantom, "estimate")
    for frame in frames:
        scope.take(frame)
    return scope


def about_tissue(turn: F64) -> F64:
    """Pose of a scope that looks at the same tissue after a turn [3] (rotation vector, rad)."""
    T, middle = np.eye(4), np.array([0, 0, TISSUE])
    T[:3, :3] = cv2.Rodrigues(turn)[0]
    T[:3, 3] = middle - T[:3, :3] @ middle
    return T


def aside(x: float, y: float = 0.0) -> F64:
    """By so many m, looking at the same tissue."""
    return about_tissue(np.array([y, -x, 0]) / TISSUE)


def sway(k: int) -> F64:
    angle = 2 * np.pi * k / 12
    return about_tissue(0.05 * np.array([np.sin(angle), np.cos(angle) - 1, 0.4 * np.sin(angle)]))


def is_at(T: F64, true: F64) -> bool:
    """To 2 mm and 2 degrees."""
    wrong = invert(true) @ T
    turn = np.degrees(np.linalg.norm(cv2.Rodrigues(wrong[:3, :3])[0]))
    return bool(np.linalg.norm(wrong[:3, 3]) < 2e-3 and turn < 2)


def test_no_jump_ends_verified_and_wrong(ours: Scope) -> None:
    """Near jumps, far ones, and some to where the scope has never been."""
    rng = np.random.default_rng(0)
    found = []
    for size in np.linspace(0.1, 1.0, 12):
        turn, move = rng.normal(size=3), rng.normal(size=3)
        turn *= np.radians(40) * size / np.linalg.norm(turn)
        T = about_tissue(0.5 * turn)
        T[:3, 3] += move * 0.015 * size / np.linalg.norm(move)
        frame = ours.look(T)
        results = [ours.take(frame) for _ in range(TRIAL + 1)]
        assert all(each.epoch == 0 for each in results)
        assert all(each.held or is_at(each.pair.camera.T_world_cam, T) for each in results), size
        found.append(not results[-1].held)
    assert all(found[:3]) and sum(found) >= 4, found  # or it would be right by finding nothing


def test_while_it_is_verified_nothing_is_learnt(ours: Scope) -> None:
    before = ours.pipeline.newest
    assert before is not None
    frame = ours.look(aside(0.008))
    results = [ours.take(frame) for _ in range(TRIAL)]
    assert all(each.held for each in results[:-1])
    for result in results[:-1]:
        assert np.array_equal(result.snapshot.gaussians.means, before.snapshot.gaussians.means)
        assert np.array_equal(result.snapshot.gaussians.colors, before.snapshot.gaussians.colors)
    again = [result for result in [results[-1], ours.take(frame)] if not result.held]
    assert again and np.isin(again[0].snapshot.gaussians.ids, before.snapshot.gaussians.ids).mean() > 0.8


def test_a_wrong_place_is_found_out_and_what_was_learnt_there_undone(
    swaying: tuple[Phantom, list[StereoFrame]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """What was seen before stands elsewhere: where the camera is found again the model fits, but not that."""
    wrong = invert(exponential(np.array([0.012, -0.01, 0.004, 0.1, 0.0, 0.1])))  # 16 mm, 8 degrees
    offer, learnt, known = Keyframes.offer, TissueMap.learnt, list[Learnt]()

    def elsewhere(self: Keyframes, observation: Observation, view: RenderedView) -> None:
        camera = observation.camera
        moved = replace(observation, camera=replace(camera, T_world_cam=wrong @ camera.T_world_cam))
        offer(self, moved, view)

    def noted(self: TissueMap) -> Learnt:
        known.append(learnt(self))
        return known[-1]

    monkeypatch.setattr(Keyframes, "offer", elsewhere)
    monkeypatch.setattr(TissueMap, "learnt", noted)
    phantom, frames = swaying
    ours = Scope(phantom, "estimate")
    for frame in frames:
        ours.take(frame)
    tissue, there = ours.pipeline.map, [ours.look(aside(0.008) @ sway(k)) for k in range(12)]
    assert any(not ours.take(there[0]).held for _ in range(TRIAL + 2))
    (right,) = known
    ids = right.model.ids.copy()

    looks = DISAGREEING * (LOOK_NS // PERIOD_NS + 1) + 1
    for k in range(looks):
        result = ours.take(there[k % 12])
        if result.held:
            break
    assert result.held and "elsewhere" in result.skipped["pose"]
    assert tissue.model is right.model and np.array_equal(tissue.model.ids, ids)
    results = [ours.take(there[(k + i) % 12]) for i in range(TRIAL + 3)]
    true = there[(k + TRIAL + 2) % 12].T_world_cam
    assert not results[-1].held and is_at(results[-1].pair.camera.T_world_cam, true)


def test_the_light_moves_with_the_scope() -> None:
    """A model of tissue that is not wet, made from one place, drawn 12 and 19 mm aside, as the scope with its
    lamp sees it there."""
    ours = Scope(Phantom(SHAPE.model_copy(update={"gloss": 0.0})), "session", steps=3)
    frame = ours.look(np.eye(4))
    for _ in range(8):
        ours.take(frame)
    pipeline = ours.pipeline
    turned = aside(0.012), aside(0, 0.012), aside(-0.019)
    straight = [exponential(np.array([metres, 0, 0, 0, 0, 0])) for metres in (0.012, 0.019)]
    # Seen from elsewhere tissue has its broad gleam elsewhere too, which is left out: turned, there is less
    # to gain.
    for T, gain in zip((*turned, *straight), (2, 2, 2, 6, 6), strict=True):
        there = ours.look(T)
        pair = pipeline.rectifier(there)
        tissue = cv2.erode(pipeline.tissue(there, pair, None).view(np.uint8), np.ones((9, 9))) > 0
        psnr = []
        for gaussians in (pipeline.map.model.gaussians(), pipeline.map.relight(pair.camera)):
            view = rasterize(gaussians, pair.camera)
            wrong = (as_float(view.rgb) - pair.left / np.float32(255))[tissue & (view.alpha > 0.9)]
            psnr.append(-10 * np.log10(np.mean(np.square(wrong))))
        assert psnr[1] - psnr[0] > gain, T


def test_light_falls_off_with_the_square_of_the_distance_and_the_angle() -> None:
    """A flat piece of tissue right below the lamp; display values are light to the power of 1 / 2.2."""
    means = np.array([[0, 0, 0.05]], np.float32)
    index, weight = np.zeros((1, 4), np.int32), np.full((1, 4), 0.25, np.float32)
    facing = np.array([[0, 0, -1]], np.float32)

    def factor(T: F64, normal: np.ndarray = facing) -> float:
        return float(light_gain(means, normal, index, weight, np.eye(4), T)[0])

    back = np.eye(4)
    back[2, 3] = -0.05
    assert factor(back) == pytest.approx(0.25 ** (1 / 2.2), rel=1e-5)
    assert factor(np.eye(4)) == 1
    # At 60 degrees, as far away as before, pointed at it: only the angle at which light arrives counts.
    c, s = 0.5, np.sqrt(0.75)
    slanted = np.eye(4)
    slanted[:3, :3] = [[c, 0, s], [0, 1, 0], [-s, 0, c]]
    slanted[:3, 3] = means[0] - 0.05 * slanted[:3, 2]
    assert factor(slanted) == pytest.approx(0.5 ** (1 / 2.2), rel=1e-4)
