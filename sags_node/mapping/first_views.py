"""Images of the tissue as it was first seen: from them the camera's pose is found without drift.

The model's places at rest follow optical flow, whose errors add up. So some images are kept, with the
places at rest of their corners.
"""

from dataclasses import dataclass, replace

import cv2
import numpy as np

from sags_node.geometry import project, unproject
from sags_node.mapping.camera_pose import at_pixels, disparities_at, fit_pose
from sags_node.mapping.keyframes import distance
from sags_node.mapping.tissue_map import TissueMap
from sags_node.types import F32, F64, U8, Camera, Observation

MOST = 16  # images
FAR = 0.01  # m, as `keyframes.distance` counts: an image this far from all others is kept
REACH = 0.025  # m, the same: from farther away too little of an image is found again
CORNERS = 300
CORNER_QUALITY = 0.005
CORNER_DISTANCE = 8 / 640  # of the width
WINDOW = (21, 21)  # px
ASIDE = 0.02  # of the width, from where it is expected: a corner found farther is another one
LEAST_CORNERS = 40
LEAST_INLIERS = 0.5  # share of the corners found
LARGEST_SCALE = 6 / 640  # of the width: scale of the residuals; that of correct fits reached 5 / 640


@dataclass(frozen=True, slots=True)
class _View:
    camera: Camera
    gray: U8
    pixels: F32  # [K, 2] of corners
    rest: F32  # [K, 3] m, world: where their tissue rests


class FirstViews:
    """At most `MOST` images, the first one of each place."""

    def __init__(self, tissue_map: TissueMap) -> None:
        self._map = tissue_map
        self._kept: list[_View] = []  # oldest first

    def clear(self) -> None:
        self._kept.clear()

    def pose(self, observation: Observation, about: F64) -> F64 | None:
        """The camera's pose [4, 4] by the oldest view with enough matches; None: none has. Later views
        contain the error that the older ones left.

        Args:
            observation: a frame that was taken in; its camera says where the tissue is now.
            about: a rough `T_world_cam` [4, 4] against the tissue at rest.
        """
        camera = replace(observation.camera, T_world_cam=about)
        near = (view for view in self._kept if distance(view.camera, camera) < REACH)
        poses = (self._fitted(view, observation, camera) for view in near)
        return next((pose for pose in poses if pose is not None), None)

    def offer(self, observation: Observation, at_rest: F64) -> None:
        """Keep the image of a frame that was taken in, if no kept one is near.

        Args:
            observation: its camera says where the tissue is now.
            at_rest: `T_world_cam` [4, 4] against the tissue at rest.
        """
        camera = replace(observation.camera, T_world_cam=at_rest)
        if any(distance(view.camera, camera) < FAR for view in self._kept):
            return
        view = self._seen(observation, camera)
        if len(view.pixels) >= LEAST_CORNERS:
            if len(self._kept) == MOST:
                del self._kept[1]  # the first one shows how it all began
            self._kept.append(view)

    def _seen(self, observation: Observation, camera: Camera) -> _View:
        where = (observation.tissue & (observation.depth > 0)).view(np.uint8)
        apart = CORNER_DISTANCE * camera.width
        corners = cv2.goodFeaturesToTrack(observation.gray, CORNERS, CORNER_QUALITY, apart, mask=where)
        pixels = np.zeros((0, 2), np.float32) if corners is None else np.asarray(corners[:, 0], np.float32)
        points = np.asarray(
            unproject(observation.camera, pixels, at_pixels(observation.depth, pixels)), np.float32
        )
        return _View(camera, observation.gray, pixels, points - self._map.displacement_at(points))

    def _fitted(self, view: _View, observation: Observation, camera: Camera) -> F64 | None:
        now = view.rest + self._map.displacement_at(view.rest)
        expected = np.asarray(project(observation.camera, now)[0], np.float32)
        height, width = observation.gray.shape
        inside = ((expected > 0) & (expected < [width - 1, height - 1])).all(1)
        expected, rest = expected[inside], view.rest[inside]
        if len(expected) < LEAST_CORNERS:
            return None
        pixels, status, _ = cv2.calcOpticalFlowPyrLK(
            view.gray, observation.gray, view.pixels[inside], expected.copy(),
            winSize=WINDOW, maxLevel=1, flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
        )  # fmt: skip
        found = (status[:, 0] > 0) & (np.abs(pixels - expected).max(1) < ASIDE * width)
        found &= ((pixels > 0) & (pixels < [width - 1, height - 1])).all(1)
        found[found] = at_pixels(observation.tissue, pixels[found])
        if np.count_nonzero(found) < LEAST_CORNERS:
            return None
        pixels, rest = pixels[found], rest[found]
        fit = fit_pose(rest, pixels, disparities_at(observation, pixels), camera, observation.baseline)
        if fit.inliers < LEAST_INLIERS * len(pixels) or fit.scale > LARGEST_SCALE * width:
            return None
        return fit.T_world_cam
