"""Projection of Gaussians to splats (EWA, Zwicker et al. 2001) with the 2D Mip filter.

    V = J R_cam R_q S  [2, 3]      cov0 = V V^T      cov = cov0 + 0.1 px^2 I
    opacity' = opacity sqrt(det cov0 / det cov)               (Mip-Splatting, Yu et al. 2024)

or, for comparison, with the dilation of 3D Gaussian Splatting (Kerbl et al. 2023): cov = cov0 + 0.3 px^2 I
and opacity' = opacity. `screen_filter` says which: the variance, and 1 where the opacity makes up for it,
else 0.

det cov0 is the sum of the squared 2x2 minors of V (Cauchy-Binet): no cancellation for flat Gaussians. J is
taken at x/z, y/z held within the widened frustum, as Mip-Splatting and gsplat do.

The kernel copies blocks of Gaussians into planes of a small scratch array so that the arithmetic vectorises.
`projection_backward` differentiates it and compiles the helpers and constants of this file into its own
kernel: after editing them, delete the caches (see `jit`).
"""

from __future__ import annotations

import math
from typing import Any

import numba
import numpy as np

from sags_node.kernels.jit import inlined, parallel_kernel, square_root
from sags_node.types import F32

f4 = np.float32
u8 = np.uint64
BLOCK = 64  # Gaussians per block

# Planes of a block's scratch: the inputs, then what the kernel works out.
MEAN_X, MEAN_Y, MEAN_Z, SCALE_X, SCALE_Y, SCALE_Z = (u8(k * BLOCK) for k in range(6))
QUAT_W, QUAT_X, QUAT_Y, QUAT_Z, OPACITY = (u8(k * BLOCK) for k in range(6, 11))
MEAN2D_X, MEAN2D_Y, WHITEN_XX, WHITEN_XY, WHITEN_YY, FILTERED, DEPTH = (u8(k * BLOCK) for k in range(11, 18))
SCRATCH = 18 * BLOCK  # floats per worker

# The values of `engine.interface`, repeated because Numba's disk cache does not see other files.
NEAR_PLANE = f4(1e-3)
MAX_OPACITY = f4(0.999)
MIN_QUAT_NORM2, MAX_QUAT_NORM2 = f4(1e-24), f4(1e36)  # where float32 can still square
LOG2_MIN_ALPHA = f4(math.log2(1.0 / 255.0))

ZERO, HALF, ONE, TWO = f4(0.0), f4(0.5), f4(1.0), f4(2.0)
MAX_COORDINATE = f4(1e9)  # px; a comparison with it also rejects NaN and infinity
MAX_VALUE = f4(1e18)  # its square is still finite
TWO_LN2 = f4(2.0 * math.log(2.0))
WHITEN2 = f4(0.5 / math.log(2.0))  # exponents of base e and 1/2 to base 2

Row = tuple[Any, ...]


@inlined
def to_camera(R: Row, t: Row, x: Any, y: Any, z: Any) -> Row:
    return (
        R[0] * x + R[1] * y + R[2] * z + t[0],
        R[3] * x + R[4] * y + R[5] * z + t[1],
        R[6] * x + R[7] * y + R[8] * z + t[2],
    )


@inlined
def rotation(w: Any, x: Any, y: Any, z: Any) -> Row:
    """Rows of the rotation matrix of a unit quaternion."""
    return (
        ONE - TWO * (y * y + z * z), TWO * (x * y - w * z), TWO * (x * z + w * y),
        TWO * (x * y + w * z), ONE - TWO * (x * x + z * z), TWO * (y * z - w * x),
        TWO * (x * z - w * y), TWO * (y * z + w * x), ONE - TWO * (x * x + y * y),
    )  # fmt: skip


