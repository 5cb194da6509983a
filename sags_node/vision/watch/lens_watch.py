"""Where something sits on one lens: a drop, a splash, dirt.

It hides fine detail from one eye, and stays where it is while the tissue moves. The other eye sees the same
tissue through another part of its lens. So each cell of the left picture is compared with the place in the
right one at which the model's depth says the same tissue is. What moves, is smooth or out of focus is so in
both eyes.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from sags_node.kernels.jit import kernel
from sags_node.types import F32, I8, U8, Bool, Finding
from sags_node.vision.pyramid import BORDER, inner, pyramids
from sags_node.vision.watch.clarity import LOST_CONTRAST, REMEMBERED_S, USUAL_DIFFERENCE
from sags_node.vision.watch.judgement import Evidence, Judgement
from sags_node.vision.watch.picture_fit import middle_of
from sags_node.vision.watch.standing import Debounced, watched_ns

CELLS = 40  # across the picture
SMALLEST = 8  # px of the first half, the side of a cell: of fewer, the detail is chance
EVERY = 2  # rows of a cell that are looked at
NOISE = 0.5  # grey levels: detail below it is a camera's noise
# Octaves of one eye's detail beside the other's. Of 100 cells of tissue that is pulled, one loses 0.8; under
# drops 90 lose more than 1, half of them 3.
LOST, BACK = 1.0, 0.5 * LOST_CONTRAST
ALIKE = 5  # of a cell and the eight around it have lost it: drops are wider than a cell
FEWEST = 6  # cells: the area of a drop whose radius is 3.5 % of the width
VEIL = 0.5 * LOST  # of the median cell: something lies over the whole lens, see `vision.watch.clarity`

_TEXT = "drops or dirt on the {eye} lens hide some of the tissue, which is not learnt: clean the lens"
_LEFT, _RIGHT = (Finding(f"{eye}_eye_drops", _TEXT.format(eye=eye)) for eye in ("left", "right"))


class LensWatch(Debounced):
    """Compares the eyes of every pair."""

    def __init__(self) -> None:
        super().__init__()
        self._stamp_ns: int | None = None
        self._usual: F32 | None = None  # octaves of the left eye over the right one, of each cell
        self._hidden: I8 = np.zeros((1, 1), np.int8)  # -1: from the left eye, 1: from the right one

    def judge(self, evidence: Evidence, judged: Judgement) -> Judgement:
        """The depth of the frame mapped last says where tissue is in the right picture."""
        pair, last = evidence.pair, evidence.last
        if last is None or evidence.is_repeat:
            return judged
        left, right = pyramids(pair)
        sound = judged.learn and not (judged.hold or judged.no_stereo or evidence.eyes_are_late)
        if right is None or not sound or judged.is_new_scene:
            self.note(pair.t_capture_ns, [])
            return judged
        height, width = inner(left.halves[0]).shape
        side = max(SMALLEST, round(width / CELLS))  # px of the first half
        rows, columns = height // side, width // side
        detail = np.empty((2, rows, columns), np.float32)
        _measure(left.halves[0], side, detail[0])
        _measure(right.halves[0], side, detail[1])
        # The middles of the cells, in the whole picture.
        depth = last.views["left"].depth[side :: 2 * side, side :: 2 * side][:rows, :columns]
        tissue = last.observation.tissue[side :: 2 * side, side :: 2 * side][:rows, :columns]
        apart = _octaves_apart(detail, depth, pair.camera.K[0, 0] * pair.baseline / (2 * side))
        if self._usual is None or self._usual.shape != apart.shape or self._stamp_ns is None:
            self._usual = apart.clip(-USUAL_DIFFERENCE, USUAL_DIFFERENCE)
            self._hidden = np.zeros(apart.shape, np.int8)
            self._stamp_ns = pair.t_capture_ns
        passed = watched_ns(self._stamp_ns, pair.t_capture_ns) * 1e-9
        self._stamp_ns = pair.t_capture_ns
        off = apart - self._usual
        followed = self._usual + np.float32(min(1.0, passed / REMEMBERED_S)) * off
        followed = followed.clip(-USUAL_DIFFERENCE, USUAL_DIFFERENCE)
        if abs(middle_of(off[apart != 0])) > VEIL:
            self._usual = followed
            self.note(pair.t_capture_ns, [])
            return judged
        stays = self._hidden * off > 0
        lost = (stays | tissue) & (np.abs(off) > np.where(stays, BACK, LOST))
        self._usual = np.where(lost, self._usual, followed)
        self._hidden = np.zeros(apart.shape, np.int8)
        covered: list[Bool | None] = []
        for eye in (-1, 1):
            alike = lost & (np.sign(off) == eye)
            around = cv2.boxFilter(
                alike.view(np.uint8), -1, (3, 3), normalize=False, borderType=cv2.BORDER_CONSTANT
            )
            hidden = alike & (around >= ALIKE)
            self._hidden[hidden] = eye
            is_so = np.count_nonzero(hidden) >= FEWEST
            grown: U8 = cv2.dilate(hidden.view(np.uint8), np.ones((3, 3), np.uint8))
            covered.append(grown.view(np.bool_) if is_so else None)
        self.note(
            pair.t_capture_ns,
            [found for found, mask in zip((_LEFT, _RIGHT), covered, strict=True) if mask is not None],
        )
        return replace(judged, covered_left=covered[0], covered_right=covered[1])


@kernel
def _measure(half: F32, side: int, detail: F32) -> None:
    """Second differences along and across every other row, mean over each cell, grey levels: edges that are
    only out of focus have next to none."""
    rows, columns = detail.shape
    line = np.empty(columns * side, np.float32)  # sums over the pixels below each other in one row of cells
    share = np.float32(1 / (side * -(-side // EVERY)))
    for row in range(rows):
        line[:] = np.float32(0)
        for y in range(BORDER + row * side, BORDER + (row + 1) * side, EVERY):
            _add_bends(half[y - 1, BORDER:], half[y, BORDER - 1 :], half[y + 1, BORDER:], line)
        for column in range(columns):
            total = np.float32(0)
            for x in range(column * side, (column + 1) * side):
                total += line[x]
            detail[row, column] = share * total


@kernel
def _add_bends(above: F32, row: F32, below: F32, line: F32) -> None:
    """`row` begins a pixel before the others."""
    one, two = np.uint64(1), np.uint64(2)
    for i in range(line.size):
        x = np.uint64(i)
        twice = row[x + one] + row[x + one]
        line[x] += abs(row[x] + row[x + two] - twice) + abs(above[x] + below[x] - twice)


def _octaves_apart(detail: F32, depth: F32, focal_baseline: float) -> F32:
    """Octaves of the left eye's detail over that of the right eye, where it sees the same tissue; else 0.

    Args:
        detail: [left or right, rows, columns].
        depth: [rows, columns] m, of the left eye; 0: unknown, taken for the median.
        focal_baseline: a distance of 1 m is so many cells of disparity.
    """
    known = depth > 0
    inverse = np.divide(1, depth, out=np.zeros_like(depth), where=known)
    inverse[~known] = np.median(inverse[known]) if known.any() else 0
    row, columns = np.arange(len(depth))[:, None], np.arange(depth.shape[1])
    places = columns.astype(np.float32) - np.float32(focal_baseline) * inverse
    there = np.maximum(places, 0)
    before = there.astype(np.intp)
    near, far = detail[1, row, before], detail[1, row, np.minimum(before + 1, columns[-1])]
    other = near + (there - before.astype(np.float32)) * (far - near)
    noise = np.float32(NOISE)
    return np.where(places >= 0, np.log2((detail[0] + noise) / (other + noise)), np.float32(0))
