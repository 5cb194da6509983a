"""The tissue mask of recordings that show the left eye once more with the instruments painted green."""

from __future__ import annotations

import cv2
import numpy as np

from sags_node.kernels.jit import kernel
from sags_node.types import U8, Bool

# The paint is blended at 30 %: painted pixels gain about 70 counts of green against the mean of blue and red,
# and the dimming of the others takes the same share from every channel. Half of the gain separates them.
PAINTED_ABOVE = 73  # counts, of twice that gain
OPEN = np.ones((3, 3), np.uint8)  # removes codec specks
CLOSE = np.ones((5, 5), np.uint8)  # fills dots inside instruments


def unpainted(pane: U8, left: U8) -> Bool:
    """True where `pane` shows `left` without green paint.

    Args:
        pane: [H, W, 3] RGB, the left picture with semi-transparent green instruments.
        left: [H, W, 3] RGB, the same picture without paint.
    """
    painted = np.empty(pane.shape[:2], np.uint8)
    _find_paint(pane, left, painted)
    painted = cv2.morphologyEx(painted, cv2.MORPH_OPEN, OPEN)
    painted = cv2.morphologyEx(painted, cv2.MORPH_CLOSE, CLOSE)
    tissue: Bool = painted == 0
    return tissue


@kernel
def _find_paint(pane: U8, left: U8, painted: U8) -> None:
    """Write 1 where green was gained, else 0; in one pass, since pictures in between cost four times that."""
    for y in range(painted.shape[0]):
        for x in range(painted.shape[1]):
            red, green, blue = (
                np.int32(pane[y, x, 0]) - left[y, x, 0],
                np.int32(pane[y, x, 1]) - left[y, x, 1],
                np.int32(pane[y, x, 2]) - left[y, x, 2],
            )
            painted[y, x] = 2 * green - blue - red > PAINTED_ABOVE
