"""Tissue masks that another process makes of the published images, joined to the frames by time."""

from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from sags_node.config.schema import TissueConfig
from sags_node.errors import SagsError, UsageError
from sags_node.types import Bool, RectifiedPair

SHAPE_TOLERANCE = 0.02  # of the ratio of width to height
LARGEST_SIDE = 4096  # px of a mask
WHITE = 128  # grey level from which on a pixel is white

# Stamp (ns) and image of the mask whose stamp is nearest to the one given; None: none has come.
NearestMask = Callable[[int], tuple[int, NDArray[Any]] | None]


class NoMaskError(SagsError):
    """No usable mask has come for one frame."""


class TopicMasks:
    """The mask that was made of a frame, or of one within `tolerance` of it.

    A mask is made of a published image, so the newest frame's mask comes too late for it: the mask of the
    frame before is used. The node does not wait.

    Attributes:
        is_new: whether the last mask was not used before.

    Raises:
        UsageError: nothing here receives masks.
    """

    def __init__(self, config: TissueConfig, nearest: NearestMask | None) -> None:
        if nearest is None:
            raise UsageError(
                "vision.tissue.method topic is for a running node (sags run); here set it to session, "
                "classical or onnx"
            )
        self._nearest = nearest
        self._tolerance_ns = round(config.tolerance * 1e9)
        self._is_white = config.tissue_is == "white"
        self._where = f"{config.ns}/left/tissue_mask from {config.endpoint}"
        self._last_stamp_ns: int | None = None
        self.is_new = False

    def __call__(self, pair: RectifiedPair) -> Bool:
        """Return the tissue [H, W] of a rectified pair.

        Raises:
            NoMaskError: none has come, none of this time, or it is no mask of this image.
        """
        found = self._nearest(pair.t_capture_ns)
        if found is None:
            raise NoMaskError(f"no mask has come on {self._where}")
        stamp_ns, values = found
        apart_ns = pair.t_capture_ns - stamp_ns
        if abs(apart_ns) > self._tolerance_ns:
            when = "older" if apart_ns > 0 else "newer"
            raise NoMaskError(
                f"the mask on {self._where} is {abs(apart_ns) * 1e-9:.3f} s {when} than the image; "
                f"vision.tissue.tolerance is {self._tolerance_ns * 1e-9:g} s"
            )
        white = self._white(values, pair.left.shape[1], pair.left.shape[0])
        self.is_new = stamp_ns != self._last_stamp_ns
        self._last_stamp_ns = stamp_ns
        return white if self._is_white else ~white

    def _white(self, values: NDArray[Any], width: int, height: int) -> Bool:
        """Find where a mask is white, at the size of the image [height, width]."""
        if values.ndim != 2 or values.dtype != np.uint8 or not values.size:
            raise NoMaskError(f"what comes on {self._where} is no mask: mono8 is expected, 255 is white")
        ratio = values.shape[1] / values.shape[0] * height / width
        if abs(ratio - 1) > SHAPE_TOLERANCE or max(values.shape) > LARGEST_SIDE:
            raise NoMaskError(
                f"the mask on {self._where} has {values.shape[1]}x{values.shape[0]} px, the image "
                f"{width}x{height}"
            )
        largest = int(values.max())
        if 0 < largest < WHITE:
            raise NoMaskError(f"the mask on {self._where} has no value above {largest}: 255 is white")
        if values.shape != (height, width):
            values = cv2.resize(values, (width, height), interpolation=cv2.INTER_LINEAR)
        white: Bool = values >= WHITE
        return white
