"""What the right eye's picture says of the model."""

from __future__ import annotations

import numpy as np

from sags_node.engine.losses.tissue import tissue_loss
from sags_node.mapping.exposure import exposure_gain
from sags_node.types import F32, Bool, Observation

FAR_MARGIN = 0.1  # of the disparity, below the furthest tissue drawn
NEAR_MARGIN = 0.5  # of the disparity, above the nearest: instruments come in between tissue and camera
WEIGHT = 0.3  # of a right pixel against a left one; see benchmarks/mapping.md
EVERY = 4  # px: enough to know the range of depths


def right_eye_loss(planes: F32, observation: Observation, v_planes: F32, weight: F32) -> None:
    """Loss of the right eye's picture, and its gradient.

    Both eyes see one model: their gradients are added in one step. Each eye has its own gain in each channel,
    and the right one counts less, since what shines looks different from there. Its depth is not measured.

    Args:
        planes: [2, 5, H, W] of the rasteriser, left and right.
        observation: with the right eye's picture.
        v_planes: [5, H, W] written.
        weight: [H, W] written, as the losses of the engine do.
    """
    image, (left, right) = observation.right, planes
    assert image is not None
    coverage = left[4, ::EVERY, ::EVERY]
    depth = np.zeros_like(coverage)
    np.divide(left[3, ::EVERY, ::EVERY], coverage, out=depth, where=coverage > 0.5)
    known = depth[observation.tissue[::EVERY, ::EVERY] & (depth > 0)]
    focal_px = float(observation.camera.K[0, 0])
    mask = right_eye_mask(observation.tissue, known, focal_px, observation.baseline)
    gain = exposure_gain(right, image, mask)
    nothing = np.zeros(mask.shape, np.float32)
    tissue_loss(right, image / gain, mask, nothing, v_planes, weight, 0.0, 1.0)
    v_planes *= np.float32(WEIGHT)
    weight *= np.float32(WEIGHT)


def right_eye_mask(tissue: Bool, depths: F32, focal_px: float, baseline: float) -> Bool:
    """The right eye's pixels that show tissue for certain, without having looked at the right picture.

    A pixel is kept when every disparity that tissue and instruments can have (1st to 99th percentile of the
    drawn depth, widened by `FAR_MARGIN` and `NEAR_MARGIN`) takes it to a tissue pixel of the left picture. A
    mask made by warping with the depth itself would be wrong where the depth is wrong, on the shafts above
    all, and let the instrument in.

    Args:
        tissue: [H, W] of the left picture.
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
