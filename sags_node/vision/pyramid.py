"""Gray pyramids, made once a frame for all that compares images: stereo, optical flow, and the test whether
anything moved. A half is a level of half the size of the one before."""

from typing import Any

import cv2
import numpy as np

from sags_node.kernels.jit import kernel
from sags_node.types import F32, U8, GrayPyramid, Observation, RectifiedPair

BORDER = 16  # px around every half: so far outside the image a patch may lie
SMALLEST_SIDE = 16  # px of the last half: two patches of the inverse search
NARROW = 60  # px, least width of the largest half in a `narrowed` pyramid


def gray_pyramid(picture: U8) -> GrayPyramid:
    """Make the gray pyramid of an RGB image [H, W, 3] or a gray one [H, W]."""
    gray: U8 = cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY) if picture.ndim == 3 else picture
    height, width = gray.shape
    halves: list[F32] = []
    for _ in range(level_count(width, height)):
        height, width = height // 2, width // 2
        half = np.empty((height + 2 * BORDER, width + 2 * BORDER), np.float32)
        if halves:
            _halve_inner(halves[-1], half)
        else:
            _halve(gray, half)
        halves.append(half)
    return GrayPyramid(gray, tuple(halves))


def pyramids(pair: RectifiedPair) -> tuple[GrayPyramid, GrayPyramid | None]:
    """Return the pyramids of the left and the right image: those that came with the pair, else new ones."""
    if pair.gray is not None:
        return pair.gray
    return gray_pyramid(pair.left), None if pair.right is None else gray_pyramid(pair.right)


def pyramid_of(observation: Observation) -> GrayPyramid:
    """Return the pyramid of an observation's gray image: the one that came with it, or else a new one."""
    pyramid = observation.pyramid
    made = pyramid is not None and pyramid.full is observation.gray  # another image may have been put in
    return pyramid if pyramid is not None and made else gray_pyramid(observation.gray)


def level_count(width: int, height: int) -> int:
    """Return how many halves an image of this size has: at least one."""
    count = 1
    while min(width, height) >> count >= 2 * SMALLEST_SIDE:
        count += 1
    return count


def with_border(gray: U8) -> F32:
    """Return the whole image [H, W] in the form of a half, with a border."""
    return np.asarray(
        cv2.copyMakeBorder(gray, BORDER, BORDER, BORDER, BORDER, cv2.BORDER_REPLICATE), np.float32
    )


def level(pyramid: GrayPyramid, halvings: int) -> F32:
    """Return the image after so many halvings, with its border."""
    return pyramid.halves[halvings - 1] if halvings > 0 else with_border(pyramid.full)


def inner(bordered: F32) -> F32:
    """Return a view of an image without its border."""
    return bordered[BORDER:-BORDER, BORDER:-BORDER]


def narrowed(pyramid: GrayPyramid) -> GrayPyramid:
    """Drop the halves before the smallest that is at least `NARROW` wide: motion in the rest costs little."""
    wide = [k for k, half in enumerate(pyramid.halves) if inner(half).shape[1] >= NARROW]
    return GrayPyramid(pyramid.full, pyramid.halves[max(wide, default=0) :])


@kernel
def _halve(picture: U8, half: F32) -> None:
    """Means of 2x2 px. An odd last row or column is left out: so every half has exactly half the scale."""
    for y in range(half.shape[0] - 2 * BORDER):
        _mean_row(picture[2 * y], picture[2 * y + 1], half[y + BORDER])
    _repeat_edges(half)


@kernel
def _halve_inner(picture: F32, half: F32) -> None:
    for y in range(half.shape[0] - 2 * BORDER):
        upper, lower = picture[2 * y + BORDER], picture[2 * y + 1 + BORDER]
        _mean_row(upper[BORDER:], lower[BORDER:], half[y + BORDER])
    _repeat_edges(half)


@kernel
def _mean_row(upper: Any, lower: Any, row: F32) -> None:
    quarter, two, one, border = np.float32(0.25), np.uint64(2), np.uint64(1), np.uint64(BORDER)
    for i in range(row.size - 2 * BORDER):
        x = np.uint64(i)
        total = (
            np.float32(upper[two * x]) + np.float32(upper[two * x + one])
            + (np.float32(lower[two * x]) + np.float32(lower[two * x + one]))
        )  # fmt: skip
        row[x + border] = quarter * total


@kernel
def _repeat_edges(half: F32) -> None:
    height, width = half.shape
    for y in range(BORDER, height - BORDER):
        half[y, :BORDER] = half[y, BORDER]
        half[y, width - BORDER :] = half[y, width - BORDER - 1]
    for y in range(BORDER):
        half[y] = half[BORDER]
        half[height - 1 - y] = half[height - 1 - BORDER]
