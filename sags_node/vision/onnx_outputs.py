"""A network's output as a map of the picture."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from sags_node.types import F32
from sags_node.vision.onnx_inputs import Fit

COARSENESS = (1, 2, 4, 8)  # picture px per px of an output
MOST_CHANNELS = 4  # of an output that is maps; more are features


def find_map(values: NDArray[Any], fit: Fit) -> F32 | None:
    """The first channel [h, w] of maps of the padded picture, whole or coarser; None: they are none.

    Args:
        values: [1, C, h, w], [1, h, w, C], [C, h, w], [h, w, C] or [h, w].
    """
    if values.dtype.kind not in "fiu":
        return None
    maps: F32 = (values[0] if values.ndim == 4 and len(values) == 1 else values).astype(np.float32)
    for coarseness in COARSENESS:
        shape = -(-fit.outer[1] // coarseness), -(-fit.outer[0] // coarseness)
        if maps.shape == shape:
            return maps
        if maps.ndim == 3 and maps.shape[:2] == shape and maps.shape[2] <= MOST_CHANNELS:
            maps = maps.transpose(2, 0, 1)
        if maps.ndim == 3 and maps.shape[1:] == shape and len(maps) <= MOST_CHANNELS:
            first: F32 = maps[0]
            return first
    return None


def unfit(plane: F32, fit: Fit) -> F32:
    """A map of the padded picture as one of the picture [h, w] alone, at `fit.inner`."""
    if plane.shape[::-1] != fit.outer:
        plane = cv2.resize(plane, fit.outer, interpolation=cv2.INTER_LINEAR)
    return plane[: fit.inner[1], : fit.inner[0]]
