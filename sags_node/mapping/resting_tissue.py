"""The model's tissue where it rests, and the camera's pose against it."""

from dataclasses import dataclass, replace

import cv2
import numpy as np

from sags_node.geometry import invert, project
from sags_node.mapping.camera_pose import at_pixels, disparities_at, fit_pose
from sags_node.mapping.first_views import FirstViews
from sags_node.mapping.motion import Drawn, Tracks
from sags_node.mapping.tissue_map import TissueMap
from sags_node.resizing import resized_image
from sags_node.types import F32, F64, I64, U8, Bool, Observation
from sags_node.vision.watch.standing import watched_ns

CANDIDATES = 2000  # Gaussians that are considered, of those found
POINTS = 300  # of them, those with most texture; measured: one in each cell of a grid is worse
WINDOW = (15, 15)  # px
LARGEST_CORRECTION = 3 / 640  # of the width: most that Lucas-Kanade may move a pixel found by dense flow
LEAST_POINTS = 40
REST_SECONDS = 60.0  # s over which a place at rest follows the tissue: ten breaths and more
CALM = 3.0  # times the median distance from the place at rest: tissue farther away moves by itself
LOOK_NS = 200_000_000  # ns between comparisons with the first views
LEAST_INLIERS = 0.35  # of the points
LEAST_AGREEMENT = 0.5  # correlation of the image with the colours of the Gaussians found in it
LARGEST_SCALE = 4 / 640  # of the width: scale of the residuals


@dataclass(frozen=True, slots=True)
class TissueFit:
    """Where a camera is, `T_world_cam` [4, 4]."""

    near: F64  # by how the tissue moved since the last frame
    at_rest: F64  # by where it rests; as `near` where too little of it is there


class RestingTissue:
    """The places where the tissue rests, which follow it slowly."""

    def __init__(self, tissue_map: TissueMap) -> None:
        self._map = tissue_map
        self._restarts = tissue_map.restarts
        self._stamp_ns: int | None = None  # of the last frame that was mapped
        self._seconds = 0.0  # that the model has been learnt for
        self._first_views = FirstViews(tissue_map)
        self._at_rest: F64 | None = None  # pose of the last frame against the tissue at rest; None: not known
        self._correction: F64 | None = None  # [4, 4] of a pose, from the left; None: no first view gives one
        self._looked_ns = 0

    def fit(self, observation: Observation, last: Drawn, tracks: Tracks, start: F64) -> TissueFit | str:
        """The pose of a frame, or why there is none.

        Args:
            last: the frame before, and `tracks` from it to this one.
            start: [4, 4] about where it was taken from.
        """
        model, camera, pixels = self._map.model, observation.camera, tracks.pixels
        self._at_rest = None
        rows = np.flatnonzero(_is_inside(pixels, observation.gray))
        rows = rows[:: max(1, len(rows) // CANDIDATES)]
        if len(rows) < LEAST_POINTS:
            return "hardly any tissue in view"
        away = self._map.away(rows)
        ways = np.linalg.norm(away, axis=1)
        calm = ways <= CALM * np.median(ways)
        rows, away = rows[calm], away[calm]
        seen = at_pixels(observation.gray, pixels[rows]).astype(np.float32)
        if correlation(model.colors[rows].mean(1), seen) < LEAST_AGREEMENT:
            return "the image does not show the model's tissue"

        before = project(last.view.camera, model.means[rows])[0].astype(np.float32)
        chosen = _most_textured(last.observation.gray, before)
        found, pixels = _refined(
            last.observation.gray, observation.gray, before[chosen], pixels[rows[chosen]]
        )
        rows, away = rows[chosen[found]], away[chosen[found]]
        if len(rows) < LEAST_POINTS:
            return "too little texture to follow"
        points = model.means[rows]
        disparities = disparities_at(observation, pixels)
        start_camera = replace(camera, T_world_cam=start)
        near = fit_pose(points, pixels, disparities, start_camera, observation.baseline)
        if near.inliers < LEAST_INLIERS * len(rows) or near.scale > LARGEST_SCALE * camera.width:
            return "the tissue moved in no common way"
        if self._correction is not None:
            self._at_rest = self._correction @ near.T_world_cam
            return TissueFit(near.T_world_cam, self._at_rest)
        near_camera = replace(camera, T_world_cam=near.T_world_cam)
        at_rest = fit_pose(points - away, pixels, disparities, near_camera, observation.baseline)
        is_there = at_rest.inliers >= LEAST_INLIERS * len(rows)
        self._at_rest = at_rest.T_world_cam if is_there else near.T_world_cam
        return TissueFit(near.T_world_cam, self._at_rest)

    def learn(self, observation: Observation) -> None:
        """Let the places at rest follow a frame that was taken in."""
        if self._map.restarts != self._restarts:
            self._restarts = self._map.restarts
            self._seconds = 0.0
            self._first_views.clear()
            self._at_rest = self._correction = None
        before, self._stamp_ns = self._stamp_ns, observation.t_capture_ns
        passed = watched_ns(before, self._stamp_ns) * 1e-9
        # A model that is younger than `REST_SECONDS` rests where it was on average until now.
        self._seconds = min(self._seconds + passed, REST_SECONDS)
        share = passed / max(self._seconds, passed, 1e-9)
        self._map.settle(share)
        self._look(observation)

    def _look(self, observation: Observation) -> None:
        """Correct the pose of a frame by the first views."""
        now, pose = observation.t_capture_ns, observation.camera.T_world_cam
        at_rest = self._at_rest
        if at_rest is None:
            at_rest = pose if self._correction is None else self._correction @ pose
        told = self._correction is not None
        if not 0 <= now - self._looked_ns < LOOK_NS:
            self._looked_ns = now
            found = self._first_views.pose(observation, at_rest)
            told = found is not None
            at_rest = at_rest if found is None else found
            self._first_views.offer(observation, at_rest)
        self._correction = at_rest @ invert(pose) if told else None


def _is_inside(pixels: F32, picture: U8) -> Bool:
    """Which of the pixels [N, 2] lie in the image; NaN does not."""
    height, width = picture.shape
    u, v = pixels.T
    inside: Bool = (u >= 0) & (v >= 0) & (u <= width - 1) & (v <= height - 1)
    return inside


def _most_textured(gray: U8, pixels: F32) -> I64:
    """Indices of the pixels [N, 2] that can be tracked best (J. Shi and C. Tomasi, CVPR 1994), computed at
    half the size."""
    small = resized_image(gray, (gray.shape[1] // 2, gray.shape[0] // 2))
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


def correlation(a: F32, b: F32) -> float:
    """The correlation of two lists of numbers; 0 where one of them is constant."""
    a, b = a - a.mean(), b - b.mean()
    spread = float(np.sqrt((a @ a) * (b @ b)))
    return float(a @ b) / spread if spread > 0 else 0.0
