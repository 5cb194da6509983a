"""Kernels for input images: conversion of 16 to 8 bits by levels, and detection of green-painted tools."""

from functools import lru_cache

import cv2
import numpy as np

from sags_node.kernels.jit import kernel
from sags_node.types import U8, Bool, Samples

# The paint is blended at 30 %. Painted pixels gain about 70 counts of green against the mean of blue and red;
# dimming takes the same share from every channel. Half of the gain is the threshold.
PAINTED_ABOVE = 73  # counts of twice the gain (2 green - blue - red)
OPEN = np.ones((3, 3), np.uint8)  # removes codec specks
CLOSE = np.ones((5, 5), np.uint8)  # fills dots inside instruments


def spread(picture: Samples, levels: tuple[float, float]) -> U8:
    """Map black and white to 0 and 255, rounded: a new image [H, W, 3] of one [H, W, 3] of any strides.

    Args:
        levels: black and white, in units of the brightest value of the image's type.
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
    """Look up each sample in one pass. OpenCV has no table for 16 bit, and takes three times as long."""
    for y in range(picture.shape[0]):
        for x in range(picture.shape[1]):
            for channel in range(3):
                found[y, x, channel] = table[picture[y, x, channel]]


def unpainted(pane: U8, left: U8) -> Bool:
    """Return the tissue mask [H, W]: True where `pane` shows `left` without green paint.

    Args:
        pane: [H, W, 3] RGB, the left image with semi-transparent green instruments.
        left: [H, W, 3] RGB, the same image without paint.
    """
    painted = np.empty(pane.shape[:2], np.uint8)
    _find_paint(pane, left, painted)
    painted = cv2.morphologyEx(painted, cv2.MORPH_OPEN, OPEN)
    painted = cv2.morphologyEx(painted, cv2.MORPH_CLOSE, CLOSE)
    tissue: Bool = painted == 0
    return tissue


@kernel
def _find_paint(pane: U8, left: U8, painted: U8) -> None:
    """Write 1 where green was gained, else 0. One pass: intermediate images cost four times the time."""
    for y in range(painted.shape[0]):
        for x in range(painted.shape[1]):
            red, green, blue = (
                np.int32(pane[y, x, 0]) - left[y, x, 0],
                np.int32(pane[y, x, 1]) - left[y, x, 1],
                np.int32(pane[y, x, 2]) - left[y, x, 2],
            )
            painted[y, x] = 2 * green - blue - red > PAINTED_ABOVE
