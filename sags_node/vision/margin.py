"""Tissue that is far enough from instruments: what is measured beside one may be its own."""

import cv2
import numpy as np

from sags_node.types import U8, Bool

EDGE_MARGIN = 20 / 640  # of the width: depths and flow smear that far across an instrument's edge


def clear_of_instruments(tissue: Bool, halvings: int) -> Bool:
    """Find where a mask [H, W] is tissue, and all around it, in a picture after so many halvings."""
    height, width = (side >> halvings for side in tissue.shape)
    step = 1 << halvings
    small = np.ascontiguousarray(tissue[: height * step : step, : width * step : step])
    side = 2 * round(EDGE_MARGIN * width) + 1
    clear: U8 = cv2.erode(small.view(np.uint8), np.ones((side, side), np.uint8))
    return clear.view(np.bool_)


class ClearOfInstruments:
    """The same for masks that are asked for twice: with their own frame, and as that of the frame before."""

    def __init__(self, halvings: int) -> None:
        self._halvings = halvings
        self._newest: tuple[Bool, Bool] | None = None  # a mask and what is clear of it

    def __call__(self, tissue: Bool) -> Bool:
        if self._newest is None or self._newest[0] is not tissue:
            self._newest = tissue, clear_of_instruments(tissue, self._halvings)
        return self._newest[1]
