"""How far away an instrument is: patches along its midline, found again in the right image.

A shaft is smooth, and black or reflecting, so one patch alone is often wrong. But along a straight instrument
the inverse depth, and so the disparity, is linear in the image: of all such lines the one is taken with
which most patches agree.
"""

from typing import NamedTuple

import cv2
import numpy as np

from sags_node.instruments.outlines import Outline
from sags_node.kernels.jit import kernel, read_only
from sags_node.types import F32, F64, I64, U8, Bool

PATCHES = 12  # along a midline, at most
FEWEST = 4  # patches that must agree
RADIUS = (7, 24)  # px, smallest and largest radius of a patch
SAMPLES = 7  # to each side of a patch's middle, at most; twice as many in the fine search
BESIDE = 0.3  # of the instrument's width, which a patch covers to each side of it
MARGIN = 3  # px around an instrument that are compared, too: its edge tells where it is
COARSE = 2.0  # px between the disparities of the coarse search
FINE = 3  # px to each side of the line that the fine search covers
REFINED = 2  # fine searches
FITS = 8  # iterations of a line's fit
TILT = 0.3  # of the disparity: its usual change along the visible part of an instrument
CORE = 0.15  # of the width: half the side of the square that must be instrument, not a gap between jaws
AGREES = 0.6  # zero-mean normalised cross-correlation (ZNCC) from which on a patch counts
LEAST_SPREAD = 0.25  # px, smallest scatter of the patches around their line: less would be chance
BIAS = 0.3  # px, error of each end that all patches share: background behind edges and reflections shift them
FLAT = 1.0  # grey levels^4: floor of the product of two variances, for patches without structure
HALF_SEEN = 127  # of 255: a mask's pixel above it counts


class Disparities(NamedTuple):
    """The disparities at both ends of an instrument (px), and their covariance (px^2)."""

    tip_and_back: F64  # [2]
    covariance: F64  # [2, 2]


class Eyes(NamedTuple):
    """The images in which disparities are measured."""

    left: U8  # [H, W] gray
    right: U8  # [H, W] gray
    tools: U8  # [H, W] 255: instrument
    counts: U8  # [H, W] 255: what shows an instrument or lies close beside it
    row_error: float  # px by which the right image is too low


def eyes(left: U8, right: U8, tools: Bool, row_error: float) -> Eyes:
    """Prepare both gray images [H, W] and the instruments [H, W] in the left one for `disparities`."""
    around = np.ones((2 * MARGIN + 1, 2 * MARGIN + 1), np.uint8)
    shown = tools.view(np.uint8) * np.uint8(255)
    return Eyes(read_only(left), read_only(right), shown, cv2.dilate(shown, around), float(row_error))


