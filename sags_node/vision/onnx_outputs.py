"""A network's outputs: which numbers of them are a map of the picture, and what they mean."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from sags_node.types import F32
from sags_node.vision.onnx_inputs import Fit

COARSENESS = (1, 2, 4, 8)  # picture px per px of an output
MOST_CHANNELS = 4  # of an output that is maps; more are features


class MapName(NamedTuple):
    """One map among a network's outputs."""

    output: str
    channel: int
    coarseness: int  # px of the picture per px of the map


class Reading(NamedTuple):
    """What a map's numbers mean: disparity (px of the picture) is factor * number, or factor / number."""

    factor: float
    inverted: bool = False

    def disparity(self, numbers: F32) -> F32:
        if not self.inverted:
            return numbers * np.float32(self.factor)
        return np.divide(np.float32(self.factor), numbers, out=np.zeros_like(numbers), where=numbers > 0)


def find_maps(outputs: Mapping[str, NDArray[Any]], fit: Fit) -> dict[MapName, F32]:
    """Every map [h, w] of the padded picture, whole or coarser, in the order of the outputs."""
    maps: dict[MapName, F32] = {}
    for name, values in outputs.items():
        for coarseness in COARSENESS:
            planes = _planes(values, (-(-fit.outer[1] // coarseness), -(-fit.outer[0] // coarseness)))
            maps |= {MapName(name, channel, coarseness): plane for channel, plane in enumerate(planes)}
            if planes:
                break
    return maps


def _planes(values: NDArray[Any], shape: tuple[int, int]) -> list[F32]:
    """The channels of [1, C, h, w], [1, h, w, C], [C, h, w], [h, w, C] or [h, w]; none where h, w differ."""
    if values.dtype.kind not in "fiu":
        return []
    if values.ndim == 4 and values.shape[0] == 1:
        values = values[0]
    if values.shape == shape:
        values = values[None]
    if values.ndim == 3 and values.shape[:2] == shape:
        values = values.transpose(2, 0, 1)
    if values.ndim != 3 or values.shape[1:] != shape or len(values) > MOST_CHANNELS:
        return []
    return [plane.astype(np.float32) for plane in values]


def unfit(plane: F32, fit: Fit) -> F32:
    """A map of the padded picture as one of the picture [h, w] alone, at `fit.inner`."""
    if plane.shape[::-1] != fit.outer:
        plane = cv2.resize(plane, fit.outer, interpolation=cv2.INTER_LINEAR)
    return plane[: fit.inner[1], : fit.inner[0]]
