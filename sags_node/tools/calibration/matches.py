"""Points that both raw images of a stereo pair show, found without the calibration they are to judge."""

import cv2
import numpy as np

from sags_node.types import F64, U8, Bool

FEATURES = 3000  # of each image
CONTRAST = 0.01  # least contrast of a SIFT feature: tissue has little
LARGEST_RATIO = 0.8  # best to second best descriptor distance (Lowe, IJCV 2004, section 7.1)
HIGHLIGHT = 245  # grey level
HIGHLIGHT_MARGIN = 9  # px: a highlight lies at another depth than the tissue it shines on
EPIPOLAR_DISTANCE = 1.5 / 640  # of the width: as far as lens distortion bends an epipolar line
LEAST = 16  # matches for an epipolar geometry worth the name


def match_eyes(left: U8, right: U8) -> F64:
    """The pixels of the same points in both images, [M, 4]: x, y in the left one, x, y in the right one.

    These are SIFT features away from highlights that are each other's best match and fit one epipolar
    geometry, whichever it is. Where they disagree with a calibration, the calibration is wrong.

    Args:
        left, right: [H, W, 3] RGB, raw.
    """
    sift = cv2.SIFT.create(FEATURES, contrastThreshold=CONTRAST)
    (points_left, said_left), (points_right, said_right) = (
        sift.detectAndCompute(gray, _dull(gray).view(np.uint8))
        for gray in (cv2.cvtColor(eye, cv2.COLOR_RGB2GRAY) for eye in (left, right))
    )
    if min(len(points_left), len(points_right)) < LEAST:
        return np.empty((0, 4))
    there, back = _nearest(said_left, said_right), _nearest(said_right, said_left)
    pairs = [(i, j) for i, j in there.items() if back.get(j) == i]
    found = np.array([[*points_left[i].pt, *points_right[j].pt] for i, j in pairs]).reshape(-1, 4)
    return _on_one_geometry(found, EPIPOLAR_DISTANCE * left.shape[1])


def _dull(gray: U8) -> Bool:
    """A mask [H, W] of the pixels away from highlights."""
    window = np.ones((2 * HIGHLIGHT_MARGIN + 1,) * 2, np.uint8)
    dull: Bool = cv2.dilate(gray, window) < HIGHLIGHT
    return dull


def _nearest(said: np.ndarray, other: np.ndarray) -> dict[int, int]:
    """For each descriptor that has one, the index of the clearly most similar of the others (ratio test)."""
    two = cv2.BFMatcher(cv2.NORM_L2).knnMatch(said, other, k=2)
    return {a.queryIdx: a.trainIdx for a, b in two if a.distance < LARGEST_RATIO * b.distance}


def _on_one_geometry(found: F64, distance: float) -> F64:
    if len(found) < LEAST:
        return np.empty((0, 4))
    cv2.setRNGSeed(0)
    _, inliers = cv2.findFundamentalMat(
        found[:, :2], found[:, 2:], cv2.FM_RANSAC, distance, confidence=0.9999, maxIters=10_000
    )
    return np.empty((0, 4)) if inliers is None else found[inliers.ravel() > 0]
