"""The depth of all that the eyes see, for smoke in front of it and blood on it."""

from collections.abc import Mapping

import cv2
import numpy as np

from sags_node.clients.overlay.deform import filled
from sags_node.phantom.rig import raw_rays
from sags_node.types import F32, Eye, StereoRig

NOMINAL_DEPTH = 0.08  # m, a usual working distance: where no depth is known
SEARCHES = 8  # iterations that find the right eye's depth; each at least halves the error


class Scene:
    """The depths of a recording, as the raw images of a rig see them.

    Attributes:
        rig: its calibration.
        rays: of the left and the right eye: where each raw pixel looks, [H, W, 2], the x and y of a ray with
            z = 1 in the rectified camera's axes.
    """

    def __init__(self, rig: StereoRig, references: Mapping[int, F32]) -> None:
        """
        Args:
            references: number of a frame -> depth [H, W] of the left rectified image, m, 0 unknown. Between
                the frames that have one it is interpolated; without any all lies at `NOMINAL_DEPTH`.
        """
        self.rig = rig
        self.rays: tuple[F32, F32] = _rays(rig.left), _rays(rig.right)
        size = rig.left.width, rig.left.height
        self._frames = sorted(frame for frame, depth in references.items() if depth.any())
        self._depths = [_filled(references[frame], size) for frame in self._frames]
        self._mirrors: tuple[F32, F32] | None = None
        self._newest: tuple[int, tuple[F32, F32]] | None = None

    def depths(self, frame_id: int) -> tuple[F32, F32]:
        """Return the depth [H, W] (m) of every raw pixel of the left and the right eye. Instruments, whose
        depth is not known, are as far as the tissue beside them."""
        if self._newest is None or self._newest[0] != frame_id:
            rectified = self._rectified(frame_id)
            left = self._look_up(rectified, self.rays[0])
            self._newest = frame_id, (left, self._right(rectified))
        return self._newest[1]

    def in_left(self, eye: int, frame_id: int) -> F32:
        """Return the left eye's rays [H, W, 2] to what each pixel of an eye (0 left, 1 right) sees."""
        seen = self.rays[eye].copy()
        if eye:
            seen[..., 0] += np.float32(self.rig.baseline) / self.depths(frame_id)[1]
        return seen

    def rectified_left(self, picture: F32) -> F32:
        """Rectify a raw left image [H, W] at the calibration's size; 0 beyond its edges."""
        eye = self.rig.left
        x, y = cv2.initUndistortRectifyMap(
            eye.K, eye.distortion, eye.R, eye.P[:, :3], (eye.width, eye.height), cv2.CV_32FC1
        )
        return np.asarray(cv2.remap(picture, x, y, cv2.INTER_LINEAR))

    @property
    def mirrors(self) -> tuple[F32, F32]:
        """The raw pixel [H, W, 2] of either eye that shows what each pixel would see if the world stood
        upside down before the same rig."""
        if self._mirrors is None:
            eyes = zip((self.rig.left, self.rig.right), self.rays, strict=True)
            left, right = (_raw_pixels(eye, rays * np.array([1, -1], np.float32)) for eye, rays in eyes)
            self._mirrors = left, right
        return self._mirrors

    def _rectified(self, frame_id: int) -> F32:
        """Depth [H, W] of the left rectified image."""
        if not self._frames:
            return np.full((self.rig.left.height, self.rig.left.width), np.float32(NOMINAL_DEPTH))
        after = int(np.searchsorted(self._frames, frame_id))
        later, earlier = min(after, len(self._frames) - 1), max(after - 1, 0)
        if self._frames[later] <= frame_id or later == earlier:
            return self._depths[later]
        between = (frame_id - self._frames[earlier]) / (self._frames[later] - self._frames[earlier])
        share = np.float32(np.clip(between, 0, 1))
        return self._depths[earlier] + share * (self._depths[later] - self._depths[earlier])

    def _look_up(self, rectified: F32, rays: F32) -> F32:
        P = self.rig.left.P
        x = rays[..., 0] * np.float32(P[0, 0]) + np.float32(P[0, 2])
        y = rays[..., 1] * np.float32(P[1, 1]) + np.float32(P[1, 2])
        return np.asarray(cv2.remap(rectified, x, y, cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE))

    def _right(self, rectified: F32) -> F32:
        """The right eye's depth. It sees a point at depth z farther left by B / z; the z is found that the
        left eye has there."""
        rays = self.rays[1].copy()
        depth = np.full(rays.shape[:2], np.median(rectified))
        for _ in range(SEARCHES):
            rays[..., 0] = self.rays[1][..., 0] + np.float32(self.rig.baseline) / depth
            depth = self._look_up(rectified, rays)
        return depth


def _rays(eye: Eye) -> F32:
    return raw_rays(eye)[..., :2].astype(np.float32)


def _raw_pixels(eye: Eye, rays: F32) -> F32:
    """Raw pixel [H, W, 2] where an eye sees rays [H, W, 2]."""
    points = np.ones((rays.shape[0] * rays.shape[1], 3))
    points[:, :2] = rays.reshape(-1, 2)
    turn = cv2.Rodrigues(eye.R.T)[0]
    pixels, _ = cv2.projectPoints(points, turn, np.zeros(3), eye.K, eye.distortion)
    return np.asarray(pixels.reshape(rays.shape), np.float32)


def _filled(depth: F32, size: tuple[int, int]) -> F32:
    """The depth at the calibration's size; unknown pixels get that of the nearest known pixel."""
    depth = np.asarray(cv2.resize(depth, size, interpolation=cv2.INTER_NEAREST_EXACT))
    return filled(depth, depth > 0)
