"""The camera's gain from one frame to the next."""

from typing import Any

import numpy as np

from sags_node.engine.losses.pieces import LEVEL
from sags_node.kernels.jit import kernel
from sags_node.types import F32, U8, Bool

EVERY = 8  # px between pixels that are compared
COVERED = 0.5  # coverage above which a pixel is compared
DARK, BRIGHT = 0.05, 0.95  # of full scale: beyond, a pixel shows noise or saturation
LEAST_PIXELS = 50  # with fewer, the gain is 1
LARGEST = 1.5  # a larger change within one frame is another scene, not another exposure


def exposure_gain(planes: F32, image: U8, tissue: Bool) -> F32:
    """The factor [3] by which an image is brighter than the model, for each channel.

    An endoscope's exposure follows what comes near, and all colours change at once. With one gain for that,
    the model need not learn it Gaussian by Gaussian. The median ignores highlights and new tissue.

    Args:
        planes: [5, H, W] of the rasteriser, drawn for that image.
        image: [H, W, 3] RGB.
        tissue: [H, W] where to compare.
    """
    most = -(-tissue.shape[0] // EVERY) * -(-tissue.shape[1] // EVERY)
    ratios = np.empty((3, most), np.float32)
    count = _ratios(planes, image, tissue, ratios)
    if count < LEAST_PIXELS:
        return np.ones(3, np.float32)
    gain: F32 = np.median(ratios[:, :count], axis=1).astype(np.float32)
    return gain.clip(1 / LARGEST, LARGEST)


@kernel
def _ratios(planes: F32, image: U8, tissue: Bool, ratios: F32) -> Any:
    """Write the ratios [3, M] of image to model at fair pixels of a grid; returns how many there are."""
    height, width = tissue.shape
    dark, bright = np.float32(DARK), np.float32(BRIGHT)
    n = 0
    for y in range(0, height, EVERY):
        for x in range(0, width, EVERY):
            coverage = planes[4, y, x]
            if not (tissue[y, x] and coverage > np.float32(COVERED)):
                continue
            fair: Any = True
            for c in range(3):
                seen, drawn = np.float32(image[y, x, c]) * LEVEL, planes[c, y, x] / coverage
                fair = fair and seen > dark and seen < bright and drawn > dark and drawn < bright
                ratios[c, n] = seen / drawn
            if fair:
                n += 1
    return n
