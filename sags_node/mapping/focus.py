"""Where in the image another refinement step pays most."""

from typing import Any

import cv2
import numpy as np
from numba import prange

from sags_node.engine.losses.pieces import LEVEL
from sags_node.engine.losses.tissue import COVERED
from sags_node.engine.rasterizer.compositing import TILE_HEIGHT, TILE_WIDTH
from sags_node.kernels.jit import kernel, parallel_kernel
from sags_node.types import F32, I32, U8, Bool

EVERY = 2  # px between pixels that are compared: a quarter of them is enough
REACH = 32  # px: few Gaussians are larger, and those are faint out there


def largest(residuals: F32, share: float) -> Bool:
    """The tiles [rows, columns] of an image with the largest squared colour residuals.

    PSNR counts squared residuals, and most of their sum lies in few tiles: a step on a sixth of the image
    gains half of what a step on all of it does.

    Args:
        residuals: [rows, columns] of `sum_residuals`.
        share: of all tiles, 0..1; at least one is chosen.
    """
    chosen = np.zeros(residuals.shape, np.bool_)
    count = max(1, round(share * residuals.size))
    chosen.ravel()[np.argpartition(residuals.ravel(), -count)[-count:]] = True
    return chosen


def tile_grid(mask: Bool) -> Bool:
    """The rasteriser's tiles [rows, columns] of an image as large as `mask` [H, W]; none is chosen."""
    height, width = mask.shape
    return np.zeros((-(-height // TILE_HEIGHT), -(-width // TILE_WIDTH)), np.bool_)


def tiles_of(pixels: I32, mask: Bool) -> Bool:
    """The tiles [rows, columns] of an image as large as `mask` in which the pixels [M, 2] (x, y) lie."""
    tiles = tile_grid(mask)
    tiles[pixels[:, 1] // TILE_HEIGHT, pixels[:, 0] // TILE_WIDTH] = True
    return tiles


def with_neighbours(tiles: Bool) -> Bool:
    """The tiles [rows, columns] and those less than `REACH` px away: a Gaussian may reach into them."""
    rows, columns = -(-REACH // TILE_HEIGHT), -(-REACH // TILE_WIDTH)
    window = np.ones((2 * rows + 1, 2 * columns + 1), np.uint8)
    grown: U8 = cv2.dilate(tiles.view(np.uint8), window)
    return grown.view(np.bool_)


@parallel_kernel
def sum_residuals(
    planes: F32,  # [5, H, W]
    image: U8,  # [H, W, 3]
    tissue: Bool,  # [H, W]
    tiles: Bool,  # [rows, columns] which to sum
    sums: F32,  # [rows, columns] squared colour residuals, written for those tiles
) -> None:
    for row in prange(sums.shape[0]):
        _sum_row(planes, image, tissue, tiles, sums, np.int64(row))


@kernel
def _sum_row(planes: F32, image: U8, tissue: Bool, tiles: Bool, sums: F32, row: Any) -> None:
    height, width = tissue.shape
    for column in range(sums.shape[1]):
        if tiles[row, column]:
            sums[row, column] = np.float32(0)
    for y in range(row * TILE_HEIGHT, min((row + 1) * TILE_HEIGHT, height), EVERY):
        for x in range(0, width, EVERY):
            if not tiles[row, x // TILE_WIDTH]:
                continue
            coverage = planes[4, y, x]
            if tissue[y, x] and coverage > COVERED:
                for k in range(3):
                    residual = planes[k, y, x] / coverage - np.float32(image[y, x, k]) * LEVEL
                    if abs(residual) < np.float32(1):
                        sums[row, x // TILE_WIDTH] += residual * residual
