"""Whether an image shows the model's scene: what is too dark, too bright, veiled, covered or another scene
is not to be learnt, and is no reason for a new model.

Small images are compared, before anything else is done with a frame. The exposure is one gain for each
channel. A veil, as smoke is, takes contrast away all over. Blood and other cover changes some of the image.
Another scene changes most of it, and no motion explains it.
"""

from dataclasses import replace
from functools import cache
from typing import Any, NamedTuple

import cv2
import numpy as np

from sags_node.kernels.jit import kernel
from sags_node.types import F32, U8, Bool, Finding, FrameResult, GrayPyramid, RectifiedPair
from sags_node.vision.flow import OpticalFlow
from sags_node.vision.landmarks import Landmarks, find_again, motion
from sags_node.vision.pyramid import gray_pyramid, inner, narrowed, pyramid_of, pyramids
from sags_node.vision.watch.clarity import SMOKE
from sags_node.vision.watch.judgement import Evidence, Judgement
from sags_node.vision.watch.palette import Palette
from sags_node.vision.watch.picture_fit import COVERED, FEWEST, GREEN, LEAST_MATCH, Fit
from sags_node.vision.watch.standing import Debounced, watched_ns

WIDTH = 80  # px of the small images
SEEN_ALPHA = 0.5  # of the model: a pixel with more is known
LEAST_USABLE = 0.5  # of the model's channels can be compared: with less the image is overexposed or dark
WHOLE = 0.98  # of them: with more, an image may be learnt in another exposure than the model's
STARTLING = 0.08  # of the px misfit: then motion is looked for that explains it
VEILED, HIDDEN = 0.6, 0.15  # of the model's contrast; clear images have 0.9 and more
RIM = 5  # small px: what lies over the tissue has a soft edge, and grows
LEAST_KEPT = 0.3  # of what is known must be in view after motion
LARGEST_GAIN = 1.5  # over the model's exposure; an image with more is brought to that exposure
STEADY = 1.2  # factor to the gain before: if it stays smaller, the exposure has changed for good
FOLLOWED = 0.9  # of the gain's logarithm that the frame before took out is taken out after that
STRANGE = 0.02  # of the tissue has new colours: clear images have 0.001, a bleeding 0.04 in its first frame
LONGEST_NS = {"cover": 3_000_000_000, "veil": 10_000_000_000, "gain": 1_000_000_000}  # what lasts is usual
NEW_SCENE_NS = 3_000_000_000  # ns: an unknown scene that lasts begins a new model

_FLOW = OpticalFlow(stride=4)

_DARK = Finding("picture_dark", "the image is too dark, and is not learnt: check the light")
_BRIGHT = Finding(
    "picture_bright", "the image is overexposed, and is not learnt: lower the light or the exposure"
)
_COVERED = Finding(
    "picture_covered", "blood or something else covers some of the tissue, and is not learnt: clear the view"
)
_UNKNOWN = Finding(
    "picture_unknown_scene",
    "the image does not show the model's scene: go back to it, or wait; what lasts three seconds begins a "
    "new model",
)


class Look(NamedTuple):
    """How one image compares with the model as it was drawn last."""

    wrong: Finding | None = None  # why it cannot be followed
    veiled: bool = False  # its colours and contrast are not the scene's
    covered: Bool | None = None  # [h, w] where something lies over the scene; None: nowhere
    gain: F32 = np.ones(3, np.float32)  # [3] its exposure over the model's
    whole: bool = True  # next to nothing of it is clipped
    guess: F32 | None = None  # [rows, columns, 2] px: roughly the motion to where the scene is found again
    clear: bool = True  # the image itself is good


