"""Frames whose camera poses are known, to find the camera again when it is lost."""

from dataclasses import replace
from functools import cached_property

import cv2
import numpy as np

from sags_node.geometry import invert, project, rigid, unproject
from sags_node.mapping.pose_agreement import Agreement, Small, agreement, shrunk, small_frame
from sags_node.types import F32, F64, U8, Bool, Camera, Observation, RenderedView
from sags_node.vision.landmarks import Features, features_in, matched

MOST = 8
PERIOD_NS = 500_000_000  # ns between keyframes
APART = 4e-3  # m: a nearer keyframe is replaced, since tissue changes
LEVER = 0.08  # m, working distance of an endoscope: a rotation counts as its angle times this
FEATURES = 800
FAST_THRESHOLD = 7  # grey levels: tissue has few corners
REPROJECTION = 4 / 640  # of the width: largest reprojection error of an inlier
LEAST_MATCHES = 15
WITNESSES = 2  # keyframes, the nearest, that a frame is compared with
EVERY = 2  # shrunk px between pixels that are compared
LEAST_OVERLAP = 0.4  # share of a keyframe that a frame must show to be compared with it


class _Keyframe:
    """A frame whose pose was known, with what is computed from it when it is first needed."""

    def __init__(self, observation: Observation, depth: F32) -> None:
        self.observation = observation
        self.depth = depth  # [H, W] m, of the model drawn there

    @cached_property
    def small(self) -> tuple[Small, F32]:
        """The keyframe shrunk, and the points [h, w, 3] (m, world) of the tissue in its pixels."""
        there = self.observation
        fine = shrunk(there.gray, self.depth, there.tissue & (self.depth > 0))
        small = Small(fine.gray[::EVERY, ::EVERY], fine.depth[::EVERY, ::EVERY], fine.where[::EVERY, ::EVERY])
        step = there.gray.shape[1] // fine.gray.shape[1]
        rows, columns = (EVERY * step * np.arange(side, dtype=np.float32) for side in small.gray.shape)
        pixels = np.stack(np.meshgrid(columns, rows), -1) + np.float32(0.5 * (step - 1))
        return small, np.asarray(unproject(there.camera, pixels, small.depth), np.float32)

    @cached_property
    def features(self) -> Features:
        return _features(self.observation.gray, self.observation.tissue & (self.depth > 0))


class Keyframes:
    """At most `MOST` frames, spread over the places from which the tissue was seen."""

    def __init__(self) -> None:
        self._kept: list[_Keyframe] = []  # oldest first

    def clear(self) -> None:
        self._kept.clear()

    def offer(self, observation: Observation, view: RenderedView) -> None:
        """Keep a frame whose pose is known, if it is time for one; `view` is the model drawn for it."""
        if self._kept:
            passed = observation.t_capture_ns - self._kept[-1].observation.t_capture_ns
            if 0 <= passed < PERIOD_NS:
                return
        camera = observation.camera
        distances = [distance(camera, each.observation.camera) for each in self._kept]
        nearest = int(np.argmin(distances)) if distances else -1
        if distances and distances[nearest] < APART:
            del self._kept[nearest]
        elif len(self._kept) == MOST:
            del self._kept[0]
        self._kept.append(_Keyframe(observation, view.depth))

    def find(self, observation: Observation) -> list[F64]:
        """Find poses `T_world_cam` [4, 4] from which the image may have been taken: one for each keyframe
        that shows some of it, the one with most inliers first (ORB features, PnP in RANSAC)."""
        features = _features(observation.gray, observation.tissue)
        if len(features.codes) < LEAST_MATCHES:
            return []
        found = [_pose_from(each, features, observation.camera) for each in self._kept]
        poses = [pose for pose in found if pose is not None]
        return [pose for _, pose in sorted(poses, key=lambda pose: pose[0], reverse=True)]

    def agree(self, observation: Observation) -> Agreement | None:
        """The agreement of a frame, at its pose, with the best of the nearest keyframes; None: it shows too
        little of them."""
        frame = small_frame(observation)
        near = sorted(self._kept, key=lambda each: distance(observation.camera, each.observation.camera))
        best: Agreement | None = None
        for keyframe in near[:WITNESSES]:
            found = _warped(*keyframe.small, frame, observation)
            if found is not None and (best is None or found.rank > best.rank):
                best = found
        return best


def _warped(there: Small, points: F32, frame: Small, observation: Observation) -> Agreement | None:
    """The agreement of a frame with a keyframe, whose pixels are projected into the frame."""
    step = observation.gray.shape[1] // frame.gray.shape[1]
    height, width = frame.gray.shape
    pixels, depth = project(observation.camera, points)
    places = np.nan_to_num((pixels - np.float32(0.5 * (step - 1))) / np.float32(step), nan=-1.0)
    places = np.asarray(places, np.float32)
    inside = there.where & (places >= 0).all(-1) & (places <= [width - 1, height - 1]).all(-1)
    known = int(np.count_nonzero(there.where))
    if known == 0 or int(np.count_nonzero(inside)) < LEAST_OVERLAP * known:
        return None

    def at(picture: F32, how: int) -> F32:
        return np.asarray(cv2.remap(picture, places, None, how))

    tissue = at(frame.where.astype(np.float32), cv2.INTER_NEAREST) > 0
    found = Small(at(frame.gray, cv2.INTER_LINEAR), at(frame.depth, cv2.INTER_NEAREST), inside & tissue)
    expected = replace(there, depth=np.where(inside, depth, 0).astype(np.float32), where=inside)
    return agreement(expected, found, observation.camera, observation.baseline)


def _pose_from(keyframe: _Keyframe, features: Features, camera: Camera) -> tuple[int, F64] | None:
    before, after = matched(keyframe.features, features)
    if len(before) < LEAST_MATCHES:
        return None
    ours = keyframe.features.places[before]
    columns, rows = np.rint(ours).astype(np.intp).T
    depths = keyframe.depth[rows, columns].astype(float)
    points = unproject(keyframe.observation.camera, ours.astype(np.float64), depths)
    found, rotation, translation, inliers = cv2.solvePnPRansac(
        points, features.places[after].astype(np.float64), camera.K, None,
        reprojectionError=REPROJECTION * camera.width, iterationsCount=300,
    )  # fmt: skip
    if not found or inliers is None or len(inliers) < LEAST_MATCHES:
        return None
    return len(inliers), invert(rigid(cv2.Rodrigues(rotation)[0], translation[:, 0]))


def _features(gray: U8, where: Bool) -> Features:
    return features_in(gray, where, FEATURES, FAST_THRESHOLD)


def distance(a: Camera, b: Camera) -> float:
    """The distance between two cameras, m: about how far what they look at shifts from one to the other."""
    motion = invert(a.T_world_cam) @ b.T_world_cam
    turn = cv2.Rodrigues(motion[:3, :3])[0]
    return float(np.linalg.norm(motion[:3, 3]) + LEVER * np.linalg.norm(turn))
