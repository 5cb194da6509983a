"""Raw stereo images -> row-aligned, undistorted images at the working size."""

import time
from functools import cache

import cv2
import numpy as np

from sags_node import geometry
from sags_node.errors import SagsError, UsageError
from sags_node.rig import rectified_camera, wrong_size
from sags_node.types import (
    F32,
    F64,
    U8,
    Bool,
    Camera,
    Eye,
    Published,
    RectifiedPair,
    RectifiedPictures,
    StereoFrame,
    StereoRig,
)
from sags_node.vision.pyramid import gray_pyramid


class _EyeMap:
    """Where each working pixel of one eye lies in its raw image. The look-up maps are made once.

    A raw image much larger than the working one is shrunk before the look-up, so that fine texture is
    averaged instead of aliased. An eye that is rectified already needs no look-up, only a new size.
    """

    def __init__(self, eye: Eye, K_rectified: F64, camera: Camera) -> None:
        self.size = camera.width, camera.height
        plain = not eye.distortion.any() and np.allclose(eye.R, np.eye(3), atol=1e-9)
        self.is_rectified = plain and np.allclose(eye.K, K_rectified, atol=1e-6)
        if self.is_rectified:
            return
        shrink = max(1, int(min(eye.width / camera.width, eye.height / camera.height)))
        self.looked_up_size = eye.width // shrink, eye.height // shrink
        K = geometry.scale_intrinsics(eye.K, (eye.width, eye.height), self.looked_up_size)
        x, y = cv2.initUndistortRectifyMap(K, eye.distortion, eye.R, camera.K, self.size, cv2.CV_32FC1)
        # Fixed-point maps: twice as fast as float ones. A map for nearest pixels is rounded, not cut off.
        self.linear = cv2.convertMaps(x, y, cv2.CV_16SC2)
        self.nearest = cv2.convertMaps(x, y, cv2.CV_16SC2, nninterpolation=True)[0]

    def image(self, raw: U8) -> U8:
        if self.is_rectified:
            return _resize(raw, self.size)
        shrunk = _resize(raw, self.looked_up_size)
        image: U8 = cv2.remap(shrunk, self.linear[0], self.linear[1], cv2.INTER_LINEAR)
        return image

    def mask(self, raw: Bool) -> Bool:
        counts = raw.view(np.uint8)
        if self.is_rectified:
            return _resize_mask(counts, self.size).view(np.bool_)
        shrunk = _resize_mask(counts, self.looked_up_size)
        mask: U8 = cv2.remap(shrunk, self.nearest, None, cv2.INTER_NEAREST, borderValue=0)
        return mask.view(np.bool_)


