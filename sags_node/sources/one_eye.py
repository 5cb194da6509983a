"""One eye for both inputs of a recording: no depth can come of it, so nothing should begin with it.

Live cameras are not refused: both may send a test picture until the scope is plugged in. There the watch on
both eyes warns (`eyes_equal`).
"""

from __future__ import annotations

import cv2
import numpy as np

from sags_node.errors import UsageError
from sags_node.types import U8

WIDTH = 80  # px of the pictures that are compared: noise and compression are averaged away in them
SURELY = 0.25  # of what a shift by one of their pixels changes; the eyes of a scope differ by 1 to 5 of it
LEAST = 1.0  # grey levels, of such a shift: less is a picture of nothing, which tells nothing


def refuse_one_eye_twice(left: U8, right: U8 | None) -> None:
    """Look at the first pair [H, W, 3] of a recording.

    Raises:
        UsageError: both pictures are surely of the same eye.
    """
    if right is None or left.shape != right.shape:
        return
    size = WIDTH, max(1, round(left.shape[0] * WIDTH / left.shape[1]))
    a, b = (cv2.resize(eye, size, interpolation=cv2.INTER_AREA).astype(np.float32) for eye in (left, right))
    shifted = float(np.abs(a[:, 1:] - a[:, :-1]).mean())
    if shifted > LEAST and float(np.abs(a - b).mean()) < SURELY * shifted:
        raise UsageError(
            "both eyes get the same picture, so there is no depth; name the other eye's camera or file in "
            "source.right, or see to the cables"
        )
