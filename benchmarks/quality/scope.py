"""How accurate the pose of a moving scope stays over minutes: on the phantom, whose tissue moves, too.

The same images are played once for each way to know the pose. The node's own ways are compared with rigid
odometry, and with the pose that fits the true surface points best. That pose says how much of an error is a
matter of definition, since a motion that all tissue shares cannot be told from the scope's.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, get_args

import cv2
import numpy as np

from benchmarks import Advance
from benchmarks.quality.depth import frame_of
from sags_node.config.schema import LaunchConfig, PhantomSource, PoseWay
from sags_node.errors import UsageError
from sags_node.geometry import project, rigid
from sags_node.mapping.budget import StepBudget
from sags_node.mapping.camera_pose import fit_pose
from sags_node.phantom.motion import BREATH
from sags_node.phantom.scene import Phantom, PhantomFrame, PhantomScene
from sags_node.pipeline.pipeline import Pipeline
from sags_node.pipeline.warm_up import prepare
from sags_node.quality import metrics
from sags_node.tools.evaluation.receipt import Receipt
from sags_node.tools.evaluation.trajectory import RigidOdometry, trajectory_errors
from sags_node.types import F32, F64, Bool, Camera, StereoFrame

Motion = Literal["sway", "zoom", "orbit"]
MOTIONS: tuple[Motion, ...] = get_args(Motion)
RATE = 10.0  # frames per second, where the launch file says nothing
STEPS = 1  # of the mapper, each frame

# What is wrong with the poses that a robot gives.
WANDERS = 120.0  # s, in which the robot's base drifts by WANDERED and TURNED
WANDERED = np.array([0.002, -0.0015, 0.0017])  # m: 3 mm
TURNED = np.radians([0.6, 0.5, -0.6])  # 1 degree
HAND_EYE = np.radians([0.6, -0.6, 0.5])  # error of the hand-eye calibration: 1 degree
JITTER = 1e-4  # m, along each axis (standard deviation)
JITTER_TURN = np.radians(0.03)  # rad about each axis (standard deviation)


class Robot:
    """A robot that gives wrong poses: its base drifts slowly, its hand-eye calibration is wrong, and its
    joints tremble."""

    def __init__(self) -> None:
        self._rng = np.random.default_rng(0)

    def gives(self, T_world_cam: F64, seconds: float) -> F64:
        """Return the robot's pose [4, 4] for the true pose after some seconds."""
        gone = seconds / WANDERS
        trembles = self._rng.normal(size=(2, 3))
        base = rigid(cv2.Rodrigues(gone * TURNED)[0], gone * WANDERED)
        turn = cv2.Rodrigues(HAND_EYE + JITTER_TURN * trembles[1])[0]
        return np.asarray(base @ T_world_cam @ rigid(turn, JITTER * trembles[0]))


@dataclass(slots=True)
class _Played:
    """What the node makes of the images with one way to know the scope's pose."""

    pipeline: Pipeline
    budget: StepBudget = field(default_factory=lambda: StepBudget(STEPS))
    poses: list[F64] = field(default_factory=list)
    psnr: list[float] = field(default_factory=list)
    depth: list[metrics.DepthErrors] = field(default_factory=list)
    held: int = 0

    def take(self, frame: StereoFrame, depth: F32) -> None:
        result = self.pipeline.process(frame, self.budget)
        view, tissue = result.views["left"], result.observation.tissue
        self.poses.append(result.pair.camera.T_world_cam)
        if result.held:
            self.held += 1
            return
        self.psnr.append(metrics.psnr(metrics.as_float(view.rgb), metrics.as_float(result.pair.left), tissue))
        truth = metrics.resample_nearest(depth, view.camera.width, view.camera.height)
        self.depth.append(metrics.depth_errors(view.depth, truth, tissue))

    def figures(self) -> dict[str, float]:
        return {
            "psnr": float(np.mean(self.psnr)),
            "depth_median_mm": float(np.mean([each.median_mm for each in self.depth])),
            "depth_p90_mm": float(np.mean([each.p90_mm for each in self.depth])),
            "held": self.held,
        }


TABLES = (
    "motion way max_mm rpe_mm rpe_deg end_mm end_deg drift_mm drift_deg worst_drift_mm worst_drift_deg"
    " ate_mm",
    "motion way depth_median_mm depth_p90_mm held psnr",
)


def measure_scope(
    config: LaunchConfig, motions: Sequence[Motion], seconds: float, advance: Advance
) -> dict[str, Any]:
    """Measure each motion of the scope once, so many seconds.

    Returns:
        `rows`, by `motion` and `way`. `session`: the true poses are given; `estimate`: none; `robot`: those
        of a `Robot`; `refine`: the same, corrected; `rigid` and `points`: see the module. Errors are those of
        `trajectory_errors` and `drift`, images and depth over frames that were not `held`.
    """
    source = config.source
    if not isinstance(source, PhantomSource):
        raise UsageError("benchmarks scope needs the phantom, whose scope is known: launch/phantom.yaml")
    if seconds < 2 * BREATH:
        raise UsageError(f"--seconds {seconds:g} is too short: two breaths take {2 * BREATH:g}")
    prepare(config)
    rate = source.rate or RATE
    rows: list[dict[str, Any]] = []
    receipts: dict[str, Any] = {}
    for motion in motions:
        moving = source.model_copy(update={"seconds": seconds, "camera_motion": motion})
        found, receipts[motion] = _measured(config, Phantom(moving), motion, seconds, rate, advance)
        rows += found
    return {
        "seconds": seconds,
        "rate": rate,
        "seed": source.seed,
        "width": source.width,
        "height": source.height,
        "still_tissue": PhantomScene.of(source).still_tissue,
        "rows": rows,
        "receipts": receipts,  # by motion
    }


