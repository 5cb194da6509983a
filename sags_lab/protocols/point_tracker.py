"""Points followed from one stereo frame to the next, as STIR's evaluator calls a method.

Its interface is x(t+1) = f(x(t), I(t), I(t+1)): at each step the caller hands points in. A point that is
handed in just as it was returned stays the same point: its anchor remembers how it looked when it was pinned,
so it does not drift, and it is found again after an instrument. A point that is new, or was moved by the
caller, is pinned in frame t. A point that is new at every step is followed from two frames only: its errors
add up, and under an instrument it follows the instrument.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from sags_lab.protocols.point_tracks import surely_seen
from sags_node.config.schema import LaunchConfig
from sags_node.errors import SagsError
from sags_node.geometry import transform
from sags_node.mapping.anchors import MAX_ANCHORS
from sags_node.pipeline.pipeline import Pipeline
from sags_node.types import F64, I64, AnchorStates, Bool, Camera, Eye, FrameResult, StereoFrame, StereoRig

SAME = 0.01  # px: a point this near to one that was returned is the same one, even if stored as float32


@dataclass(frozen=True, slots=True)
class Followed:
    """Points in one frame; one that is not found keeps its last known values."""

    pixels: F64  # [P, 2] px, raw left image
    points: F64  # [P, 3] m, left rectified camera; NaN: never known
    found: Bool  # [P]
    visible: Bool  # [P] found, and surely seen by the left eye
    anchors: I64  # [P] ids of their anchors; -1: none could be pinned

    @staticmethod
    def unknown(pixels: F64) -> Followed:
        count = len(pixels)
        nowhere, no = np.full((count, 3), np.nan), np.zeros(count, np.bool_)
        return Followed(pixels, nowhere, no, no, np.full(count, -1, np.int64))


class PointTracker:
    """Follows points of one recording. Another recording needs another tracker.

    Args:
        config: of the pipeline; its source is not opened.
        rig: of the frames that will be given.
    """

    def __init__(self, config: LaunchConfig, rig: StereoRig) -> None:
        self._rig = rig
        self._pipeline = Pipeline(config, rig)
        self._budget = self._pipeline.make_budget()
        self._newest: FrameResult | None = None
        self._said: dict[int, tuple[F64, F64]] = {}  # by anchor: pixel [2] and point [3] as last returned

    def follow(self, pixels: F64, now: StereoFrame, following: StereoFrame) -> Followed:
        """Return where points at `pixels` [P, 2] (px, raw left image) of frame `now` are in `following`.

        Frames are known by their stamps: `now` is processed only if it is not the `following` of the call
        before. A point that cannot be pinned (instrument, no depth, outside) stays where it is.

        Raises:
            SagsError: there are more points than anchors, or the frames do not fit the rig or each other.
        """
        if following.t_capture_ns <= now.t_capture_ns:
            raise SagsError("the following frame is not later than the one before it; look at t_capture_ns")
        anchors = self._pinned(pixels, now)
        self._newest = self._pipeline.process(following, self._budget)
        return self._found(anchors, pixels, self._newest, self._newest.anchors)

    def pin(self, pixels: F64, now: StereoFrame) -> Followed:
        """Pin points at `pixels` [P, 2] (px, raw left image) of frame `now`, and return them in that frame,
        with what else is known there, such as their 3D points.

        Raises:
            SagsError: as `follow`.
        """
        anchors = self._pinned(pixels, now)
        assert self._newest is not None  # it is `now`
        return self._found(anchors, pixels, self._newest, self._pipeline.anchors.states())

    def _pinned(self, pixels: F64, now: StereoFrame) -> I64:
        """Ids of the points' anchors [P]; -1: it cannot be pinned. All other anchors are removed."""
        if len(pixels) > MAX_ANCHORS:
            raise SagsError(f"{len(pixels)} points, {MAX_ANCHORS} at most; follow them in several trackers")
        if self._newest is None or self._newest.pair.t_capture_ns != now.t_capture_ns:
            self._newest = self._pipeline.process(now, self._budget)
        newest, pixels = self._newest, np.asarray(pixels, np.float64).reshape(-1, 2)
        anchors = np.full(len(pixels), -1, np.int64)
        for anchor, (place, _) in list(self._said.items()):
            away = np.where(anchors < 0, np.linalg.norm(pixels - place, axis=1), np.inf)
            if len(away) and away.min() <= SAME:
                anchors[np.argmin(away)] = anchor
            else:
                self._pipeline.anchors.remove(anchor)
                del self._said[anchor]
        fresh = np.flatnonzero(anchors < 0)
        places = to_working(self._rig.left, self._pipeline.rectifier.camera, pixels[fresh])
        for point, (u, v) in zip(fresh, places, strict=True):
            view = newest.views["left"]
            try:
                anchor = self._pipeline.anchors.add_pixel(u, v, newest.observation, newest.snapshot, view)
            except SagsError:
                continue
            anchors[point] = anchor
            self._said[anchor] = pixels[point], np.full(3, np.nan)
        return anchors

    def _found(self, anchors: I64, pixels: F64, newest: FrameResult, states: AnchorStates) -> Followed:
        camera, seen = newest.snapshot.camera, surely_seen(states)
        rows = {int(anchor): row for row, anchor in enumerate(states.ids)}
        pixels, points = np.array(pixels, np.float64).reshape(-1, 2), np.full((len(pixels), 3), np.nan)
        found, visible = np.zeros((2, len(pixels)), np.bool_)
        for number in np.flatnonzero(anchors >= 0):
            anchor = int(anchors[number])
            row = rows.get(anchor)
            if row is not None and np.isfinite(states.pixels[row]).all():
                point = transform(camera.viewmat, states.points[row].astype(np.float64)[None])[0]
                pixel = to_raw(self._rig.left, camera, states.pixels[row].astype(np.float64)[None])[0]
                self._said[anchor] = pixel, point
                found[number], visible[number] = True, seen[row]
            pixels[number], points[number] = self._said[anchor]
        return Followed(pixels, points, found, visible, anchors)


def to_working(eye: Eye, camera: Camera, pixels: F64) -> F64:
    """Return raw pixels [P, 2] of an eye as pixels of the rectified camera at the working size."""
    if not len(pixels):
        return pixels
    there: F64 = cv2.undistortPoints(pixels[:, None], eye.K, eye.distortion, R=eye.R, P=camera.K)[:, 0]
    return there


def to_raw(eye: Eye, camera: Camera, pixels: F64) -> F64:
    """Return raw pixels [P, 2] of working ones: the inverse of `to_working`."""
    rays = np.column_stack([pixels, np.ones(len(pixels))]) @ np.linalg.inv(camera.K).T @ eye.R
    raw: F64 = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), eye.K, eye.distortion)[0][:, 0]
    return raw


def raw_pair(rig: StereoRig, points: F64) -> tuple[F64, F64]:
    """Project points [P, 3] (m, rectified left camera) into the raw images of both eyes, [P, 2] px each."""
    if not len(points):
        return np.empty((0, 2)), np.empty((0, 2))
    left = points @ rig.left.R  # in the raw left camera
    T = rig.T_right_left
    left_px, right_px = (
        cv2.projectPoints(seen[:, None], np.zeros(3), np.zeros(3), eye.K, eye.distortion)[0][:, 0]
        for seen, eye in ((left, rig.left), (left @ T[:3, :3].T + T[:3, 3], rig.right))
    )
    return left_px, right_px
