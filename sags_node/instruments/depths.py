"""How far away an instrument is: patches along its midline, found again in the right picture.

A shaft is smooth, black or mirrors, so one patch alone is often wrong. But along a straight instrument the
inverse depth, and so the disparity, is linear in the picture: of all such lines the one is taken that most
patches agree with.
"""

from typing import NamedTuple

import cv2
import numpy as np

from sags_node.instruments.outlines import Outline
from sags_node.kernels.jit import kernel, read_only
from sags_node.types import F32, F64, I64, U8, Bool

PATCHES = 12
FEWEST = 4  # that agree
RADIUS = (7, 24)  # px, of a patch: half of the instrument's width, and what is beside it
SAMPLES = 7  # to each side of the middle, at least as many
BESIDE = 0.3  # of its width
MARGIN = 3  # px of what lies around it, whose edge tells where it is
COARSE = 2.0  # px, of the disparities that are tried
FINE = 3  # px around the line that is found
REFINED = 2  # times
FITS = 8
TILT = 0.3  # of its disparity: by so much it usually changes along what is seen of an instrument
CORE = 0.15  # of the width, around the midline, that is instrument where it is not between jaws
AGREES = 0.6  # zero-mean normalised cross-correlation (ZNCC) from which on a patch counts
LEAST_SPREAD = 0.25  # px, of the patches around their line: fewer would be chance
BIAS = 0.3  # px, of each end: what lies behind an edge, and a mirror, moves a patch
FLAT = 1.0  # grey levels^4, of patches in which nothing is seen
HALF_SEEN = 127  # of a mask


class Disparities(NamedTuple):
    """Along an instrument, px, and how sure they are."""

    tip_and_back: F64  # [2]
    covariance: F64  # [2, 2]


class Eyes(NamedTuple):
    """What is compared."""

    left: U8  # [H, W] gray
    right: U8  # [H, W] gray
    tools: U8  # [H, W] 255: instrument
    counts: U8  # [H, W] 255: what shows an instrument or lies close beside it
    row_error: float  # px, by which the right picture is too low


def eyes(left: U8, right: U8, tools: Bool, row_error: float) -> Eyes:
    """Both gray pictures [H, W], and the instruments [H, W] in the left one."""
    around = np.ones((2 * MARGIN + 1, 2 * MARGIN + 1), np.uint8)
    shown = tools.view(np.uint8) * np.uint8(255)
    return Eyes(read_only(left), read_only(right), shown, cv2.dilate(shown, around), float(row_error))


def disparities(seen: Eyes, outline: Outline, limits: tuple[float, float]) -> Disparities | None:
    """The disparities of an instrument; None: too few patches agree.

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
    """Tell whether there is instrument around a place of the midline: not between open jaws."""
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
    """Fill a patch [n, n] around a place, bilinear; beyond the picture its edge goes on."""
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
    """Zero-mean normalised cross-correlation (ZNCC) [D] with the patches at disparities [D] that are tried;
    -1: beyond the right picture.

    Args:
        left, right: gray pictures [H, W].
        counts: [H, W] 255: what is compared of the left patch.
        u, v: its middle, px; row_error: by so much the right picture is too low.
        radius, every: every so many rows and columns of so many px around the middle are compared.
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
    """Which [2] of the disparities tried, at the tip and at the back, most patches [S, D] agree with."""
    count = scores.shape[1]
    tip, back = np.meshgrid(np.arange(count), np.arange(count), indexing="ij")
    total = np.zeros((count, count), np.float32)
    for place, row in zip(places, np.maximum(scores, 0), strict=True):
        total += row[np.clip(np.rint((1 - place) * tip + place * back), 0, count - 1).astype(np.intp)]
    return np.array(np.unravel_index(int(np.argmax(total)), total.shape))


def _vertices(scores: F32, best: I64) -> tuple[F64, F64]:
    """The vertices of the parabola through the best score and both beside it: the place of its vertex from
    the best, and how sharp it is [S]."""
    rows = np.arange(len(best))
    before, middle, after = (scores[rows, best + step].astype(np.float64) for step in (-1, 0, 1))
    bend = np.maximum(2 * middle - before - after, 1e-6)
    return (after - before) / (2 * bend), bend


def _fitted(places: F64, found: F64, sharpness: F64) -> tuple[F64, F64]:
    """The line (at the tip, at the back) through disparities [S], and its covariance [2, 2] (px^2)."""
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
