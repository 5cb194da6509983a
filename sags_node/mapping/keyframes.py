"""Pictures of the model from where the camera was, to find it again when it is lost."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from sags_node.geometry import invert, unproject
from sags_node.types import F32, F64, U8, Bool, Camera, Observation, RenderedView

MOST = 8
PERIOD_NS = 500_000_000  # between keyframes
APART = 4e-3  # m: a nearer keyframe is replaced, since tissue changes
LEVER = 0.08  # m: what an endoscope looks at; a turn moves it by the angle times this
FEATURES = 800
FAST_THRESHOLD = 7  # grey levels: tissue has few corners
DISTINCT = 0.8  # of the next best match's distance (D. Lowe, IJCV 2004)
REPROJECTION = 4 / 640  # of the width
LEAST_MATCHES = 15


@dataclass(frozen=True, slots=True)
class _Keyframe:
    observation: Observation
    depth: F32  # [H, W] m, of the model drawn there


class Keyframes:
    """At most `MOST` frames, spread over the places from which the tissue was seen."""

    def __init__(self) -> None:
        self._kept: list[_Keyframe] = []  # oldest first
        self._orb = cv2.ORB.create(FEATURES, fastThreshold=FAST_THRESHOLD)

    def clear(self) -> None:
        self._kept.clear()

    def offer(self, observation: Observation, view: RenderedView) -> None:
        """Keep a frame whose pose is known, if it is time for one; `view` is the model drawn for it."""
        if self._kept:
            passed = observation.t_capture_ns - self._kept[-1].observation.t_capture_ns
            if 0 <= passed < PERIOD_NS:
                return
        camera = observation.camera
        distances = [_distance(camera, each.observation.camera) for each in self._kept]
        nearest = int(np.argmin(distances)) if distances else -1
        if distances and distances[nearest] < APART:
            del self._kept[nearest]
        elif len(self._kept) == MOST:
            del self._kept[0]
        self._kept.append(_Keyframe(observation, view.depth))

    def find(self, observation: Observation) -> F64 | None:
        """`T_world_cam` [4, 4] from which the picture was taken, by the keyframe with most matching features
        that agree (ORB; perspective from points in RANSAC); None: it shows none of them."""
        pixels, features = self._features(observation.gray, observation.tissue)
        if features is None:
            return None
        best: tuple[int, F64] | None = None
        for keyframe in self._kept:
            found = self._pose_from(keyframe, pixels, features, observation.camera)
            if found is not None and (best is None or found[0] > best[0]):
                best = found
        return None if best is None else best[1]

    def _pose_from(
        self, keyframe: _Keyframe, pixels: F32, features: U8, camera: Camera
    ) -> tuple[int, F64] | None:
        there = keyframe.observation
        known = there.tissue & (keyframe.depth > 0)
        places, described = self._features(there.gray, known)
        if described is None:
            return None
        pairs = cv2.BFMatcher(cv2.NORM_HAMMING).knnMatch(described, features, k=2)
        good = [p[0] for p in pairs if len(p) == 2 and p[0].distance < DISTINCT * p[1].distance]
        if len(good) < LEAST_MATCHES:
            return None
        ours = places[[match.queryIdx for match in good]]
        columns, rows = np.rint(ours).astype(np.intp).T
        points = unproject(there.camera, ours.astype(np.float64), keyframe.depth[rows, columns].astype(float))
        found, rotation, translation, inliers = cv2.solvePnPRansac(
            points, pixels[[match.trainIdx for match in good]].astype(np.float64), camera.K, None,
            reprojectionError=REPROJECTION * camera.width, iterationsCount=300,
        )  # fmt: skip
        if not found or inliers is None or len(inliers) < LEAST_MATCHES:
            return None
        view = np.eye(4)
        view[:3, :3], view[:3, 3] = cv2.Rodrigues(rotation)[0], translation[:, 0]
        return len(inliers), invert(view)

    def _features(self, gray: U8, where: Bool) -> tuple[F32, U8 | None]:
        """Pixels [F, 2] and descriptors [F, 32], None where there are fewer than needed."""
        corners, described = self._orb.detectAndCompute(gray, where.view(np.uint8))
        if described is None or len(corners) < LEAST_MATCHES:
            return np.zeros((0, 2), np.float32), None
        return np.array([corner.pt for corner in corners], np.float32), np.asarray(described)


def _distance(a: Camera, b: Camera) -> float:
    """How far apart two cameras are, m: what they look at shifts by about as much."""
    motion = invert(a.T_world_cam) @ b.T_world_cam
    turn = cv2.Rodrigues(motion[:3, :3])[0]
    return float(np.linalg.norm(motion[:3, 3]) + LEVER * np.linalg.norm(turn))
