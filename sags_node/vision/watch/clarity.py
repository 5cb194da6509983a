"""How clear the eyes see: contrast and fine detail, beside what they usually have and beside each other."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import cv2
import numpy as np

from sags_node.kernels.jit import kernel
from sags_node.types import F32, Finding, GrayPyramid
from sags_node.vision.pyramid import BORDER, inner
from sags_node.vision.watch.standing import watched_ns

WIDTH = 160  # px, at most, of the picture in which contrast is measured, with its border
LOCAL = 15  # px of it: shading wider than that is no structure

# Octaves. Contrast and detail of a heart's two pictures differ by half an octave and one, on other tissue by
# 0.1, and change by 0.2 while it moves. A fogged lens takes one and a half, and all of the detail.
USUAL_DIFFERENCE = 0.6  # what eyes may differ by for good
LOST_CONTRAST = 0.8  # beside what they usually differ by
LOST_DETAIL = 1.5  # of one eye beside the other, and of both beside what they usually have
VEILED = 0.5  # of the contrast of both eyes, beside what they usually have
FINEST = 0.005  # of the detail: below is rounding
REMEMBERED_S = 3.0  # s over which what is usual follows
LASTING_S = 10.0  # s: what has been unclear for so long is how the scene looks now

LENS = "clean the lens, and check focus and cable"
SMOKE = Finding(
    "picture_smoke", "smoke or a fogged lens veils the picture, and it is not learnt: clear the view"
)


class Unclear(NamedTuple):
    """What one frame lacks."""

    eye: str = ""  # the one that is fogged: left or right
    all: str = ""  # what all eyes are: blurred or veiled


class Clarity:
    """Compares frames with what is usual. A scene that gets smooth does so in both eyes."""

    def __init__(self) -> None:
        self._stamp_ns: int | None = None
        self._unclear_s = 0.0  # for how long both eyes have been
        self._contrast = self._detail = 0.0  # octaves, of the better eye
        self._contrasts = self._details = 0.0  # octaves, of the right eye over the left

    def __call__(self, stamp_ns: int, eyes: Sequence[GrayPyramid], structures: Sequence[F32]) -> Unclear:
        """Take one frame: its picture, or the left and the right one, and the `structure` of each."""
        contrasts, details = list(map(_contrast, eyes, structures)), list(map(_detail, eyes))
        contrast, detail = max(contrasts), max(details)
        apart = contrasts[-1] - contrasts[0], details[-1] - details[0]
        if self._stamp_ns is None:
            self._contrast, self._detail = contrast, detail
            self._details = _usual(apart[1])
        passed = 1e-9 * watched_ns(self._stamp_ns, stamp_ns)
        self._stamp_ns = stamp_ns
        is_blurred = detail < self._detail - LOST_DETAIL
        for lost, limit in (
            (apart[0] - self._contrasts, LOST_CONTRAST),
            (apart[1] - self._details, np.inf if is_blurred else LOST_DETAIL),
        ):
            if abs(lost) > limit:
                return Unclear(eye="right" if lost < 0 else "left")
        is_veiled = contrast < self._contrast - VEILED
        self._unclear_s = self._unclear_s + passed if is_blurred or is_veiled else 0.0
        if 0 < self._unclear_s < LASTING_S:
            return Unclear(all="blurred" if is_blurred else "veiled")
        share = 1.0 if self._unclear_s else min(1.0, passed / REMEMBERED_S)
        self._contrast += share * (contrast - self._contrast)
        self._detail += share * (detail - self._detail)
        self._contrasts = _usual(self._contrasts + share * (apart[0] - self._contrasts))
        self._details += share * (apart[1] - self._details)
        return Unclear()


def structure(pyramid: GrayPyramid) -> F32:
    """Return what is no shading, in a small picture [h, w]."""
    small = small_level(pyramid)
    found = np.empty(inner(small).shape, np.float32)
    _leave_shading_out(small, found)
    return found


def mean_difference(a: F32, b: F32) -> float:
    """Mean of the absolute differences of two small pictures."""
    return cv2.norm(a, b, cv2.NORM_L1) / a.size


def small_level(pyramid: GrayPyramid) -> F32:
    """The first half that is small enough, with its border."""
    return next((half for half in pyramid.halves if half.shape[1] <= WIDTH), pyramid.halves[-1])


@kernel
def _leave_shading_out(bordered: F32, found: F32) -> None:
    """A picture less the mean of the window around each pixel."""
    height, width = found.shape
    radius, share = LOCAL // 2, np.float32(1 / LOCAL**2)
    first = BORDER - radius
    line = np.empty(width + 2 * radius, np.float32)  # sums over columns
    for y in range(height):
        line[:] = np.float32(0)
        for row in range(y + first, y + first + LOCAL):
            for i in range(line.size):
                x = np.uint64(i)
                line[x] += bordered[row, x + np.uint64(first)]
        for i in range(width):
            x, total = np.uint64(i), np.float32(0)
            for k in range(LOCAL):
                total += line[x + np.uint64(k)]
            found[y, x] = bordered[y + BORDER, x + np.uint64(BORDER)] - share * total


@kernel
def _sums(structure: F32, bordered: F32) -> Any:
    """The sums of the squares of the structure, and of the picture that it was found in."""
    squares, light = np.float32(0), np.float32(0)
    for y in range(structure.shape[0]):
        for i in range(structure.shape[1]):
            x = np.uint64(i)
            squares += structure[y, x] * structure[y, x]
            light += bordered[y + BORDER, x + np.uint64(BORDER)]
    return squares, light


def _usual(octaves: float) -> float:
    return min(max(octaves, -USUAL_DIFFERENCE), USUAL_DIFFERENCE)


def _contrast(pyramid: GrayPyramid, structure: F32) -> float:
    """Octaves of local contrast over brightness."""
    squares, light = _sums(structure, small_level(pyramid))
    energy, brightness = squares / structure.size, light / structure.size
    return 0.5 * math.log2((energy + 1e-3) / (brightness**2 + 1e-3))


def _detail(pyramid: GrayPyramid) -> float:
    """Octaves of what is finer than a blur: steps between the pixels of the first half over those of a
    picture of half its size, which are half of them when there is nothing finer."""
    fine = inner(pyramid.halves[0])[::4]
    coarse = inner(pyramid.halves[min(1, len(pyramid.halves) - 1)])[::2]
    steps = [mean_difference(rows[:, 1:], rows[:, :-1]) for rows in (fine, coarse)]
    return math.log2(max(steps[0] / (steps[1] + 1e-3) - 0.5, FINEST))
