"""New Gaussians from pixels and depth: already a good picture without any optimisation."""

from __future__ import annotations

import cv2
import numpy as np

from sags_node.geometry import unproject
from sags_node.model.gaussians import GaussianModel
from sags_node.types import F32, I32, Observation

SCALE_PER_SPACING = 0.4  # of the distance between neighbours; measured best (0.3-0.5), 0.8 loses 4 dB
FLATNESS = 0.5  # the extent along the ray against the extent across it
OPACITY = 0.9
INITIAL_SHARE = 0.75  # of the cap used by the first frame; the rest is for what appears later


def insert(model: GaussianModel, observation: Observation, pixels: I32, z: F32, spacing: float) -> slice:
    """Add one Gaussian for each pixel [M, 2] (x, y), coloured by the picture, at depth `z` [M] m.

    Args:
        spacing: px between neighbouring pixels of the list; it sets the scales.

    Returns:
        The new rows of the model.
    """
    x, y = pixels[:, 0], pixels[:, 1]
    camera = observation.camera
    across = SCALE_PER_SPACING * spacing * z / np.float32(camera.K[0, 0])
    scales = np.stack([across, across, FLATNESS * across], 1).astype(np.float32)
    means = unproject(camera, pixels.astype(np.float32), z).astype(np.float32)
    return model.append(means, scales, observation.image[y, x], OPACITY)


def first_pixels(observation: Observation, depth: F32, limit: int) -> tuple[I32, float]:
    """A regular grid of at most about `limit` tissue pixels with depth: pixels [M, 2] and their spacing."""
    usable = observation.tissue & (depth > 0)
    spacing = max(1.0, float(np.sqrt(np.count_nonzero(usable) / limit)))
    height, width = usable.shape
    ys = np.arange(0.5 * (spacing - 1), height - 0.5, spacing)
    xs = np.arange(0.5 * (spacing - 1), width - 0.5, spacing)
    x, y = np.meshgrid(np.rint(xs).astype(np.int32), np.rint(ys).astype(np.int32))
    chosen = usable[y, x]
    return np.stack([x[chosen], y[chosen]], 1), spacing


def filled_depth(observation: Observation) -> F32:
    """Depth [H, W] with its unknown pixels filled from around them (push-pull: coarse levels fill fine ones).

    For the first frame only: a model without holes needs a guess where stereo had none.
    """
    depths = [observation.depth]
    weights = [(observation.depth > 0).astype(np.float32)]
    while min(depths[-1].shape) > 4:
        size = (depths[-1].shape[1] // 2, depths[-1].shape[0] // 2)
        weight = cv2.resize(weights[-1], size, interpolation=cv2.INTER_AREA)
        total = cv2.resize(depths[-1] * weights[-1], size, interpolation=cv2.INTER_AREA)
        depths.append(total / np.maximum(weight, 1e-6))
        weights.append((weight > 0).astype(np.float32))
    filled = depths[-1]
    for depth, weight in zip(depths[-2::-1], weights[-2::-1], strict=True):
        coarse = cv2.resize(filled, depth.shape[::-1], interpolation=cv2.INTER_LINEAR)
        filled = np.where(weight > 0, depth, coarse)
    return filled.astype(np.float32)
