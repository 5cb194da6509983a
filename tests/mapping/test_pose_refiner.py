"""Poses that a robot gives, put right by the image: what is slow is the robot's."""

from itertools import pairwise
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from benchmarks.quality.scope import WANDERED, WANDERS
from sags_node.config.schema import LaunchConfig, PhantomSource, VisionConfig
from sags_node.geometry import invert
from sags_node.mapping.budget import StepBudget
from sags_node.mapping.camera_pose import exponential, towards
from sags_node.mapping.first_views import FirstViews
from sags_node.mapping.motion import Tracks
from sags_node.mapping.pose_refiner import SECONDS, PoseRefiner
from sags_node.mapping.resting_tissue import RestingTissue, TissueFit
from sags_node.mapping.tissue_map import TissueMap
from sags_node.phantom.scene import Phantom
from sags_node.pipeline.pipeline import Pipeline
from sags_node.types import F64, Camera, StereoFrame

RATE = 10.0
BREATH = 0.0012  # m
PERIOD = 4.0  # s


def camera(T: F64) -> Camera:
    return Camera(640, 512, np.array([[580.0, 0, 320], [0, 580, 256], [0, 0, 1]]), T)


def refined(monkeypatch: pytest.MonkeyPatch, given: list[F64], seen: list[F64 | None]) -> list[F64]:
    """What a refiner makes of given poses, where the image says others, or nothing."""
    refiner = PoseRefiner(TissueMap(1))
    last: Any = SimpleNamespace()
    tracks = Tracks(np.zeros((1, 2), np.float32), 1 / RATE)
    poses = []
    for number, (T, says) in enumerate(zip(given, seen, strict=True)):
        fit = "hardly any tissue in view" if says is None else TissueFit(says, says)
        monkeypatch.setattr(RestingTissue, "fit", lambda *_, fit=fit: fit)
        guess = refiner.guess(T)
        assert guess is not None
        observation: Any = SimpleNamespace(t_capture_ns=round(number / RATE * 1e9), camera=camera(guess))
        assert refiner.locate(observation, last, tracks) is tracks
        assert bool(refiner.unsure) == (says is None and number > 0)
        poses.append(refiner.pose)
    return poses


def test_a_slow_error_is_taken_out_and_a_breath_is_not_taken_for_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """A filter of the first order lags by the error's speed times its seconds, and lets a swing through by
    one over the angle that it goes on meanwhile."""
    times = np.arange(0, 120, 1 / RATE)
    speed = np.linalg.norm(WANDERED) / WANDERS
    true = [exponential(np.array([0.01 * np.sin(t), 0, 0, 0, 0.1 * np.sin(t), 0])) for t in times]
    base = np.eye(4)
    given = []
    for t, T in zip(times, true, strict=True):
        base[:3, 3] = t / WANDERS * WANDERED
        given.append(base @ T)
    breathing = np.eye(4)
    seen: list[F64 | None] = []
    for t, T in zip(times, true, strict=True):
        breathing[2, 3] = BREATH * np.sin(2 * np.pi * t / PERIOD)
        seen.append(breathing @ T)
    errors = [
        np.linalg.norm((invert(T) @ pose)[:3, 3])
        for T, pose in zip(true, refined(monkeypatch, given, seen), strict=True)
    ]
    left = BREATH / (2 * np.pi * SECONDS / PERIOD)
    assert max(errors) < 1.1 * (speed * SECONDS + left)
    assert np.linalg.norm(given[-1][:3, 3] - true[-1][:3, 3]) > 4 * max(errors)  # as it was given


def test_where_the_picture_cannot_tell_the_camera_moves_as_it_is_given(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    step = exponential(np.array([1e-3, 0, 0, 0, 0.01, 0]))
    given = [np.linalg.matrix_power(step, k) for k in range(60)]
    off = exponential(np.array([0, 2e-3, 0, 0, 0, 0]))
    seen: list[F64 | None] = [off @ T for T in given[:40]] + [None] * 20
    poses = refined(monkeypatch, given, seen)
    moved = [invert(a) @ b for a, b in pairwise(poses[39:])]
    assert np.allclose(moved, step, atol=1e-9)
    assert np.linalg.norm((poses[-1] @ invert(given[-1]))[:3, 3]) > 0.3 * 2e-3  # what was known is kept


def test_the_way_to_a_pose_is_the_shortest() -> None:
    start, motion = exponential(np.array([0.1, 0, 0, 1.0, 0, 0])), np.array([1e-3, 0, 0, 0, 0, 0.02])
    half = towards(start, start @ exponential(motion), 0.5)
    assert np.allclose(half, start @ exponential(0.5 * motion), atol=1e-12)


def test_a_robot_that_is_right_is_left_as_it_is() -> None:
    """The images of a second move the poses by less than the breath that they show, and nothing is held."""
    source = PhantomSource(seconds=2, width=160, height=128, camera_motion="sway")
    phantom = Phantom(source)
    pipeline = Pipeline(LaunchConfig(source=source, vision=VisionConfig(pose="refine")), phantom.rig)
    for number in range(10):
        frame = phantom.frame(number, 20)
        stamp = round(number / RATE * 1e9)
        shown = StereoFrame(
            number, stamp, stamp, frame.left, frame.right, T_world_cam=frame.T_world_cam, tissue=~frame.tool
        )
        result = pipeline.process(shown, StepBudget(1))
        off = invert(frame.T_world_cam) @ result.pair.camera.T_world_cam
        assert not result.held and np.linalg.norm(off[:3, 3]) < BREATH


def test_after_a_gap_tissue_does_not_rest_where_it_is_seen_first(monkeypatch: pytest.MonkeyPatch) -> None:
    """It may be at the end of a breath there. A model of 5 s rests where it was on average."""
    shares: list[float] = []
    monkeypatch.setattr(TissueMap, "settle", lambda _, share: shares.append(share))
    for look in ("pose", "offer"):
        monkeypatch.setattr(FirstViews, look, lambda *_: None)
    tissue = RestingTissue(TissueMap(1))
    for t in [*np.arange(0, 5.05, 1 / RATE), 60.0]:
        observation: Any = SimpleNamespace(t_capture_ns=round(t * 1e9), camera=camera(np.eye(4)))
        tissue.learn(observation)
    assert shares[-2] == pytest.approx(0.1 / 5) and shares[-1] == pytest.approx(1 / 6)
