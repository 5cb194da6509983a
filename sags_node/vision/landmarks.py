"""Features of an image that are recognised in another one, however far they moved.

Oriented binary features (Rublee et al., "ORB: an efficient alternative to SIFT or SURF", ICCV 2011), matched
where the best is clearly better than the second (Lowe, IJCV 2004). Landmarks are features of tissue that are
found again: they tell a scene that was lost from sight from another one. Tissue bends, so there is no common
motion to vote for: a match counts if it moves as those around it do.
"""

from typing import NamedTuple

import cv2
import numpy as np

from sags_node.types import F32, I64, U8, Bool, GrayPyramid
from sags_node.vision.pyramid import inner

RATIO = 0.8  # of the distance to the second best match
WIDTH = 360  # px, at most, of the image in which they are looked for
COUNT = 600  # features of an image
FAST_THRESHOLD = 5  # grey levels: tissue is smooth, and smoke takes contrast away
LARGEST_TURN = 40.0  # degrees by which a match may turn
FARTHEST = 0.3  # of the width, which a match may move
AROUND = 5  # matches nearby, whose median motion a match must follow
APART = 0.03  # of the width, by which it may differ from that motion
# Of 600: the same tissue after up to two seconds of pulling, veiled, or covered by six tenths, has 12 to 390
# such matches; other tissue, and the same turned or mirrored, up to 3.
FEWEST = 8
CELLS = 16  # across the image, of a field of motion
NEAREST = 4  # matches that tell the motion of a cell


class Features(NamedTuple):
    """What can be recognised in an image."""

    places: F32  # [F, 2] px
    angles: F32  # [F] degrees
    codes: U8  # [F, 32] ORB
    width: int  # px of the whole image


class Landmarks(NamedTuple):
    """Places in two images."""

    before: F32  # [K, 2] px of the whole image
    after: F32  # [K, 2]


def features_in(gray: U8, where: Bool | None, count: int, fast_threshold: int) -> Features:
    """Find at most `count` features of an image [H, W], where `where` [H, W] is True (None: everywhere).

    Args:
        fast_threshold: grey levels by which a corner differs from what surrounds it.
    """
    mask = None if where is None else where.view(np.uint8)
    points, codes = cv2.ORB.create(count, fastThreshold=fast_threshold).detectAndCompute(gray, mask)
    places = np.array([point.pt for point in points], np.float32).reshape(-1, 2)
    angles = np.array([point.angle for point in points], np.float32)
    codes = np.zeros((0, 32), np.uint8) if codes is None else np.asarray(codes, np.uint8)
    return Features(places, angles, codes, gray.shape[1])


def matched(before: Features, after: Features) -> tuple[I64, I64]:
    """Return the rows [K] in both images' features of the pairs that clearly look alike."""
    none = np.zeros(0, np.int64)
    if min(len(before.codes), len(after.codes)) < 2:
        return none, none
    pairs = cv2.BFMatcher(cv2.NORM_HAMMING).knnMatch(before.codes, after.codes, 2)
    clear = [pair[0] for pair in pairs if len(pair) == 2 and pair[0].distance < RATIO * pair[1].distance]
    rows = np.array([(match.queryIdx, match.trainIdx) for match in clear], np.int64).reshape(-1, 2)
    return rows[:, 0], rows[:, 1]


def features_of(pyramid: GrayPyramid, tissue: Bool | None = None) -> Features:
    """Find features of an image, px of the whole one, where `tissue` [H, W] is True (None: everywhere)."""
    halves = [inner(half) for half in pyramid.halves]
    small = next((half for half in halves if half.shape[1] <= WIDTH), halves[-1]).astype(np.uint8)
    width = pyramid.full.shape[1]
    mask = None
    if tissue is not None:
        resized = cv2.resize(tissue.view(np.uint8), small.shape[::-1], interpolation=cv2.INTER_NEAREST)
        mask = resized.view(np.bool_)
    found = features_in(small, mask, COUNT, FAST_THRESHOLD)
    # The middle of the first pixel is at 0 in both sizes.
    places = (found.places + np.float32(0.5)) * np.float32(width / small.shape[1]) - np.float32(0.5)
    return found._replace(places=places, width=width)


def find_again(before: GrayPyramid, after: GrayPyramid, tissue: Bool) -> Landmarks | None:
    """Find landmarks of the earlier image in the later one; None: so few that it may be another scene.

    Args:
        tissue: [H, W] of the earlier image.
    """
    first, second = features_of(before, tissue), features_of(after)
    if min(len(first.places), len(second.places)) < FEWEST:
        return None
    a, b = matched(first, second)
    start, end, turns = first.places[a], second.places[b], second.angles[b] - first.angles[a]
    near = np.hypot(*(end - start).T) < FARTHEST * first.width
    near &= np.abs((turns + 180) % 360 - 180) < LARGEST_TURN
    start, end = start[near], end[near]
    agreed = agreeing(start, end, APART * first.width)
    if np.count_nonzero(agreed) < FEWEST:
        return None
    return Landmarks(start[agreed], end[agreed])


def motion(start: F32, end: F32, width: int, height: int) -> F32:
    """Return the motion from places [K, 2] to others [K, 2] as a field [rows, CELLS, 2] (px) of square cells
    over an image: in each cell the mean of the nearest motions, weighted by nearness."""
    side = width / CELLS
    columns, rows = (
        np.arange(count) * side + (side - 1) / 2 for count in (CELLS, max(1, round(height / side)))
    )
    cells = np.stack(np.meshgrid(columns, rows), 2).astype(np.float32)
    squares = np.square(cells[:, :, None] - start).sum(3) + np.float32(side**2)
    nearest = np.argpartition(squares, min(NEAREST, len(start)) - 1, axis=2)[..., :NEAREST]
    weights = 1 / np.take_along_axis(squares, nearest, 2)[..., None]
    field: F32 = (weights * (end - start)[nearest]).sum(2) / weights.sum(2)
    return field


def agreeing(start: F32, end: F32, apart: float) -> Bool:
    """Tell which matches from places [K, 2] to others [K, 2] move like those around them, to `apart` px."""
    if len(start) <= AROUND:
        return np.zeros(len(start), np.bool_)
    moves = end - start
    squares = np.square(start[:, None] - start[None, :]).sum(2)
    np.fill_diagonal(squares, np.inf)
    around = np.argpartition(squares, AROUND - 1, axis=1)[:, :AROUND]
    agrees: Bool = np.hypot(*(moves - np.median(moves[around], axis=1)).T) < apart
    return agrees
