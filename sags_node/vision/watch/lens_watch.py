"""Where something sits on one lens: a drop, a splash, dirt.

It hides fine detail from one eye, and stays where it is while the tissue moves. The other eye sees the same
tissue through another part of its lens. So each cell of the left image is compared with the place in the
right one at which the model's depth says the same tissue is. What moves, is smooth or out of focus is so in
both eyes.
"""

from dataclasses import replace
from typing import Any

import numpy as np

from sags_node.kernels.jit import kernel
from sags_node.types import F32, I8, Bool, Finding
from sags_node.vision.pyramid import BORDER, inner, pyramids
from sags_node.vision.watch.clarity import LOST_CONTRAST, REMEMBERED_S, USUAL_DIFFERENCE
from sags_node.vision.watch.judgement import Evidence, Judgement
from sags_node.vision.watch.picture_fit import middle_of
from sags_node.vision.watch.standing import Debounced, watched_ns

CELLS = 40  # across the image
SMALLEST = 8  # px of the first half, the side of a cell: of fewer, the detail is chance
EVERY = 2  # rows from one that is read to the next
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
        """Find what the lenses hide. The frame mapped last tells where tissue is in the right image."""
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
        apart = np.empty((rows, columns), np.float32)
        focal_baseline = np.float32(pair.camera.K[0, 0] * pair.baseline / (2 * side))
        _compare(detail, last.views["left"].depth, 2 * side, focal_baseline, apart)
        if self._usual is None or self._usual.shape != apart.shape or self._stamp_ns is None:
            self._usual = apart.clip(-USUAL_DIFFERENCE, USUAL_DIFFERENCE)
            self._hidden = np.zeros(apart.shape, np.int8)
            self._stamp_ns = pair.t_capture_ns
        passed = watched_ns(self._stamp_ns, pair.t_capture_ns) * 1e-9
        self._stamp_ns = pair.t_capture_ns
        share = np.float32(min(1.0, passed / REMEMBERED_S))
        off = apart - self._usual
        if abs(middle_of(off[apart != 0])) > VEIL:
            self._usual = (self._usual + share * off).clip(-USUAL_DIFFERENCE, USUAL_DIFFERENCE)
            self.note(pair.t_capture_ns, [])
            return judged
        covered = np.zeros((2, rows, columns), np.bool_)
        counts = _judge(apart, last.observation.tissue, 2 * side, share, self._usual, self._hidden, covered)
        many = [count >= FEWEST for count in counts]
        self.note(
            pair.t_capture_ns, [found for found, is_so in zip((_LEFT, _RIGHT), many, strict=True) if is_so]
        )
        hidden = (mask if is_so else None for mask, is_so in zip(covered, many, strict=True))
        return replace(judged, covered_left=next(hidden), covered_right=next(hidden))


@kernel
def _measure(half: F32, side: int, detail: F32) -> None:
    """Mean absolute second differences, along and across every other row, in each cell, grey levels. Edges
    out of focus have next to none."""
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
    """Adds the second differences of a row to `line`; `row` begins a pixel before the others."""
    one, two = np.uint64(1), np.uint64(2)
    for i in range(line.size):
        x = np.uint64(i)
        twice = row[x + one] + row[x + one]
        line[x] += abs(row[x] + row[x + two] - twice) + abs(above[x] + below[x] - twice)


@kernel
def _compare(detail: F32, depth: F32, side: int, focal_baseline: Any, apart: F32) -> None:
    """Octaves of the left eye's detail over that of the right eye, where it sees the same tissue.

    Args:
        depth: [H, W] m, of the left eye's pixels; 0: unknown, taken for the median.
        side: of a cell, px of `depth`.
        focal_baseline: disparity at a distance of 1 m, in cells.
    """
    rows, columns = apart.shape
    inverse, known = np.zeros((rows, columns), np.float32), np.empty(rows * columns, np.float32)
    count = 0
    for row in range(rows):
        for column in range(columns):
            z = depth[row * side + side // 2, column * side + side // 2]
            if z > 0:
                inverse[row, column] = known[count] = np.float32(1) / z
                count += 1
    usual = np.median(known[:count]) if count else np.float32(0)
    noise = np.float32(NOISE)
    for row in range(rows):
        for column in range(columns):
            nearness = inverse[row, column]
            place = np.float32(column) - focal_baseline * (nearness if nearness > 0 else usual)
            apart[row, column] = 0
            if place >= 0 and place < columns:  # else the right eye does not see it
                before = int(place)
                after, share = min(before + 1, columns - 1), place - np.float32(before)
                other = detail[1, row, before] + share * (detail[1, row, after] - detail[1, row, before])
                apart[row, column] = np.log2((detail[0, row, column] + noise) / (other + noise))


@kernel
def _judge(apart: F32, tissue: Bool, side: int, share: Any, usual: F32, hidden: I8, covered: Bool) -> Any:
    """Updates each cell's `usual` and `hidden` in place. Writes `covered` [left or right, rows, columns], a
    cell wider than what is hidden. Returns how many cells are hidden from either eye."""
    rows, columns = apart.shape
    lost, back, most = np.float32(LOST), np.float32(BACK), np.float32(USUAL_DIFFERENCE)
    found = np.zeros((rows, columns), np.int8)
    for row in range(rows):
        for column in range(columns):
            off = apart[row, column] - usual[row, column]
            stays = hidden[row, column] * off > 0
            shown = stays or tissue[row * side + side // 2, column * side + side // 2]
            if shown and abs(off) > (back if stays else lost):
                found[row, column] = 1 if off > 0 else -1
    counts = np.zeros(2, np.int64)
    for row in range(rows):
        for column in range(columns):
            alike = 0
            for y in range(max(row - 1, 0), min(row + 2, rows)):
                for x in range(max(column - 1, 0), min(column + 2, columns)):
                    alike += found[y, x] == found[row, column]
            hidden[row, column] = found[row, column] if alike >= ALIKE else 0
            if hidden[row, column] != 0:
                eye = 0 if hidden[row, column] < 0 else 1
                counts[eye] += 1
                for y in range(max(row - 1, 0), min(row + 2, rows)):
                    for x in range(max(column - 1, 0), min(column + 2, columns)):
                        covered[eye, y, x] = True
            elif found[row, column] == 0:
                off = apart[row, column] - usual[row, column]
                usual[row, column] = min(max(usual[row, column] + share * off, -most), most)
    return counts
