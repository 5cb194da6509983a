"""Whether both eyes show what they should: faults that no stage notices, because it fails quietly.

They are looked for in small images of every frame, whatever else is skipped. An eye is compared with the
other one and with what it showed a moment ago: a scene that gets smooth or stands still does so in both.
"""

from collections import deque
from dataclasses import replace
from typing import Any, NamedTuple

import cv2
import numpy as np

from sags_node.kernels.jit import kernel
from sags_node.types import F32, I64, U8, Finding, RectifiedPair, StereoFrame
from sags_node.vision.pyramid import pyramids
from sags_node.vision.watch.clarity import LENS, SMOKE, Clarity, mean_difference, structure
from sags_node.vision.watch.judgement import Evidence, Judgement
from sags_node.vision.watch.picture_fit import GREEN
from sags_node.vision.watch.standing import Debounced

BLOCK = 8  # px, of JPEG and similar codecs
EVERY = 16  # rows from one that is read to the next
# By how much steps across block borders exceed those beside them, over the image's mean step. Recorded
# endoscopies have 0.1 to 0.3; JPEG of quality 50 to 30 has 0.3 to 1.3, of quality 10, which keeps 28 to
# 30 dB, 1.3 to 2.4.
BLOCKY = 1.0

WIDTH = 80  # px of the small images
BLACK = 20.0  # grey levels; video that keeps its black at 16 too
WHITE = 235.0  # and its white at 235
ONE_COLOR = 6.0  # grey levels between the darkest and the brightest of an image of one colour
OUTLIERS = 0.01  # of the pixels at either end: a caption, dead pixels
EQUAL = 0.5  # of the difference that a shift by one small pixel makes; true pairs have 1 to 5
LEAST_MATCH = 0.35  # correlation; nothing matches below
CLEARLY_BETTER = 0.2  # correlation by which exchanged eyes must match better than in their order

HISTORY = 12  # frames with which an eye is compared to see whether it stands still
MOVED = 1.0  # grey levels, mean: the other eye has moved for sure
UNMOVED = 1 / 8  # of the other eye's change; clear pairs have 1/2 or more, with fog 1/4

_TEXTS = {
    "black": "the {eye} image is black: check the light, the lens cap and the cable",
    "white": "the {eye} image is white: lower the light or the exposure",
    "plain": "the {eye} image is of one colour: check the lens, the cable and the capture card",
    "fogged": f"the {{eye}} image is fogged or out of focus beside the other: {LENS}",
    "frozen": "the {eye} image stands still while the other moves: check its cable and capture card",
}
_EQUAL = Finding("eyes_equal", "both eyes show the same image, so there is no depth: connect the other eye")
_EXCHANGED = Finding(
    "eyes_exchanged",
    "left and right seem to be exchanged: exchange source.left and source.right or set source.geometry.first",
)
_UNCLEAR = {
    "": [],
    "blurred": [Finding("picture_blurred", f"the image is blurred, and is not learnt: {LENS}")],
    "veiled": [SMOKE],
}
_COMPRESSED = Finding(
    "picture_compressed",
    "the image is compressed so hard that blocks show: raise the bit rate or the quality of the capture",
)


class Small(NamedTuple):
    """One image, shrunk."""

    rgb: U8  # [h, w, 3]
    gray: F32  # [h, w]


class PairWatch(Debounced):
    """Looks at every pair of a source."""

    def __init__(self) -> None:
        super().__init__()
        self._clarity = Clarity()
        self._history: deque[tuple[F32, F32]] = deque(maxlen=HISTORY)

    def judge(self, evidence: Evidence, judged: Judgement) -> Judgement:
        """Hold a frame with a bad left image or exchanged eyes; do not match eyes of which one is bad."""
        frame = evidence.frame
        found = self._look(frame, evidence.pair)
        learn = not any(code.startswith("picture") for code, _ in found)
        if is_blocky(frame.left):  # learnt all the same: on D4D leaving it out cost more than it spared
            found = [*found, _COMPRESSED]
        self.note(frame.t_capture_ns, found)
        hold, no_stereo = judged.hold, judged.no_stereo
        for code, text in found:
            if code.startswith("left") or code == _EXCHANGED.code:
                hold = hold or text
            if not code.startswith("picture"):
                no_stereo = no_stereo or text
        return replace(judged, hold=hold, no_stereo=no_stereo, learn=judged.learn and learn)

    def _look(self, frame: StereoFrame, pair: RectifiedPair) -> list[Finding]:
        """Return what is wrong in one frame."""
        eyes = {"left": _small(frame.left)}
        if frame.right is not None:
            eyes["right"] = _small(frame.right)
        empty = [_finding(name, kind) for name, eye in eyes.items() if (kind := _emptiness(eye.rgb))]
        if empty:
            self._history.clear()
            return empty
        left, right = pyramids(pair)
        if frame.right is None or right is None:
            return _UNCLEAR[self._clarity(frame.t_capture_ns, [left], [structure(left)]).all]
        if _are_equal(eyes["left"].gray, eyes["right"].gray):
            return [_EQUAL]
        structures = [structure(left), structure(right)]
        if _are_exchanged(*structures):
            return [_EXCHANGED]
        frozen = self._frozen(eyes["left"].gray, eyes["right"].gray)
        unclear = self._clarity(frame.t_capture_ns, [left, right], structures)
        if unclear.eye:
            return [_finding(unclear.eye, "fogged")]
        return [_finding(frozen, "frozen")] if frozen else _UNCLEAR[unclear.all]

    def _frozen(self, left: F32, right: F32) -> str:
        """Which eye shows what it showed before, while the other has moved since; empty: none."""
        pictures = left[::4, ::4].copy(), right[::4, ::4].copy()
        frozen = ""
        for before in reversed(self._history):
            changes = [mean_difference(now, then) for now, then in zip(pictures, before, strict=True)]
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
    return Small(rgb, cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY).astype(np.float32))


