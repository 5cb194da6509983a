"""How well a small image agrees with the model as it was drawn: in exposure, colours and structure."""

from typing import Any

import cv2
import numpy as np

from sags_node.kernels.jit import kernel
from sags_node.types import F32, I64, Bool

FEWEST = 50  # small px of the model in the image, to judge it by
DARK, BRIGHT = 0.03, 0.95  # beyond, a channel shows only noise or saturation
MISFIT = 0.1  # of the range of colours, mean over the channels: above it a pixel does not agree
COVERED = 0.15  # of the px misfit: something covers them, or it is another scene; a beating heart stays below
LEAST_MATCH = 0.3  # correlation of the structure
SOME = 3  # every so many px tell the exposure
FINE, LOCAL = 3, 15  # small px: structure is coarser than noise and finer than shading
GREEN = 1  # the channel with most of the structure, and seldom saturated


class Fit:
    """How well small images [h, w, 3] agree where something is known [h, w].

    Attributes:
        usable: share of the channels that can be compared.
        gain: [3] of the exposure.
        wrong: [h, w] where they do not agree.
        misfit: share of the known pixels that do not agree.
        contrast: that of the seen image over that of the model, after the gain.
        match: correlation of their structure.
    """

    def __init__(self, seen: F32, drawn: F32, known: Bool) -> None:
        fair = np.empty(seen.shape, np.bool_)
        ratios = np.empty((3, -(-known.size // SOME)), np.float32)
        counts = np.zeros(3, np.int64)
        channels = _compare(seen, drawn, known, fair, ratios, counts)
        self.usable = float(counts.sum()) / max(1, channels)
        self.gain = _gain(ratios, counts)
        self.wrong, self.misfit = _misfit(seen, drawn, known, fair, self.gain)
        if self.misfit > COVERED:  # most may be covered, and the exposure what it was
            unchanged = np.ones(3, np.float32)
            wrong, misfit = _misfit(seen, drawn, known, fair, unchanged)
            if misfit < self.misfit:
                self.gain, self.wrong, self.misfit = unchanged, wrong, misfit
        picture, model = np.empty((2, *known.shape), np.float32)
        _take_green(seen, drawn, fair, self.gain[GREEN], picture, model)
        energy_a, energy_b, product = _energies(structure(picture), structure(model), fair)
        self.contrast = float(np.sqrt(energy_a / max(energy_b, 1e-9)))
        self.match = product / max(float(np.sqrt(energy_a * energy_b)), 1e-9)


def structure(gray: F32) -> F32:
    """Return the structure of a small image [h, w]: neither noise nor shading."""
    found: F32 = cv2.blur(gray, (FINE, FINE)) - cv2.blur(gray, (LOCAL, LOCAL))
    return found


def _misfit(seen: F32, drawn: F32, known: Bool, fair: Bool, gain: F32) -> tuple[Bool, float]:
    """Find where images do not agree [h, w], and the share of the known pixels where they do not."""
    difference, wrong = np.empty(seen.shape, np.float32), np.empty(known.shape, np.bool_)
    _subtract(seen, drawn, fair, np.reciprocal(gain), difference)
    count, misfit = _judge(cv2.blur(difference, (FINE, FINE)), known, fair, wrong)
    return wrong, misfit / max(1, count)


@kernel
def _compare(seen: F32, drawn: F32, known: Bool, fair: Bool, ratios: F32, counts: I64) -> Any:
    """Find where both can be compared (`fair`), in how many pixels of each channel (`counts`), and every
    `SOME`-th of the ratios there. Returns how many of the model's values could be compared."""
    dark, bright = np.float32(DARK), np.float32(BRIGHT)
    channels = 0
    for y in range(known.shape[0]):
        for x in range(known.shape[1]):
            for k in range(3):
                a, b = seen[y, x, k], drawn[y, x, k]
                could = known[y, x] and b > dark and b < bright
                can = could and a > dark and a < bright
                fair[y, x, k] = can
                channels += could
                if can:
                    if counts[k] % SOME == 0:
                        ratios[k, counts[k] // SOME] = a / b
                    counts[k] += 1
    return channels


def _gain(ratios: F32, counts: I64) -> F32:
    """The exposure's gain [3]: the median of each channel's ratios; if they are too few, the others' mean."""
    some = [-(-count // SOME) for count in counts.tolist()]
    known = {k: middle_of(ratios[k, : some[k]]) for k in range(3) if some[k] >= FEWEST}
    mean = sum(known.values()) / len(known) if known else 1.0
    return np.array([known.get(k, mean) for k in range(3)], np.float32)


def middle_of(values: F32) -> float:
    """Return the upper median of values; 0 if there are none. `np.median` takes eight times as long."""
    half = values.size // 2
    return float(np.partition(values, half)[half]) if values.size else 0.0


@kernel
def _subtract(seen: F32, drawn: F32, fair: Bool, factors: F32, difference: F32) -> None:
    zero = np.float32(0)
    for y in range(fair.shape[0]):
        for x in range(fair.shape[1]):
            for k in range(3):
                value = seen[y, x, k] * factors[k] - drawn[y, x, k]
                difference[y, x, k] = value if fair[y, x, k] else zero


@kernel
def _judge(difference: F32, known: Bool, fair: Bool, wrong: Bool) -> Any:
    """Find where the residual, the mean over the channels that can be compared, is too large. Returns how
    many pixels are known, and how many of them are wrong."""
    count, misfit = 0, 0
    for y in range(known.shape[0]):
        for x in range(known.shape[1]):
            residual, channels = np.float32(0), np.float32(0)
            for k in range(3):
                residual += abs(difference[y, x, k])
                channels += np.float32(fair[y, x, k])
            residual /= max(channels, np.float32(1))
            wrong[y, x] = known[y, x] and residual > np.float32(MISFIT)
            if known[y, x]:
                count += 1
                misfit += wrong[y, x]
    return count, misfit


@kernel
def _take_green(seen: F32, drawn: F32, fair: Bool, gain: Any, picture: F32, model: F32) -> None:
    """The green of both, without the gain. Where they cannot be compared both are the model: no edges."""
    for y in range(model.shape[0]):
        for x in range(model.shape[1]):
            model[y, x] = drawn[y, x, GREEN]
            picture[y, x] = seen[y, x, GREEN] / gain if fair[y, x, GREEN] else model[y, x]


@kernel
def _energies(a: F32, b: F32, fair: Bool) -> Any:
    """Sums of a a, b b and a b over what can be compared."""
    aa, bb, ab = 0.0, 0.0, 0.0
    for y in range(a.shape[0]):
        for x in range(a.shape[1]):
            if fair[y, x, GREEN]:
                aa += a[y, x] * a[y, x]
                bb += b[y, x] * b[y, x]
                ab += a[y, x] * b[y, x]
    return aa, bb, ab
