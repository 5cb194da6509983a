"""What a drawn right view is compared with: the left picture, warped by depth."""

from __future__ import annotations

import cv2
import numpy as np

from sags_node.kernels.jit import kernel
from sags_node.types import F32, Bool

LARGEST_STEP = 1.0  # px of disparity between neighbours of one surface: steeper ones the right eye cannot see


def warp_to_right(left: F32, depth: F32, focal_px: float, baseline: float) -> tuple[F32, Bool]:
    """The left picture as the right eye would see it, and where that is known.

    Neighbouring left pixels of nearly one disparity span the surface between them; the nearest surface hides
    the others. What no surface covers stays unknown.

    Args:
        left: [H, W, 3] rectified.
        depth: [H, W] m, of the left picture, 0 unknown.
        focal_px: of the rectified pair.
        baseline: m.

    Returns:
        The picture [H, W, 3] (0 where unknown) and the mask [H, W].
    """
    disparity = np.divide(np.float32(focal_px * baseline), depth, out=np.zeros_like(depth), where=depth > 0)
    columns = _left_columns(disparity)
    known: Bool = columns >= 0
    rows = np.broadcast_to(np.arange(depth.shape[0], dtype=np.float32)[:, None], depth.shape)
    warped: F32 = cv2.remap(left, columns, rows.copy(), cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    return np.where(known[..., None], warped, np.float32(0)), known


@kernel
def _left_columns(disparity: F32) -> F32:
    """The left column that each right pixel shows, -1 unknown, [H, W]."""
    height, width = disparity.shape
    columns = np.full((height, width), np.float32(-1))
    for y in range(height):
        nearest = np.zeros(width, np.float32)  # disparity of what each right pixel shows so far
        for x in range(width - 1):
            here, beside = disparity[y, x], disparity[y, x + 1]
            if here <= 0 or beside <= 0 or abs(beside - here) >= LARGEST_STEP:
                continue
            start, end = x - here, x + 1 - beside  # start < end: the step is below one pixel
            for column in range(max(0, int(np.ceil(start))), min(width - 1, int(np.floor(end))) + 1):
                share = (column - start) / (end - start)
                between = here + share * (beside - here)
                if between > nearest[column]:
                    nearest[column] = between
                    columns[y, column] = x + share
    return columns