def _emptiness(rgb: U8) -> str:
    """The fault of the middle, where scopes show something: black, white, plain (one colour), or none."""
    height, width = rgb.shape[:2]
    middle = rgb[height // 4 : height - height // 4, width // 4 : width - width // 4]
    dark, bright = _ends(middle, round(OUTLIERS * middle.shape[0] * middle.shape[1])).tolist()
    if max(bright) < BLACK:
        return "black"
    if min(dark) > WHITE:
        return "white"
    return "plain" if max(b - a for a, b in zip(dark, bright, strict=True)) < ONE_COLOR else ""


@kernel
def _ends(rgb: U8, outliers: int) -> I64:
    """The darkest and the brightest value of each channel, [2, 3], without so many outliers at either end."""
    counts, ends = np.zeros((3, 256), np.int64), np.empty((2, 3), np.int64)
    for y in range(rgb.shape[0]):
        for x in range(rgb.shape[1]):
            for k in range(3):
                counts[k, rgb[y, x, k]] += 1
    for k in range(3):
        dark, bright = 0, 255
        left = right = outliers
        while left >= counts[k, dark]:
            left -= counts[k, dark]
            dark += 1
        while right >= counts[k, bright]:
            right -= counts[k, bright]
            bright -= 1
        ends[0, k], ends[1, k] = dark, bright
    return ends


def _are_equal(left: F32, right: F32) -> bool:
    """Whether both are captures of one image: these differ far less than after a small shift."""
    apart = mean_difference(left, right * np.float32(cv2.mean(left)[0] / cv2.mean(right)[0]))
    return apart < EQUAL * mean_difference(left[:, 1:], left[:, :-1])


def _are_exchanged(left: F32, right: F32) -> bool:
    """Whether the eyes are exchanged: then everything lies farther right in the right image, not farther
    left (unless the eyes converge so much that the calibration shifts it back)."""
    match = row_correlation(left, right)
    reach = len(match) // 2
    wrong, true = match[:reach].max(), match[reach + 1 :].max()
    return bool(wrong > LEAST_MATCH and wrong > true + CLEARLY_BETTER)


def row_correlation(left: F32, right: F32) -> F32:
    """Correlate rows for disparities from minus to plus half of the width, [2 * (w // 2) + 1]."""
    width = left.shape[1]
    reach = width // 2
    # Row after row, with so many zeros between them that a shift brings no row beside another.
    a, b = (cv2.copyMakeBorder(eye, 1, 1, 0, reach, cv2.BORDER_CONSTANT) for eye in (left, right))
    correlation = np.empty(2 * reach + 1, np.float32)
    _correlate(a, b, width, correlation)
    return correlation


@kernel
def _correlate(a: F32, b: F32, width: int, correlation: F32) -> None:
    height, line = a.shape
    reach = line - width
    energy = np.zeros((2, width + 1), np.float32)  # of the columns before each
    for y in range(height):
        for x in range(width):
            energy[0, x + 1] += a[y, x] * a[y, x]
            energy[1, x + 1] += b[y, x] * b[y, x]
    for x in range(width):
        energy[0, x + 1] += energy[0, x]
        energy[1, x + 1] += energy[1, x]
    all_a, all_b = a.ravel(), b.ravel()
    inner_b = all_b[line : all_b.size - line]
    for k in range(2 * reach + 1):
        disparity = k - reach
        shifted, product = all_a[line + disparity :], np.float32(0)
        for j in range(inner_b.size):
            i = np.uint64(j)
            product += shifted[i] * inner_b[i]
        start, end = max(disparity, 0), min(width + disparity, width)  # of the columns that overlap
        within_a = energy[0, end] - energy[0, start]
        within_b = energy[1, end - disparity] - energy[1, start - disparity]
        correlation[k] = product / np.sqrt(max(within_a * within_b, np.float32(1)))


def is_blocky(picture: U8) -> bool:
    """Tell whether blocks show in an image [H, W, 3] as it came. Resizing and rectifying hide them."""
    return bool(_excess(picture) > BLOCKY)


@kernel
def _excess(picture: U8) -> Any:
    """By how much steps across the borders of blocks, wherever these begin, exceed those beside them, over
    the mean step. An image that was enlarged by repeating pixels has such steps at other places too."""
    height, width, _ = picture.shape
    blocks = (width - 3) // BLOCK
    sums = np.zeros(BLOCK + 2, np.float32)  # of the steps at each place in a block, and in the next two
    for y in range(0, height, EVERY):
        for block in range(blocks):
            for place in range(BLOCK + 2):
                x = block * BLOCK + place
                sums[place] += abs(np.float32(picture[y, x + 1, GREEN]) - np.float32(picture[y, x, GREEN]))
    most, second, total = np.float32(0), np.float32(0), np.float32(0)
    for place in range(1, BLOCK + 1):
        excess = sums[place] - np.float32(0.5) * (sums[place - 1] + sums[place + 1])
        second = max(second, min(most, excess))
        most = max(most, excess)
        total += sums[place]
    count = np.float32(blocks * (1 + (height - 1) // EVERY))
    mean = total / np.float32(BLOCK)
    return (most - second) / (mean + np.float32(0.5) * count)