def _resize(picture: U8, size: tuple[int, int]) -> U8:
    """Resizes, by area averaging only where it is needed: for ratios up to 1.5 it costs five times as much
    for the same image, and for ratios that are not whole numbers eight times as much."""
    height, width = picture.shape[:2]
    if (width, height) == size:
        return picture
    ratios = width / size[0], height / size[1]
    whole = int(min(ratios))
    if whole > 1 and width % whole == height % whole == 0:
        shrunk = cv2.resize(picture, (width // whole, height // whole), interpolation=cv2.INTER_AREA)
        return _resize(np.asarray(shrunk), size)  # less than 1.5 is left
    resized: U8 = cv2.resize(
        picture, size, interpolation=cv2.INTER_AREA if max(ratios) > 1.5 else cv2.INTER_LINEAR
    )
    return resized


def _resize_mask(mask: U8, size: tuple[int, int]) -> U8:
    resized: U8 = cv2.resize(mask, size, interpolation=cv2.INTER_NEAREST_EXACT)
    return resized


class Rectifier:
    """Rectifies both eyes to a working size with one common projection.

    The right eye is mapped with the left eye's rectified `K`: rows and zero disparity agree by construction.

    Attributes:
        camera: the left rectified camera at the working size, at the world's origin.
        baseline: metres.
        path: of the calibration.
        raw_size: width and height of the images it takes, px.
    """

    def __init__(
        self, rig: StereoRig, width: int, height: int, published: tuple[int, int] | None = None
    ) -> None:
        """`published`: width and height in which frames are published; default: those they are worked in."""
        self.camera = rectified_camera(rig, width, height)
        self.baseline, self.path = rig.baseline, rig.path
        self._size = width, height
        self.raw_size = rig.left.width, rig.left.height
        K_rectified = rig.left.P[:, :3]
        self._left = _EyeMap(rig.left, K_rectified, self.camera)
        self._right = _EyeMap(rig.right, K_rectified, self.camera)
        self._published = None if published in (None, self._size) else Rectifier(rig, *published)

    def pictures(self, frame: StereoFrame) -> RectifiedPictures:
        """Rectify the images of one frame, and make its gray ones. Any thread may do it ahead.

        Raises:
            UsageError, SagsError: the images do not have the calibration's size, or that of each other.
        """
        started = time.perf_counter()
        height, width = frame.left.shape[:2]
        if wrong := wrong_size(self.path, self.raw_size, (width, height)):
            raise UsageError(f"{wrong.what}; {wrong.fix}")
        if frame.right is not None:
            self._check(frame.right, "right image")
        left = self._left.image(frame.left)
        right = None if frame.right is None else self._right.image(frame.right)
        gray = gray_pyramid(left), None if right is None else gray_pyramid(right)
        return RectifiedPictures(left, right, gray, 1e3 * (time.perf_counter() - started))

    def __call__(self, frame: StereoFrame, made: RectifiedPictures | None = None) -> RectifiedPair:
        """Rectify one frame; the camera takes its pose, or stays at the world's origin.

        Args:
            made: its `pictures`, where they are made already.

        Raises:
            SagsError: the images do not have the calibration's size.
            UsageError: the pose holds NaN or infinity.
        """
        made = made or self.pictures(frame)
        camera = self.camera
        if frame.T_world_cam is not None:
            if not np.isfinite(frame.T_world_cam).all():
                number = frame.frame_id
                raise UsageError(
                    f"the pose of frame {number} holds NaN or infinity; check the source's poses"
                )
            camera = Camera(camera.width, camera.height, camera.K, frame.T_world_cam)
        return RectifiedPair(
            frame_id=frame.frame_id,
            t_capture_ns=frame.t_capture_ns,
            camera=camera,
            baseline=self.baseline,
            left=made.left,
            right=made.right,
            gray=made.gray,
            published=None if self._published is None else self._published.later(frame),
        )

    def later(self, frame: StereoFrame) -> Published:
        """Return a frame whose images are rectified when they are asked for."""

        @cache
        def picture(side: str) -> U8:
            eye, raw = (self._left, frame.left) if side == "left" else (self._right, frame.right)
            assert raw is not None  # else nobody asks
            return eye.image(raw)

        return Published(self.camera, picture)

    def mask(self, mask: Bool) -> Bool:
        """Rectify a mask of the raw left image at the working size; False outside the raw image.

        Raises:
            SagsError: the mask does not have the images' size.
        """
        self._check(mask, "mask")
        return self._left.mask(mask)

    def depth(self, depth: F32) -> F32:
        """Resize the depth of the left rectified image to the working size. It is not interpolated: a mean
        across an edge is a surface that does not exist.

        Raises:
            SagsError: the depth image does not have the images' size.
        """
        self._check(depth, "depth image")
        resized: F32 = cv2.resize(depth, self._size, interpolation=cv2.INTER_NEAREST_EXACT)
        return resized

    def _check(self, picture: U8 | Bool | F32, name: str) -> None:
        width, height = self.raw_size
        if picture.shape[:2] != (height, width):
            size = f"{picture.shape[1]}x{picture.shape[0]}"
            fix = "all that belongs to a frame needs one size: fix the source"
            raise SagsError(f"the {name} is {size} px, the left image {width}x{height}; {fix}")
