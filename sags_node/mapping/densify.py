"""Where Gaussians are added and which are removed. N stays under its cap."""

from __future__ import annotations

import numpy as np
from numba import prange

from sags_node.engine.jit import kernel, parallel_kernel
from sags_node.geometry import project
from sags_node.mapping.initialise import nearest_depth
from sags_node.model.gaussians import GaussianModel
from sags_node.types import F32, I32, Bool, Camera, Observation

HOLE_ALPHA = 0.4  # below this a tissue pixel is a hole; 0.8 would count the gaps between small Gaussians
RESIDUAL_NEW_SURFACE = 0.2  # summed over RGB: with a surface in front of the model, content is new
RESIDUAL_DETAIL = 0.45  # summed over RGB: with the right depth, detail is missing
DEPTH_TOLERANCE = 0.035  # of the depth
GRID = 4  # px between candidates
MAX_INSERTED = 1500  # per frame: a budget, and a brake on runaway insertion
FRONT_TOLERANCE = 0.065  # of the depth: so far in front of the measured surface is free space
FRONT_FRAMES = 3  # in a row, since stereo is wrong now and then
MIN_OPACITY = 0.03
CROWDED = 0.9  # share of the cap above which what left the view is given up


def candidates(planes: F32, observation: Observation, phase: int) -> tuple[I32, F32]:
    """Pixels [M, 2] (x, y) that want a Gaussian, and their depths [M] m: holes, then new surfaces, then
    missing detail.

    A hole beside an instrument or in the strip that one eye does not see has no depth of its own; it takes
    that of the nearest pixel in its row or column that has one.

    Args:
        planes: [5, H, W] of the rasteriser: sums of w*rgb, w*z, w.
        phase: shifts the candidate grid, so that every pixel has its turn over the frames.
    """
    pixels = np.empty((MAX_INSERTED, 2), np.int32)
    depths = np.empty(MAX_INSERTED, np.float32)
    count = _candidates(
        planes, observation.image, observation.tissue, observation.depth, phase % GRID, pixels, depths
    )
    return pixels[:count], depths[:count]


def free_space_violations(model: GaussianModel, observation: Observation) -> None:
    """Count the frames in a row that saw the surface well behind each Gaussian (updates `in_front`)."""
    pixels, depths = project(observation.camera, model.means)
    _count_in_front(pixels, depths, observation.tissue, observation.depth, model.in_front)


def doomed(model: GaussianModel, camera: Camera) -> Bool:
    """[N] what to remove: in free space, transparent, not finite, or out of view when N nears its cap."""
    remove: Bool = (model.in_front >= FRONT_FRAMES) | (model.opacities < MIN_OPACITY)
    remove |= ~np.isfinite(model.means).all(1) | ~np.isfinite(model.colors).all(1)
    if model.count > CROWDED * model.capacity:
        pixels, _ = project(camera, model.means)
        margin = 0.06 * camera.width
        size = np.array([camera.width, camera.height])
        remove |= ~((pixels > -margin) & (pixels < size + margin)).all(1)
    return remove


@kernel
def _candidates(
    planes: F32, image: F32, tissue: Bool, depth: F32, phase: int, pixels: I32, depths: F32
) -> int:
    height, width = tissue.shape
    n = 0
    for rank in range(3):
        for y in range(phase, height, GRID):
            for x in range(phase, width, GRID):
                if not tissue[y, x]:
                    continue
                z = depth[y, x]
                alpha = planes[4, y, x]
                if alpha < HOLE_ALPHA:
                    if z <= 0 and rank == 0:
                        z = nearest_depth(depth, x, y)
                    wanted = rank == 0 and z > 0
                elif rank == 0 or z <= 0:
                    wanted = False
                else:
                    residual = np.float32(0)
                    for c in range(3):
                        residual += abs(planes[c, y, x] / alpha - image[y, x, c])
                    behind = planes[3, y, x] / alpha - z
                    if rank == 1:
                        wanted = residual > RESIDUAL_NEW_SURFACE and behind > 2 * DEPTH_TOLERANCE * z
                    else:
                        wanted = residual > RESIDUAL_DETAIL and abs(behind) < DEPTH_TOLERANCE * z
                if wanted:
                    if n == len(pixels):
                        return n
                    pixels[n, 0] = x
                    pixels[n, 1] = y
                    depths[n] = z
                    n += 1
    return n


@parallel_kernel
def _count_in_front(pixels: F32, depths: F32, tissue: Bool, depth: F32, in_front: I32) -> None:
    height, width = tissue.shape
    for i in prange(len(depths)):
        u, v = pixels[i, 0], pixels[i, 1]
        if not (u > -0.5 and v > -0.5 and u < width - 0.5 and v < height - 0.5):
            continue
        x, y = int(u + 0.5), int(v + 0.5)
        if tissue[y, x] and depth[y, x] > 0:
            if depth[y, x] - depths[i] > FRONT_TOLERANCE * depth[y, x]:
                in_front[i] += 1
            else:
                in_front[i] = 0
