"""Whether a picture shows the model's scene: what is too dark, too bright, veiled, covered or another scene
is not to be learnt, and is no reason for a new model.

Looked at in small pictures, before anything else is done with a frame. The exposure is one gain for each
channel. A veil, as smoke is, takes contrast away all over. Blood and other cover changes some of the picture.
Another scene changes most of it, and no motion explains it.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import cv2
import numpy as np

from sags_node.kernels.jit import kernel
from sags_node.types import F32, I64, U8, Bool, Finding, FrameResult, RectifiedPair
from sags_node.vision.clarity import SMOKE
from sags_node.vision.flow import OpticalFlow
from sags_node.vision.picture_fit import (
    BRIGHT,
    COVERED,
    DARK,
    FEWEST,
    FINE,
    GREEN,
    LEAST_MATCH,
    Fit,
    structure,
)
from sags_node.vision.pyramid import gray_pyramid, inner, narrowed, pyramid_of, pyramids
from sags_node.vision.standing import Standing

WIDTH = 80  # px of the small pictures
SEEN_ALPHA = 0.5
LEAST_USABLE = (
    0.5  # of the channels of the model that can be compared: with less the picture is overexposed or dark
)
STARTLING = 0.08  # of the px misfit: then motion is looked for that explains it
VEILED, HIDDEN = 0.6, 0.15  # of the model's contrast; clear pictures have 0.9 and more
RIM = 5  # small px: what lies over the tissue has a soft edge, and grows
LEAST_KEPT = 0.3  # of what is known, in view after motion
LARGEST_GAIN = 1.5  # from one frame to the next; beyond, a picture is brought to the model's exposure
STEADY = 1.2  # of the gain before: the exposure has changed for good when it stays so
FOLLOWED = 0.9  # of the gain's logarithm, per frame, is still taken out of a picture after that
BINS = 32  # of the share of red in a colour, and of green
NOVEL = 0.002  # of the tissue had a colour like this, or less: it is new
STRANGE = 0.02  # of the tissue has new colours: clear pictures have 0.005
REMEMBERED_S = 3.0  # s over which the usual colours follow
LONGEST_NS = {"cover": 3_000_000_000, "veil": 10_000_000_000, "gain": 1_000_000_000}
NEW_SCENE_NS = 3_000_000_000

_FLOW = OpticalFlow(stride=4)

_DARK = Finding("picture_dark", "the picture is too dark, and is not learnt: see to the light")
_BRIGHT = Finding(
    "picture_bright", "the picture is overexposed, and is not learnt: lower the light or the exposure"
)
_COVERED = Finding(
    "picture_covered", "blood or something else covers some of the tissue, and is not learnt: clear the view"
)
_UNKNOWN = Finding(
    "picture_unknown_scene",
    "the picture does not show the model's scene: go back to it, or wait; what lasts three seconds begins a "
    "new model",
)


class Look(NamedTuple):
    """What one picture is, beside the model as it was drawn last."""

    wrong: Finding | None = None  # why it cannot be followed
    veiled: bool = False  # its colours and contrast are not the scene's
    covered: Bool | None = None  # [h, w] where something lies over the scene; None: nowhere
    gain: F32 = np.ones(3, np.float32)  # [3] its exposure over the model's
    shift: tuple[float, float] = (0.0, 0.0)  # px right and down: where the scene is found again, about
    clear: bool = True  # it is good in itself


class Advice(NamedTuple):
    """What to do with a frame."""

    held: str = ""  # why it is not taken in; empty: it is
    is_new: bool = False  # it shows another scene for good: begin a new model
    learn: bool = True  # else it is only followed
    covered: Bool | None = None  # [h, w] a small picture of what is not tissue now
    gain: F32 | None = None  # [3] to be taken out of the pictures
    shift: tuple[float, float] = (0.0, 0.0)  # px, where the motion search is to begin


class SceneWatch:
    """Compares every picture with the frame mapped last."""

    def __init__(self, moving: bool = False) -> None:
        """
        Args:
            moving: the camera's pose is estimated: what shows another scene is left to that.
        """
        self._moving = moving
        self._standing = Standing()
        self._since: dict[str, int] = {}  # stamps: how long something has lasted
        self._gain: F32 = np.ones(3, np.float32)  # of the frame before
        self._taken_out: F32 = np.ones(3, np.float32)
        self._palette = _Palette()
        self._tissue: Bool | None = None  # [h, w] of the last clear frame
        self._is_clear = True  # the last frame was

    @property
    def findings(self) -> tuple[Finding, ...]:
        """What is wrong with the pictures. May be read from any thread."""
        return self._standing.findings

    def forget(self) -> None:
        """There is a new model."""
        self._since.clear()
        self._palette = _Palette()
        self._tissue = None
        self._gain = self._taken_out = np.ones(3, np.float32)

    def __call__(self, pair: RectifiedPair, last: FrameResult, veiled: bool = False) -> Advice:
        """Take one frame.

        Args:
            veiled: it is known to be blurred or veiled: colours tell nothing.
        """
        now = pair.t_capture_ns
        step = max(1, pair.camera.width // WIDTH)
        if self._tissue is None or self._is_clear:
            self._tissue = np.ascontiguousarray(last.observation.tissue[::step, ::step])
        picture = np.empty((*self._tissue.shape, 3), np.uint8)
        _every(step, pair.left, picture)
        seen = look(pair, last, picture, self._tissue)
        if seen.wrong is _UNKNOWN and self._moving:
            self._is_clear = False
            self._standing.update(now, [])
            return Advice()
        if seen.wrong is not None:
            self._is_clear = False
            self._standing.update(now, [seen.wrong])
            lasts = self._lasts("scene", seen.wrong is _UNKNOWN and seen.clear, now)
            return Advice(seen.wrong.text, is_new=lasts >= NEW_SCENE_NS)
        self._lasts("scene", False, now)
        if veiled or (seen.veiled and self._lasts("veil", True, now) < LONGEST_NS["veil"]):
            self._is_clear = False
            self._standing.update(now, [] if veiled else [SMOKE])
            return Advice(learn=False, shift=seen.shift)
        self._lasts("veil", False, now)
        cover = self._cover(seen, picture, now)
        self._is_clear = cover is None
        self._standing.update(now, [] if cover is None else [_COVERED])
        gain = self._exposure(seen.gain, now)
        return Advice(learn=gain is None, covered=cover, gain=gain, shift=seen.shift)

    def _cover(self, seen: Look, picture: U8, now: int) -> Bool | None:
        """[h, w] what lies over the tissue: what the model does not explain, and colours that are new. What
        stays so long is taken for tissue."""
        assert self._tissue is not None
        new = self._palette.new(picture, self._tissue, now)
        is_strange = bool(np.count_nonzero(new & self._tissue) > STRANGE * np.count_nonzero(self._tissue))
        lasts = self._lasts("cover", seen.covered is not None or is_strange, now)
        if lasts >= LONGEST_NS["cover"]:
            is_strange = False
        self._palette.take(except_new=is_strange)
        if lasts >= LONGEST_NS["cover"] or not (seen.covered is not None or is_strange):
            return None
        cover: Bool = new if seen.covered is None else seen.covered | new
        grown: U8 = cv2.dilate(cover.view(np.uint8), np.ones((RIM, RIM), np.uint8))
        return grown.view(np.bool_)

    def _exposure(self, gain: F32, now: int) -> F32 | None:
        """What to take out of the pictures; None: the model follows their exposure by itself."""
        steady = _strength(gain / self._gain) < STEADY
        self._gain = gain
        if _strength(gain) <= LARGEST_GAIN:
            self._lasts("gain", False, now)
            return None
        if self._lasts("gain", steady, now) < LONGEST_NS["gain"]:
            self._taken_out = gain
        else:
            self._taken_out = self._taken_out**FOLLOWED
        return self._taken_out

    def _lasts(self, what: str, is_so: bool, now: int) -> int:
        """For how long it has been so, ns."""
        if not is_so:
            self._since.pop(what, None)
            return 0
        since = self._since.setdefault(what, now)
        if now < since:  # the clock has jumped back
            since = self._since[what] = now
        return now - since


class _Palette:
    """The colours that the tissue usually has, whatever the exposure."""

    def __init__(self) -> None:
        self._usual: F32 | None = None  # [BINS, BINS] share of the tissue, by share of red and of green
        self._share = 1.0
        self._colors = np.zeros((1, 1), np.int64)  # [h, w] bins of the newest picture, -1: too dark or bright
        self._counted = self._is_new = np.zeros((1, 1), np.bool_)
        self._stamp_ns = 0

    def new(self, picture: U8, tissue: Bool, now: int) -> Bool:
        """Which pixels [h, w] of a small picture [h, w, 3] have colours that tissue has not had before."""
        self._colors, self._is_new = np.empty(tissue.shape, np.int64), np.empty(tissue.shape, np.bool_)
        if self._usual is None:
            self._share, around = 1.0, np.ones((BINS, BINS), np.float32)
        else:
            self._share = min(1.0, max(0.0, (now - self._stamp_ns) * 1e-9) / REMEMBERED_S)
            around = cv2.boxFilter(self._usual, -1, (FINE, FINE), normalize=False)
        self._stamp_ns = now
        _sort_colors(cv2.blur(picture, (FINE, FINE)), around, self._colors, self._is_new)
        self._counted = tissue
        return self._is_new

    def take(self, except_new: bool) -> None:
        """Learn the colours of that picture."""
        counted = self._counted & ~self._is_new if except_new else self._counted
        found = np.zeros((BINS, BINS), np.float32)
        count = _count_colors(self._colors, counted, found)
        if count == 0:
            return
        found /= np.float32(count)
        before = found if self._usual is None else self._usual
        self._usual = before + np.float32(self._share) * (found - before)


@kernel
def _sort_colors(picture: U8, around: F32, colors: I64, is_new: Bool) -> None:
    """The bin of each pixel's colour, or -1 where it is too dark or too bright to tell, and whether there is
    next to nothing in the bins `around` it."""
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
            is_new[y, x] = fair and around[row, column] < np.float32(NOVEL)


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


@kernel
def _every(step: int, picture: Any, small: Any) -> None:
    """Every `step` th pixel of every `step` th row."""
    for y in range(small.shape[0]):
        for x in range(small.shape[1]):
            for k in range(3):
                small[y, x, k] = picture[y * step, x * step, k]


def exposed(pair: RectifiedPair, gain: F32) -> RectifiedPair:
    """The pair as it would be with 1 / `gain` [3] of its exposure."""
    factors = (1 / gain).astype(np.float64)

    def change(picture: U8) -> U8:
        return np.asarray(cv2.multiply(picture, (*factors, 1.0)))

    left = change(pair.left)
    right = None if pair.right is None else change(pair.right)
    gray = gray_pyramid(left), None if right is None else gray_pyramid(right)
    return replace(pair, left=left, right=right, gray=gray)


def enlarged(small: Bool, shape: tuple[int, ...]) -> Bool:
    """A mask of a small picture for one of `shape`."""
    large: U8 = cv2.resize(small.view(np.uint8), shape[1::-1], interpolation=cv2.INTER_NEAREST)
    return large.view(np.bool_)


def look(pair: RectifiedPair, last: FrameResult, picture: U8, tissue: Bool) -> Look:
    """What a picture is, beside the frame mapped last.

    Args:
        picture: [h, w, 3] the left one, small.
        tissue: [h, w] small, where that frame would have shown tissue but for what covers it.
    """
    step = max(1, pair.camera.width // WIDTH)
    view = last.views["left"]
    seen = picture * np.float32(1 / 255)
    drawn = np.empty(picture.shape, np.float32)
    _every(step, view.rgb, drawn)
    known = (view.alpha[::step, ::step] > SEEN_ALPHA) & tissue
    if np.count_nonzero(known) < FEWEST:
        return Look()
    fit = Fit(seen, drawn, known)
    if fit.usable < LEAST_USABLE:
        return Look(_DARK if seen[known].mean() < drawn[known].mean() else _BRIGHT)
    if fit.contrast < VEILED and fit.match > LEAST_MATCH:
        return Look(SMOKE if fit.contrast < HIDDEN else None, veiled=True)
    shift = (0.0, 0.0)
    if fit.misfit > STARTLING:
        fit, shift = _found_again(pair, last, step, seen, drawn, known, fit)
    if fit.is_another:
        return Look(_UNKNOWN, clear=fit.contrast * float(fit.gain[GREEN]) > VEILED)
    if fit.misfit <= COVERED:
        return Look(gain=fit.gain, shift=shift)
    return Look(covered=fit.wrong, gain=fit.gain, shift=shift)


def _found_again(
    pair: RectifiedPair, last: FrameResult, step: int, seen: F32, drawn: F32, known: Bool, fit: Fit
) -> tuple[Fit, tuple[float, float]]:
    """The best fit after motion that the pictures show, from where they lie and from where they lie best as a
    whole; and that common shift, px."""
    now = narrowed(pyramids(exposed(pair, fit.gain) if _strength(fit.gain) > LARGEST_GAIN else pair)[0])
    before = narrowed(pyramid_of(last.observation))
    whole = pair.camera.width / (2 * inner(now.halves[0]).shape[1])  # px of the picture in one of the flow's
    greens = (structure(np.ascontiguousarray(each[..., GREEN])) for each in (drawn, seen))
    (x, y), _ = cv2.phaseCorrelate(*greens)
    columns, rows = np.meshgrid(*(np.arange(side, dtype=np.float32) for side in known.shape[::-1]))
    best, best_shift = fit, (0.0, 0.0)
    for shift in ((0.0, 0.0), (step * x, step * y)):
        back = _FLOW(now, before, (-shift[0] / whole, -shift[1] / whole))
        back = cv2.resize(back, known.shape[::-1], interpolation=cv2.INTER_AREA) * np.float32(whole / step)
        there = columns + back[..., 0], rows + back[..., 1]
        moved = cv2.remap(drawn, *there, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        tissue = cv2.remap(known.view(np.uint8), *there, cv2.INTER_NEAREST).view(np.bool_)
        if np.count_nonzero(tissue) < LEAST_KEPT * np.count_nonzero(known):
            continue
        found = Fit(seen, moved, tissue)
        if found.misfit < best.misfit:
            best, best_shift = found, shift
        if best.misfit <= STARTLING:
            break
    return best, best_shift


def _strength(gain: F32) -> float:
    """How far a gain is from one, as a factor."""
    return float(max(max(each, 1 / max(each, 1e-6)) for each in gain.tolist()))
