"""Parts of a picture in which depth errs in different ways."""

from __future__ import annotations

import cv2
import numpy as np

from sags_node.types import F32, Bool

STEP = 2.0  # px of disparity over `AROUND`: an edge of the depth, or a slope that is hard to match
AROUND = 21  # px, a window's side
BESIDE = 30 / 640  # of the width, from an instrument or what else is no tissue


def regions_of(truth: F32, tissue: Bool, focal_baseline: float) -> dict[str, Bool]:
    """Masks [H, W] of pixels that are tissue and have a true depth, by name.

    "near" and "far" are the thirds of them with the least and the greatest depth. The next three may overlap,
    "elsewhere" is what is in none of them.

    Args:
        truth: [H, W] m, 0 unknown.
        focal_baseline: px m, of this picture.
    """
    comparable = tissue & (truth > 0)
    if not comparable.any():
        return {}
    disparity = np.divide(focal_baseline, truth, out=np.zeros_like(truth), where=truth > 0)
    nearest, farthest = np.percentile(truth[comparable], [100 / 3, 200 / 3])
    window = np.ones((AROUND, AROUND), np.uint8)
    lowest = cv2.erode(np.where(truth > 0, disparity, np.inf).astype(np.float32), window)
    edges = cv2.dilate(disparity, window) - lowest > STEP
    side = 2 * round(BESIDE * truth.shape[1]) + 1
    beside = cv2.erode(tissue.view(np.uint8), np.ones((side, side), np.uint8)) == 0
    unseen = np.arange(truth.shape[1]) < disparity
    masks = {
        "near": truth <= nearest,
        "far": truth > farthest,
        "at edges": edges,
        "beside instruments": beside,
        "not seen by the right eye": unseen,
        "elsewhere": ~(edges | beside | unseen),
    }
    return {name: np.asarray(comparable & mask, np.bool_) for name, mask in masks.items()}
