"""The instruments of a mask, each with its midline in the image.

An instrument enters from the image's edge. Its midline joins the middles of the pixels that are equally far
from there inside the mask (level sets of the geodesic distance), so that jaws may be open. A region that
touches the edge in several places is several instruments that overlap: each is followed straight on.
"""

from dataclasses import dataclass, replace

import cv2
import numpy as np

from sags_node.kernels.jit import kernel
from sags_node.types import F64, I32, U8, Bool

WIDTH = 320  # px, of the mask in which midlines are sought
MOST = 8  # instruments of a frame, and entries of a region, at most
SMALLEST = 0.002  # of the image: smaller regions are left out
FRAME = 0.9  # of a row or column at the image's edge: if so much is masked, it is no instrument
GAP = 7  # px: smaller gaps (a highlight, the window of a jaw) are closed
APART = 21  # px: entries nearer than this are one
BIN = 3  # px of the distance from the entry, for each point of a midline
FEWEST = 4  # points of a midline
WIDER = 1.4  # times as wide as at its entry: another instrument begins
BAND = 0.75  # of its width, to each side of the line along which an instrument is followed
STRAIGHT = 0.15  # of its width, plus 1 px: so far a straight midline may lie off its line
SIDEWAYS = 0.1  # of its area may lie farther off: one jaw reaches farther than the other
SHORTEST = 1.0  # of its width: in a shorter part, such as the corner of a shaft, no end is seen
MOSTLY = 0.5  # of an entry: where so much of it lies in another's band, that other leaves there
FITS = 4  # iterations of a line's fit, each without the outliers of the one before


@dataclass(frozen=True, slots=True)
class Outline:
    """An instrument in the image; px of the mask."""

    far: F64  # [2] u v, its end that is the farthest from the entry
    back: F64  # [2] u v, where the straight part that ends there begins
    middles: F64  # [K, 2] u v, points of the midline of that part that lie on its line, from the far end
    widths: F64  # [K] there
    spread: float  # how far its far end reaches to a side of the line: open jaws, a hook
    is_outside: bool  # its end is at the image's edge, so the tip is beyond; or it is too short to tell
    is_alone: bool  # nothing else lies over it


def outlines(tools: Bool, usable: Bool) -> list[Outline]:
    """Find the instruments in a mask [H, W] that enter at the edge of the image, or of its `usable` part
    [H, W]; those of the largest regions first. A region that does not touch this edge is no instrument."""
    scale = max(1.0, tools.shape[1] / WIDTH)
    size = round(tools.shape[1] / scale), round(tools.shape[0] / scale)
    small, inside = (_smaller(mask, size) for mask in (tools & usable, usable))
    rows, columns = (np.flatnonzero(small.mean(axis) < FRAME) for axis in (1, 0))
    if len(rows) == 0 or len(columns) == 0:
        return []
    bare = np.zeros_like(inside)
    bare[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1] = 1
    inside &= bare
    small = cv2.morphologyEx(small, cv2.MORPH_CLOSE, _disc(GAP)) & inside
    edge = inside & ~cv2.erode(inside, np.ones((3, 3), np.uint8), borderValue=0)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(small)
    areas = stats[:, cv2.CC_STAT_AREA]
    found: list[Outline] = []
    for label in sorted(range(1, count), key=lambda i: -areas[i])[:MOST]:
        if areas[label] >= SMALLEST * small.size and len(found) < MOST:
            found += _of_component((labels == label).view(np.uint8), edge)
    return [_enlarged(each, scale) for each in found[:MOST]]


def _enlarged(small: Outline, scale: float) -> Outline:
    far, back, middles = ((at + 0.5) * scale - 0.5 for at in (small.far, small.back, small.middles))
    widths, spread = scale * small.widths, scale * small.spread
    return replace(small, far=far, back=back, middles=middles, widths=widths, spread=spread)


def _smaller(mask: Bool, size: tuple[int, int]) -> U8:
    shrunk = cv2.resize(mask.view(np.uint8) * np.uint8(255), size, interpolation=cv2.INTER_AREA)
    return np.asarray(shrunk > 127).view(np.uint8)


def _disc(side: int) -> U8:
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side)), np.uint8)


def _of_component(mask: U8, edge: U8) -> list[Outline]:
    """The outlines of the instruments in one connected region [h, w]."""
    count, entries = cv2.connectedComponents(cv2.dilate(mask & edge, _disc(APART)))
    entries *= mask & edge
    found: dict[int, tuple[Outline, U8]] = {}  # by entry: it, and the band it was sought in
    sizes = np.bincount(entries.ravel(), minlength=count)
    for entry in sorted(range(1, count), key=lambda i: -sizes[i])[:MOST]:
        start = (entries == entry).view(np.uint8)
        band = mask if count == 2 else _band(mask, start)
        outline = None if band is None else _of_band(band, start, edge, alone=count == 2)
        if outline is not None and band is not None:
            found[entry] = outline, band
    lengths = {entry: np.linalg.norm(outline.far - outline.back) for entry, (outline, _) in found.items()}
    for entry in sorted(found, key=lambda i: -lengths[i]):
        if entry in found and found[entry][0].is_outside:  # where it leaves, nothing enters
            band = found[entry][1]
            left_at = {other for other in found if other != entry and band[entries == other].mean() > MOSTLY}
            found = {other: kept for other, kept in found.items() if other not in left_at}
    return [outline for outline, _ in found.values()]


