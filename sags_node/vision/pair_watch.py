"""Whether both eyes show what they should: what no stage notices by itself, because it fails quietly.

Looked for in small pictures of every frame, whatever else is left out of it. An eye is compared with the other
one and with what it showed a moment ago: a scene that gets smooth or stands still does so in both.
"""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import cv2
import numpy as np

from sags_node.types import F32, U8, Finding, GrayPyramid, RectifiedPair, StereoFrame
from sags_node.vision.pyramid import inner, pyramids
from sags_node.vision.standing import Standing

WIDTH = 80  # px of the small pictures
BLACK = 20.0  # grey levels; video that keeps its black at 16 too
WHITE = 235.0  # and its white at 235
ONE_COLOR = 6.0  # grey levels between the darkest and the brightest of a picture of one colour
OUTLIERS = 0.01  # of the pixels at either end: a caption, dead pixels
EQUAL = 0.5  # of what a shift by one small pixel makes; true pairs 1 to 5
LOCAL = 15  # small px: shading wider than that is no structure
LEAST_MATCH = 0.35  # correlation; nothing matches below
CLEARLY_BETTER = 0.2  # of a match the wrong way round, against the best the right way round

# Contrast and sharpness of the eyes differ by less than half an octave on a heart, by 0.1 on other tissue. A
# fogged lens takes away one and a half or more.
USUAL_DIFFERENCE = 0.6  # octaves: what eyes may differ by for good
LOST_CONTRAST = 0.8  # octaves beside what they usually differ by
LOST_SHARPNESS = 1.5  # octaves of what is finer than a blur, of one eye beside the other
BLURRED = 1.5  # octaves, of both eyes beside what they usually have: a quarter of the fine detail is left
FINEST = 0.005  # of the detail: below is rounding
REMEMBERED_S = 3.0  # s over which what is usual follows

HISTORY = 12  # frames among which an eye is looked at for standing still
MOVED = 1.0  # grey levels, mean: the other eye has moved for sure
UNMOVED = 1 / 8  # of what changes in the other eye; clear pairs change alike to 1/2, fog leaves 1/4

_LENS = "clean the lens, and see to focus and cable"
_TEXTS = {
    "black": "the {eye} picture is black: see to the light, the lens cap and the cable",
    "white": "the {eye} picture is white: lower the light or the exposure",
    "plain": "the {eye} picture is of one colour: see to the lens, the cable and the capture card",
    "fogged": f"the {{eye}} picture is fogged or out of focus beside the other: {_LENS}",
    "frozen": "the {eye} picture stands still while the other moves: see to its cable and capture card",
}
_EQUAL = Finding("eyes_equal", "both eyes show the same picture, so there is no depth: connect the other eye")
_EXCHANGED = Finding(
    "eyes_exchanged",
    "left and right seem to be exchanged: swap source.left and source.right, or LR and RL",
)
_BLURRED = Finding("picture_blurred", f"the picture is blurred, and is not learnt: {_LENS}")


class Verdict(NamedTuple):
    """What of one frame may be used."""

    left: str = ""  # why its left picture may not; empty: it may
    right: str = ""  # why there may be no stereo
    blurred: bool = False  # what it shows may be followed, and not learnt


class Small(NamedTuple):
    """One picture, shrunk."""

    rgb: F32  # [h, w, 3]
    gray: F32  # [h, w]


