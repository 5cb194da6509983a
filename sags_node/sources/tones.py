"""Eight bits of pictures that have more, or whose tones fill a part of the range."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from sags_node.kernels.jit import kernel
from sags_node.types import U8, Samples


def spread(picture: Samples, levels: tuple[float, float]) -> U8:
    """A new picture [H, W, 3] of one [H, W, 3] of any strides, with black to white as 0 to 255, rounded.

    Args:
        levels: black and white, in units of the brightest value of the picture's type.
    """
    found = np.empty(picture.shape, np.uint8)
    _look_up(picture, _table(levels, picture.dtype), found)
    return found


@lru_cache(maxsize=4)
def _table(levels: tuple[float, float], dtype: np.dtype[np.uint8] | np.dtype[np.uint16]) -> U8:
    black, white = levels
    brightest = np.iinfo(dtype).max
    counts = np.arange(brightest + 1) / brightest
    return np.clip(255 * (counts - black) / (white - black) + 0.5, 0, 255).astype(np.uint8)


@kernel
def _look_up(picture: Samples, table: U8, found: U8) -> None:
    """In one pass: OpenCV has no table for 16 bit, and its passes take three times as long."""
    for y in range(picture.shape[0]):
        for x in range(picture.shape[1]):
            for channel in range(3):
                found[y, x, channel] = table[picture[y, x, channel]]