def _band(mask: U8, start: U8) -> U8 | None:
    """Return the part of a region that lies straight ahead of an entry; None: no direction can be told."""
    middles, widths, _ = _midline(mask, start)
    if len(middles) < FEWEST:
        return None
    usual = float(np.median(widths[1:FEWEST]))
    wider = np.nonzero(widths[FEWEST:] > WIDER * usual)[0]
    clean = middles[1 : FEWEST + int(wider[0]) if len(wider) else None]
    direction, middle, _ = _line(clean, np.ones(len(clean)), usual)
    rows, columns = np.nonzero(mask)
    aside = (columns - middle[0]) * direction[1] - (rows - middle[1]) * direction[0]
    band = np.zeros_like(mask)
    near = np.abs(aside) <= BAND * usual + 1
    band[rows[near], columns[near]] = 1
    _, labels = cv2.connectedComponents(band)
    at_start = labels[(start & band) > 0]
    return np.asarray(labels == np.bincount(at_start).argmax()).view(np.uint8) if len(at_start) else None


def _of_band(mask: U8, start: U8, edge: U8, alone: bool) -> Outline | None:
    middles, widths, reached = _midline(mask, start)
    if len(middles) < FEWEST:
        return None
    # The longest part that ends at the far end and is straight.
    for first in range(len(middles) - FEWEST + 1):
        part, weights = middles[first:], widths[first:]
        width = float(weights.max())
        direction, middle, off = _line(part, weights, STRAIGHT * width + 1)
        if weights[off].sum() <= SIDEWAYS * weights.sum():
            break
    rows, columns, steps = reached[:, reached[2] > reached[2, -1] - max(3 * BIN, width)]
    away = np.stack([columns, rows], -1) - middle
    reach = float((away @ direction).max()) + 0.5
    end = steps > steps[-1] - 3 * BIN
    spread = float(np.abs(away[end] @ np.array([direction[1], -direction[0]])).max())
    far = middle + reach * direction
    back = middle + direction * float((middles[first] - middle) @ direction)
    last = steps > steps[-1] - 2
    at_edge = (edge[rows[last], columns[last]] > 0).any()
    is_outside = bool(at_edge or np.linalg.norm(far - back) < SHORTEST * width)
    return Outline(far, back, part[~off][::-1], weights[~off][::-1], spread, is_outside, alone)


def _midline(mask: U8, start: U8) -> tuple[F64, F64, I32]:
    """Middles [K, 2] (u v) and widths [K] (px) of the bins of distance from the start within a mask, and all
    pixels that are reached, [3, N]: row, column, steps."""
    reached = np.stack(geodesic(mask, start & mask))
    if reached.size == 0:
        return np.zeros((0, 2)), np.zeros(0), reached
    rows, columns, steps = reached
    bins = (steps - 1) // BIN
    counts = np.maximum(np.bincount(bins), 1)
    middles = np.stack([np.bincount(bins, places) / counts for places in (columns, rows)], -1)
    return middles, counts / BIN, reached


@kernel
def geodesic(inside: U8, start: U8) -> tuple[I32, I32, I32]:
    """Return row, column and steps from the start, each [K], of all pixels reached; the nearest first.

    Every other step goes to four neighbours, the others to eight: so the fronts are octagons, nearly round
    (Rosenfeld and Pfaltz, 1968, "Distance functions on digital images").

    Args:
        inside, start: [h, w] 1: where a way may lead, and where it begins (all of it inside), with step 1.
    """
    height, width = inside.shape
    rows, columns = np.empty(inside.size, np.int32), np.empty(inside.size, np.int32)
    steps, left = np.empty(inside.size, np.int32), inside.copy()
    count = 0
    for y in range(height):
        for x in range(width):
            if start[y, x]:
                rows[count], columns[count], steps[count] = y, x, 1
                left[y, x] = 0
                count += 1
    older, old, step = 0, 0, 1  # where the last two fronts begin: a corner may be reached a step later
    while old < count:
        end = count
        for i in range(older, end):
            for dy in range(-1, 2):
                for dx in range(-1, 2):
                    y, x = rows[i] + dy, columns[i] + dx
                    if step % 2 == 1 and dy != 0 and dx != 0:
                        continue
                    if 0 <= y < height and 0 <= x < width and left[y, x]:
                        rows[count], columns[count], steps[count] = y, x, step + 1
                        left[y, x] = 0
                        count += 1
        older, old, step = old, end, step + 1
    return rows[:count], columns[:count], steps[:count]


def _line(points: F64, weights: F64, tolerance: float) -> tuple[F64, F64, Bool]:
    """The line fitted to points [K, 2] by iterated least squares: its direction [2] in the points' order, its
    middle [2], and the outliers, which are farther off than the tolerance and hardly count."""
    off = np.zeros(len(points), np.bool_)
    for _ in range(FITS):
        share = np.where(off, 1e-3, 1.0) * weights
        middle = share @ points / share.sum()
        direction = np.linalg.svd((points - middle) * np.sqrt(share)[:, None])[2][0]
        off = np.abs((points - middle) @ np.array([direction[1], -direction[0]])) > tolerance
    forward = 1.0 if direction @ (points[-1] - points[0]) >= 0 else -1.0
    return forward * direction, middle, off
