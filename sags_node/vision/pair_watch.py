"""Whether both eyes show what they should: what no stage notices by itself, because it fails quietly.

Looked for in small pictures of every frame, whatever else is left out of it. An eye is compared with the
other one and with what it showed a moment ago: a scene that gets smooth or stands still does so in both.
"""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import cv2
import numpy as np

from sags_node.types import F32, U8, Finding, RectifiedPair, StereoFrame
from sags_node.vision.clarity import LENS, SMOKE, Clarity, small_level
from sags_node.vision.pyramid import pyramids
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

HISTORY = 12  # frames among which an eye is looked at for standing still
MOVED = 1.0  # grey levels, mean: the other eye has moved for sure
UNMOVED = 1 / 8  # of what changes in the other eye; clear pairs change alike to 1/2, fog leaves 1/4

_TEXTS = {
    "black": "the {eye} picture is black: see to the light, the lens cap and the cable",
    "white": "the {eye} picture is white: lower the light or the exposure",
    "plain": "the {eye} picture is of one colour: see to the lens, the cable and the capture card",
    "fogged": f"the {{eye}} picture is fogged or out of focus beside the other: {LENS}",
    "frozen": "the {eye} picture stands still while the other moves: see to its cable and capture card",
}
_EQUAL = Finding("eyes_equal", "both eyes show the same picture, so there is no depth: connect the other eye")
_EXCHANGED = Finding(
    "eyes_exchanged",
    "left and right seem to be exchanged: swap source.left and source.right, or LR and RL",
)
_UNCLEAR = {
    "": [],
    "blurred": [Finding("picture_blurred", f"the picture is blurred, and is not learnt: {LENS}")],
    "veiled": [SMOKE],
}


class Verdict(NamedTuple):
    """What of one frame may be used."""

    left: str = ""  # why its left picture may not; empty: it may
    right: str = ""  # why there may be no stereo
    learn: bool = True  # else what it shows may be followed, and not learnt


class Small(NamedTuple):
    """One picture, shrunk."""

    rgb: F32  # [h, w, 3]
    gray: F32  # [h, w]


class PairWatch:
    """Looks at every pair of a source."""

    def __init__(self) -> None:
        self._standing = Standing()
        self._clarity = Clarity()
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
            if not code.startswith("picture"):
                right = right or text
        return Verdict(left, right, not any(code.startswith("picture") for code, _ in found))

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
            return _UNCLEAR[self._clarity(frame.t_capture_ns, left, None).all]
        if _are_equal(eyes["left"].gray, eyes["right"].gray):
            return [_EQUAL]
        if _are_exchanged(small_level(left), small_level(right)):
            return [_EXCHANGED]
        frozen = self._frozen(eyes["left"].gray, eyes["right"].gray)
        unclear = self._clarity(frame.t_capture_ns, left, right)
        if unclear.eye:
            return [_finding(unclear.eye, "fogged")]
        return [_finding(frozen, "frozen")] if frozen else _UNCLEAR[unclear.all]

    def _frozen(self, left: F32, right: F32) -> str:
        """Which eye shows what it showed before, while the other has moved since; empty: none."""
        pictures = left[::4, ::4].copy(), right[::4, ::4].copy()
        frozen = ""
        for before in reversed(self._history):
            changes = [float(np.abs(now - then).mean()) for now, then in zip(pictures, before, strict=True)]
            if max(changes) > MOVED:  # what is older tells of longer motion, not more clearly
                if min(changes) < UNMOVED * max(changes):
                    frozen = "left" if changes[0] < changes[1] else "right"
                break
        self._history.append(pictures)
        return frozen


def _finding(eye: str, kind: str) -> Finding:
    return Finding(f"{eye}_eye_{kind}", _TEXTS[kind].format(eye=eye))


def _small(image: U8) -> Small:
    height = max(1, round(image.shape[0] * WIDTH / image.shape[1]))
    if image.shape[1] > 4 * WIDTH:  # 16 pixels for each small one do: all of them take three times as long
        image = cv2.resize(image, (2 * WIDTH, 2 * height), interpolation=cv2.INTER_LINEAR)
    rgb = cv2.resize(image, (WIDTH, height), interpolation=cv2.INTER_AREA)
    return Small(rgb.astype(np.float32), cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY).astype(np.float32))


def _emptiness(rgb: F32) -> str:
    """Black, white or plain, of one colour, in the middle, where every scope shows something; else empty."""
    height, width = rgb.shape[:2]
    middle = rgb[height // 4 : height - height // 4, width // 4 : width - width // 4].reshape(-1, 3)
    outliers = round(OUTLIERS * len(middle))
    ordered = np.partition(middle, (outliers, -1 - outliers), axis=0)
    dark, bright = ordered[outliers], ordered[-1 - outliers]
    if bright.max() < BLACK:
        return "black"
    if dark.min() > WHITE:
        return "white"
    return "plain" if (bright - dark).max() < ONE_COLOR else ""


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
