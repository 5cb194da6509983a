"""How well the rows of one rectified pair agree, measured with care and without hurry."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np

from sags_node.types import F32, U8, Bool
from sags_node.vision.matchers import InverseSearch
from sags_node.vision.stereo import FULL_SIZE_BELOW

FEWEST_KNOWN = 0.1  # of the picture
FOUND_BACK = 0.7  # px


class RowError(NamedTuple):
    """Distances between rows of a rectified pair, px of the full pictures."""

    median: float
    p90: float
    matched: float  # share of the picture, 0..1


def measure_rows(left: U8, right: U8, smallest: float, largest: float) -> RowError | None:
    """Dense row errors of a rectified pair [H, W, 3] (RGB); None where next to nothing matches.

    Args:
        smallest, largest: disparities to search, px.
    """
    width, height = left.shape[1], left.shape[0]
    shrink = 2 if width >= FULL_SIZE_BELOW else 1
    size = width // shrink, height // shrink
    gray = [
        cv2.resize(cv2.cvtColor(eye, cv2.COLOR_RGB2GRAY), size, interpolation=cv2.INTER_AREA)
        for eye in (left, right)
    ]
    match = InverseSearch(smallest / shrink, largest / shrink, size)
    disparity, row_error, known = match(*gray)
    known &= _found_back(match, gray[0], gray[1], disparity, row_error)
    if np.mean(known) < FEWEST_KNOWN:
        return None
    median, p90 = np.percentile(np.abs(row_error[known]), [50, 90]) * shrink
    return RowError(float(median), float(p90), float(np.mean(known)))


def _found_back(match: InverseSearch, left: U8, right: U8, disparity: F32, row_error: F32) -> Bool:
    """Where the match of a left pixel is matched back to it, [h, w]: anything is matched to something."""
    mirrored = match(np.ascontiguousarray(right[:, ::-1]), np.ascontiguousarray(left[:, ::-1]))
    back_disparity, back_error, _ = (np.ascontiguousarray(field[:, ::-1]) for field in mirrored)
    rows, columns = np.indices(left.shape, np.float32)
    there = columns - disparity, rows + row_error
    x = cv2.remap(back_disparity, *there, cv2.INTER_LINEAR, borderValue=np.inf)
    y = cv2.remap(back_error, *there, cv2.INTER_LINEAR, borderValue=np.inf)
    back: Bool = np.hypot(x - disparity, y + row_error) < FOUND_BACK
    return back
