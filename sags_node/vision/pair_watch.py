"""Whether both eyes show what they should: what no stage notices by itself, because it fails quietly.

A picture without content, one eye fed to both inputs, and exchanged eyes. Looked for in small pictures, a few
times a second, whatever else is left out of a frame.
"""

from __future__ import annotations

from collections import Counter, deque
from typing import NamedTuple

import cv2
import numpy as np

from sags_node.types import F32, U8, Finding, RectifiedPair, StereoFrame

PERIOD_NS = 150_000_000  # between two looks
LOOKS, NEEDED = 5, 4  # so many of the last looks must find the same
WIDTH = 80  # px of the small pictures
BLACK = 20.0  # grey levels; video that keeps its black at 16 too
WHITE = 235.0  # and its white at 235
ONE_COLOR = 6.0  # grey levels between the darkest and the brightest of a picture of one colour
OUTLIERS = 0.01  # of the pixels at either end: a caption, dead pixels
EQUAL = 0.5  # of what a shift by one small pixel makes; true pairs 1 to 5
LOCAL = 15  # small px: shading wider than that is no structure
LEAST_MATCH = 0.35  # correlation; nothing matches below
CLEARLY_BETTER = 0.2  # of a match the wrong way round, against the best the right way round
_CODES = {"black": "black", "white": "white", "of one colour": "plain"}
_MENDS = {
    "black": "see to the light, the lens cap and the cable",
    "white": "lower the light or the exposure",
    "of one colour": "see to the lens, the cable and the capture card",
}


class Small(NamedTuple):
    """One picture, shrunk."""

    rgb: F32  # [h, w, 3]
    gray: F32  # [h, w]


class PairWatch:
    """Looks at the pairs of a source.

    Attributes:
        findings: what is wrong with the eyes, and how to mend it. May be read from any thread.
    """

    def __init__(self) -> None:
        self.findings: tuple[Finding, ...] = ()
        self._looked_ns: int | None = None
        self._found: deque[list[Finding]] = deque(maxlen=LOOKS)

    def __call__(self, frame: StereoFrame, pair: RectifiedPair) -> None:
        """Take one frame, raw and rectified; most of them are let pass unseen."""
        now = frame.t_capture_ns
        if self._looked_ns is not None and 0 <= now - self._looked_ns < PERIOD_NS:
            return
        self._looked_ns = now
        self._found.append(_look(frame, pair))
        often = Counter(finding for findings in self._found for finding in findings)
        self.findings = tuple(finding for finding, count in often.items() if count >= NEEDED)


def _look(frame: StereoFrame, pair: RectifiedPair) -> list[Finding]:
    """What is wrong in one frame."""
    eyes = {"left": _small(frame.left)}
    if frame.right is not None:
        eyes["right"] = _small(frame.right)
    empty = {name: kind for name, eye in eyes.items() if (kind := _emptiness(eye.rgb))}
    if empty:
        return [
            Finding(f"{name}_eye_{_CODES[kind]}", f"the {name} picture is {kind}: {_MENDS[kind]}")
            for name, kind in empty.items()
        ]
    if frame.right is None or pair.right is None:
        return []
    if _are_equal(eyes["left"].gray, eyes["right"].gray):
        said = "both eyes show the same picture, so there is no depth: connect the other eye"
        return [Finding("eyes_equal", said)]
    # A source that is rectified already hands its pictures through.
    left = eyes["left"] if pair.left is frame.left else _small(pair.left)
    right = eyes["right"] if pair.right is frame.right else _small(pair.right)
    if _are_exchanged(left.gray, right.gray):
        said = "left and right seem to be exchanged: swap source.left and source.right, or LR and RL"
        return [Finding("eyes_exchanged", said)]
    return []


def _small(image: U8) -> Small:
    height = max(1, round(image.shape[0] * WIDTH / image.shape[1]))
    if image.shape[1] > 4 * WIDTH:  # 16 pixels for each small one do: all of them take three times as long
        image = cv2.resize(image, (2 * WIDTH, 2 * height), interpolation=cv2.INTER_LINEAR)
    rgb = cv2.resize(image, (WIDTH, height), interpolation=cv2.INTER_AREA)
    return Small(rgb.astype(np.float32), cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY).astype(np.float32))


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