@inlined
def screen_axes(R: Row, j00: Any, j02: Any, j11: Any, j12: Any) -> Row:
    """J R_cam [2, 3]: how a small step in the world moves the picture."""
    return (
        j00 * R[0] + j02 * R[6], j00 * R[1] + j02 * R[7], j00 * R[2] + j02 * R[8],
        j11 * R[3] + j12 * R[6], j11 * R[4] + j12 * R[7], j11 * R[5] + j12 * R[8],
    )  # fmt: skip


@inlined
def times_rotation(A: Row, Q: Row) -> Row:
    """A [2, 3] Q [3, 3]."""
    return (
        A[0] * Q[0] + A[1] * Q[3] + A[2] * Q[6],
        A[0] * Q[1] + A[1] * Q[4] + A[2] * Q[7],
        A[0] * Q[2] + A[1] * Q[5] + A[2] * Q[8],
        A[3] * Q[0] + A[4] * Q[3] + A[5] * Q[6],
        A[3] * Q[1] + A[4] * Q[4] + A[5] * Q[7],
        A[3] * Q[2] + A[4] * Q[5] + A[5] * Q[8],
    )


@inlined
def scale_axes(U: Row, sx: Any, sy: Any, sz: Any) -> Row:
    return U[0] * sx, U[1] * sy, U[2] * sz, U[3] * sx, U[4] * sy, U[5] * sz


@inlined
def covariance(V: Row) -> Row:
    """xx, xy, yy of V V^T, its determinant, and the minors of V that give it."""
    xx = V[0] * V[0] + V[1] * V[1] + V[2] * V[2]
    xy = V[0] * V[3] + V[1] * V[4] + V[2] * V[5]
    yy = V[3] * V[3] + V[4] * V[4] + V[5] * V[5]
    m01 = V[0] * V[4] - V[1] * V[3]
    m02 = V[0] * V[5] - V[2] * V[3]
    m12 = V[1] * V[5] - V[2] * V[4]
    return xx, xy, yy, m01 * m01 + m02 * m02 + m12 * m12, m01, m02, m12


@inlined
def whitening(xx: Any, xy: Any, yy: Any, det0: Any, screen_filter: Row) -> Row:
    """Triangular factor (xx, xy, yy) of the conic of the filtered covariance, for exponents of base 2; and
    the share of the opacity that the filter leaves."""
    variance, compensates = screen_filter
    det = det0 + variance * (xx + yy) + variance * variance
    filtered_yy = yy + variance
    inverse_yy = ONE / filtered_yy
    along = square_root(WHITEN2 * filtered_yy / det)
    kept = square_root(det0 / det) if compensates > ZERO else ONE
    return along, -along * xy * inverse_yy, square_root(WHITEN2 * inverse_yy), kept


@inlined
def clamp(value: Any, low: Any, high: Any) -> Any:
    return min(max(value, low), high)


@inlined
def load_block(S: F32, means: F32, quats: F32, scales: F32, opacities: F32, first: int, filled: int) -> None:
    for lane in range(filled):
        i, j = first + lane, u8(lane)
        S[MEAN_X + j] = means[i, 0]
        S[MEAN_Y + j] = means[i, 1]
        S[MEAN_Z + j] = means[i, 2]
        S[SCALE_X + j] = scales[i, 0]
        S[SCALE_Y + j] = scales[i, 1]
        S[SCALE_Z + j] = scales[i, 2]
        S[QUAT_W + j] = quats[i, 0]
        S[QUAT_X + j] = quats[i, 1]
        S[QUAT_Y + j] = quats[i, 2]
        S[QUAT_Z + j] = quats[i, 3]
        S[OPACITY + j] = opacities[i]


