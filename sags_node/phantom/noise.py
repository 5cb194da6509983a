"""Smooth random images, from which shapes and colours are made."""

import cv2
import numpy as np

from sags_node.types import F32


def fractal_noise(rng: np.random.Generator, shape: tuple[int, int], cell: float, octaves: int) -> F32:
    """Return value noise [rows, cols] with about zero mean and unit standard deviation.

    `cell` is the size in pixels of the coarsest bumps; every further octave halves size and strength.
    """
    total = np.zeros(shape, np.float32)
    power = 0.0
    for octave in range(octaves):
        size = cell / 2**octave
        coarse = rng.standard_normal((int(shape[0] / size) + 4, int(shape[1] / size) + 4), dtype=np.float32)
        zoom = np.array([[1 / size, 0, 1.5], [0, 1 / size, 1.5]], np.float32)
        layer = cv2.warpAffine(
            coarse,
            zoom,
            shape[::-1],
            flags=cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP,
            borderMode=cv2.BORDER_REFLECT,
        )
        total += 0.5**octave * layer
        power += 0.25**octave * 0.45  # cubic interpolation of unit noise keeps about 0.45 of its variance
    return total / np.float32(np.sqrt(power))
