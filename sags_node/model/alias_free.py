"""The 3D smoothing filter of Mip-Splatting (Yu et al., CVPR 2024): no Gaussian is finer than what was seen.

    Sigma' = Sigma + (0.2 / nu^2) I,    nu = max over the cameras that see the Gaussian of f / z

nu is the sampling rate, samples per metre, at the Gaussian's depth. (The paper prints 0.2 / nu; the square is
what has the unit of a variance.) In a deforming scene it belongs after the deformation, where z is known.
`engine.rasterizer.smoothing` applies the variance; the 2D filter is part of the projection.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numba import prange

from sags_node.engine.pinhole import pack, to_camera, to_pixel
from sags_node.kernels.jit import kernel, parallel_kernel
from sags_node.types import F32, Camera

FILTER_VARIANCE = 0.2  # of the squared sampling interval
VIEW_MARGIN = 0.15  # of the image's size: what is that far outside still counts as seen
UNSEEN = np.float32(np.inf)


def smoothing_variances(means: F32, cameras: Sequence[Camera]) -> F32:
    """Compute the variance of the 3D filter, [N] m^2.

    Args:
        means: [N, 3] m, world, after deformation.
        cameras: those the Gaussians were fitted to. A camera that only looks at the result does not belong
            here: from nearer by it would ask for detail that nothing was ever measured of, and the image
            loses 2 dB at four times the size (`benchmarks alias`). The mapper gives the camera of the whole
            image, also while it fits to one of half the size (benchmarks/mapping.md).

    Gaussians that no camera sees take the largest variance of the seen ones.
    """
    variances = np.full(len(means), UNSEEN, np.float32)
    for camera in cameras:
        narrow(variances, means, camera)
    seen = variances < UNSEEN
    variances[~seen] = variances[seen].max(initial=0.0)
    return variances


def narrow(variances: F32, means: F32, camera: Camera) -> None:
    """Update the variances [N] m^2 of Gaussians, in place, for one more camera that they are fitted to: what
    it samples more finely than all before gets a smaller one, and what it does not see keeps its own."""
    intervals = np.full(len(means), UNSEEN, np.float32)
    _sampling_intervals(means, pack(camera), camera.width, camera.height, intervals)
    np.minimum(variances, np.float32(FILTER_VARIANCE) * intervals * intervals, out=variances)


@parallel_kernel
def _sampling_intervals(means: F32, cam: F32, width: int, height: int, intervals: F32) -> None:
    for i in prange(len(means)):
        intervals[i] = _sampling_interval(means[i], cam, width, height)


@kernel
def _sampling_interval(mean: F32, cam: F32, width: int, height: int) -> Any:
    """Metres per pixel at the point; infinite where the camera does not see it."""
    x, y, z = to_camera(cam, mean[0], mean[1], mean[2])
    if not z > 0:
        return UNSEEN
    u, v = to_pixel(cam, x, y, z)
    margin_x, margin_y = VIEW_MARGIN * width, VIEW_MARGIN * height
    inside = -margin_x <= u < width + margin_x and -margin_y <= v < height + margin_y
    return z / max(cam[12], cam[13]) if inside else UNSEEN
