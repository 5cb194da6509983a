"""How well a patch of the left picture agrees with patches of the right one."""

from __future__ import annotations

import numpy as np

from sags_node.kernels.jit import kernel
from sags_node.types import F32, F64, U8

FLAT = 1.0  # grey levels^4, of patches in which nothing is seen
HALF_SEEN = 127  # of a mask


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
