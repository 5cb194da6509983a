"""Which working pixels show tissue."""

from __future__ import annotations

import cv2
import numpy as np

from sags_node.config import TissueConfig
from sags_node.errors import UsageError
from sags_node.types import U8, Bool, RectifiedPair, StereoFrame
from sags_node.vision.rectify import Rectifier

CLASSICAL_WIDTH = 320  # px: instruments are large, their outline is enlarged by `dilate` anyhow
DARK = 12  # grey level below which colour says nothing: the black border, shafts in shadow
LEAST_REDNESS = 0.45  # of the picture's median
THINNEST = 5  # px at CLASSICAL_WIDTH
RED_MINUS_GREEN_AND_SUM = np.array([[1, -1, 0], [1, 1, 1]], np.float32)


class TissueMask:
    """The tissue mask of every frame: the session's own, or found by colour.

    Raises:
        UsageError: a box to exclude does not lie in the raw picture.
    """

    def __init__(self, config: TissueConfig, rectifier: Rectifier) -> None:
        self._config = config
        self._rectifier = rectifier
        width, height = rectifier.raw_size
        usable = np.ones((height, width), np.bool_)
        for x, y, box_width, box_height in config.exclude:
            if (
                min(x, y) < 0
                or min(box_width, box_height) < 1
                or x + box_width > width
                or y + box_height > height
            ):
                raise UsageError(
                    f"vision.tissue.exclude: box {[x, y, box_width, box_height]} (x, y, width, height) is "
                    f"not inside the raw picture of {width}x{height}"
                )
            usable[y : y + box_height, x : x + box_width] = False
        self._usable = rectifier.mask(usable)
        side = 2 * config.dilate + 1
        self._neighbourhood = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))

    def __call__(self, frame: StereoFrame, pair: RectifiedPair) -> Bool:
        """Mask [H, W], True = tissue; highlights on tissue are tissue."""
        if self._config.method == "none":
            return self._usable
        if self._config.method == "session" and frame.tissue is not None:
            tissue = self._rectifier.mask(frame.tissue)
        else:
            tissue = ~find_instruments(pair.left)
        # The picture's border counts as tissue here: only instruments grow.
        eroded: U8 = cv2.erode(tissue.view(np.uint8), self._neighbourhood)
        return eroded.view(np.bool_) & self._usable


def find_instruments(image: U8) -> Bool:
    """Instruments and black borders [H, W] of a picture [H, W, 3] by colour and position alone.

    Tissue is redder than metal and plastic under any white balance, so redness (R - G) / (R + G + B) is
    compared with the picture's own median. Instruments come in from the picture's edge, so a pale patch that
    does not touch the edge is a highlight, fat or gauze and stays tissue.

    A stopgap for recordings without masks, not a segmentation: gold or red instrument parts are missed, pale
    tissue at the edge is lost. On D4D (18 frames with masks): instrument IoU 0.47, 3 % of the tissue lost,
    37 % of the instrument pixels missed, mostly the gold wrist and the tips.
    """
    height, width = image.shape[:2]
    size = min(width, CLASSICAL_WIDTH), max(1, round(height * min(1.0, CLASSICAL_WIDTH / width)))
    small = cv2.blur(cv2.resize(image, size, interpolation=cv2.INTER_AREA), (THINNEST, THINNEST))
    difference, light = cv2.split(cv2.transform(small.astype(np.float32), RED_MINUS_GREEN_AND_SUM))
    redness = difference / (light + 1)
    dark = light <= 3 * DARK
    sample = redness[::4, ::4][~dark[::4, ::4]]
    if len(sample) == 0:
        return np.ones((height, width), np.bool_)
    pale = (redness < LEAST_REDNESS * np.median(sample)) | dark
    opening = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (THINNEST, THINNEST))
    solid = cv2.morphologyEx(pale.view(np.uint8), cv2.MORPH_OPEN, opening)
    count, labels = cv2.connectedComponents(solid)
    touches_edge = np.zeros(count, np.uint8)
    for edge in (labels[0], labels[-1], labels[:, 0], labels[:, -1]):
        touches_edge[edge] = 1
    touches_edge[0] = 0  # the background
    instruments: U8 = cv2.resize(touches_edge[labels], (width, height), interpolation=cv2.INTER_NEAREST)
    return instruments.view(np.bool_)