@parallel_kernel
def project(
    means: F32,
    quats: F32,
    scales: F32,
    opacities: F32,
    colors: F32,
    R: Row,  # 9 rows of the world-to-camera rotation
    t: Row,  # 3
    intrinsics: Row,  # fx, fy, cx, cy
    limits: Row,  # of x/z and y/z in the Jacobian: low, high, low, high
    screen_filter: Row,
    scratch: F32,  # [workers, SCRATCH]
    splats: Any,  # [N] SPLAT, written
    depths: F32,  # [N] written; 0 where not drawn
) -> None:
    count = means.shape[0]
    blocks = (count + BLOCK - 1) // BLOCK
    workers = scratch.shape[0]
    fx, fy, cx, cy = intrinsics
    for worker in numba.prange(workers):
        S = scratch[worker]
        for block in range(worker * blocks // workers, (worker + 1) * blocks // workers):
            first = block * BLOCK
            filled = min(BLOCK, count - first)
            load_block(S, means, quats, scales, opacities, first, filled)
            for lane in range(BLOCK):
                j = u8(lane)
                x, y, z = to_camera(R, t, S[MEAN_X + j], S[MEAN_Y + j], S[MEAN_Z + j])
                in_front = z > NEAR_PLANE
                inverse_z = ONE / (z if in_front else ONE)
                slope_x, slope_y = x * inverse_z, y * inverse_z
                held_x = clamp(slope_x, limits[0], limits[1])
                held_y = clamp(slope_y, limits[2], limits[3])
                qw, qx, qy, qz = S[QUAT_W + j], S[QUAT_X + j], S[QUAT_Y + j], S[QUAT_Z + j]
                norm2 = qw * qw + qx * qx + qy * qy + qz * qz
                has_direction = norm2 > MIN_QUAT_NORM2 and norm2 < MAX_QUAT_NORM2
                n = ONE / square_root(norm2 if has_direction else ONE)
                Q = rotation(qw * n, qx * n, qy * n, qz * n)
                j00, j11 = fx * inverse_z, fy * inverse_z
                A = screen_axes(R, j00, -j00 * held_x, j11, -j11 * held_y)
                V = scale_axes(times_rotation(A, Q), S[SCALE_X + j], S[SCALE_Y + j], S[SCALE_Z + j])
                xx, xy, yy, det0, _, _, _ = covariance(V)
                along, across, down, kept = whitening(xx, xy, yy, det0, screen_filter)
                mean_x, mean_y = fx * slope_x + cx, fy * slope_y + cy
                given = S[OPACITY + j]
                in_range = abs(mean_x) + abs(mean_y) < MAX_COORDINATE and xx + yy < MAX_VALUE
                in_range = in_range and given < MAX_VALUE
                opacity = min(given * kept, MAX_OPACITY)
                S[MEAN2D_X + j] = mean_x
                S[MEAN2D_Y + j] = mean_y
                S[WHITEN_XX + j] = along
                S[WHITEN_XY + j] = across
                S[WHITEN_YY + j] = down
                S[FILTERED + j] = opacity if in_front and has_direction and in_range else ZERO
                S[DEPTH + j] = z
            for lane in range(filled):
                i, j = first + lane, u8(lane)
                splat = splats[i]
                opacity = S[FILTERED + j]
                log2_opacity = f4(math.log2(opacity)) if opacity > ZERO else TWO * LOG2_MIN_ALPHA
                extent = max(log2_opacity - LOG2_MIN_ALPHA, ZERO)
                if not abs(colors[i, 0]) + abs(colors[i, 1]) + abs(colors[i, 2]) < MAX_VALUE:
                    extent = ZERO
                splat.mean_x = S[MEAN2D_X + j]
                splat.mean_y = S[MEAN2D_Y + j]
                splat.whiten_xx = S[WHITEN_XX + j]
                splat.whiten_xy = S[WHITEN_XY + j]
                splat.whiten_yy = S[WHITEN_YY + j]
                splat.log2_opacity = log2_opacity
                splat.extent = extent
                splat.red = colors[i, 0]
                splat.green = colors[i, 1]
                splat.blue = colors[i, 2]
                splat.depth = S[DEPTH + j]
                depths[i] = S[DEPTH + j] if extent > ZERO else ZERO
