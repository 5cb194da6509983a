"""How well the rows of one rectified pair agree, measured with care and without hurry."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np

from sags_node.types import U8, Bool
from sags_node.vision.inverse_search import at_pixels, centres
from sags_node.vision.matchers import InverseSearch, Patches
from sags_node.vision.pyramid import gray_pyramid
from sags_node.vision.stereo import FULL_SIZE_BELOW

FEWEST_KNOWN = 0.1  # of the patches
FOUND_BACK = 0.7  # px


class RowError(NamedTuple):
    """Distances between rows of a rectified pair, px of the full pictures."""

    median: float
    p90: float
    matched: float  # share of the picture, 0..1


def measure_rows(left: U8, right: U8, smallest: float, largest: float) -> RowError | None:
    """Row errors all over a rectified pair [H, W, 3] (RGB); None where next to nothing matches.

    Args:
        smallest, largest: disparities to search, px.
    """
    halvings = 1 if left.shape[1] >= FULL_SIZE_BELOW else 0
    match = InverseSearch(smallest / 2**halvings, largest / 2**halvings, halvings)
    found = match(gray_pyramid(left), gray_pyramid(right))
    mirrored = match(*(gray_pyramid(np.ascontiguousarray(eye[:, ::-1])) for eye in (right, left)))
    known = found.good & _found_back(found, mirrored)
    if np.mean(known) < FEWEST_KNOWN:
        return None
    errors = np.abs(found.field[..., 1][known]) * 2**halvings
    median, p90 = np.percentile(errors, [50, 90])
    return RowError(float(median), float(p90), float(np.mean(known)))


def _found_back(found: Patches, mirrored: Patches) -> Bool:
    """Find where the match of a left patch is matched back to it: anything is matched to something."""
    flow = at_pixels(mirrored.left, mirrored.right, mirrored.stride, mirrored.field)
    back = np.ascontiguousarray(flow[:, ::-1])  # to the right in the mirror is to the left
    columns, rows = centres(found.left, found.stride)
    there = columns + found.field[..., 0], rows + found.field[..., 1]
    x, y = (cv2.remap(back[..., k], *there, cv2.INTER_LINEAR, borderValue=np.inf) for k in (0, 1))
    near: Bool = np.hypot(x - found.field[..., 0], y + found.field[..., 1]) < FOUND_BACK
    return near
