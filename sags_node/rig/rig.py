"""Rigs made from what calibrations say: matrices of two cameras and how they stand to each other."""

from __future__ import annotations

import cv2
import numpy as np

from sags_node import geometry
from sags_node.errors import UsageError
from sags_node.types import F64, Camera, Eye, StereoRig

LARGEST_SIDE = 16384  # px
PLUMB_BOB = 5  # k1 k2 p1 p2 k3
RATIONAL = 8  # and k4 k5 k6


def rectified_rig(name: str, width: int, height: int, K: F64, baseline: float) -> StereoRig:
    """A rig whose pictures are rectified already: both eyes have `K` [3, 3] px and no distortion.

    Args:
        baseline: m.
    """
    left, right = np.column_stack([K, np.zeros(3)]), np.column_stack([K, np.zeros(3)])
    right[0, 3] = -K[0, 0] * baseline
    eyes = [Eye(width, height, K, np.zeros(PLUMB_BOB), np.eye(3), P) for P in (left, right)]
    return StereoRig(name, *eyes)


def rectify_eyes(
    name: str,
    size: tuple[int, int],
    K: tuple[F64, F64],
    distortion: tuple[F64, F64],
    R: F64,
    T: F64,
) -> StereoRig:
    """A rig from two cameras, rectified by `cv2.stereoRectify`: rows and zero disparity agree, and no
    rectified pixel lies outside the raw pictures.

    Args:
        size: width and height of both pictures, px.
        K: left, right, each [3, 3] px.
        distortion: left, right, as `fit_distortion` gives them.
        R, T: rotation [3, 3] and translation [3] (m) from left to right camera coordinates.

    Raises:
        UsageError: no rectification follows from these numbers.
    """
    if not all(1 <= side <= LARGEST_SIDE for side in size):
        raise UsageError(
            f"{name}: a picture size of {size[0]}x{size[1]} px is not possible; give the right one"
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
    """Coefficients in OpenCV's order, padded with zeros to [5] (plumb_bob) or [8] (rational_polynomial).

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
    """The same rig for pictures that were resized by `factor`."""
    return StereoRig(rig.name, _resized(rig.left, factor), _resized(rig.right, factor))


def _resized(eye: Eye, factor: float) -> Eye:
    size, new_size = (eye.width, eye.height), (round(eye.width * factor), round(eye.height * factor))
    K, K_rectified = (geometry.scale_intrinsics(part, size, new_size) for part in (eye.K, eye.P[:, :3]))
    P = np.column_stack([K_rectified, eye.P[:, 3] * new_size[0] / size[0]])
    return Eye(*new_size, K, eye.distortion, eye.R, P)


def rectified_camera(rig: StereoRig, width: int, height: int) -> Camera:
    """The left rectified camera resized to a working size, at the world's origin."""
    size = rig.left.width, rig.left.height
    K = geometry.scale_intrinsics(rig.left.P[:, :3], size, (width, height))
    return Camera(width, height, K, np.eye(4))
