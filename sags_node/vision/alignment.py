"""Whether the rows of both eyes still agree while the node runs: a scope that was bumped, refocused or
exchanged no longer fits its calibration, and stereo then fails bit by bit.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np

from sags_node.types import F32, U8, Bool
from sags_node.vision.matchers import InverseSearch
from sags_node.vision.stereo import FULL_SIZE_BELOW

SAMPLES = 40  # of a field's width
WINDOW = 60  # fields behind the slow median
FEWEST_FIELDS = 10  # before anything is said
FEWEST_KNOWN = 0.1  # of the samples, for a spread
FOUND_BACK = 0.7  # px
LARGEST_MEDIAN = 1.0  # px of the working size
LARGEST_SPREAD = (
    2.0  # px, between the tenth and the ninetieth percentile: a turn about the axis by 0.25 degrees
)
BACK_AT = 0.8  # of the limits: a warning ends


@dataclass(frozen=True, slots=True)
class Alignment:
    """How well rows agree, over the last fields; px of the working size."""

    median: float  # how far below its row in the left picture a point lies in the right one
    spread: float  # of that, between the tenth and the ninetieth percentile; 0 while too little is matched
    warning: str  # empty: they agree


class RowMonitor:
    """A slow, robust look at the row errors that `InverseSearch` finds anyway.

    Args:
        width: of the working size, px.
    """

    def __init__(self, width: int) -> None:
        self._width = width
        self._medians: deque[float] = deque(maxlen=WINDOW)
        self._spreads: deque[float] = deque(maxlen=WINDOW)
        self._warns = False

    def update(self, row_error: F32, known: Bool) -> None:
        """Take the field [h, w] of one frame: row errors in px of the matching size, and where it matched."""
        step = max(1, row_error.shape[1] // SAMPLES)
        scale = self._width / row_error.shape[1]
        errors, matched = (
            row_error[step // 2 :: step, step // 2 :: step],
            known[step // 2 :: step, step // 2 :: step],
        )
        # Errors beyond what can be matched stand at the limit, unmatched: the median must see them.
        every = np.sort(errors, axis=None)
        self._medians.append(scale * float(every[every.size // 2]))
        some = np.sort(errors[matched])
        if some.size >= FEWEST_KNOWN * every.size:
            self._spreads.append(scale * float(some[9 * some.size // 10] - some[some.size // 10]))

    @property
    def alignment(self) -> Alignment | None:
        """None before enough was seen."""
        if len(self._medians) < FEWEST_FIELDS:
            return None
        median = float(np.median(self._medians))
        spread = float(np.median(self._spreads)) if self._spreads else 0.0
        excess = max(abs(median) / LARGEST_MEDIAN, spread / LARGEST_SPREAD)
        self._warns = excess > (BACK_AT if self._warns else 1.0)
        warning = ""
        if self._warns:
            warning = (
                f"rows of the eyes differ by {median:.1f} px, spread {spread:.1f} px: the calibration no "
                "longer fits; run sags calib check with --session"
            )
        return Alignment(median, spread, warning)


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
