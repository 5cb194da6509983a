"""Eight bits of pictures that have more, or whose tones fill a part of the range."""

from __future__ import annotations

import numpy as np

from sags_node.kernels.jit import kernel
from sags_node.types import U8, Samples


class Tones:
    """Makes black to white 0 to 255, rounded.

    Args:
        levels: black and white, in units of the brightest value of `dtype`.
        dtype: of the pictures, uint8 or uint16.
    """

    def __init__(self, levels: tuple[float, float], dtype: np.dtype[np.uint8] | np.dtype[np.uint16]) -> None:
        self.dtype = dtype
        black, white = levels
        brightest = np.iinfo(dtype).max
        counts = np.arange(brightest + 1) / brightest
        self._table = np.clip(255 * (counts - black) / (white - black) + 0.5, 0, 255).astype(np.uint8)

    def __call__(self, picture: Samples) -> U8:
        """A new picture [H, W, 3] of one [H, W, 3] of any strides."""
        found = np.empty(picture.shape, np.uint8)
        _look_up(picture, self._table, found)
        return found


@kernel
def _look_up(picture: Samples, table: U8, found: U8) -> None:
    """In one pass: OpenCV has no table for 16 bit, and its passes take three times as long."""
    for y in range(picture.shape[0]):
        for x in range(picture.shape[1]):
            for channel in range(3):
                found[y, x, channel] = table[picture[y, x, channel]]
