"""Instruments without masks or networks: by colour, by misfit to the model, by where they enter."""

import cv2
import numpy as np

from sags_node.kernels.jit import kernel
from sags_node.resizing import resized_image
from sags_node.types import F32, U8, Bool, RenderedView

WIDTH = 320  # px that an image is shrunk to; all px below are of that
WINDOW = 3  # px: means against noise
DARK = 12  # grey level below which colour says nothing: the black border, shafts in shadow
DARK_RED = 0.3  # of R + G + B, by which red exceeds green: a cavity, no shaft
CLIPPED = 240  # grey level of the brightest channel above which any surface looks pale
CLIPPED_WINDOW = 20  # px around a highlight that say what it lies on
WHITE = 230  # grey level of the darkest channel above which nothing of a surface shows
WHITEOUT = 0.5  # of that window is white: no highlight, but a shaft in the light
COARSE = 4  # px of a coarse pixel, from which means over that window are taken

# How much each sign counts: from 1 on their sum means instrument. Rounded from a logistic regression on D4D,
# which did as well on the phantom as one made there. A coarse disparity brought nothing beside them.
PALENESS = 1.2  # of 1 - redness / the image's median redness
LEAST_PALENESS = -0.5
GOLD = 6.0  # of (min(R, G) - B) / (R + G + B)
LARGEST_GOLD = 0.2
SHADE = 0.5  # where the brightest channel is below SHADE_LEVEL
SHADE_LEVEL = 40  # grey level
CHROMATICITY = 12.0  # of how far R / (R + G + B) is below the model's
LARGEST_CHROMATICITY = 0.05
MEMORY = 0.2  # for having been instrument in the frame before
SURE = 1.15  # evidence that a region must have somewhere

OPENING = 3  # px: thinner is noise
CLOSING = 7  # px: gaps within an instrument
LONGEST_DOUBT = 1.0  # s
FORGIVEN = 3.0  # s of doubt, per second without
LONGEST_STEP = 0.2  # s: of a longer time between two frames only so much counts


class InstrumentFinder:
    """Finds instruments and black borders, frame by frame.

    Tissue is redder than metal and plastic under any white balance, so redness (R - G) / (R + G + B) is
    compared with the image's own median; gold is a yellow that fat does not reach. Where the model is
    drawn, what is less red than it is suspect too: what has just come, jaws that mirror tissue. Regions of
    enough evidence that come in from the image's edge are instruments; a pale patch inside is a highlight,
    fat or gauze.

    What is instrument only because it differs from the model, or was one before, is let go after
    `LONGEST_DOUBT`, for a third as long: tissue that moved too fast or has just come into view is learnt
    then.
    """

    def __init__(self) -> None:
        self._found: Bool | None = None  # [h, w] in the frame before; None: it was judged alone
        self._held: F32 = np.zeros((1, 1), np.float32)  # [h, w] s of being instrument on doubtful grounds
        self._trusted: Bool = np.ones((1, 1), np.bool_)  # [h, w] where such grounds count
        self._stamp_ns = 0

    def __call__(self, image: U8, expected: RenderedView | None = None, stamp_ns: int = 0) -> Bool:
        """Find the instruments [H, W] of an image [H, W, 3].

        Args:
            expected: the model as it was drawn last; None: the image is judged alone, and what was found
                before is forgotten.
            stamp_ns: of the image.
        """
        height, width = image.shape[:2]
        size = min(width, WIDTH), max(1, round(height * min(1.0, WIDTH / width)))
        small = resized_image(image, size)
        red, green, blue = cv2.split(cv2.blur(small, (WINDOW, WINDOW)))
        evidence, is_open = _evidence(red, green, blue)
        if expected is None:
            found, self._found = _regions(evidence), None
        else:
            if self._found is None:
                self._found, self._trusted = np.zeros(red.shape, np.bool_), np.ones(red.shape, np.bool_)
                self._held, self._stamp_ns = np.zeros(red.shape, np.float32), stamp_ns
            # Not averaged: the model's image has no noise, and reading all of it takes long.
            sampled = cv2.resize(expected.colours.small, size, interpolation=cv2.INTER_NEAREST)
            drawn_red, drawn_green, drawn_blue = cv2.split(_mean(sampled * np.float32(1 / 255), WINDOW))
            doubtful = _doubtful(
                red, green, blue, drawn_red, drawn_green, drawn_blue, resized_image(expected.alpha, size),
                is_open, self._found, self._trusted,
            )  # fmt: skip
            found = _regions(evidence + _mean(doubtful, WINDOW))
            step = min(max((stamp_ns - self._stamp_ns) * 1e-9, 0.0), LONGEST_STEP)
            _count_doubt(found, evidence, step, self._held, self._trusted)
            self._found, self._stamp_ns = found, stamp_ns
        enlarged: U8 = cv2.resize(found * np.uint8(255), (width, height))
        return enlarged > 127


