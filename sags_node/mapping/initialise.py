"""New Gaussians from pixels and depth: already a good picture without any optimisation."""

from __future__ import annotations

from typing import Any

import numpy as np

from sags_node.geometry import unproject
from sags_node.kernels.jit import kernel
from sags_node.model.alias_free import smoothing_variances
from sags_node.model.gaussians import GaussianModel
from sags_node.types import F32, I32, Observation

SCALE_PER_SPACING = 0.4  # of the distance between neighbours; measured best (0.3-0.5), 0.8 loses 4 dB
LEAST_SIZE = 0.8  # px: the filters take so much opacity from smaller ones that the first pictures have gaps
FLATNESS = 0.5  # the extent along the ray against the extent across it
OPACITY = 0.9
LEAST_SHARE = 0.3  # of the drawn scale that is left when the 3D filter's share is taken off
INITIAL_SHARE = 0.75  # of the cap used by the first frame; the rest is for what appears later


def insert(
    model: GaussianModel, observation: Observation, pixels: I32, z: F32, spacing: float, smoothing: bool
) -> slice:
    """Add one Gaussian for each pixel [M, 2] (x, y), coloured by the picture, at depth `z` [M] m.

    Args:
        spacing: px between neighbouring pixels of the list; it sets the scales as they are drawn.
        smoothing: give them the 3D filter.

    Returns:
        The new rows of the model.
    """
    x, y = pixels[:, 0], pixels[:, 1]
    camera = observation.camera
    across = max(SCALE_PER_SPACING * spacing, LEAST_SIZE) * z / np.float32(camera.K[0, 0])
    scales = np.stack([across, across, FLATNESS * across], 1).astype(np.float32)
    means = unproject(camera, pixels.astype(np.float32), z).astype(np.float32)
    variances = smoothing_variances(means, [camera]) if smoothing else np.zeros(len(means), np.float32)
    scales = np.sqrt(np.maximum(scales**2 - variances[:, None], (LEAST_SHARE * scales) ** 2))
    rows = model.append(means, scales, observation.image[y, x], OPACITY)
    model.smoothing[rows] = variances[: rows.stop - rows.start]
    return rows


def first_pixels(observation: Observation, limit: int) -> tuple[I32, F32, float]:
    """A regular grid of at most about `limit` tissue pixels: pixels [M, 2], depths [M] m, spacing px.

    Pixels without depth take that of others in their row or column; without any they are left out.
    """
    tissue = observation.tissue
    spacing = max(1.0, float(np.sqrt(np.count_nonzero(tissue) / limit)))
    height, width = tissue.shape
    ys = np.arange(0.5 * (spacing - 1), height - 0.5, spacing)
    xs = np.arange(0.5 * (spacing - 1), width - 0.5, spacing)
    x, y = np.meshgrid(np.rint(xs).astype(np.int32), np.rint(ys).astype(np.int32))
    pixels = np.stack([x[tissue[y, x]], y[tissue[y, x]]], 1)
    depths = _depths_at(observation.depth, pixels)
    known = depths > 0
    return pixels[known], depths[known], spacing


@kernel
def _depths_at(depth: F32, pixels: I32) -> F32:
    depths = np.empty(len(pixels), np.float32)
    for i in range(len(pixels)):
        depths[i] = nearest_depth(depth, pixels[i, 0], pixels[i, 1])
    return depths


@kernel
def nearest_depth(depth: F32, x: int, y: int) -> Any:
    """Depth [H, W] at a pixel, else of the nearest known pixels in its row and column the farthest, else 0.

    Depth is missing beside what stands in front: where the other eye sees past an edge, and around
    instruments. What is seen there belongs to the surface behind.
    """
    if depth[y, x] > 0:
        return depth[y, x]
    height, width = depth.shape
    farthest = np.float32(0)
    for side in range(4):
        dx, dy = (1, 0) if side == 0 else (-1, 0) if side == 1 else (0, 1) if side == 2 else (0, -1)
        u, v = x + dx, y + dy
        while u >= 0 and v >= 0 and u < width and v < height:
            if depth[v, u] > 0:
                farthest = max(farthest, depth[v, u])
                break
            u += dx
            v += dy
    return farthest
