"""Rigs made from the numbers of calibrations: the matrices of two cameras and their relative pose."""

from dataclasses import replace

import cv2
import numpy as np

from sags_node import geometry
from sags_node.errors import UsageError
from sags_node.types import F64, Camera, Eye, StereoRig

LARGEST_SIDE = 16384  # px
PLUMB_BOB = 5  # k1 k2 p1 p2 k3
RATIONAL = 8  # and k4 k5 k6
STILL = 1 / 180  # of the width: if the median pixel moves by no more, the images were rectified already


def rectified_rig(name: str, width: int, height: int, K: F64, baseline: float) -> StereoRig:
    """Make a rig whose images are rectified already: both eyes have `K` [3, 3] (px) and no distortion.

    Args:
        baseline: m.
    """
    left, right = np.column_stack([K, np.zeros(3)]), np.column_stack([K, np.zeros(3)])
    right[0, 3] = -K[0, 0] * baseline
    eyes = [Eye(width, height, K, np.zeros(PLUMB_BOB), np.eye(3), P) for P in (left, right)]
    return StereoRig(name, *eyes)


def already_rectified(rig: StereoRig) -> StereoRig:
    """Return the rig for images that `rig` rectified: only P holds for them, as for ROS's `image_rect`."""
    left, right = (
        replace(eye, K=eye.P[:, :3].copy(), distortion=np.zeros(PLUMB_BOB), R=np.eye(3))
        for eye in (rig.left, rig.right)
    )
    return replace(rig, left=left, right=right)


def rectifies(rig: StereoRig) -> bool:
    """Tell whether the rig straightens or turns images, rather than only zooming them."""
    across = np.linspace(0, 1, 9)
    for eye in (rig.left, rig.right):
        pixels = np.stack(np.meshgrid(across * eye.width, across * eye.height), -1).reshape(-1, 1, 2)
        moved = cv2.undistortPoints(pixels, eye.K, eye.distortion, R=eye.R, P=eye.K)
        if np.median(np.linalg.norm(moved - pixels, axis=-1)) > STILL * eye.width:
            return True
    return False


def part_of_sensor(eye: Eye, roi: tuple[int, int, int, int], binning: tuple[int, int], where: str) -> Eye:
    """Return the eye for images of a binned part of the sensor: offset, then division (ROS, REP 104).

    Args:
        roi: x, y, width and height of the part, px of the sensor; no width or height: all of it.
        binning: across and down; 0: none.

    Raises:
        UsageError: this is no part of the sensor; `where` names the source in the message.
    """
    x, y, *sides = roi
    across, down = max(binning[0], 1), max(binning[1], 1)
    width, height = (sides[0] or eye.width), (sides[1] or eye.height)
    binned = width // across, height // down
    if min(x, y) < 0 or x + width > eye.width or y + height > eye.height or 0 in binned:
        raise UsageError(
            f"{where}: roi {x},{y} {width}x{height} with binning {across}x{down} is no part of "
            f"{eye.width}x{eye.height} px; set rig to a calibration of these images"
        )
    if (x, y, *binned) == (0, 0, eye.width, eye.height):
        return eye
    K, K_rectified = eye.K.copy(), eye.P[:, :3].copy()
    for each in (K, K_rectified):
        each[:2, 2] -= x, y
    whole = binned[0] * across, binned[1] * down
    K, K_rectified = (geometry.scale_intrinsics(each, whole, binned) for each in (K, K_rectified))
    P = np.column_stack([K_rectified, eye.P[:, 3] / [across, down, 1]])
    return replace(eye, width=binned[0], height=binned[1], K=K, P=P)


def rectify_eyes(
    name: str, size: tuple[int, int], K: tuple[F64, F64], distortion: tuple[F64, F64], R: F64, T: F64
) -> StereoRig:
    """Make a rig of two cameras, rectified by `cv2.stereoRectify`: rows and zero disparity agree, and no
    rectified pixel lies outside the raw images.

    Args:
        size: width and height of both images, px.
        K: left, right, each [3, 3] px.
        distortion: left, right, as `fit_distortion` gives them.
        R, T: rotation [3, 3] and translation [3] (m) from left to right camera coordinates.

    Raises:
        UsageError: no rectification follows from these numbers.
    """
    if not all(1 <= side <= LARGEST_SIDE for side in size):
        raise UsageError(
            f"{name}: an image size of {size[0]}x{size[1]} px is not possible; give the right one"
        )
    numbers = np.concatenate([part.ravel() for part in (*K, *distortion, R, T)])
    if not np.isfinite(numbers).all():
        raise UsageError(f"{name}: the matrices hold NaN or infinity; run the calibration again")
    if not geometry.is_rotation(R):
        raise UsageError(f"{name}: R, from left to right camera, is not a rotation; save the files again")
    if not T.any():
        raise UsageError(f"{name}: T is zero: there is no baseline; run the stereo calibration again")
    R_left, R_right, P_left, P_right, *_ = cv2.stereoRectify(
        *(K[0], distortion[0], K[1], distortion[1], size, R, T.reshape(3, 1)),
        flags=cv2.CALIB_ZERO_DISPARITY,
        alpha=0,
    )
    return StereoRig(
        name,
        Eye(*size, K[0], distortion[0], R_left, P_left),
        Eye(*size, K[1], distortion[1], R_right, P_right),
    )


def fit_distortion(coefficients: F64, where: str) -> F64:
    """Pad coefficients in OpenCV's order with zeros to [5] (plumb_bob) or [8] (rational_polynomial).

    Raises:
        UsageError: there are more, and they are not zero.
    """
    used = np.trim_zeros(coefficients, "b")
    for length in (PLUMB_BOB, RATIONAL):
        if len(used) <= length:
            return np.pad(used, (0, length - len(used))).astype(np.float64)
    raise UsageError(
        f"{where}: {len(used)} distortion coefficients; plumb_bob (up to 5) and rational_polynomial (8) are "
        "read: calibrate without thin prism and tilt"
    )


def resized_rig(rig: StereoRig, factor: float) -> StereoRig:
    """Return the rig for images that were resized by `factor`."""
    return replace(rig, left=_resized(rig.left, factor), right=_resized(rig.right, factor))


def _resized(eye: Eye, factor: float) -> Eye:
    size, new_size = (eye.width, eye.height), (round(eye.width * factor), round(eye.height * factor))
    K, K_rectified = (geometry.scale_intrinsics(part, size, new_size) for part in (eye.K, eye.P[:, :3]))
    P = np.column_stack([K_rectified, eye.P[:, 3] * new_size[0] / size[0]])
    return Eye(*new_size, K, eye.distortion, eye.R, P)


def rectified_camera(rig: StereoRig, width: int, height: int) -> Camera:
    """Return the left rectified camera, resized to a working size, at the world's origin."""
    eye = rig.left
    return geometry.resized_camera(Camera(eye.width, eye.height, eye.P[:, :3], np.eye(4)), width, height)
