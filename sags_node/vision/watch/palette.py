"""The colours that the tissue usually has, whatever the exposure. Blood is a colour that there is suddenly
far more of.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np

from sags_node.kernels.jit import kernel
from sags_node.types import F32, I64, U8, Bool
from sags_node.vision.watch.picture_fit import BRIGHT, DARK, FINE
from sags_node.vision.watch.standing import watched_ns

BINS = 32  # of the share of red in a colour, and of green
RARE = 0.002  # of the tissue has a colour like this, or less
NOVEL = 4.0  # times as much of it as usual, or as is rare: the colour is new
REMEMBERED_S = 3.0  # s over which the usual colours follow


class Palette:
    """Shares of the tissue's colours, followed from frame to frame."""

    def __init__(self) -> None:
        self._usual: F32 | None = None  # [BINS, BINS] share of the tissue, by share of red and of green
        self._share = 1.0
        self._colors: I64 = np.zeros((1, 1), np.int64)  # [h, w] bin of each pixel, -1: too dark or too bright
        self._counted = self._is_new = np.zeros((1, 1), np.bool_)
        self._stamp_ns = 0

    def new(self, picture: U8, tissue: Bool, now: int) -> Bool:
        """Find where [h, w] a small picture [h, w, 3] has colours that the tissue has far more of than
        usual."""
        self._colors, self._is_new = np.empty(tissue.shape, np.int64), np.zeros(tissue.shape, np.bool_)
        self._counted = tissue
        _sort_colors(cv2.blur(picture, (FINE, FINE)), self._colors)
        passed, self._stamp_ns = watched_ns(self._stamp_ns, now) * 1e-9, now
        if self._usual is None:
            self._share = 1.0
            return self._is_new
        self._share = min(1.0, passed / REMEMBERED_S)
        usual, found = (
            cv2.boxFilter(shares, -1, (FINE, FINE), normalize=False)
            for shares in (self._usual, self._shares(tissue))
        )
        is_new = found > np.float32(NOVEL) * np.maximum(usual, np.float32(RARE))
        _look_up(self._colors, is_new, self._is_new)
        return self._is_new

    def take(self, except_new: bool) -> None:
        """Learn the colours of that picture."""
        found = self._shares(self._counted & ~self._is_new if except_new else self._counted)
        if found.any():
            before = found if self._usual is None else self._usual
            self._usual = before + np.float32(self._share) * (found - before)

    def _shares(self, counted: Bool) -> F32:
        """How much [BINS, BINS] of what is counted [h, w] has each colour."""
        found = np.zeros((BINS, BINS), np.float32)
        count = _count_colors(self._colors, counted, found)
        return found / np.float32(max(1, count))


@kernel
def _sort_colors(picture: U8, colors: I64) -> None:
    """The bin of each pixel's colour, or -1 where it is too dark or too bright to tell."""
    for y in range(colors.shape[0]):
        for x in range(colors.shape[1]):
            red, green, blue = (
                np.int64(picture[y, x, 0]),
                np.int64(picture[y, x, 1]),
                np.int64(picture[y, x, 2]),
            )
            light = red + green + blue
            fair = light > 3 * 255 * DARK and max(red, green, blue) < 255 * BRIGHT
            row, column = BINS * red // (light + 1), BINS * green // (light + 1)
            colors[y, x] = BINS * row + column if fair else -1


@kernel
def _look_up(colors: I64, of_bins: Bool, of_pixels: Bool) -> None:
    """Return what is said of each pixel's colour; nothing of those without."""
    for y in range(colors.shape[0]):
        for x in range(colors.shape[1]):
            color = colors[y, x]
            of_pixels[y, x] = color >= 0 and of_bins[color // BINS, color % BINS]


@kernel
def _count_colors(colors: I64, counted: Bool, found: F32) -> Any:
    """How often there is each colour. Returns how often any."""
    count = 0
    for y in range(colors.shape[0]):
        for x in range(colors.shape[1]):
            if counted[y, x] and colors[y, x] >= 0:
                found[colors[y, x] // BINS, colors[y, x] % BINS] += 1
                count += 1
    return count