class PairWatch:
    """Looks at every pair of a source."""

    def __init__(self) -> None:
        self._standing = Standing()
        self._usual = _Usual()
        self._history: deque[tuple[F32, F32]] = deque(maxlen=HISTORY)

    @property
    def findings(self) -> tuple[Finding, ...]:
        """What is wrong with the eyes, and how to mend it. May be read from any thread."""
        return self._standing.findings

    def __call__(self, frame: StereoFrame, pair: RectifiedPair) -> Verdict:
        """Take one frame, raw and rectified."""
        found = self._look(frame, pair)
        self._standing.update(frame.t_capture_ns, found)
        left = right = ""
        for code, text in found:
            if code.startswith("left") or code == _EXCHANGED.code:
                left = left or text
            if code != _BLURRED.code:
                right = right or text
        return Verdict(left, right, _BLURRED in found)

    def _look(self, frame: StereoFrame, pair: RectifiedPair) -> list[Finding]:
        """What is wrong in one frame."""
        eyes = {"left": _small(frame.left)}
        if frame.right is not None:
            eyes["right"] = _small(frame.right)
        empty = [_finding(name, kind) for name, eye in eyes.items() if (kind := _emptiness(eye.rgb))]
        if empty:
            self._history.clear()
            return empty
        left, right = pyramids(pair)
        if frame.right is None or right is None:
            return [_BLURRED] if self._usual.judge(frame.t_capture_ns, left, None)[1] else []
        if _are_equal(eyes["left"].gray, eyes["right"].gray):
            return [_EQUAL]
        if _are_exchanged(_small_level(left), _small_level(right)):
            return [_EXCHANGED]
        frozen = self._frozen(eyes["left"].gray, eyes["right"].gray)
        fogged, blurred = self._usual.judge(frame.t_capture_ns, left, right)
        if fogged:
            return [_finding(fogged, "fogged")]
        if frozen:
            return [_finding(frozen, "frozen")]
        return [_BLURRED] if blurred else []

    def _frozen(self, left: F32, right: F32) -> str:
        """Which eye shows what it showed before, while the other has moved since; empty: none."""
        pictures = left[::2, ::2], right[::2, ::2]
        frozen = ""
        for before in reversed(self._history):
            changes = [float(np.abs(now - then).mean()) for now, then in zip(pictures, before, strict=True)]
            if max(changes) > MOVED:  # what is older tells of longer motion, not more clearly
                if min(changes) < UNMOVED * max(changes):
                    frozen = "left" if changes[0] < changes[1] else "right"
                break
        self._history.append(pictures)
        return frozen


class _Usual:
    """What contrast and sharpness of the eyes usually are, and what falls behind that."""

    def __init__(self) -> None:
        self._stamp_ns: int | None = None
        self._contrast = 0.0  # octaves, of the right eye over the left
        self._sharpness: float | None = None  # the same of the fine detail
        self._detail: float | None = None  # octaves, of the sharper eye

    def judge(self, stamp_ns: int, left: GrayPyramid, right: GrayPyramid | None) -> tuple[str, bool]:
        """Which eye is fogged (left, right or empty), and whether all that there are is blurred."""
        passed = 0.0 if self._stamp_ns is None else max(0.0, (stamp_ns - self._stamp_ns) * 1e-9)
        self._stamp_ns = stamp_ns
        share = min(1.0, passed / REMEMBERED_S)
        details = [_detail(eye) for eye in (left, right) if eye is not None]
        detail = max(details)
        blurred = self._detail is not None and detail < self._detail - BLURRED
        if self._detail is None:
            self._detail = detail
        if right is None:
            self._detail += 0.0 if blurred else share * (detail - self._detail)
            return "", blurred
        contrast = _contrast(right) - _contrast(left)
        sharpness = details[1] - details[0]
        if self._sharpness is None:
            self._sharpness = float(np.clip(sharpness, -USUAL_DIFFERENCE, USUAL_DIFFERENCE))
        beyond = contrast - self._contrast, sharpness - self._sharpness
        if abs(beyond[0]) > LOST_CONTRAST:
            return ("right" if beyond[0] < 0 else "left"), False
        if abs(beyond[1]) > LOST_SHARPNESS and not blurred:
            return ("right" if beyond[1] < 0 else "left"), False
        if not blurred:
            self._detail += share * (detail - self._detail)
            self._sharpness += share * beyond[1]
            contrast = self._contrast + share * beyond[0]
            self._contrast = float(np.clip(contrast, -USUAL_DIFFERENCE, USUAL_DIFFERENCE))
        return "", blurred


def _finding(eye: str, kind: str) -> Finding:
    return Finding(f"{eye}_eye_{kind}", _TEXTS[kind].format(eye=eye))


