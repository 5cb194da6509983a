"""Which pixels of the right eye show tissue."""

import numpy as np

from sags_node.types import F32, Bool

FAR_MARGIN = 0.1  # of the disparity, below the furthest tissue drawn
COARSE = 4  # px: the error of a mask this coarse is within the margins
NEAR_MARGIN = 0.5  # of the disparity, above the nearest: instruments come in between tissue and camera


def right_eye_mask(tissue: Bool, depths: F32, focal_px: float, baseline: float) -> Bool:
    """The right eye's pixels that show tissue for certain, without having looked at the right image.

    A pixel is kept when every disparity that tissue and instruments can have (1st to 99th percentile of the
    drawn depth, widened by `FAR_MARGIN` and `NEAR_MARGIN`) takes it to a tissue pixel of the left image. A
    mask made by warping with the depth itself would be wrong where the depth is wrong, on the shafts above
    all, and let the instrument in.

    Args:
        tissue: [H, W] of the left image.
        depths: [M] m, of tissue as it is drawn for the left eye.
        focal_px: of the rectified pair.
        baseline: m.
    """
    if depths.size == 0:
        return np.zeros_like(tissue)
    near, far = np.percentile(depths, [1, 99])
    lowest = int(np.floor(focal_px * baseline / far * (1 - FAR_MARGIN)))
    highest = int(np.ceil(focal_px * baseline / near * (1 + NEAR_MARGIN)))
    height, width = tissue.shape
    mask = np.zeros_like(tissue)
    columns = width - highest  # further right, the left eye does not see all of the range
    if columns <= 0:
        return mask
    others = np.zeros((height, width + 1), np.int32)  # non-tissue pixels left of each column
    np.cumsum(~tissue, axis=1, out=others[:, 1:])
    mask[:, :columns] = others[:, highest + 1 : highest + 1 + columns] == others[:, lowest : lowest + columns]
    return mask


def coarse_right_eye_mask(tissue: Bool, depth: F32, focal_px: float, baseline: float) -> Bool:
    """The `right_eye_mask` of every `COARSE`-th pixel along both axes, [h, w].

    Args:
        depth: [H, W] m, as it is drawn for the left eye; 0 unknown.
    """
    tissue = tissue[::COARSE, ::COARSE]
    known = depth[:: 2 * COARSE, :: 2 * COARSE][tissue[::2, ::2]]
    return right_eye_mask(tissue, known[known > 0], focal_px / COARSE, baseline)
