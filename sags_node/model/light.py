"""Light that travels with the scope: how bright tissue looks when the lamp has moved."""

from typing import Any

import numpy as np
from numba import prange

from sags_node.kernels.jit import PIECE, inlined, kernel, parallel_kernel
from sags_node.types import F32, F64, I32

GAMMA = 2.2  # of video: colours are display values, light is not
BEAM = 1.0  # exponent of the fall-off towards the rim of the lamp's beam
LEAST_COSINE = 0.15  # lower bound: stray and reflected light reaches what faces away
STEP_M, STEP_RAD = 0.5e-3, 0.01  # motion that changes no colour by as much as a grey level
LARGEST = 3.0  # factor on a colour: beyond it the normal cannot be right


def light_gain(means: F32, normals: F32, index: I32, weight: F32, before: F64, after: F64) -> F32:
    """Compute the factors [N] by which colours and slopes change when the lamp has moved.

    The light that a matt surface sends back falls with the square of the lamp's distance, with the cosine of
    the angle at which it arrives (Lambert) and towards the rim of the beam. Gleams and shadows are left out.

    Args:
        means: [N, 3] m, world.
        normals: [M, 3] of the control nodes, towards the cameras.
        index, weight: [N, K] the nodes that a Gaussian follows.
        before, after: `T_world_cam` [4, 4] of the lamp, which shines along z.
    """
    gain = np.empty(len(means), np.float32)
    lamps = np.stack([np.concatenate([T[:3, 3], T[:3, 2]]) for T in (before, after)]).astype(np.float32)
    _gains(means, normals, index, weight, lamps, gain)
    return gain


def is_near(before: F64, after: F64) -> bool:
    """Tell whether two poses [4, 4] of a lamp give the same light, as far as one can see."""
    moved = float(np.linalg.norm(after[:3, 3] - before[:3, 3]))
    return moved < STEP_M and float(np.abs(after[:3, :3] - before[:3, :3]).max()) < STEP_RAD


@parallel_kernel
def _gains(means: F32, normals: F32, index: I32, weight: F32, lamps: F32, gain: F32) -> None:
    for piece in prange(-(-len(means) // PIECE)):
        first = np.int64(piece) * PIECE
        _gains_of_rows(means, normals, index, weight, lamps, gain, first, min(first + PIECE, len(means)))


@kernel
def _gains_of_rows(
    means: F32, normals: F32, index: I32, weight: F32, lamps: F32, gain: F32, first: Any, end: Any
) -> None:
    exponent, most = np.float32(1 / GAMMA), np.float32(LARGEST)
    one = np.float32(1)
    for i in range(first, end):
        nx, ny, nz = np.float32(0), np.float32(0), np.float32(0)
        for k in range(index.shape[1]):
            node, share = index[i, k], weight[i, k]
            nx += share * normals[node, 0]
            ny += share * normals[node, 1]
            nz += share * normals[node, 2]
        x, y, z = means[i, 0], means[i, 1], means[i, 2]
        before = _brightness(lamps[0], x, y, z, nx, ny, nz)
        after = _brightness(lamps[1], x, y, z, nx, ny, nz)
        gain[i] = one
        if before > 0 and after > 0:
            gain[i] = min(max((after / before) ** exponent, one / most), most)


@inlined
def _brightness(lamp: F32, x: Any, y: Any, z: Any, nx: Any, ny: Any, nz: Any) -> Any:
    """The brightness of a place with a normal, of any length, in the light of a lamp [6]: place and
    direction."""
    least = np.float32(LEAST_COSINE)
    x, y, z = lamp[0] - x, lamp[1] - y, lamp[2] - z
    squared = x * x + y * y + z * z
    per_distance = np.float32(1) / np.sqrt(squared)
    length = np.sqrt(nx * nx + ny * ny + nz * nz)
    arriving = (x * nx + y * ny + z * nz) * per_distance / max(length, np.float32(1e-6))
    leaving = -(x * lamp[3] + y * lamp[4] + z * lamp[5]) * per_distance
    return max(arriving, least) * max(leaving, least) ** np.float32(BEAM) / squared
