"""The camera's gain from one frame to the next."""

from __future__ import annotations

import numpy as np

from sags_node.types import F32, Bool

EVERY = 8  # px
COVERED = 0.5
DARK, BRIGHT = 0.05, 0.95  # beyond, a pixel tells noise or saturation
LEAST_PIXELS = 50
LARGEST = 1.5  # a larger change within one frame is another scene, not another exposure


def exposure_gain(planes: F32, image: F32, tissue: Bool) -> F32:
    """Factor [3] by which a picture is brighter than the model, for each channel.

    An endoscope's exposure follows what comes near, and all colours change at once; taking that as one gain
    spares the model to learn it Gaussian by Gaussian. The median does not see highlights and what is new.

    Args:
        planes: [5, H, W] of the rasteriser, drawn for that picture.
        image: [H, W, 3] RGB 0..1.
        tissue: [H, W] where to compare.
    """
    image = image[::EVERY, ::EVERY]
    coverage = planes[4, ::EVERY, ::EVERY]
    used = tissue[::EVERY, ::EVERY] & (coverage > COVERED)
    seen = image[used]
    drawn = planes[:3, ::EVERY, ::EVERY][:, used].T / coverage[used, None]
    fair = ((seen > DARK) & (seen < BRIGHT) & (drawn > DARK) & (drawn < BRIGHT)).all(-1)
    if np.count_nonzero(fair) < LEAST_PIXELS:
        return np.ones(3, np.float32)
    gain: F32 = np.median(seen[fair] / drawn[fair], axis=0).astype(np.float32)
    return gain.clip(1 / LARGEST, LARGEST)
