"""What a snapshot says of a moment and of an eye that the mapper never saw."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sags_node.types import F32, Bool, Gaussians, Snapshot

VELOCITY_SHARE = 0.8  # tissue slows down: less than the last velocity predicts best (0.3 to 0.7 dB over none)
FAR_MARGIN = 0.1  # of the disparity, below the furthest tissue drawn
NEAR_MARGIN = 0.5  # of the disparity, above the nearest: instruments come in between tissue and camera


def extrapolated(snapshot: Snapshot, seconds: float) -> Gaussians:
    """The Gaussians `seconds` after the snapshot, by 0.8 times their last observed velocity."""
    means = snapshot.gaussians.means + snapshot.velocities * np.float32(VELOCITY_SHARE * seconds)
    return replace(snapshot.gaussians, means=means)


def right_eye_mask(tissue: Bool, depth: F32, focal_px: float, baseline: float) -> Bool:
    """The right eye's pixels that show tissue for certain, without having looked at the right picture.

    A pixel is kept when every disparity that tissue and instruments can have (1st to 99th percentile of the
    drawn depth, widened by `FAR_MARGIN` and `NEAR_MARGIN`) takes it to a tissue pixel of the left picture. A
    mask made by warping with the depth itself would be wrong where the depth is wrong, on the shafts above
    all, and let the instrument into the figure.

    Args:
        tissue: [H, W] of the left picture.
        depth: [H, W] m, drawn for the left eye, 0 unknown.
        focal_px: of the rectified pair.
        baseline: m.
    """
    known = depth[tissue & (depth > 0)]
    if known.size == 0:
        return np.zeros_like(tissue)
    near, far = np.percentile(known, [1, 99])
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
