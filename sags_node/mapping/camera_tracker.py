"""Where the camera is, frame by frame, against the model's tissue at rest."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np

from sags_node.geometry import disparity_to_depth, invert, project
from sags_node.mapping.camera_pose import PoseFit, fit_pose
from sags_node.mapping.keyframes import Keyframes
from sags_node.mapping.mapper import Drawn, Mapper
from sags_node.types import F32, F64, I64, U8, Bool, Camera, Observation, RenderedView

CANDIDATES = 2000  # Gaussians, of those found
POINTS = 300  # of them, those with most texture; measured: one in each cell of a grid is worse
WINDOW = (15, 15)  # px
LARGEST_CORRECTION = 3 / 640  # of the width
LEAST_POINTS = 40
PULL = 0.2  # share of the way back to its place at rest, per frame: keeps the pose from drifting
REST_SECONDS = 10.0  # over which a place at rest follows the tissue: longer than a breath
LEAST_INLIERS = 0.35  # of the points
LEAST_AGREEMENT = 0.5  # correlation of the picture with the colours of the Gaussians found in it
LARGEST_SCALE = 4 / 640  # of the width: of the residuals
GIVE_UP = 15  # lit frames: then a new model is begun
LIT = 4.0  # grey levels, standard deviation over the tissue: a covered or dark picture has less


class CameraTracker:
    """Estimates the camera's pose from where the model's Gaussians are found in each frame.

    Pictures cannot tell a camera that moves from tissue that moves as one. Here the motion that most of the
    tissue shares is the camera's: every Gaussian has a place at rest, which follows it slowly, and the camera
    is where most of them are seen nearest to that. What moves otherwise, as pulled tissue does, counts
    little.

    A frame in which too few are found, or in which what is found looks otherwise, leaves the camera lost.
    Then the last pose stays, and every frame is compared with the last one that was tracked, and with
    keyframes. When `GIVE_UP` frames have shown something else, a new model is begun at the last pose.

    Attributes:
        lost: why the camera is lost; None: it is not.
    """

    def __init__(self, mapper: Mapper, draw: Callable[[Camera], RenderedView]) -> None:
        """`draw`: shows the mapper's model as it is now."""
        self.lost: str | None = None
        self._mapper = mapper
        self._draw = draw
        self._pose: F64 = np.eye(4)
        self._motion: F64 = np.eye(4)  # of the camera in its own axes, from the frame before to the last one
        self._keyframes = Keyframes()
        self._restarts = mapper.restarts
        self._unknown = 0  # lit frames in a row in which the camera was lost
        self._stamp_ns: int | None = None  # of the last frame that was mapped

    @property
    def pose(self) -> F64:
        """`T_world_cam` [4, 4] of the last frame that was tracked."""
        return self._pose

    def track(self, observation: Observation) -> bool:
        """Find the pose of a frame, whatever its camera says; False: the camera is lost."""
        if self._mapper.model.count == 0:
            self.lost, self._motion = None, np.eye(4)
            return True  # the model begins where the camera was last
        fit = self._fit(observation, self._pose @ self._motion)
        if isinstance(fit, str) and self.lost is not None:
            fit = self._find_again(observation, fit)
        if isinstance(fit, PoseFit):
            moved = invert(self._pose) @ fit.T_world_cam
            self._motion = np.eye(4) if self.lost is not None else moved
            self._pose, self.lost, self._unknown = fit.T_world_cam, None, 0
            return True
        self.lost, self._motion = fit, np.eye(4)
        self._unknown = self._unknown + 1 if _is_lit(observation) else 0
        if self._unknown < GIVE_UP:
            return False
        self._mapper.restart()
        self.lost, self._unknown = None, 0
        return True

    def mapped(self, observation: Observation, view: RenderedView) -> None:
        """Learn from a frame that was tracked and taken in; `view` is the model drawn for it."""
        if self._mapper.restarts != self._restarts:
            self._restarts = self._mapper.restarts
            self._keyframes.clear()
        before, self._stamp_ns = self._stamp_ns, observation.t_capture_ns
        passed = 0.0 if before is None else max(0.0, (self._stamp_ns - before) * 1e-9)
        model = self._mapper.model
        new = np.isnan(model.rest[:, 0])
        model.rest[new] = model.means[new]
        model.rest[:] += np.float32(min(1.0, passed / REST_SECONDS)) * (model.means - model.rest)
        self._keyframes.offer(observation, view)

    def _fit(self, observation: Observation, start: F64) -> PoseFit | str:
        """The pose, or why there is none."""
        model, camera, last = self._mapper.model, observation.camera, self._mapper.last
        pixels = self._mapper.found_again(observation)
        rows = np.flatnonzero(_is_inside(pixels, observation.gray))
        rows = rows[:: max(1, len(rows) // CANDIDATES)]
        if last is None or len(rows) < LEAST_POINTS:
            return "hardly any tissue in view"
        seen = _values(observation.gray, pixels[rows])
        if _correlation(model.colors[rows].mean(1), seen) < LEAST_AGREEMENT:
            return "the picture does not show the model's tissue"

        before = project(last.view.camera, model.means[rows])[0].astype(np.float32)
        chosen = _most_textured(last.observation.gray, before)
        found, pixels = _refined(
            last.observation.gray, observation.gray, before[chosen], pixels[rows[chosen]]
        )
        rows = rows[chosen[found]]
        if len(rows) < LEAST_POINTS:
            return "too little texture to follow"
        points = model.means[rows] + np.float32(PULL) * (model.rest[rows] - model.means[rows])
        # The formula is its own inverse.
        disparities = disparity_to_depth(
            _values(observation.depth, pixels), float(camera.K[0, 0]), observation.baseline
        )
        fit = fit_pose(points, pixels, disparities, replace(camera, T_world_cam=start), observation.baseline)
        if fit.inliers < LEAST_INLIERS * len(rows) or fit.scale > LARGEST_SCALE * camera.width:
            return "the tissue moved in no common way"
        return fit

    def _find_again(self, observation: Observation, reason: str) -> PoseFit | str:
        """By the keyframes, then as from a frame before that the model would have shown from there."""
        pose = self._keyframes.find(observation)
        if pose is None:
            return reason
        view = self._draw(replace(observation.camera, T_world_cam=pose))
        gray = cv2.cvtColor(cv2.convertScaleAbs(view.rgb, alpha=255.0), cv2.COLOR_RGB2GRAY)
        seen = replace(observation, camera=view.camera, gray=gray, tissue=view.alpha > 0.5)
        last = self._mapper.start_from(Drawn(seen, view))
        fit = self._fit(observation, pose)
        if isinstance(fit, str):
            self._mapper.start_from(last)
        return fit


def _is_inside(pixels: F32, picture: U8) -> Bool:
    """Which of the pixels [N, 2] lie in the picture; NaN does not."""
    height, width = picture.shape
    u, v = pixels.T
    inside: Bool = (u >= 0) & (v >= 0) & (u <= width - 1) & (v <= height - 1)
    return inside


def _values(picture: U8 | F32, pixels: F32) -> F32:
    """Of a picture [H, W] at pixels [N, 2] in it."""
    columns, rows = (pixels + np.float32(0.5)).astype(np.intp).T
    return np.asarray(picture[rows, columns], np.float32)


def _most_textured(gray: U8, pixels: F32) -> I64:
    """Indices of those of the pixels [N, 2] that are followed best (J. Shi and C. Tomasi, CVPR 1994), looked
    for at half the size."""
    small = cv2.resize(gray, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    texture = np.asarray(cv2.cornerMinEigenVal(small, 3))
    height, width = texture.shape
    columns, rows = (0.5 * pixels).astype(np.intp).clip(0, [width - 1, height - 1]).T
    return np.argsort(-texture[rows, columns], kind="stable")[:POINTS]


def _refined(before: U8, after: U8, here: F32, there: F32) -> tuple[I64, F32]:
    """Follow the pixels `here` [N, 2] once more, from about `there` [N, 2]: dense flow is smooth and coarse.
    Indices [M] of those found, and where [M, 2] (Lucas-Kanade)."""
    pixels, status, _ = cv2.calcOpticalFlowPyrLK(
        before, after, here, there.copy(), winSize=WINDOW, maxLevel=0, flags=cv2.OPTFLOW_USE_INITIAL_FLOW
    )
    near = np.abs(pixels - there).max(1) < LARGEST_CORRECTION * before.shape[1]
    found = np.flatnonzero((status[:, 0] > 0) & near & _is_inside(pixels, after))
    return found, pixels[found]


def _is_lit(observation: Observation) -> bool:
    shown = observation.gray[::8, ::8][observation.tissue[::8, ::8]]
    return bool(shown.size > 0 and shown.std() > LIT)


def _correlation(a: F32, b: F32) -> float:
    """Of two lists of numbers; 0 where one of them is constant."""
    a, b = a - a.mean(), b - b.mean()
    spread = float(np.sqrt((a @ a) * (b @ b)))
    return float(a @ b) / spread if spread > 0 else 0.0