def _evidence(red: U8, green: U8, blue: U8) -> tuple[F32, F32]:
    """Return the evidence [h, w] of the channels [h, w] of a shrunk image alone; and 0 on highlights, 1
    elsewhere [h, w].

    A highlight has the mean evidence around it.
    """
    r, g, b = (channel[::4, ::4].astype(np.float32) for channel in (red, green, blue))
    light = r + g + b
    redness = ((r - g) / (light + 1))[light > 3 * DARK]
    typical = max(float(np.median(redness)), 1e-3) if redness.size else 1.0
    evidence, is_open = _colorless(red, green, blue, typical)
    if not is_open.all():
        around = _around(evidence, is_open)
        evidence = np.where(is_open > 0, evidence, around)
        white = (cv2.min(red, cv2.min(green, blue)) > WHITE).astype(np.float32)
        evidence[(white > 0) & (_widely(white) > WHITEOUT)] = SURE
    return _mean(evidence, WINDOW), is_open


def _around(evidence: F32, is_open: F32) -> F32:
    """The mean evidence within CLIPPED_WINDOW of the pixels that are no highlights, [h, w]."""
    return np.asarray(_widely(evidence * is_open) / (_widely(is_open) + np.float32(1e-3)))


def _widely(plane: F32) -> F32:
    """The mean within `CLIPPED_WINDOW`, [h, w]."""
    height, width = plane.shape
    coarse = max(1, width // COARSE), max(1, height // COARSE)
    wide: F32 = cv2.resize(_mean(resized_image(plane, coarse), CLIPPED_WINDOW // COARSE), (width, height))
    return wide


@kernel
def _colorless(red: U8, green: U8, blue: U8, typical_redness: float) -> tuple[F32, F32]:
    """Evidence by colour, and 0 on highlights. Planes are five times as fast as RGB pixels, also below."""
    height, width = red.shape
    evidence, is_open = np.empty((height, width), np.float32), np.empty((height, width), np.float32)
    for y in range(height):
        for x in range(width):
            r, g, b = float(red[y, x]), float(green[y, x]), float(blue[y, x])
            light, brightest = r + g + b, max(r, g, b)
            paleness = 1 - (r - g) / ((light + 1) * typical_redness)
            gold = (min(r, g) - b) / (light + 1)
            total = PALENESS * max(paleness, LEAST_PALENESS) + GOLD * min(max(gold, 0.0), LARGEST_GOLD)
            total += SHADE if brightest < SHADE_LEVEL else 0.0
            says_nothing = light <= 3 * DARK and r - g <= DARK_RED * light
            evidence[y, x] = SURE if says_nothing else total
            is_open[y, x] = 1.0 if brightest <= CLIPPED else 0.0
    return evidence, is_open


@kernel
def _doubtful(
    red: U8, green: U8, blue: U8,
    drawn_red: F32, drawn_green: F32, drawn_blue: F32, alpha: F32,
    is_open: F32, found: Bool, trusted: Bool,
) -> F32:  # fmt: skip
    """Return the evidence [h, w] of being less red than the model (0..1), and of the frame before.

    What is redder than the model is tissue that an instrument has left.
    """
    height, width = red.shape
    evidence = np.empty((height, width), np.float32)
    for y in range(height):
        for x in range(width):
            share = red[y, x] / (float(red[y, x]) + green[y, x] + blue[y, x] + 1)
            drawn_light = drawn_red[y, x] + drawn_green[y, x] + drawn_blue[y, x] + 1 / 255
            lacking = min(max(drawn_red[y, x] / drawn_light - share, 0.0), LARGEST_CHROMATICITY)
            known = is_open[y, x] if alpha[y, x] > 0.5 else 0.0
            total = CHROMATICITY * lacking * known + (MEMORY if found[y, x] else 0.0)
            evidence[y, x] = total if trusted[y, x] else 0.0
    return evidence


@kernel
def _count_doubt(found: Bool, evidence: F32, step: float, held: F32, trusted: Bool) -> None:
    """Updates in place the seconds of being instrument on doubtful grounds, and whether these still count."""
    height, width = found.shape
    for y in range(height):
        for x in range(width):
            if found[y, x] and evidence[y, x] < 1:
                held[y, x] += step
            else:
                held[y, x] = max(held[y, x] - FORGIVEN * step, 0.0)
            trusted[y, x] = held[y, x] < LONGEST_DOUBT and (trusted[y, x] or held[y, x] == 0)


def _regions(evidence: F32) -> Bool:
    """Regions of evidence of at least 1 that touch the image's edge and reach `SURE` somewhere."""
    solid = (evidence >= 1).view(np.uint8)
    solid = cv2.morphologyEx(solid, cv2.MORPH_OPEN, _disc(OPENING))
    solid = cv2.morphologyEx(solid, cv2.MORPH_CLOSE, _disc(CLOSING))
    count, labels = cv2.connectedComponents(solid)
    touches_edge, is_sure = np.zeros((2, count), np.bool_)
    for edge in (labels[0], labels[-1], labels[:, 0], labels[:, -1]):
        touches_edge[edge] = True
    is_sure[labels[evidence >= SURE]] = True
    kept = touches_edge & is_sure
    kept[0] = False  # the background
    return kept[labels]


def _mean(picture: F32, window: int) -> F32:
    mean: F32 = cv2.blur(picture, (window, window))
    return mean


def _disc(side: int) -> U8:
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side)))
