"""The predicted depth error of each Gaussian: from when and how well it was measured, and how it moved since.

A Gaussian begins with the error of the depth that it was placed at. Where a frame measures the surface that
it lies on, it is moved there by a part (`motion.depth_pull`), and its error approaches the measurement's by
the same part. It falls no lower: the errors of successive frames come from the same texture and the same
calibration, and do not average out. Measurements that contradict it raise its error to the contradiction.
While it is not measured, its error grows with the distance that it moves unseen.
"""

from typing import Any

import numpy as np
from numba import prange

from sags_node.engine.interface import BEHIND_SURFACE
from sags_node.kernels.jit import PIECE, kernel, parallel_kernel
from sags_node.mapping.initialise import LARGEST_ERROR
from sags_node.mapping.motion import DEPTH_GATE
from sags_node.model.gaussians import GaussianModel
from sags_node.types import F32

DRIFT = 0.5  # share of an unmeasured Gaussian's motion that may be an error along the ray
UNSEEN = 1e-3  # m/s: speed at which tissue may move by itself, unseen
UNWATCHED = 2e-2  # m/s: speed of tissue that is pulled while no frame is mapped


def remember(model: GaussianModel, surface: F32, pull: float, seconds: float) -> None:
    """Carry the predicted errors on to a frame to which the Gaussians were moved already.

    Args:
        surface: [N, 3] of `surface_at` for that frame.
        pull: share of the difference in depth by which the Gaussians were moved.
        seconds: since the frame before.
    """
    _remember(surface, model.velocities, np.float32(pull), np.float32(seconds), model.depth_errors)


@parallel_kernel
def _remember(surface: F32, velocities: F32, pull: Any, seconds: Any, errors: F32) -> None:
    for piece in prange(-(-len(surface) // PIECE)):
        first = np.int64(piece) * PIECE
        _remember_rows(surface, velocities, pull, seconds, errors, first, min(first + PIECE, len(surface)))


@kernel
def _remember_rows(
    surface: F32, velocities: F32, pull: Any, seconds: Any, errors: F32, first: Any, end: Any
) -> None:
    left = (np.float32(1) - pull) ** 2  # of the old squared error
    for i in range(first, end):
        error, z, measured, its_error = errors[i], surface[i, 0], surface[i, 1], surface[i, 2]
        apart = measured - z
        if measured > 0 and abs(apart) < np.float32(BEHIND_SURFACE) * z:
            expected = error * error + its_error * its_error
            square = left * error * error + (np.float32(1) - left) * its_error * its_error
            error = np.sqrt(square + pull * max(apart * apart - expected, np.float32(0)))
        elif measured > 0 and apart > -np.float32(DEPTH_GATE) * z:
            error = max(error, abs(apart))  # before the surface, or not quite hidden by it
        else:
            way = velocities[i, 0] ** 2 + velocities[i, 1] ** 2 + velocities[i, 2] ** 2
            error += (np.float32(DRIFT) * np.sqrt(way) + np.float32(UNSEEN)) * seconds
        errors[i] = min(error, np.float32(LARGEST_ERROR))
