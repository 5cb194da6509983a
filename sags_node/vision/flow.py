"""Optical flow between consecutive images."""

import numpy as np

from sags_node.types import F32, GrayPyramid
from sags_node.vision import inverse_search
from sags_node.vision.pyramid import inner

STEPS = 4  # of a patch's search, at most
COARSE_STRIDE = 4  # px between patches in all but the largest image


class OpticalFlow:
    """Inverse search from small images up to those of half the size. There is no refinement: callers
    average over many places anyway. Making one costs nothing."""

    def __init__(self, stride: int) -> None:
        """`stride`: px between patches in the images of half the size, at most 8."""
        self._stride = stride

    def __call__(self, before: GrayPyramid, after: GrayPyramid, guess: F32 | None = None) -> F32:
        """Estimate the flow [H // 2, W // 2, 2], in px of the whole images, from `before` to `after`.

        Args:
            guess: [rows, columns, 2] px, motion in square cells over the image, from which to search;
                None: no motion.
        """
        guess = np.zeros((1, 1, 2), np.float32) if guess is None else guess
        scale = 0.5 ** (len(before.halves) + 1)
        field = guess * np.float32(scale)
        spacing = scale * 2 * inner(before.halves[0]).shape[1] / guess.shape[1]
        corner = (spacing - 1) / 2
        for k in reversed(range(len(before.halves))):
            first, second = before.halves[k], after.halves[k]
            stride = self._stride if k == 0 else COARSE_STRIDE
            field = inverse_search.start(first, stride, field, spacing, corner, 2)
            field = inverse_search.search(first, second, stride, field, STEPS)
            spacing, corner = float(stride), inverse_search.CENTRE
        flow = inverse_search.at_pixels(before.halves[0], after.halves[0], self._stride, field)
        flow *= np.float32(2)
        return flow
