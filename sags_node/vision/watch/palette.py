"""The colours that the tissue usually has, whatever the exposure. Blood shows as a colour of which there is
suddenly far more.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from sags_node.types import F32, U8, Bool
from sags_node.vision.watch.picture_fit import BRIGHT, DARK, FINE
from sags_node.vision.watch.standing import watched_ns

BINS = 32  # of the share of red in a colour, and of green
RARE = 0.002  # of the tissue: least share that counts as usual for any colour
NOVEL = 4.0  # times the usual share: a colour with more than that is new
REMEMBERED_S = 3.0  # s over which the usual colours follow


class Colors:
    """The channels of an image [h, w, 3], and which of its pixels tell a colour.

    Attributes:
        light: [h, w] their sum.
        fair: [h, w] it is not too dark, and no channel is clipped.
    """

    def __init__(self, picture: U8, dark: float) -> None:
        """`dark`: of full light; a pixel is too dark if the mean of its channels is below."""
        self.red, self.green, self.blue = (each.astype(np.uint16) for each in cv2.split(picture))
        self.light = self.red + self.green + self.blue
        brightest = np.maximum(np.maximum(self.red, self.green), self.blue)
        self.fair: Bool = (self.light > 3 * 255 * dark) & (brightest < 255 * BRIGHT)

    def bins(self) -> NDArray[np.uint16]:
        """Return each pixel's bin [h, w], of `BINS` times `BINS`: by share of red, then of green."""
        one = self.light + 1
        return np.asarray(BINS * (BINS * self.red // one) + BINS * self.green // one)


class Palette:
    """Shares of the tissue's colours, followed from frame to frame."""

    def __init__(self) -> None:
        self._usual: F32 | None = None  # [BINS, BINS] share of the tissue, by share of red and of green
        self._share = 1.0
        self._bins = np.zeros((1, 1), np.uint16)  # [h, w]
        self._counted = self._is_new = np.zeros((1, 1), np.bool_)
        self._stamp_ns = 0

    def new(self, picture: U8, tissue: Bool, now: int) -> Bool:
        """Find where [h, w] a small image [h, w, 3] has colours that the tissue has far more of than
        usual."""
        colors = Colors(cv2.blur(picture, (FINE, FINE)), DARK)
        self._bins, self._counted = colors.bins(), tissue & colors.fair
        self._is_new = np.zeros(tissue.shape, np.bool_)
        passed, self._stamp_ns = watched_ns(self._stamp_ns, now) * 1e-9, now
        if self._usual is None:
            self._share = 1.0
            return self._is_new
        self._share = min(1.0, passed / REMEMBERED_S)
        usual, found = (
            cv2.boxFilter(shares, -1, (FINE, FINE), normalize=False)
            for shares in (self._usual, self._shares(self._counted))
        )
        is_new = found > np.float32(NOVEL) * np.maximum(usual, np.float32(RARE))
        self._is_new = colors.fair & is_new.ravel()[self._bins]
        return self._is_new

    def take(self, except_new: bool) -> None:
        """Learn the colours of the image that `new` took last; `except_new`: but for its new colours."""
        found = self._shares(self._counted & ~self._is_new if except_new else self._counted)
        if found.any():
            before = found if self._usual is None else self._usual
            self._usual = before + np.float32(self._share) * (found - before)

    def _shares(self, counted: Bool) -> F32:
        """The share [BINS, BINS] of each colour in what is `counted` [h, w]."""
        counts = np.bincount(self._bins[counted], minlength=BINS**2).reshape(BINS, BINS)
        return counts.astype(np.float32) / np.float32(max(1, counts.sum()))