class SceneWatch(Debounced):
    """Compares every image with the frame mapped last."""

    def __init__(self, moving: bool = False) -> None:
        """
        Args:
            moving: the camera's pose is estimated, which also deals with images of another scene.
        """
        self._moving = moving
        super().__init__()
        self._since: dict[str, int] = {}  # the stamps since when something lasts, moved on by unwatched gaps
        self._looked_ns: int | None = None  # at the frame before
        self._gain: F32 = np.ones(3, np.float32)  # of the frame before
        self._taken_out: F32 = np.ones(3, np.float32)
        self._palette = Palette()
        self._tissue: Bool | None = None  # [h, w] of the last clear frame
        self._is_clear = True  # the last frame was

    def forget(self) -> None:
        """Begin anew with a new model."""
        self._since.clear()
        self._palette = Palette()
        self._tissue = None
        self._gain = self._taken_out = np.ones(3, np.float32)

    def judge(self, evidence: Evidence, judged: Judgement) -> Judgement:
        """Compare a frame with the scene. Colours are not judged of one that is not to be learnt anyway."""
        pair, last = evidence.pair, evidence.last
        if last is None or judged.hold or evidence.is_repeat:
            return judged
        now = pair.t_capture_ns
        self._leave_gaps_out(now)
        step = max(1, pair.camera.width // WIDTH)
        if self._tissue is None or self._is_clear:
            self._tissue = np.ascontiguousarray(last.observation.tissue[::step, ::step])
        picture = np.empty((*self._tissue.shape, 3), np.uint8)
        _every(step, pair.left, picture)
        seen = look(pair, last, picture, self._tissue)
        if seen.wrong is _UNKNOWN and self._moving:
            self._is_clear = False
            self.note(now, [])
            return judged
        if seen.wrong is not None:
            self._is_clear = False
            self.note(now, [seen.wrong])
            lasts = self._lasts("scene", seen.wrong is _UNKNOWN and seen.clear, now)
            is_new = lasts >= NEW_SCENE_NS
            return replace(judged, hold="" if is_new else seen.wrong.text, is_new_scene=is_new)
        self._lasts("scene", False, now)
        veiled = not judged.learn
        if veiled or (seen.veiled and self._lasts("veil", True, now) < LONGEST_NS["veil"]):
            self._is_clear = False
            self.note(now, [] if veiled else [SMOKE])
            return replace(judged, learn=False, guess=seen.guess)
        self._lasts("veil", False, now)
        cover = self._cover(seen, picture, now)
        self._is_clear = cover is None
        self.note(now, [] if cover is None else [_COVERED])
        gain = self._exposure(seen.gain, now)
        learn = gain is None or seen.whole
        return replace(judged, learn=learn, covered=cover, gain=gain, guess=seen.guess)

    def _cover(self, seen: Look, picture: U8, now: int) -> Bool | None:
        """What lies over the tissue, [h, w]: what the model does not explain, and new colours. What lasts
        longer than `LONGEST_NS` is taken for tissue."""
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
        """Return the gain [3] to take out of the images; None: the model follows their exposure itself."""
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
        """Return for how long it has been so, ns."""
        if not is_so:
            self._since.pop(what, None)
            return 0
        return now - self._since.setdefault(what, now)

    def _leave_gaps_out(self, now: int) -> None:
        """Does not count long gaps between frames, nor time before the clock was set back, as lasting."""
        before, self._looked_ns = self._looked_ns, now
        unseen = 0 if before is None else now - before - watched_ns(before, now)
        self._since = {what: since + unseen for what, since in self._since.items()}


@kernel
def _every(step: int, picture: Any, small: Any) -> None:
    """Every `step` th pixel of every `step` th row."""
    for y in range(small.shape[0]):
        for x in range(small.shape[1]):
            for k in range(3):
                small[y, x, k] = picture[y * step, x * step, k]


def exposed(pair: RectifiedPair, gain: F32) -> RectifiedPair:
    """Return the pair as it would be with 1 / `gain` [3] of its exposure."""
    factors = (1 / gain).astype(np.float64)

    def change(picture: U8) -> U8:
        return np.asarray(cv2.multiply(picture, (*factors, 1.0)))

    left, published = change(pair.left), pair.published
    right = None if pair.right is None else change(pair.right)
    gray = gray_pyramid(left), None if right is None else gray_pyramid(right)
    if published is not None:
        picture = published.picture
        published = replace(published, picture=cache(lambda side: change(picture(side))))
    return replace(pair, left=left, right=right, gray=gray, published=published)


def enlarged(small: Bool, shape: tuple[int, ...]) -> Bool:
    """Enlarge a small image's mask to `shape`."""
    large: U8 = cv2.resize(small.view(np.uint8), shape[1::-1], interpolation=cv2.INTER_NEAREST)
    return large.view(np.bool_)


def look(pair: RectifiedPair, last: FrameResult, picture: U8, tissue: Bool) -> Look:
    """Compare an image with the frame mapped last.

    Args:
        picture: [h, w, 3] the left one, small.
        tissue: [h, w] small, where that frame would have shown tissue but for what covers it.
    """
    step = max(1, pair.camera.width // WIDTH)
    view = last.views["left"]
    seen = picture * np.float32(1 / 255)
    drawn = view.colours.every(step) * np.float32(1 / 255)
    known = (view.alpha[::step, ::step] > SEEN_ALPHA) & tissue
    if np.count_nonzero(known) < FEWEST:
        return Look()
    fit = Fit(seen, drawn, known)
    if fit.usable < LEAST_USABLE:
        return Look(_DARK if seen[known].mean() < drawn[known].mean() else _BRIGHT)
    if fit.contrast < VEILED and fit.match > LEAST_MATCH:
        return Look(SMOKE if fit.contrast < HIDDEN else None, veiled=True)
    if fit.misfit <= STARTLING:
        return Look(gain=fit.gain, whole=fit.usable > WHOLE)
    return _closer_look(pair, last, step, seen, drawn, known, fit)


def _closer_look(
    pair: RectifiedPair, last: FrameResult, step: int, seen: F32, drawn: F32, known: Bool, fit: Fit
) -> Look:
    """Why image and model differ: the tissue has moved, something covers it, or it is other tissue."""
    now = pyramids(exposed(pair, fit.gain) if _strength(fit.gain) > LARGEST_GAIN else pair)[0]
    before = pyramid_of(last.observation)
    fit = _after_motion(now, before, None, step, seen, drawn, known, fit)
    if fit.misfit <= COVERED:
        return Look(gain=fit.gain, whole=fit.usable > WHOLE)
    landmarks = find_again(before, now, last.observation.tissue)
    if landmarks is None:
        return Look(_UNKNOWN, clear=fit.contrast * float(fit.gain[GREEN]) > VEILED)
    height, width = now.full.shape
    back = motion(landmarks.after, landmarks.before, width, height)
    fit = _after_motion(now, before, back, step, seen, drawn, known, fit)
    guess = motion(landmarks.before, landmarks.after, width, height)
    if fit.misfit <= COVERED:
        return Look(gain=fit.gain, whole=fit.usable > WHOLE, guess=guess)
    return Look(covered=fit.wrong & ~_around(landmarks, step, known.shape), gain=fit.gain, guess=guess)


def _after_motion(
    now: GrayPyramid, before: GrayPyramid, guess: F32 | None, step: int, seen: F32, drawn: F32, known: Bool,
    fit: Fit,
) -> Fit:  # fmt: skip
    """The fit after the motion between the images is taken out; `fit` if that is no better. The motion is
    searched from a guess [rows, columns, 2] px of the way back."""
    few = narrowed(now)
    px = np.float32(now.full.shape[1] / (2 * inner(few.halves[0]).shape[1]))  # image px per flow px
    flow = _FLOW(few, narrowed(before), None if guess is None else guess / px)
    flow = cv2.resize(flow, known.shape[::-1], interpolation=cv2.INTER_AREA) * (px / np.float32(step))
    columns, rows = np.meshgrid(*(np.arange(side, dtype=np.float32) for side in known.shape[::-1]))
    there = columns + flow[..., 0], rows + flow[..., 1]
    moved = cv2.remap(drawn, *there, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    tissue = cv2.remap(known.view(np.uint8), *there, cv2.INTER_NEAREST).view(np.bool_)
    if np.count_nonzero(tissue) < LEAST_KEPT * np.count_nonzero(known):
        return fit
    found = Fit(seen, moved, tissue)
    return found if found.misfit < fit.misfit else fit


def _around(landmarks: Landmarks, step: int, shape: tuple[int, ...]) -> Bool:
    """True [h, w] where tissue was found again in a small image: nothing covers it there."""
    found = np.zeros(shape, np.uint8)
    columns, rows = np.rint(landmarks.after / step).astype(np.intp).T
    found[rows.clip(0, shape[0] - 1), columns.clip(0, shape[1] - 1)] = 1
    grown: U8 = cv2.dilate(found, np.ones((2 * RIM + 1, 2 * RIM + 1), np.uint8))
    return grown.view(np.bool_)


def _strength(gain: F32) -> float:
    """How far a gain is from one: the largest factor of a channel, up or down."""
    return float(max(max(each, 1 / max(each, 1e-6)) for each in gain.tolist()))
