"""The tissue mask of recordings that show the left eye once more with the instruments painted green."""

from __future__ import annotations

import cv2
import numpy as np

from sags_node.types import U8, Bool

# The paint is blended at 30 %: painted pixels gain about 70 counts of green against the mean of blue and red,
# and the dimming of the others takes the same share from every channel. Half of the gain separates them.
GREEN_EXCESS = np.array([[-0.5, 1.0, -0.5]], np.float32)  # of blue, green, red
PAINTED_ABOVE = 36  # counts
OPEN = np.ones((3, 3), np.uint8)  # removes codec specks
CLOSE = np.ones((5, 5), np.uint8)  # fills dots inside instruments


def unpainted(pane: U8, left: U8) -> Bool:
    """True where `pane` shows `left` without green paint.

    Args:
        pane: [H, W, 3] BGR, the left picture with semi-transparent green instruments.
        left: [H, W, 3] BGR, the same picture without paint.
    """
    gained = cv2.transform(cv2.subtract(pane, left, dtype=cv2.CV_16S), GREEN_EXCESS)
    painted = (gained > PAINTED_ABOVE).astype(np.uint8)
    painted = cv2.morphologyEx(painted, cv2.MORPH_OPEN, OPEN)
    painted = cv2.morphologyEx(painted, cv2.MORPH_CLOSE, CLOSE)
    tissue: Bool = painted == 0
    return tissue
