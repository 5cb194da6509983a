"""New Gaussians from pixels and depth: already a good image without any optimisation."""

import math
from typing import Any

import numpy as np

from sags_node.engine.losses.pieces import LEVEL
from sags_node.geometry import unproject
from sags_node.kernels.jit import kernel
from sags_node.model.alias_free import smoothing_variances
from sags_node.model.gaussians import GaussianModel
from sags_node.types import F32, I32, Observation
from sags_node.vision.depth_grid import depth_at, grid_of

SCALE_PER_SPACING = 0.4  # of the distance between neighbours; measured best (0.3-0.5), 0.8 loses 4 dB
FILTERED = 0.45  # px, in quadrature: else the filters make small Gaussians so faint that gaps are left
FLATNESS = 0.5  # the extent along the ray against the extent across it
OPACITY = 0.9
LEAST_SHARE = 0.3  # of the drawn scale: at least so much is left without the 3D filter's share
LARGEST_ERROR = 0.05  # m of depth: predicted errors are capped here
INITIAL_SHARE = 0.75  # of the cap used by the first frame; the rest is for what appears later


def insert(
    model: GaussianModel,
    observation: Observation,
    pixels: I32,
    z: F32,
    errors: F32,
    spacing: float,
    smoothing: bool,
) -> slice:
    """Add one Gaussian for each pixel [M, 2] (x, y), coloured by the image, at depth `z` [M] m.

    Args:
        errors: [M] m, predicted, of the depths; infinite: unknown, then the median of the model's is taken.
        spacing: px between neighbouring pixels of the list; it sets the scales as they are drawn.
        smoothing: give them the 3D filter.

    Returns:
        The new rows of the model.
    """
    x, y = pixels[:, 0], pixels[:, 1]
    camera = observation.camera
    across = math.hypot(SCALE_PER_SPACING * spacing, FILTERED) * z / np.float32(camera.K[0, 0])
    scales = np.stack([across, across, FLATNESS * across], 1).astype(np.float32)
    means = unproject(camera, pixels.astype(np.float32), z).astype(np.float32)
    variances = smoothing_variances(means, [camera]) if smoothing else np.zeros(len(means), np.float32)
    scales = np.sqrt(np.maximum(scales**2 - variances[:, None], (LEAST_SHARE * scales) ** 2))
    rows = model.append(means, scales, observation.image[y, x] * LEVEL, OPACITY)
    model.smoothing[rows] = variances[: rows.stop - rows.start]
    added = errors[: rows.stop - rows.start]
    unknown = ~np.isfinite(added)
    if unknown.any():
        known = model.depth_errors[: rows.start]
        added = np.where(unknown, np.median(known) if len(known) else LARGEST_ERROR, added)
    model.depth_errors[rows] = added
    return rows


def first_pixels(observation: Observation, limit: int) -> tuple[I32, F32, F32, float]:
    """A regular grid of at most about `limit` tissue pixels: pixels [M, 2], depths and their predicted errors
    [M] m, spacing px.

    Pixels without depth borrow it from around; where there is none to borrow, they are left out.
    """
    tissue = observation.tissue
    spacing = max(1.0, float(np.sqrt(np.count_nonzero(tissue) / limit)))
    height, width = tissue.shape
    ys = np.arange(0.5 * (spacing - 1), height - 0.5, spacing)
    xs = np.arange(0.5 * (spacing - 1), width - 0.5, spacing)
    x, y = np.meshgrid(np.rint(xs).astype(np.int32), np.rint(ys).astype(np.int32))
    pixels = np.stack([x[tissue[y, x]], y[tissue[y, x]]], 1)
    grid = grid_of(observation)
    depths, errors = np.empty((2, len(pixels)), np.float32)
    _depths_at(observation.depth, grid.inverse, grid.error, np.float32(grid.side), pixels, depths, errors)
    known = depths > 0
    return pixels[known], depths[known], errors[known], spacing


@kernel
def _depths_at(
    depth: F32, inverse: F32, error: F32, side: Any, pixels: I32, depths: F32, errors: F32
) -> None:
    for i in range(len(pixels)):
        depths[i], errors[i] = depth_at(depth, inverse, error, side, pixels[i, 0], pixels[i, 1])
