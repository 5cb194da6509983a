"""Tissue that is far enough from instruments: what is measured beside one may be of the instrument."""

import cv2
import numpy as np

from sags_node.types import U8, Bool

EDGE_MARGIN = 20 / 640  # of the width: depths and flow smear that far across an instrument's edge


def clear_of_instruments(tissue: Bool, halvings: int) -> Bool:
    """Find the pixels of an image after so many halvings at and around which a mask [H, W] is all tissue."""
    height, width = (side >> halvings for side in tissue.shape)
    step = 1 << halvings
    small = np.ascontiguousarray(tissue[: height * step : step, : width * step : step])
    side = 2 * round(EDGE_MARGIN * width) + 1
    clear: U8 = cv2.erode(small.view(np.uint8), np.ones((side, side), np.uint8))
    return clear.view(np.bool_)


class ClearOfInstruments:
    """Caches the same for masks that are used twice: with their own frame, and with the next one."""

    def __init__(self, halvings: int) -> None:
        self._halvings = halvings
        self._newest: tuple[Bool, Bool] | None = None  # a mask and what is clear of it

    def __call__(self, tissue: Bool) -> Bool:
        if self._newest is None or self._newest[0] is not tissue:
            self._newest = tissue, clear_of_instruments(tissue, self._halvings)
        return self._newest[1]
