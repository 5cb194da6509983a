"""Where the camera is, frame by frame, against the model's tissue at rest."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np

from sags_node.geometry import disparity_to_depth, invert, project
from sags_node.mapping.camera_pose import PoseFit, fit_pose
from sags_node.mapping.keyframes import Keyframes, distance
from sags_node.mapping.mapper import Drawn, Learnt, Mapper
from sags_node.mapping.pose_agreement import Agreement, agreement, small_frame, small_view
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
LARGEST_JUMP = 8e-3  # m, as `keyframes.distance` counts, between frames: faster, it must be verified
TRIAL = 6  # frames in which a pose that was found again must agree with picture and depth
TRIED = 3  # candidates for such a pose per frame
LOOK_NS = 150_000_000  # between two looks whether a frame agrees with the keyframes
DISAGREEING = 5  # looks in a row: then the pose that was found again was wrong
PROBATION_NS = 3_000_000_000  # after a pose was found again: no new keyframes, what is learnt can be undone
GIVE_UP_NS = 3_000_000_000  # of lit frames that show one scene: then a new model is begun
SAME_SCENE = 0.7  # correlation of a lit frame with the one before, shrunk
LIT = 4.0  # grey levels, standard deviation over the tissue: a covered or dark picture has less


class CameraTracker:
    """Estimates the camera's pose from where the model's Gaussians are found in each frame.

    Pictures cannot tell a camera that moves from tissue that moves as one. Here the motion that most of the
    tissue shares is the camera's: every Gaussian has a place at rest, which follows it slowly, and the camera
    is where most of them are seen nearest to that. What moves otherwise, as pulled tissue does, counts
    little.

    A frame in which too few are found, or in which what is found looks otherwise, leaves the camera lost.
    Then the last pose stays; it and those by the keyframes are tried in every frame. The one at which the
    model agrees best with picture and measured depth is on trial: it must go on to agree for `TRIAL` frames
    before anything is learnt or shown again. Later the keyframes from before are its witnesses: if they
    disagree for long, the camera is lost again and what was learnt since is undone. When lit frames have
    shown one other scene for `GIVE_UP_NS`, a new model is begun at the last pose.

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
        self._trial: _Candidate | None = None
        self._passed = 0  # frames that the trial's pose has agreed with
        self._unknown: list[Observation] = []  # first and last of those that show something else
        self._found_ns: int | None = None  # when the camera was found again, during the probation
        self._before: Learnt | None = None  # what was known then
        self._looked_ns = 0
        self._disagreed = 0  # looks in a row
        self._stamp_ns: int | None = None  # of the last frame that was mapped
        self._seconds = 0.0  # that the model has been learnt for

    @property
    def pose(self) -> F64:
        """`T_world_cam` [4, 4] of the last frame that was tracked."""
        return self._pose

    def track(self, observation: Observation) -> bool:
        """Find the pose of a frame, whatever its camera says; False: the camera is lost."""
        if self._mapper.model.count == 0:
            self.lost, self._motion = None, np.eye(4)
            return True  # the model begins where the camera was last
        if self.lost is not None:
            return self._find_again(observation) or self._begin_anew(observation)
        fit = self._follow(observation)
        if isinstance(fit, str):
            self.lost, self._motion = fit, np.eye(4)
            self._trial, self._passed, self._unknown = None, 0, []
            return False
        self._pose, self._motion = fit, invert(self._pose) @ fit
        return True

    def _follow(self, observation: Observation) -> F64 | str:
        """The pose of a frame that follows one that was tracked, or why the camera is lost."""
        start = self._pose @ self._motion
        fit = self._fit(observation, start)
        if isinstance(fit, str):
            return fit
        camera = observation.camera
        moved = replace(camera, T_world_cam=fit.T_world_cam)
        if distance(replace(camera, T_world_cam=start), moved) > LARGEST_JUMP:
            return "the camera jumped"
        if self._is_found_out(replace(observation, camera=moved)):
            return "the camera was taken to be elsewhere"
        return fit.T_world_cam

    def _is_found_out(self, observation: Observation) -> bool:
        """Whether the keyframes have disagreed for long; then what was learnt is undone."""
        now = observation.t_capture_ns
        if 0 <= now - self._looked_ns < LOOK_NS:
            return False
        self._looked_ns = now
        found = self._keyframes.agree(observation)
        contradicted = found is not None and found.is_contradiction
        self._disagreed = self._disagreed + 1 if contradicted else 0
        if self._disagreed < DISAGREEING:
            return False
        self._disagreed = 0
        if self._before is not None:
            self._mapper.go_back(self._before)
        self._found_ns = self._before = None
        return True

    def _find_again(self, observation: Observation) -> bool:
        """Whether the camera has been verified to be where it was found."""
        tried = None if self._trial is None else self._tried(observation, self._trial.drawn)
        if tried is None or tried.agreement.problem:
            self._passed = 0
            tried = self._best_candidate(observation)
        self._trial = tried
        if tried is None:
            return False
        self._passed += tried.agreement.near is not None  # without depth nothing is verified
        self.lost = f"verifying where it is, {self._passed} of {TRIAL} frames"
        self._mapper.start_from(tried.drawn)
        if self._passed < TRIAL:
            return False
        self._pose, self._motion = tried.T_world_rest, np.eye(4)
        self.lost = None
        self._found_ns, self._before = observation.t_capture_ns, self._mapper.learnt()
        self._looked_ns, self._disagreed = observation.t_capture_ns, 0
        return True

    def _begin_anew(self, observation: Observation) -> bool:
        """Whether a new model is begun: something else has been shown, lit and steadily, for long."""
        if self._trial is not None:
            return False
        if self._unknown and not _is_same_scene(self._unknown[-1], observation):
            self._unknown = []
        if not _is_lit(observation):
            self._unknown = []
            return False
        self._unknown = [*self._unknown[:1], observation]
        if observation.t_capture_ns - self._unknown[0].t_capture_ns < GIVE_UP_NS:
            return False
        self._mapper.restart()
        self.lost = None
        return True

    def mapped(self, observation: Observation, view: RenderedView) -> None:
        """Learn from a frame that was tracked and taken in; `view` is the model drawn for it."""
        if self._mapper.restarts != self._restarts:
            self._restarts = self._mapper.restarts
            self._keyframes.clear()
            self._found_ns = self._before = None
            self._seconds = 0.0
        before, self._stamp_ns = self._stamp_ns, observation.t_capture_ns
        passed = 0.0 if before is None else max(0.0, (self._stamp_ns - before) * 1e-9)
        model = self._mapper.model
        new = np.isnan(model.rest[:, 0])
        model.rest[new] = model.means[new]
        # A model that is younger than a breath rests where it was on average until now.
        self._seconds = min(self._seconds + passed, REST_SECONDS)
        share = passed / max(self._seconds, passed, 1e-9)
        model.rest[:] += np.float32(share) * (model.means - model.rest)
        if self._found_ns is not None and not 0 <= self._stamp_ns - self._found_ns < PROBATION_NS:
            self._found_ns = self._before = None
        if self._found_ns is None:
            self._keyframes.offer(observation, view)

    def _fit(self, observation: Observation, start: F64, pull: float = PULL) -> PoseFit | str:
        """The pose, or why there is none; `pull` is the share of the way back to its place at rest at which
        tissue is taken to be."""
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
        points = model.means[rows] + np.float32(pull) * (model.rest[rows] - model.means[rows])
        # The formula is its own inverse.
        disparities = disparity_to_depth(
            _values(observation.depth, pixels), float(camera.K[0, 0]), observation.baseline
        )
        fit = fit_pose(points, pixels, disparities, replace(camera, T_world_cam=start), observation.baseline)
        if fit.inliers < LEAST_INLIERS * len(rows) or fit.scale > LARGEST_SCALE * camera.width:
            return "the tissue moved in no common way"
        return fit

    def _best_candidate(self, observation: Observation) -> _Candidate | None:
        """Where the model agrees best with a frame: near the last pose or those by the keyframes."""
        starts = [self._pose, *self._keyframes.find(observation)[:TRIED]]
        tried = [self._tried(observation, self._seen_from(observation, start)) for start in starts]
        found = [each for each in tried if each is not None]
        best = max(found, key=lambda each: each.agreement.rank, default=None)
        if best is not None and best.agreement.problem:
            self.lost = best.agreement.problem
            return None
        return best

    def _tried(self, observation: Observation, before: Drawn) -> _Candidate | None:
        """Where the camera is if it was there before from where the model is drawn; None: not near it."""
        self._mapper.start_from(before)
        fit = self._fit(observation, before.view.camera.T_world_cam)
        if isinstance(fit, str):
            self.lost = fit
            return None
        rest = self._fit(observation, fit.T_world_cam, pull=1.0)
        now = self._seen_from(observation, fit.T_world_cam)
        frame = small_frame(observation)
        agrees = agreement(small_view(now.view), frame, observation.camera, observation.baseline)
        return _Candidate(now, agrees, (fit if isinstance(rest, str) else rest).T_world_cam)

    def _seen_from(self, observation: Observation, pose: F64) -> Drawn:
        """The model as a frame that was taken from there would have shown it."""
        view = self._draw(replace(observation.camera, T_world_cam=pose))
        gray = cv2.cvtColor(cv2.convertScaleAbs(view.rgb, alpha=255.0), cv2.COLOR_RGB2GRAY)
        shown = replace(observation, camera=view.camera, gray=gray, tissue=view.alpha > 0.5)
        return Drawn(shown, view)


@dataclass(frozen=True, slots=True)
class _Candidate:
    """A pose that may be the camera's: the model drawn from there, and how well a frame agrees with it."""

    drawn: Drawn
    agreement: Agreement
    T_world_rest: F64  # [4, 4] the pose against the tissue at rest: it may have moved since it was seen


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


def _is_same_scene(before: Observation, now: Observation) -> bool:
    both = before.tissue[::8, ::8] & now.tissue[::8, ::8]
    pictures = (
        cv2.resize(each.gray, both.shape[::-1], interpolation=cv2.INTER_AREA).astype(np.float32)[both]
        for each in (before, now)
    )
    return bool(both.any()) and _correlation(*pictures) > SAME_SCENE


def _correlation(a: F32, b: F32) -> float:
    """Of two lists of numbers; 0 where one of them is constant."""
    a, b = a - a.mean(), b - b.mean()
    spread = float(np.sqrt((a @ a) * (b @ b)))
    return float(a @ b) / spread if spread > 0 else 0.0
