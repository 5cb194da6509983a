"""The mark at the rim of an overlay: the node's warnings while it is shown, or why it is blank.

It lies on the lower edge, over whatever is there: a warning must be visible even if nothing else is sure.
"""

import re
from collections.abc import Mapping, Sequence

import cv2
import numpy as np

from sags_node.types import U8

FONT = cv2.FONT_HERSHEY_SIMPLEX
MARGIN = 4  # px around the words
MOST_LINES = 2  # more would hide the image
COLOR = (255, 170, 0)  # of warnings
ENDS = "..."


def headlines(warnings: Mapping[str, str]) -> list[str]:
    """Return what is wrong in a few words each; how to fix it stands in `status`.

    Args:
        warnings: code -> what is wrong, up to the first colon or semicolon, and how to fix it.
    """
    said = [re.split(r"[:;] ", text, maxsplit=1)[0] for text in warnings.values()]
    rest = len(said) - MOST_LINES
    return said if rest <= 0 else [*said[: MOST_LINES - 1], f"{said[MOST_LINES - 1]} (and {rest} more)"]


def draw_mark(rgba: U8, warnings: Mapping[str, str], shift: int = 0) -> None:
    """Write the warnings on the lower edge of an overlay [H, W, 4] RGBA, in place; see `draw_lines`."""
    draw_lines(rgba, headlines(warnings), shift)


def draw_lines(rgba: U8, lines: Sequence[str], shift: int = 0) -> None:
    """Write some lines on the lower edge, in place.

    Args:
        shift: px to the left, for the right eye, so that the lines appear at the tissue's depth.
    """
    height, width = rgba.shape[:2]
    scale = max(height / 1000, 0.4)
    thickness = max(1, round(2 * scale))
    for number, line in enumerate(reversed(lines)):
        text = _fitted(line, width - 4 * MARGIN - 2 * shift, scale, thickness)
        (across, above), below = cv2.getTextSize(text, FONT, scale, thickness)
        tall = above + below + 2 * MARGIN
        top = max(0, height - (number + 1) * tall)
        strip = np.zeros((tall, across + 3 * MARGIN, 3), np.uint8)
        left = max(0, (width - strip.shape[1]) // 2 - shift)
        strip[:, :MARGIN] = COLOR
        cv2.putText(strip, text, (2 * MARGIN, MARGIN + above), FONT, scale, COLOR, thickness, cv2.LINE_AA)
        shown = rgba[top : top + tall, left : left + strip.shape[1]]
        shown[..., :3] = strip[: shown.shape[0], : shown.shape[1]]
        shown[..., 3] = 255


def _fitted(text: str, width: int, scale: float, thickness: int) -> str:
    """As much of a text as fits into `width` px."""
    shown = text
    while text and cv2.getTextSize(shown, FONT, scale, thickness)[0][0] > width:
        text = text[:-1]
        shown = text + ENDS
    return shown
