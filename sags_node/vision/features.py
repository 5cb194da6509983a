"""Features of a picture that are recognised in another one, however far they moved.

Oriented binary features (Rublee et al., "ORB: an efficient alternative to SIFT or SURF", ICCV 2011), matched
where the best is clearly better than the second (Lowe, IJCV 2004).
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np

from sags_node.types import F32, I64, U8, Bool

RATIO = 0.8  # of the distance to the second best match


class Features(NamedTuple):
    """What can be recognised in a picture."""

    places: F32  # [F, 2] px
    angles: F32  # [F] degrees
    codes: U8  # [F, 32] ORB
    width: int  # px of the whole picture


def features_in(gray: U8, where: Bool | None, count: int, fast_threshold: int) -> Features:
    """At most `count` features of a picture [H, W], where [H, W] it counts (None: everywhere).

    Args:
        fast_threshold: grey levels by which a corner differs from what surrounds it.
    """
    mask = None if where is None else where.view(np.uint8)
    points, codes = cv2.ORB.create(count, fastThreshold=fast_threshold).detectAndCompute(gray, mask)
    places = np.array([point.pt for point in points], np.float32).reshape(-1, 2)
    angles = np.array([point.angle for point in points], np.float32)
    codes = np.zeros((0, 32), np.uint8) if codes is None else np.asarray(codes, np.uint8)
    return Features(places, angles, codes, gray.shape[1])


def matched(before: Features, after: Features) -> tuple[I64, I64]:
    """Rows [K] of both pictures' features that clearly look alike."""
    none = np.zeros(0, np.int64)
    if min(len(before.codes), len(after.codes)) < 2:
        return none, none
    pairs = cv2.BFMatcher(cv2.NORM_HAMMING).knnMatch(before.codes, after.codes, 2)
    clear = [pair[0] for pair in pairs if len(pair) == 2 and pair[0].distance < RATIO * pair[1].distance]
    rows = np.array([(match.queryIdx, match.trainIdx) for match in clear], np.int64).reshape(-1, 2)
    return rows[:, 0], rows[:, 1]
