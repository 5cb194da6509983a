"""The phantom's stereo endoscope: two distorted cameras with a slight toe-in, and their exact rays."""

import cv2
import numpy as np

from sags_node.rig import rectify_eyes
from sags_node.types import F64, Eye, StereoRig

FOCAL_PER_WIDTH = 0.9  # focal length over the longer side: about 58 degrees, usual for an endoscope
BASELINE = 0.0043  # m
_UNDISTORT = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-12)

_DISTORTION_LEFT = np.array([-0.110, 0.045, 0.0007, -0.0005, 0.0])
_DISTORTION_RIGHT = np.array([-0.102, 0.038, -0.0004, 0.0008, 0.0])
_TOE_IN = np.radians([0.25, 0.6, -0.3])  # rotation vector, left axes to right axes


def phantom_rig(width: int, height: int) -> StereoRig:
    """Return the rig for raw images of `width` x `height` px, rectified at that size."""
    focal = FOCAL_PER_WIDTH * max(width, height)
    K_left, K_right = np.eye(3), np.eye(3)
    K_left[0, 0], K_left[1, 1] = focal, focal
    K_left[:2, 2] = 0.5 * (width - 1) + 0.006 * width, 0.5 * (height - 1) - 0.004 * height
    K_right[0, 0], K_right[1, 1] = 1.004 * focal, 1.003 * focal
    K_right[:2, 2] = 0.5 * (width - 1) - 0.005 * width, 0.5 * (height - 1) + 0.006 * height

    R_right_left = cv2.Rodrigues(_TOE_IN)[0]
    T_right_left = -R_right_left @ np.array([BASELINE, 0.00006, -0.00008])
    distortion = _DISTORTION_LEFT, _DISTORTION_RIGHT
    return rectify_eyes("phantom", (width, height), (K_left, K_right), distortion, R_right_left, T_right_left)


def raw_rays(eye: Eye) -> F64:
    """Return the ray of every raw pixel in the rectified camera's axes, [H, W, 3], scaled to z = 1."""
    u, v = np.meshgrid(np.arange(eye.width, dtype=np.float64), np.arange(eye.height, dtype=np.float64))
    pixels = np.stack([u, v], -1).reshape(-1, 1, 2)
    normalized = cv2.undistortPoints(pixels, eye.K, eye.distortion, R=eye.R, criteria=_UNDISTORT)
    rays = np.ones((eye.height, eye.width, 3))
    rays[..., :2] = normalized.reshape(eye.height, eye.width, 2)
    return rays


def rectified_rays(eye: Eye) -> F64:
    """Return the ray of every rectified pixel in the rectified camera's axes, [H, W, 3], scaled to z = 1."""
    u, v = np.meshgrid(np.arange(eye.width, dtype=np.float64), np.arange(eye.height, dtype=np.float64))
    x, y = (u - eye.P[0, 2]) / eye.P[0, 0], (v - eye.P[1, 2]) / eye.P[1, 1]
    return np.stack([x, y, np.ones_like(x)], -1)
