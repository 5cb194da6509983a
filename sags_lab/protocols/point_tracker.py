"""Points followed from one stereo frame to the next, as STIR's evaluator calls a method.

Its interface is x(t+1) = f(x(t), I(t), I(t+1)): at each step the caller hands points in. What it hands back
as it got it goes on as the same point: its anchor remembers how it looked when it was pinned, so nothing
drifts and it is found again after an instrument. A point that the caller moved, or brings anew, is pinned in
frame t, where it is now. One that is handed in anew at every step is followed by two frames only: its errors
add up, and it goes on under an instrument as if it were the instrument.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from sags_node.config.schema import LaunchConfig
from sags_node.errors import SagsError
from sags_node.geometry import transform
from sags_node.mapping.anchors import MAX_ANCHORS
from sags_node.pipeline.pipeline import Pipeline
from sags_node.types import F64, I64, Bool, Camera, Eye, FrameResult, StereoFrame, StereoRig

SAME = 0.01  # px: a point so near to where it was said to be is the same, whatever type of number kept it


@dataclass(frozen=True, slots=True)
class Followed:
    """Points in the later of two frames; where one is not found, as it was known last."""

    pixels: F64  # [P, 2] px, raw left picture
    points: F64  # [P, 3] m, left rectified camera; NaN: never known
    found: Bool  # [P]
    anchors: I64  # [P] that follow them; -1: none could be pinned there

    @staticmethod
    def unknown(pixels: F64) -> Followed:
        count = len(pixels)
        return Followed(
            pixels, np.full((count, 3), np.nan), np.zeros(count, np.bool_), np.full(count, -1, np.int64)
        )


class PointTracker:
    """One recording's points. A new recording needs a new one.

    Args:
        config: of the pipeline; its source is not opened.
        rig: of the frames that will be given.
    """

    def __init__(self, config: LaunchConfig, rig: StereoRig) -> None:
        self._rig = rig
        self._pipeline = Pipeline(config, rig)
        self._budget = self._pipeline.make_budget()
        self._newest: FrameResult | None = None
        self._said: dict[int, tuple[F64, F64]] = {}  # by anchor: pixel [2] and point [3] as given back last

    def follow(self, pixels: F64, now: StereoFrame, following: StereoFrame) -> Followed:
        """Where the points at `pixels` [P, 2] (px, raw left picture) of frame `now` are in frame `following`.

        Frames are known by their stamps: `now` is worked again only if it is not the `following` of the call
        before. A point that cannot be pinned (instrument, no depth, outside) stays where it is.

        Raises:
            SagsError: there are more points than anchors, or the frames do not fit the rig or each other.
        """
        if len(pixels) > MAX_ANCHORS:
            raise SagsError(f"{len(pixels)} points, {MAX_ANCHORS} at most; follow them in several trackers")
        if following.t_capture_ns <= now.t_capture_ns:
            raise SagsError("the following frame is not later than the one before it; look at t_capture_ns")
        if self._newest is None or self._newest.pair.t_capture_ns != now.t_capture_ns:
            self._newest = self._pipeline.process(now, self._budget)
        anchors = self._anchors_of(np.asarray(pixels, np.float64).reshape(-1, 2), self._newest)
        self._newest = self._pipeline.process(following, self._budget)
        return self._found(anchors, np.asarray(pixels, np.float64).reshape(-1, 2), self._newest)

    def _anchors_of(self, pixels: F64, newest: FrameResult) -> I64:
        """Of each point [P], -1: it cannot be pinned. Anchors of points not asked for are removed."""
        anchors = np.full(len(pixels), -1, np.int64)
        for anchor, (place, _) in list(self._said.items()):
            away = np.where(anchors < 0, np.linalg.norm(pixels - place, axis=1), np.inf)
            if len(away) and away.min() <= SAME:
                anchors[np.argmin(away)] = anchor
            else:
                self._pipeline.anchors.remove(anchor)
                del self._said[anchor]
        fresh = np.flatnonzero(anchors < 0)
        for point, (u, v) in zip(fresh, self._to_working(pixels[fresh]), strict=True):
            view = newest.views["left"]
            try:
                anchor = self._pipeline.anchors.add_pixel(u, v, newest.observation, newest.snapshot, view)
            except SagsError:
                continue
            anchors[point] = anchor
            self._said[anchor] = pixels[point], np.full(3, np.nan)
        return anchors

    def _found(self, anchors: I64, pixels: F64, newest: FrameResult) -> Followed:
        states, camera = newest.anchors, newest.snapshot.camera
        rows = {int(anchor): row for row, anchor in enumerate(states.ids)}
        pixels, points = pixels.copy(), np.full((len(pixels), 3), np.nan)
        found = np.zeros(len(pixels), np.bool_)
        for number in np.flatnonzero(anchors >= 0):
            anchor = int(anchors[number])
            row = rows.get(anchor)
            if row is not None and np.isfinite(states.pixels[row]).all():
                point = transform(camera.viewmat, states.points[row].astype(np.float64)[None])[0]
                pixel = to_raw(self._rig.left, camera, states.pixels[row].astype(np.float64)[None])[0]
                self._said[anchor] = pixel, point
                found[number] = True
            pixels[number], points[number] = self._said[anchor]
        return Followed(pixels, points, found, anchors)

    def _to_working(self, pixels: F64) -> F64:
        return to_working(self._rig.left, self._pipeline.rectifier.camera, pixels)


def to_working(eye: Eye, camera: Camera, pixels: F64) -> F64:
    """Raw pixels [P, 2] of an eye in the rectified camera at the working size."""
    if not len(pixels):
        return pixels
    there: F64 = cv2.undistortPoints(pixels[:, None], eye.K, eye.distortion, R=eye.R, P=camera.K)[:, 0]
    return there


def to_raw(eye: Eye, camera: Camera, pixels: F64) -> F64:
    """The inverse of `to_working`."""
    rays = np.column_stack([pixels, np.ones(len(pixels))]) @ np.linalg.inv(camera.K).T @ eye.R
    raw: F64 = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), eye.K, eye.distortion)[0][:, 0]
    return raw
