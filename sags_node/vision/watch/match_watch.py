"""Whether both eyes show one moment and still stand as calibrated: what the rows of matches tell of it.

Where tissue moves up or down, an eye that is late shows it on another row than the other eye does. Row errors
that grow with the vertical motion mean that an eye is late; a jump all over the image means that the scope
was knocked. In both cases disparities are off by as much.
"""

import math
from collections import deque
from typing import NamedTuple

import cv2
import numpy as np

from sags_node.types import F32, Finding, GrayPyramid
from sags_node.vision.alignment import RowErrors
from sags_node.vision.flow import OpticalFlow
from sags_node.vision.pyramid import inner, narrowed
from sags_node.vision.watch.standing import Debounced, watched_ns

STRIDE = 4  # px between patches of the flow
WINDOW_NS = 200_000_000  # ns of motion that are compared with row errors
FEWEST_FIELDS, LONGEST_WINDOW_NS = 3, 1_000_000_000  # with fewer fields the window is longer (ns)
FEWEST_LATE = 2  # fields that show it, each by itself: one alone was tissue that slips or a match gone wrong
SHORTEST_STEP_NS = 50_000_000  # between two frames: in less time tissue moves less than the flow's error
LONGEST_STEP_NS = 200_000_000  # between two frames: longer motion is not followed in so small images
LATE_ERROR = 0.2  # px of the working size, explained by motion: 1 % of the depth where disparities are 20 px
LEAST_SLOPE = 0.1  # row error over motion: less is chance
KNOCKED = 1.0  # px of the working size from the usual row error; clear pairs stay within 0.1
LEAST_MATCHED = 0.6  # of the usual share of matches
REMEMBERED_S = 5.0  # s over which what is usual follows: a lasting loss of matches is usual after twice that

_LATE = Finding(
    "eyes_late",
    "one eye is late beside the other, so there is no depth: check the capture cards and how frames are "
    "paired; of a recording sags import --check tells by how much",
)
_KNOCKED = Finding(
    "eyes_knocked",
    "rows of the eyes have moved apart, so there is no depth: the scope was knocked or turned; run sags "
    "calib check with --session",
)


class _Sums(NamedTuple):
    """The sums of one frame, over its matches."""

    stamp_ns: int
    matches: int
    motion: float  # squared, px^2
    product: float  # motion times row error, px^2
    error: float  # row error, px

    @property
    def explained(self) -> float:
        """px of row error that motion explains, with its sign."""
        return self.product / math.sqrt(self.motion * self.matches) if self.motion > 0 else 0.0


class MatchWatch(Debounced):
    """Looks at every field of matches. These may be farther apart than flow can follow, so motion is measured
    since a frame shortly before, matched or not.

    Attributes:
        is_late: an eye was late in the last field.
    """

    def __init__(self) -> None:
        self.is_late = False
        super().__init__()
        self._flow = OpticalFlow(STRIDE)
        self._seen: deque[tuple[int, GrayPyramid]] = deque()  # stamps and left images of the last frames
        self._sums: deque[_Sums] = deque()
        self._median: float | None = None  # px, usual
        self._errors: F32 | None = None  # px, usual at each place: a calibration that fits badly leaves some
        self._matched: float | None = None  # usual share
        self._stamp_ns: int | None = None

    def see(self, stamp_ns: int, left: GrayPyramid) -> None:
        """Take the left image of a frame, whether it is matched or not."""
        while self._seen and not 0 <= stamp_ns - self._seen[0][0] <= LONGEST_STEP_NS:
            self._seen.popleft()
        self._seen.append((stamp_ns, narrowed(left)))

    def __call__(self, stamp_ns: int, rows: RowErrors) -> str:
        """Take the row errors of the frame seen last. Return why it has no valid depth; empty: it has."""
        share = min(1.0, watched_ns(self._stamp_ns, stamp_ns) * 1e-9 / REMEMBERED_S)
        self._stamp_ns = stamp_ns
        median, matched = rows.median, np.count_nonzero(rows.matched) / rows.matched.size
        if self._median is None or self._matched is None:
            self._median, self._matched = median, matched
        if self._errors is None or self._errors.shape != rows.errors.shape:
            self._errors = np.where(rows.matched, rows.errors, np.float32(median))
        found = []
        apart = abs(median - self._median) > KNOCKED  # fast motion brings the rows of a late eye there, too
        self.is_late = self._follows_motion(stamp_ns, rows, knocked=apart and _LATE not in self.findings)
        if self.is_late:
            found.append(_LATE)
        elif apart:
            found.append(_KNOCKED)
        else:
            self._median += share * (median - self._median)
            self._errors += np.float32(share) * np.where(rows.matched, rows.errors - self._errors, 0)
        self.note(stamp_ns, found)
        usual, self._matched = self._matched, self._matched + share * (matched - self._matched)
        if found:
            return found[0].text
        return "far fewer places match than usual" if matched < LEAST_MATCHED * usual else ""

    def _follows_motion(self, stamp_ns: int, rows: RowErrors, knocked: bool) -> bool:
        """Tell whether row errors follow the vertical motion of the last frames. If the scope may have been
        `knocked`, motion must explain more of them than a constant offset does."""
        small, sums = self._seen[-1][1], self._sums
        before = [shown for then, shown in self._seen if stamp_ns - then >= SHORTEST_STEP_NS]
        while sums:
            window = WINDOW_NS if len(sums) >= FEWEST_FIELDS else LONGEST_WINDOW_NS
            if 0 <= stamp_ns - sums[0].stamp_ns < window:
                break
            sums.popleft()
        if before:
            assert self._errors is not None
            height, width = rows.errors.shape
            down = self._flow(before[-1], small)[..., 1]
            scale = small.full.shape[1] / (2 * inner(small.halves[0]).shape[1])
            motion = scale * cv2.resize(down, (width, height), interpolation=cv2.INTER_AREA)[rows.matched]
            errors = (rows.errors - self._errors)[rows.matched]
            products = float(motion @ motion), float(motion @ errors), float(errors.sum())
            sums.append(_Sums(stamp_ns, motion.size, *products))
        if len(sums) < FEWEST_LATE:
            return False
        every = _Sums(stamp_ns, *np.sum([each[1:] for each in sums], axis=0).tolist())
        least = max(LATE_ERROR, abs(every.error) / max(every.matches, 1) if knocked else 0.0)
        alike = [math.copysign(each.explained, each.explained * every.explained) for each in sums]
        return (
            abs(every.product) > LEAST_SLOPE * every.motion
            and abs(every.explained) > least
            and sum(each > LATE_ERROR for each in alike) >= FEWEST_LATE
        )
