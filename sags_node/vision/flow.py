"""Optical flow between consecutive pictures."""

from __future__ import annotations

import numpy as np

from sags_node.types import F32, GrayPyramid
from sags_node.vision import inverse_search

STEPS = 4  # of a patch
COARSE_STRIDE = 4  # px, of patches in all but the largest of the pictures


class OpticalFlow:
    """Inverse search from small pictures to those of half the size, without refinement: whoever asks takes
    means over many places anyway. Costs nothing to make."""

    def __init__(self, stride: int) -> None:
        """`stride`: px between patches in the pictures of half the size, at most 8."""
        self._stride = stride

    def __call__(
        self, before: GrayPyramid, after: GrayPyramid, shift: tuple[float, float] = (0.0, 0.0)
    ) -> F32:
        """Flow [H // 2, W // 2, 2], in px of the whole pictures, from `before` to `after`.

        Args:
            shift: px right and down, from where to search.
        """
        field = np.array([[shift]], np.float32) / np.float32(2 ** (len(before.halves) + 1))
        stride = COARSE_STRIDE
        for k in reversed(range(len(before.halves))):
            first, second = before.halves[k], after.halves[k]
            coarse, stride = stride, self._stride if k == 0 else COARSE_STRIDE
            field = inverse_search.start(first, stride, field, coarse, inverse_search.CENTRE, 2)
            field = inverse_search.search(first, second, stride, field, STEPS)
        flow = inverse_search.at_pixels(before.halves[0], after.halves[0], stride, field)
        flow *= np.float32(2)
        return flow
