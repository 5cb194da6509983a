"""Stereo matching of rectified gray images, at one level of their pyramids (`pyramid`)."""

from typing import NamedTuple

import cv2
import numpy as np

from sags_node.types import F32, Bool, GrayPyramid
from sags_node.vision.coarse_stereo import coarse_disparity
from sags_node.vision.inverse_search import CENTRE, search, start
from sags_node.vision.pyramid import level

PATCH_STRIDE = 4  # px between patches of 8 px
COARSE_STRIDE = 4  # px between them in images smaller than the last
SEARCH_STEPS = 3  # of a patch's search, at most
WINDOW = 5  # patches: the window over which row errors are averaged and median disparities taken
SMALL_WIDTH = 320  # px: a smaller whole image is searched at half of its size, because of its noise
GUESS_WIDTH = 120  # px, largest width of the image in which a guess is made
LARGEST_ROW_ERROR = 2.0  # px
LARGEST_ROW_STEP = 0.35  # px from the mean row error around
LARGEST_STEP = 1.5  # px from the median disparity around: a wrong match stands alone
MOST_ALONE = 0.35  # of the patches around: where more stand alone, none is right
TETHER = 0.7  # of the texture along rows: how firmly a patch is held to that mean


class Patches(NamedTuple):
    """Where patches of the left image lie in the right one; see `inverse_search`."""

    left: F32  # the images they were searched in, with their borders
    right: F32
    stride: int  # px from patch to patch
    field: F32  # [rows, columns, 2] px to the right, which is minus the disparity, and down, the row error
    good: Bool  # [rows, columns] the match is like those of the patches around


def match_patches(
    left: GrayPyramid, right: GrayPyramid, disparities: tuple[float, float], halvings: int
) -> Patches:
    """Match patches by inverse search, from a guess in a small image up to the one wanted.

    On the smooth surface of organs it is more accurate than semi-global matching in less time, but it only
    refines a guess that is right to a few pixels. The guess is made afresh for every frame: it costs little,
    and there is no memory that could lock in an error.

    Args:
        disparities: the smallest and the largest to search, px of the matching image.
        halvings: of the matching image.
    """
    finest = halvings
    if finest == 0 and left.full.shape[1] < SMALL_WIDTH and left.halves:
        finest = 1
    field, good = _find(left, right, disparities, halvings, finest)
    pictures = level(left, halvings), level(right, halvings)
    if finest > halvings:
        both = np.dstack([field, good.astype(np.float32) / 2])
        both = start(pictures[0], PATCH_STRIDE, both, PATCH_STRIDE, CENTRE, 2)
        field, good = np.ascontiguousarray(both[..., :2]), both[..., 2] > 0.5
    return Patches(*pictures, PATCH_STRIDE, field, good)


def _find(
    left: GrayPyramid, right: GrayPyramid, disparities: tuple[float, float], halvings: int, finest: int
) -> tuple[F32, Bool]:
    """The field and `good` of the patches of the image after `finest` halvings."""
    top = finest
    while top < len(left.halves) and left.full.shape[1] >> top > GUESS_WIDTH:
        top += 1
    smallest, largest = (disparity / 2 ** (top - halvings) for disparity in disparities)
    guess = coarse_disparity(level(left, top), level(right, top), smallest, largest)
    field, stride, corner, k = np.stack([-guess, np.zeros_like(guess)], -1), 1, 0.0, top
    while k > finest + 1 or stride == 1:
        scale = 2 if k > finest else 1
        k = max(k - 1, finest)
        pictures = level(left, k), level(right, k)
        field = start(pictures[0], COARSE_STRIDE, field, stride, corner, scale)
        for _ in range(2):  # the second time places spread from the right and from below
            field = search(*pictures, COARSE_STRIDE, field, SEARCH_STEPS)
        stride, corner = COARSE_STRIDE, CENTRE
    # Calibrations are off by a row or so, smoothly over the image. A wrong match jumps to another row.
    scale = 2 if k > finest else 1
    limit = LARGEST_ROW_ERROR / scale
    rows = cv2.blur(np.clip(field[..., 1], -limit, limit), (WINDOW, WINDOW))
    pictures = level(left, finest), level(right, finest)
    begin = start(pictures[0], PATCH_STRIDE, np.dstack([field, rows]), stride, corner, scale)
    field = search(*pictures, PATCH_STRIDE, begin, SEARCH_STEPS, TETHER)
    down, rows = field[..., 1], begin[..., 2]
    good = (np.abs(down - rows) < LARGEST_ROW_STEP) & (np.abs(down) < LARGEST_ROW_ERROR)
    across = np.ascontiguousarray(field[..., 0])
    around = cv2.medianBlur(across, WINDOW)
    alone = np.abs(across - around) > LARGEST_STEP
    field[..., 0] = np.where(alone, around, across)
    good &= cv2.blur(alone.astype(np.float32), (WINDOW, WINDOW)) < MOST_ALONE
    return field, good
