"""Whether the eyes are at one time and in one place: what the matched rows tell of it.

Where tissue moves up or down, an eye that is late shows it on another row than the other eye does. Row errors
that grow with the vertical motion are lateness; those that jump all over the picture are a knock at the
scope. Both mean that disparities are off by as much.
"""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import cv2
import numpy as np

from sags_node.types import Finding, GrayPyramid
from sags_node.vision.alignment import RowErrors
from sags_node.vision.flow import OpticalFlow
from sags_node.vision.pyramid import inner, narrowed
from sags_node.vision.standing import Standing

STRIDE = 4  # px
WINDOW_NS = 200_000_000  # of the motion that is compared with row errors
SHORTEST_STEP_NS = 50_000_000  # between two frames: in less time tissue moves less than flow errs
LONGEST_STEP_NS = 150_000_000  # between two frames: longer motion is not followed in so small pictures
LATE_ERROR = 0.2  # px of the working size, explained by motion: 1 % of the depth where disparities are 20 px
LEAST_SLOPE = 0.1  # of the motion in a frame: less is chance
KNOCKED = 1.0  # px of the working size beside the usual row error; clear pairs stay within 0.1
LEAST_MATCHED = 0.6  # of the usual share of matches
REMEMBERED_S = 5.0  # s over which what is usual follows: a lasting loss of matches is usual after twice that

_LATE = Finding(
    "eyes_late",
    "one eye is late beside the other, so there is no depth: see to the capture cards and how frames are "
    "paired",
)
_KNOCKED = Finding(
    "eyes_knocked",
    "rows of the eyes have moved apart, so there is no depth: the scope was knocked or turned; run sags "
    "calib check with --session",
)


class _Sums(NamedTuple):
    """Of one frame, over its matches."""

    stamp_ns: int
    matches: int
    motion: float  # of squares
    product: float  # of motion and row error


class MatchWatch:
    """Looks at every field of matches. Its frames may be far apart."""

    def __init__(self) -> None:
        self._standing = Standing()
        self._flow = OpticalFlow(STRIDE)
        self._before: tuple[int, GrayPyramid] | None = None
        self._sums: deque[_Sums] = deque()
        self._median: float | None = None  # px, usual
        self._matched: float | None = None  # usual share
        self._stamp_ns: int | None = None

    @property
    def findings(self) -> tuple[Finding, ...]:
        """What is wrong with the eyes, and how to mend it. May be read from any thread."""
        return self._standing.findings

    def __call__(self, stamp_ns: int, left: GrayPyramid, rows: RowErrors) -> str:
        """Take the row errors of one frame, and its left picture; why its matches are no depth, or empty."""
        passed = 0 if self._stamp_ns is None else max(0, stamp_ns - self._stamp_ns)
        self._stamp_ns = stamp_ns
        share = min(1.0, passed * 1e-9 / REMEMBERED_S)
        median, matched = rows.median, np.count_nonzero(rows.matched) / rows.matched.size
        if self._median is None or self._matched is None:
            self._median, self._matched = median, matched
        found = []
        if abs(median - self._median) > KNOCKED:
            found.append(_KNOCKED)
        elif self._is_late(stamp_ns, left, rows):
            found.append(_LATE)
        else:
            self._median += share * (median - self._median)
        self._standing.update(stamp_ns, found)
        usual, self._matched = self._matched, self._matched + share * (matched - self._matched)
        if found:
            return found[0].text
        return "far fewer places match than usual" if matched < LEAST_MATCHED * usual else ""

    def _is_late(self, stamp_ns: int, left: GrayPyramid, rows: RowErrors) -> bool:
        """Row errors follow the vertical motion of the last frames."""
        small, before, sums = narrowed(left), self._before, self._sums
        if before is None or not 0 <= stamp_ns - before[0] < SHORTEST_STEP_NS:
            self._before = stamp_ns, small
        while sums and not 0 <= stamp_ns - sums[0].stamp_ns < WINDOW_NS:
            sums.popleft()
        if before is not None and SHORTEST_STEP_NS <= stamp_ns - before[0] <= LONGEST_STEP_NS:
            assert self._median is not None
            height, width = rows.errors.shape
            down = self._flow(before[1], small)[..., 1]
            scale = left.full.shape[1] / (2 * inner(small.halves[0]).shape[1])
            motion = scale * cv2.resize(down, (width, height), interpolation=cv2.INTER_AREA)[rows.matched]
            errors = rows.errors[rows.matched] - np.float32(self._median)
            sums.append(_Sums(stamp_ns, motion.size, float(motion @ motion), float(motion @ errors)))
        count = sum(each.matches for each in sums)
        squares = sum(each.motion for each in sums)
        if not squares > 0:
            return False
        slope = sum(each.product for each in sums) / squares
        explained = abs(slope) * np.sqrt(squares / count)
        return bool(abs(slope) > LEAST_SLOPE and explained > LATE_ERROR)
