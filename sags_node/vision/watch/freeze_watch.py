"""Whether a live feed has frozen: one image again and again, under new stamps.

A camera never gives the same image twice: its noise differs. A capture card or a scope's processor that
lost its input repeats the last one, often under a caption that goes on: a clock, a dot. A codec on the way
sends it anew with each key frame, equal up to quantisation. If both eyes freeze so, comparing them shows
nothing (`vision.watch.pair_watch`). Recordings may repeat images: nobody takes them for the present.
"""

from collections.abc import Sequence
from dataclasses import replace
from enum import Enum, auto

import cv2
import numpy as np

from sags_node.types import F32, U8, Bool, Finding
from sags_node.vision.watch.judgement import Evidence, Judgement

LONGEST_NS = 300_000_000  # a converter of frame rates repeats an image for 0.1 s at most (10 Hz given as 30)
LONGEST_STILL_NS = 2_000_000_000  # living tissue moves within a heartbeat, or a breath
GROUP_NS = 190_000_000  # least time between key frames of a frozen image; at 5 Hz images change sooner
EVERY = 2  # px between the pixels that are compared
CELLS = 40  # across the image
CAPTIONS = 0.04  # of the cells, all outside the middle half of the image, may change
RECODED = 4.0  # grey levels, rms in a cell: codecs at common rates differ by less from key frame to key frame
RECODED_CELLS = 0.15  # of the cells may differ more
STILL_CELLS = 0.05  # of the cells may do so while nothing moves; in D4D at rest a tenth do within a second
QUIET_CELLS = 0.5  # of the cells are equal in every bit: there is no sensor noise
GLANCED, GLANCED_ROWS = 8.0, 8  # grey levels, mean over some rows: no codec makes that

Box = tuple[int, int, int, int]
Eyes = tuple[U8, ...]

_FROZEN = Finding(
    "picture_frozen",
    "the same image comes again and again, under new stamps: check the camera, the scope's processor and "
    "the capture card",
)
_STILL = Finding(
    "picture_still",
    "hardly anything in the image has changed for two seconds: does the scope rest, or has it frozen?",
)


class _Change(Enum):
    NONE = auto()  # none but of captions
    RECODED = auto()
    NEW = auto()


class FreezeWatch:
    """Compares every live frame, as it came, with the first that showed the same image.

    Attributes:
        findings: what is wrong, and how to fix it. May be read from any thread.

    Args:
        captions: x, y, width and height of boxes that are ignored, px of the raw left image.
    """

    def __init__(self, captions: Sequence[Box] = ()) -> None:
        self.findings: tuple[Finding, ...] = ()
        self._captions = captions
        self._last_ns = 0  # stamp of the frame before
        self._shown: Eyes = ()  # the frame that has been repeated since
        self._changed: list[Bool] = []  # cells of each eye that captions have changed since
        self._group_ns = 0  # for how long that has been shown, by the stamps
        self._unchanged_ns = 0  # the same, with the groups of images before that differ only in coding
        self._first: Eyes = ()  # the frame since which hardly anything has changed
        self._is_quiet = False  # the newest frame has no sensor noise
        self._still_ns = 0  # for how long hardly anything has changed, without noise

    def judge(self, evidence: Evidence, judged: Judgement) -> Judgement:
        """Hold an image that has come for too long."""
        frame = evidence.frame
        passed_ns = max(0, frame.t_capture_ns - self._last_ns)  # clocks may be set back
        self._last_ns = frame.t_capture_ns
        is_live = frame.t_arrival_ns > 0
        eyes = tuple(eye for eye in (frame.left, frame.right) if eye is not None)
        change = self._change(eyes) if is_live else _Change.NEW
        if change is _Change.NONE:
            self._group_ns += passed_ns
            self._unchanged_ns += passed_ns
        else:
            if change is _Change.NEW or self._group_ns < GROUP_NS:
                self._unchanged_ns = 0
            self._shown, self._group_ns = eyes, 0
            self._changed = [np.zeros((1, 1), np.bool_) for _ in eyes]
        if change is _Change.NEW or not _are_recoded(self._squares(eyes, self._first), STILL_CELLS):
            self._first, self._still_ns = eyes, 0
        elif self._is_quiet:
            self._still_ns += passed_ns
        if self._unchanged_ns >= LONGEST_NS:
            self.findings = (_FROZEN,)
            return replace(judged, hold=judged.hold or _FROZEN.text)
        self.findings = (_STILL,) if self._still_ns >= LONGEST_STILL_NS else ()
        return judged

    def _change(self, eyes: Eyes) -> _Change:
        """How the image differs from `_shown`."""
        if [eye.shape for eye in eyes] != [eye.shape for eye in self._shown]:
            return _Change.NEW
        if any(map(self._is_plainly_new, eyes, self._shown)):
            return _Change.NEW
        squares = self._squares(eyes, self._shown)
        self._is_quiet = all(np.mean(there == 0) > QUIET_CELLS for there in squares)
        changed = [now | (there > 0) for now, there in zip(self._changed, squares, strict=True)]
        if all(map(_are_captions, changed)):
            self._changed = changed
            return _Change.NONE
        return _Change.RECODED if _are_recoded(squares, RECODED_CELLS) else _Change.NEW

    def _squares(self, eyes: Eyes, others: Eyes) -> list[F32]:
        """The mean squared difference of each eye in each cell [rows, columns], of the channel where it is
        largest; 0 under known captions."""
        found = []
        for eye, other in zip(eyes, others, strict=True):
            height, width = eye.shape[:2]
            apart = self._apart(eye, other, EVERY)
            size = min(CELLS, apart.shape[1]), max(1, min(CELLS * height // width, apart.shape[0]))
            squares = cv2.multiply(apart, apart, dtype=cv2.CV_32F)
            cells = cv2.resize(squares, size, interpolation=cv2.INTER_AREA)
            found.append(np.asarray(cells.max(axis=2), np.float32))
        return found

    def _is_plainly_new(self, picture: U8, other: U8) -> bool:
        """Whether a few rows show that an image is new; most new ones are found so."""
        return max(cv2.mean(self._apart(picture, other, max(1, len(picture) // GLANCED_ROWS)))) > GLANCED

    def _apart(self, picture: U8, other: U8, rows: int) -> U8:
        """The absolute differences in every `rows`-th row; 0 under known captions."""
        apart = cv2.absdiff(*(np.ascontiguousarray(eye[::rows, ::EVERY]) for eye in (picture, other)))
        for x, y, width, height in self._captions:
            apart[-(-y // rows) : -(-(y + height) // rows), x // EVERY : -(-(x + width) // EVERY)] = 0
        return np.asarray(apart, np.uint8)


def _are_captions(changed: Bool) -> bool:
    rows, columns = changed.shape
    middle = changed[rows // 4 : -(rows // 4) or None, columns // 4 : -(columns // 4) or None]
    return not middle.any() and bool(changed.mean() <= CAPTIONS)


def _are_recoded(squares: list[F32], share: float) -> bool:
    return all(np.mean(there > RECODED**2) <= share for there in squares)
