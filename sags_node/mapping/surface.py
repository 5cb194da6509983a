"""The measured surface where each Gaussian is seen, looked up once per frame."""

from typing import Any

import numpy as np
from numba import prange

from sags_node.engine.pinhole import pack, to_camera, to_pixel
from sags_node.kernels.jit import PIECE, kernel, parallel_kernel
from sags_node.types import F32, Bool, Observation
from sags_node.vision.depth_grid import grid_of


def surface_at(means: F32, observation: Observation) -> F32:
    """Return [N, 3] m for Gaussians at `means` [N, 3]: their depth (0: behind the camera or not in the
    image), the depth of tissue that is measured in their pixel (0: none), and its error."""
    surface = np.empty((len(means), 3), np.float32)
    grid = grid_of(observation)
    _find_surface(
        means, tuple(pack(observation.camera)), observation.tissue, observation.depth, grid.error,
        np.float32(1 / grid.side), surface,
    )  # fmt: skip
    return surface


@parallel_kernel
def _find_surface(
    means: F32, cam: Any, tissue: Bool, depth: F32, grid_error: F32, per_px: Any, surface: F32
) -> None:
    for piece in prange(-(-len(means) // PIECE)):
        first = np.int64(piece) * PIECE
        _find_surface_of_rows(
            means, cam, tissue, depth, grid_error, per_px, surface, first, min(first + PIECE, len(means))
        )


@kernel
def _find_surface_of_rows(
    means: F32, cam: Any, tissue: Bool, depth: F32, grid_error: F32, per_px: Any, surface: F32,
    first: Any, end: Any,
) -> None:  # fmt: skip
    height, width = depth.shape
    zero = np.float32(0)
    for i in range(first, end):
        surface[i, 0] = surface[i, 1] = surface[i, 2] = zero
        x, y, z = to_camera(cam, means[i, 0], means[i, 1], means[i, 2])
        if not z > 0:
            continue
        u, v = to_pixel(cam, x, y, z)
        if not (u > -0.5 and v > -0.5 and u < width - 0.5 and v < height - 0.5):
            continue
        surface[i, 0] = z
        px, py = int(u + 0.5), int(v + 0.5)
        if tissue[py, px] and depth[py, px] > 0:
            measured = depth[py, px]
            surface[i, 1] = measured
            surface[i, 2] = grid_error[int(py * per_px), int(px * per_px)] * measured * measured
