"""Whether anything moved."""

from typing import Any

import numpy as np

from sags_node.kernels.jit import kernel
from sags_node.types import F32, F64, U8, RectifiedPair
from sags_node.vision.pyramid import BORDER, level, pyramids

HALVINGS = 3  # 8x8 px are averaged: camera noise up to 4 grey levels stays below the limit
SIDE = 32  # px of a block: the length over which something moves or does not
BLOCK = SIDE >> HALVINGS  # shrunk px
LARGEST_DIFFERENCE = 1.0  # grey levels, mean over a block
LARGEST_SHARE = 0.005  # of the blocks may differ more: a highlight flickers
EVERY = 4  # px between the pixels that `is_repeat` compares
# Largest RMS difference of an image sent twice, grey levels. Over all: below a codec's noise (PSNR > 52 dB).
# In each block: below that of a shift by half a pixel (median 3 to 5). D4D's repeat has 1.5.
REPEAT_RMS, REPEAT_BLOCK_RMS = 0.6, 2.0


class StillScene:
    """Compares images with those of the last frame in which something moved, not with the frame before:
    slow motion adds up and is seen."""

    def __init__(self) -> None:
        self._eyes: list[F32] | None = None
        self._pose: F64 = np.eye(4)
        self._frames = 0

    def forget(self) -> None:
        """Take the next frame for one in which something moved."""
        self._eyes = None

    def __call__(self, pair: RectifiedPair) -> int:
        """Return for how many frames in a row, this one included, images and pose have stayed the same;
        0: something moved."""
        eyes = [level(eye, min(HALVINGS, len(eye.halves))) for eye in pyramids(pair) if eye is not None]
        before, pose = self._eyes, pair.camera.T_world_cam
        stays = np.array_equal(pose, self._pose)
        if stays and before is not None and len(before) == len(eyes) and all(map(_alike, eyes, before)):
            self._frames += 1
        else:
            self._eyes, self._pose, self._frames = eyes, pose, 0
        return self._frames


def _alike(a: F32, b: F32) -> bool:
    return bool(_share_that_differs(a, b) <= LARGEST_SHARE)


@kernel
def _share_that_differs(a: F32, b: F32) -> Any:
    """The share of blocks in which two images (with borders) differ."""
    height, width = a.shape[0] - 2 * BORDER, a.shape[1] - 2 * BORDER
    rows, columns = max(1, height // BLOCK), max(1, width // BLOCK)  # the last ones take the rest
    sums, counts = np.zeros((rows, columns), np.float32), np.zeros((rows, columns), np.float32)
    for y in range(height):
        row = min(y // BLOCK, rows - 1)
        for x in range(width):
            column = min(x // BLOCK, columns - 1)
            sums[row, column] += abs(a[BORDER + y, BORDER + x] - b[BORDER + y, BORDER + x])
            counts[row, column] += 1
    return np.mean(sums > np.float32(LARGEST_DIFFERENCE) * counts)


def is_repeat(a: RectifiedPair, b: RectifiedPair) -> bool:
    """Tell whether two pairs show the same images, one pair sent twice. Unlike in a `StillScene`, nothing
    is averaged before, for a camera's noise tells its images apart; and no block may differ, for something
    small may have moved."""
    return all(
        _are_same(x.full, y.full)
        for x, y in zip(pyramids(a), pyramids(b), strict=True)
        if x is not None and y is not None
    )


def _are_same(a: U8, b: U8) -> bool:
    mean, largest = _mean_squares(a, b)
    return bool(mean < REPEAT_RMS**2 and largest < REPEAT_BLOCK_RMS**2)


@kernel
def _mean_squares(a: U8, b: U8) -> Any:
    """The mean squared difference over every fourth pixel of every fourth row: of the whole image, and the
    largest of a block."""
    height, width = a.shape
    rows, columns = max(1, height // SIDE), max(1, width // SIDE)  # the last ones take the rest
    squares, counts = np.zeros((rows, columns), np.int64), np.zeros((rows, columns), np.int64)
    for y in range(0, height, EVERY):
        row = min(y // SIDE, rows - 1)
        for x in range(0, width, EVERY):
            column = min(x // SIDE, columns - 1)
            difference = np.int64(a[y, x]) - np.int64(b[y, x])
            squares[row, column] += difference * difference
            counts[row, column] += 1
    return squares.sum() / counts.sum(), (squares / counts).max()
