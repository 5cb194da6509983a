"""How clearly the eyes see: contrast and fine detail, compared with the usual and with the other eye."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np

from sags_node.types import F32, Finding, GrayPyramid
from sags_node.vision.pyramid import inner
from sags_node.vision.watch.standing import watched_ns

WIDTH = 160  # px, at most, of the image in which contrast is measured, with its border
LOCAL = 15  # px of it: shading wider than that is no structure

# Octaves. Contrast and detail of a heart's two images differ by half an octave and one, on other tissue by
# 0.1, and change by 0.2 while it moves. A fogged lens takes one and a half, and all of the detail.
USUAL_DIFFERENCE = 0.6  # by which eyes may differ permanently
LOST_CONTRAST = 0.8  # of one eye against the other, beyond their usual difference
LOST_DETAIL = 1.5  # of one eye against the other, and of both against their usual detail
VEILED = 0.5  # of both eyes' contrast, against their usual one
FINEST = 0.005  # least ratio of detail, not in octaves: below is rounding
REMEMBERED_S = 3.0  # s over which what is usual follows
LASTING_S = 10.0  # s: what has been unclear for so long is how the scene looks now

LENS = "clean the lens, and check focus and cable"
SMOKE = Finding(
    "picture_smoke", "smoke or a fogged lens veils the image, and it is not learnt: clear the view"
)


class Unclear(NamedTuple):
    """What is unclear in one frame."""

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
        """Take one frame: its image, or the left and the right one, and the `structure` of each."""
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
    """Return a small image [h, w] without its shading."""
    small = _small_level(pyramid)
    return np.ascontiguousarray(inner(small - cv2.blur(small, (LOCAL, LOCAL))))


def mean_difference(a: F32, b: F32) -> float:
    """Return the mean absolute difference of two small images."""
    return cv2.norm(a, b, cv2.NORM_L1) / a.size


def _small_level(pyramid: GrayPyramid) -> F32:
    """The first half that is small enough, with its border."""
    return next((half for half in pyramid.halves if half.shape[1] <= WIDTH), pyramid.halves[-1])


def _usual(octaves: float) -> float:
    return min(max(octaves, -USUAL_DIFFERENCE), USUAL_DIFFERENCE)


def _contrast(pyramid: GrayPyramid, structure: F32) -> float:
    """Octaves of local contrast over brightness."""
    energy = float(np.vdot(structure, structure)) / structure.size
    brightness = cv2.mean(inner(_small_level(pyramid)))[0]
    return 0.5 * math.log2((energy + 1e-3) / (brightness**2 + 1e-3))


def _detail(pyramid: GrayPyramid) -> float:
    """Fine detail, in octaves: the steps between pixels of the first half over those of the next smaller one,
    less 0.5, which is their ratio if there is no finer detail."""
    fine = inner(pyramid.halves[0])[::4]
    coarse = inner(pyramid.halves[min(1, len(pyramid.halves) - 1)])[::2]
    steps = [mean_difference(rows[:, 1:], rows[:, :-1]) for rows in (fine, coarse)]
    return math.log2(max(steps[0] / (steps[1] + 1e-3) - 0.5, FINEST))