def disparities(seen: Eyes, outline: Outline, limits: tuple[float, float]) -> Disparities | None:
    """Measure the disparities of an instrument; None: too few patches agree.

    Args:
        limits: the smallest and the largest disparity, px.
    """
    way = outline.back - outline.far
    chosen = np.linspace(0, len(outline.middles) - 1, min(PATCHES, len(outline.middles))).astype(np.intp)
    centres, widths = outline.middles[chosen], outline.widths[chosen]
    places = (centres - outline.far) @ way / (way @ way)
    radii = np.clip(np.rint((0.5 + BESIDE) * widths), *RADIUS).astype(int)
    solid = [_is_solid(seen.tools, c, w) for c, w in zip(centres, widths, strict=True)]
    places, centres, radii = places[solid], centres[solid], radii[solid]
    if len(places) < FEWEST:
        return None
    tried = np.arange(limits[0], limits[1] + COARSE, COARSE)
    patches = zip(centres, radii, strict=True)
    scores = np.stack([_scores(seen, c, r, tried, every=1 + r // SAMPLES) for c, r in patches])
    line = tried[_best_line(scores, places)]
    covariance = np.zeros((2, 2))
    for _ in range(REFINED):
        fine = np.arange(-FINE, FINE + 1.0)
        at = (1 - places) * line[0] + places * line[1]
        around = zip(centres, radii, at, strict=True)
        scores = np.stack([_scores(seen, c, r, d + fine, every=1 + r // (2 * SAMPLES)) for c, r, d in around])
        best = scores.argmax(1)
        good = (best > 0) & (best < 2 * FINE) & (scores.max(1) >= AGREES)
        if np.count_nonzero(good) < FEWEST:
            return None
        offsets, sharpness = _vertices(scores[good], best[good])
        line, covariance = _fitted(places[good], at[good] + fine[best[good]] + offsets, sharpness)
    return Disparities(line, covariance + BIAS**2 * np.eye(2))


def _is_solid(tools: U8, centre: F64, width: float) -> bool:
    """Tell whether a place of the midline lies on the instrument, not between open jaws."""
    side = 2 * round(CORE * width) + 1
    core = cv2.getRectSubPix(tools, (side, side), (float(centre[0]), float(centre[1])))
    return float(core.mean()) > 127


def _scores(seen: Eyes, centre: F64, radius: int, tried: F64, every: int) -> F32:
    u, v = float(centre[0]), float(centre[1])
    return agreements(
        seen.left, seen.right, seen.counts, u, v, seen.row_error, int(radius), int(every), tried
    )


@kernel
def _taken(picture: U8, u: float, v: float, radius: int, every: int, patch: F64) -> None:
    """Fill a patch [n, n] around a place, bilinear; beyond the image its edge is repeated."""
    height, width = picture.shape
    column, row = int(np.floor(u)), int(np.floor(v))
    fx, fy = u - column, v - row
    for i in range(len(patch)):
        y = row - radius + i * every
        above, below = min(max(y, 0), height - 1), min(max(y + 1, 0), height - 1)
        for j in range(len(patch)):
            x = column - radius + j * every
            before, after = min(max(x, 0), width - 1), min(max(x + 1, 0), width - 1)
            upper = (1 - fx) * picture[above, before] + fx * picture[above, after]
            lower = (1 - fx) * picture[below, before] + fx * picture[below, after]
            patch[i, j] = (1 - fy) * upper + fy * lower


@kernel
def agreements(
    left: U8, right: U8, counts: U8, u: float, v: float, row_error: float, radius: int, every: int, tried: F64
) -> F32:
    """Return the zero-mean normalised cross-correlation (ZNCC) [D] of a left patch with the right ones at the
    disparities `tried` [D]; -1: beyond the right image.

    Args:
        left, right: gray images [H, W].
        counts: [H, W] 255: what is compared of the left patch.
        u, v: its middle, px; row_error: px by which the right image is too low.
        radius, every: half the side of the patch, and the step between the rows and columns compared, px.
    """
    side = 2 * radius // every + 1
    patch, there, share = np.empty((side, side)), np.empty((side, side)), np.empty((side, side))
    _taken(counts, u, v, radius, every, share)
    share = np.where(share > HALF_SEEN, 1.0, 0.0)
    share /= max(1.0, share.sum())
    _taken(left, u, v, radius, every, patch)
    patch -= (patch * share).sum()
    own = (patch * patch * share).sum()
    found = np.full(len(tried), -1, np.float32)
    for i in range(len(tried)):
        at = u - tried[i]
        if at - radius >= 0 and at - radius + (side - 1) * every <= right.shape[1] - 1:
            _taken(right, at, v + row_error, radius, every, there)
            there -= (there * share).sum()
            other = (there * there * share).sum()
            found[i] = (patch * there * share).sum() / np.sqrt(max(own * other, FLAT))
    return found


def _best_line(scores: F32, places: F64) -> I64:
    """The line with the best sum of scores [S, D]: the indices [2] of its disparities at tip and back."""
    count = scores.shape[1]
    tip, back = np.meshgrid(np.arange(count), np.arange(count), indexing="ij")
    total = np.zeros((count, count), np.float32)
    for place, row in zip(places, np.maximum(scores, 0), strict=True):
        total += row[np.clip(np.rint((1 - place) * tip + place * back), 0, count - 1).astype(np.intp)]
    return np.array(np.unravel_index(int(np.argmax(total)), total.shape))


def _vertices(scores: F32, best: I64) -> tuple[F64, F64]:
    """For each patch [S], the parabola through the best score and both beside it: the offset of its vertex
    from the best, and how sharp it is."""
    rows = np.arange(len(best))
    before, middle, after = (scores[rows, best + step].astype(np.float64) for step in (-1, 0, 1))
    bend = np.maximum(2 * middle - before - after, 1e-6)
    return (after - before) / (2 * bend), bend


def _fitted(places: F64, found: F64, sharpness: F64) -> tuple[F64, F64]:
    """The line fitted to disparities [S] (its values at tip and back), and its covariance [2, 2] (px^2)."""
    ways = np.stack([1 - places, places], -1)
    level, scale = np.array([[1.0, -1.0], [-1.0, 1.0]]), LEAST_SPREAD
    known = sharpness / sharpness.max()
    weights = known
    for _ in range(FITS):
        normal = ways.T @ (weights[:, None] * ways) + level * (scale / (TILT * found.mean())) ** 2
        line = np.linalg.solve(normal, ways.T @ (weights * found))
        off = np.sqrt(known) * (found - ways @ line)
        scale = max(LEAST_SPREAD, 1.4826 * float(np.median(np.abs(off))))
        weights = known / (1 + (off / (2 * scale)) ** 2)  # Cauchy's
    return line, np.linalg.inv(normal) * scale**2