def _measured(
    config: LaunchConfig, phantom: Phantom, motion: Motion, seconds: float, rate: float, advance: Advance
) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """The rows of one motion, and the receipt of what was shown to the ways to know the pose."""
    count, robot = round(seconds * rate), Robot()
    ways: dict[str, PoseWay] = {way: way for way in ("session", "estimate", "refine")} | {"robot": "session"}
    played = {}
    for name, way in ways.items():
        posed = config.vision.model_copy(update={"pose": way})
        played[name] = _Played(Pipeline(config.model_copy(update={"vision": posed}), phantom.rig))
    rigid, rigid_poses, points = RigidOdometry(), list[F64](), _Points(phantom)
    raw = phantom.rig.left
    receipt = Receipt(phantom.rig, config.vision.working_size(raw.width, raw.height), None)
    for number in range(count):
        truth = phantom.frame(number, count)
        given = robot.gives(truth.T_world_cam, number / rate)
        frame = frame_of(number, rate, truth)
        for name, each in played.items():
            pose = given if name in ("robot", "refine") else truth.T_world_cam
            each.take(replace(frame, T_world_cam=pose), truth.depth)
        last = played["session"].pipeline.newest
        assert last is not None
        seen = last.observation
        receipt.add(frame, seen.tissue)
        rigid_poses.append(rigid(last.pair.left, seen.depth, seen.tissue, seen.camera))
        points.add(truth)
        advance(number + 1, count, motion)
    known, period = np.stack(points.poses), round(count / max(1, round(seconds / BREATH)))
    poses = {name: each.poses for name, each in played.items()}
    poses |= {"rigid": rigid_poses, "points": points.fitted(seen.camera)}
    rows: list[dict[str, Any]] = []
    for name, found in poses.items():
        errors = trajectory_errors(np.stack(found), known) | drift(np.stack(found), known, period)
        figures = played[name].figures() if name in played else {}
        rows.append({"motion": motion, "way": name, **errors, **figures})
    return rows, receipt.as_json()


class _Points:
    """The phantom's true surface points over time."""

    def __init__(self, phantom: Phantom) -> None:
        self.poses: list[F64] = []
        self._baseline = phantom.rig.baseline
        self._points: list[F64] = []
        self._visible: list[Bool] = []

    def add(self, truth: PhantomFrame) -> None:
        self.poses.append(truth.T_world_cam)
        self._points.append(truth.points)
        self._visible.append(truth.visible)

    def fitted(self, camera: Camera) -> list[F64]:
        """Return the poses [4, 4] that best explain the points in each frame if every point stayed at its
        mean position; `camera` gives the intrinsics."""
        rest = np.mean(self._points, axis=0).astype(np.float32)
        fitted, focal_baseline = [], float(camera.K[0, 0]) * self._baseline
        for pose, points, visible in zip(self.poses, self._points, self._visible, strict=True):
            there = replace(camera, T_world_cam=pose)
            pixels, depths = project(there, points[visible])
            disparities = (focal_baseline / depths).astype(np.float32)
            fit = fit_pose(rest[visible], pixels.astype(np.float32), disparities, there, self._baseline)
            fitted.append(fit.T_world_cam)
        return fitted


def drift(estimated: F64, known: F64, period: int) -> dict[str, float]:
    """Return how the error of poses `T_world_cam` [T, 4, 4] grows with time.

    `end_...`: the error of the last pose, worlds aligned at the first frame. `drift_...`: the mean error over
    the last `period` frames less that over the first ones; `worst_drift_...`: the largest over any period. If
    the scene repeats itself with that period, its motion changes the pose by the same in all these means.
    """
    ours = np.linalg.inv(estimated[0]) @ estimated
    true = np.linalg.inv(known[0]) @ known
    errors = np.linalg.inv(true) @ ours
    places = errors[:, :3, 3] * 1e3
    turns = np.degrees([cv2.Rodrigues(error[:3, :3])[0][:, 0] for error in errors])
    found = {}
    for unit, values in (("mm", places), ("deg", turns)):
        whole = len(values) // period
        means = values[len(values) - whole * period :].reshape(whole, period, 3).mean(1)
        drifts = np.linalg.norm(means - means[0], axis=1)
        found[f"end_{unit}"] = float(np.linalg.norm(values[-1]))
        found[f"drift_{unit}"] = float(drifts[-1])
        found[f"worst_drift_{unit}"] = float(drifts.max())
    return found
