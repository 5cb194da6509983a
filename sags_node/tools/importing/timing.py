"""Whether both eyes' images are of one time.

What moves or flickers changes rows of both eyes' images at the same time, wherever along them it is. So the
changes from frame to frame of one eye's rows are those of the other eye's, some frames later where one is
late. On D4D, a beating heart and the phantom the right delay correlates with 0.60 to 0.97, one that is off by
a frame or more with 0.57 at most, and always with 0.4 less than the right one.
"""

import cv2
import numpy as np

from sags_node.checks import Finding
from sags_node.types import F32, U8

LOOKED_AT = 120  # frames, one after the other
FEWEST = 30  # frames: with fewer nothing can be told
ROWS = 32  # bands of rows whose brightness is compared
MOST = 10  # frames: the largest delay that is tried
LEAST = 0.4  # correlation of eyes that see the same move
CLEARLY = 0.2  # by which it must exceed that of no delay


class Timing:
    """Takes pairs one after the other; of each it keeps a few numbers.

    Args:
        longer: by how many images one eye has more than the other: it may have been begun so much sooner.
    """

    def __init__(self, longer: int = 0) -> None:
        self._longer = longer
        self._rows: tuple[list[F32], list[F32]] = [], []

    def add(self, left: U8, right: U8) -> None:
        """Take in a pair [H, W, 3] RGB."""
        for rows, picture in zip(self._rows, (left, right), strict=True):
            gray = cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY).astype(np.float32)
            rows.append(cv2.resize(gray, (1, ROWS), interpolation=cv2.INTER_AREA)[:, 0])

    def findings(self) -> list[Finding]:
        """A warning where one eye is late; nothing where too little moves to tell."""
        if len(self._rows[0]) < FEWEST:
            return []
        left, right = (np.diff(np.stack(rows), axis=0) for rows in self._rows)
        near = range(-MOST, MOST + 1)
        tried = {*near, *(side * (self._longer + few) for side in (-1, 1) for few in range(-2, 3))}
        alike = {
            late: _alike(left, right, late)
            for late in sorted(tried, key=abs)
            if abs(late) <= len(left) - FEWEST or late in near
        }
        late = max(alike, key=lambda frames: alike[frames])
        if alike[late] < LEAST or alike[late] < alike[0] + CLEARLY:
            return []
        eye = "right" if late > 0 else "left"
        what = f"the {eye} eye is {abs(late)} frames late: it shows what the other one showed before"
        fix = (
            f"cut the first {abs(late)} frames off the {eye} eye's recording (of a bag: source.clocks:=two), "
            "or record both by one clock"
        )
        return [Finding("warning", what, fix, {"right_late_frames": late})]


def _alike(left: F32, right: F32, late: int) -> float:
    """Correlation of the changes, where the right eye's come `late` frames later."""
    count = len(left)
    a, b = left[max(0, -late) : count - max(0, late)], right[max(0, late) : count - max(0, -late)]
    return float(np.sum(a * b) / max(np.linalg.norm(a) * np.linalg.norm(b), 1e-9))