def _small(image: U8) -> Small:
    height = max(1, round(image.shape[0] * WIDTH / image.shape[1]))
    if image.shape[1] > 4 * WIDTH:  # 16 pixels for each small one do: all of them take three times as long
        image = cv2.resize(image, (2 * WIDTH, 2 * height), interpolation=cv2.INTER_LINEAR)
    rgb = cv2.resize(image, (WIDTH, height), interpolation=cv2.INTER_AREA)
    return Small(rgb.astype(np.float32), cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY).astype(np.float32))


def _small_level(pyramid: GrayPyramid) -> F32:
    """The first half that is about as wide as the small pictures."""
    return next(
        (inner(half) for half in pyramid.halves if half.shape[1] <= 2 * WIDTH), inner(pyramid.halves[-1])
    )


def _contrast(pyramid: GrayPyramid) -> float:
    """Octaves of local contrast over brightness."""
    gray = _small_level(pyramid)
    structure = float(np.square(gray - cv2.blur(gray, (LOCAL, LOCAL))).mean())
    return 0.5 * float(np.log2((structure + 1e-3) / (float(gray.mean()) ** 2 + 1e-3)))


def _detail(pyramid: GrayPyramid) -> float:
    """Octaves of what is finer than a blur: steps between the pixels of the first half over those of a picture
    of half its size, which are half of them when there is nothing finer."""
    fine = inner(pyramid.halves[0])[::4]
    coarse = inner(pyramid.halves[min(1, len(pyramid.halves) - 1)])[::2]
    steps = [float(np.abs(rows[:, 1:] - rows[:, :-1]).mean()) for rows in (fine, coarse)]
    return float(np.log2(max(steps[0] / (steps[1] + 1e-3) - 0.5, FINEST)))


def _emptiness(rgb: F32) -> str:
    """Black, white or of one colour in the middle, where every scope shows something; empty: none of them."""
    height, width = rgb.shape[:2]
    middle = rgb[height // 4 : height - height // 4, width // 4 : width - width // 4].reshape(-1, 3)
    outliers = round(OUTLIERS * len(middle))
    ordered = np.partition(middle, (outliers, -1 - outliers), axis=0)
    dark, bright = ordered[outliers], ordered[-1 - outliers]
    if bright.max() < BLACK:
        return "black"
    if dark.min() > WHITE:
        return "white"
    return "of one colour" if (bright - dark).max() < ONE_COLOR else ""


def _are_equal(left: F32, right: F32) -> bool:
    """Two captures of one picture differ by noise and brightness, far less than by a small shift."""
    right = right * (left.mean() / right.mean())
    shifted = np.abs(left[:, 1:] - left[:, :-1]).mean()
    return bool(np.abs(left - right).mean() < EQUAL * shifted)


def _are_exchanged(left: F32, right: F32) -> bool:
    """In a rectified pair everything lies farther left in the right picture. In an exchanged one it lies
    farther right, unless the eyes converge so much that the calibration shifts it back."""
    match = _row_correlation(left, right)
    reach = len(match) // 2
    wrong, true = match[:reach].max(), match[reach + 1 :].max()
    return bool(wrong > LEAST_MATCH and wrong > true + CLEARLY_BETTER)


def _row_correlation(left: F32, right: F32) -> F32:
    """Correlation of the rows for disparities from minus to plus half of the width, [2 * (w // 2) + 1]."""
    a, b = (eye - cv2.blur(eye, (LOCAL, LOCAL)) for eye in (left, right))
    width = left.shape[1]
    spectrum = np.fft.rfft(a, 2 * width) * np.conj(np.fft.rfft(b, 2 * width))
    products = np.fft.irfft(spectrum.sum(0), 2 * width)
    disparities = np.arange(-(width // 2), width // 2 + 1)
    # Energy of the columns that overlap: of the left picture from d on, of the right one up to w - d.
    energy_a, energy_b = (np.concatenate([[0.0], np.cumsum(np.square(eye).sum(0))]) for eye in (a, b))
    starts, ends = np.maximum(disparities, 0), np.minimum(width + disparities, width)
    within_a = energy_a[ends] - energy_a[starts]
    within_b = energy_b[ends - disparities] - energy_b[starts - disparities]
    correlation: F32 = products[disparities] / np.sqrt(np.maximum(within_a * within_b, 1.0))
    return correlation
