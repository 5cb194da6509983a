"""Projection of Gaussians to splats (EWA, Zwicker et al. 2001) with the 2D Mip filter, and its derivative.

    V = J R_cam R_q S  [2, 3]      cov0 = V V^T      cov = cov0 + 0.1 px^2 I
    opacity' = opacity sqrt(det cov0 / det cov)               (Mip-Splatting, Yu et al. 2024)

det cov0 is the sum of the squared 2x2 minors of V (Cauchy-Binet): no cancellation for flat Gaussians. J is
taken at x/z, y/z held within the widened frustum, as Mip-Splatting and gsplat do.

Both kernels copy blocks of Gaussians into planes of a small scratch array so that the arithmetic vectorises.
"""

from __future__ import annotations

import math
from typing import Any

import numba
import numpy as np

from sags_node.engine.jit import inlined, parallel_kernel, square_root
from sags_node.types import F32

f4 = np.float32
u8 = np.uint64
BLOCK = 64  # Gaussians per block

# Planes of a block's scratch: the inputs, then what each kernel works out.
MEAN_X, MEAN_Y, MEAN_Z, SCALE_X, SCALE_Y, SCALE_Z = (u8(k * BLOCK) for k in range(6))
QUAT_W, QUAT_X, QUAT_Y, QUAT_Z, OPACITY = (u8(k * BLOCK) for k in range(6, 11))
MEAN2D_X, MEAN2D_Y, WHITEN_XX, WHITEN_XY, WHITEN_YY, FILTERED, DEPTH = (u8(k * BLOCK) for k in range(11, 18))
G, G_U, G_V, G_UU, G_UV, G_VV, G_DEPTH = (u8(k * BLOCK) for k in range(11, 18))
V_MEAN_X, V_MEAN_Y, V_MEAN_Z, V_SCALE_X, V_SCALE_Y, V_SCALE_Z = (u8(k * BLOCK) for k in range(18, 24))
V_QUAT_W, V_QUAT_X, V_QUAT_Y, V_QUAT_Z, V_OPACITY = (u8(k * BLOCK) for k in range(24, 29))
SCRATCH = 29 * BLOCK  # floats per worker

# The values of `engine.interface`, repeated because Numba's disk cache does not see other files.
NEAR_PLANE = f4(1e-3)
MIP_VARIANCE = f4(0.1)
MAX_OPACITY = f4(0.999)
MIN_QUAT_NORM2 = f4(1e-24)
LOG2_MIN_ALPHA = f4(math.log2(1.0 / 255.0))

ZERO, HALF, ONE, TWO = f4(0.0), f4(0.5), f4(1.0), f4(2.0)
MAX_COORDINATE = f4(1e9)  # px; a comparison with it also rejects NaN and infinity
MAX_VALUE = f4(1e18)  # its square is still finite
TWO_LN2 = f4(2.0 * math.log(2.0))
WHITEN2 = f4(0.5 / math.log(2.0))  # exponents of base e and 1/2 to base 2

Row = tuple[Any, ...]


@inlined
def _to_camera(R: Row, t: Row, x: Any, y: Any, z: Any) -> Row:
    return (
        R[0] * x + R[1] * y + R[2] * z + t[0],
        R[3] * x + R[4] * y + R[5] * z + t[1],
        R[6] * x + R[7] * y + R[8] * z + t[2],
    )


@inlined
def _rotation(w: Any, x: Any, y: Any, z: Any) -> Row:
    """Rows of the rotation matrix of a unit quaternion."""
    return (
        ONE - TWO * (y * y + z * z), TWO * (x * y - w * z), TWO * (x * z + w * y),
        TWO * (x * y + w * z), ONE - TWO * (x * x + z * z), TWO * (y * z - w * x),
        TWO * (x * z - w * y), TWO * (y * z + w * x), ONE - TWO * (x * x + y * y),
    )  # fmt: skip


@inlined
def _screen_axes(R: Row, j00: Any, j02: Any, j11: Any, j12: Any) -> Row:
    """J R_cam [2, 3]: how a small step in the world moves the picture."""
    return (
        j00 * R[0] + j02 * R[6], j00 * R[1] + j02 * R[7], j00 * R[2] + j02 * R[8],
        j11 * R[3] + j12 * R[6], j11 * R[4] + j12 * R[7], j11 * R[5] + j12 * R[8],
    )  # fmt: skip


@inlined
def _times_rotation(A: Row, Q: Row) -> Row:
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
def _scale_axes(U: Row, sx: Any, sy: Any, sz: Any) -> Row:
    return U[0] * sx, U[1] * sy, U[2] * sz, U[3] * sx, U[4] * sy, U[5] * sz


@inlined
def _covariance(V: Row) -> Row:
    """xx, xy, yy of V V^T, its determinant, and the minors of V that give it."""
    xx = V[0] * V[0] + V[1] * V[1] + V[2] * V[2]
    xy = V[0] * V[3] + V[1] * V[4] + V[2] * V[5]
    yy = V[3] * V[3] + V[4] * V[4] + V[5] * V[5]
    m01 = V[0] * V[4] - V[1] * V[3]
    m02 = V[0] * V[5] - V[2] * V[3]
    m12 = V[1] * V[5] - V[2] * V[4]
    return xx, xy, yy, m01 * m01 + m02 * m02 + m12 * m12, m01, m02, m12


@inlined
def _whitening(xx: Any, xy: Any, yy: Any, det0: Any) -> Row:
    """Triangular factor (xx, xy, yy) of the conic of the filtered covariance, for exponents of base 2; and
    the share of the opacity that the filter leaves."""
    det = det0 + MIP_VARIANCE * (xx + yy) + MIP_VARIANCE * MIP_VARIANCE
    filtered_yy = yy + MIP_VARIANCE
    inverse_yy = ONE / filtered_yy
    along = square_root(WHITEN2 * filtered_yy / det)
    return along, -along * xy * inverse_yy, square_root(WHITEN2 * inverse_yy), square_root(det0 / det)


@inlined
def _clamp(value: Any, low: Any, high: Any) -> Any:
    return min(max(value, low), high)


@inlined
def _load_block(S: F32, means: F32, quats: F32, scales: F32, opacities: F32, first: int, filled: int) -> None:
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
            _load_block(S, means, quats, scales, opacities, first, filled)
            for lane in range(BLOCK):
                j = u8(lane)
                x, y, z = _to_camera(R, t, S[MEAN_X + j], S[MEAN_Y + j], S[MEAN_Z + j])
                in_front = z > NEAR_PLANE
                inverse_z = ONE / (z if in_front else ONE)
                slope_x, slope_y = x * inverse_z, y * inverse_z
                held_x = _clamp(slope_x, limits[0], limits[1])
                held_y = _clamp(slope_y, limits[2], limits[3])
                qw, qx, qy, qz = S[QUAT_W + j], S[QUAT_X + j], S[QUAT_Y + j], S[QUAT_Z + j]
                norm2 = qw * qw + qx * qx + qy * qy + qz * qz
                has_direction = norm2 > MIN_QUAT_NORM2
                n = ONE / square_root(norm2 if has_direction else ONE)
                Q = _rotation(qw * n, qx * n, qy * n, qz * n)
                j00, j11 = fx * inverse_z, fy * inverse_z
                A = _screen_axes(R, j00, -j00 * held_x, j11, -j11 * held_y)
                V = _scale_axes(_times_rotation(A, Q), S[SCALE_X + j], S[SCALE_Y + j], S[SCALE_Z + j])
                xx, xy, yy, det0, _, _, _ = _covariance(V)
                along, across, down, kept = _whitening(xx, xy, yy, det0)
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


@parallel_kernel
def project_backward(
    means: F32,
    quats: F32,
    scales: F32,
    opacities: F32,
    R: Row,
    t: Row,
    intrinsics: Row,
    limits: Row,
    scratch: F32,
    splats: Any,  # [N] SPLAT, of `project`
    v_splats: Any,  # [N] SPLAT_GRADIENT, of `sum_pairs`
    v_means: F32,  # written, as the rest
    v_quats: F32,
    v_scales: F32,
    v_opacities: F32,
) -> None:
    count = means.shape[0]
    blocks = (count + BLOCK - 1) // BLOCK
    workers = scratch.shape[0]
    fx, fy = intrinsics[0], intrinsics[1]
    for worker in numba.prange(workers):
        S = scratch[worker]
        for block in range(worker * blocks // workers, (worker + 1) * blocks // workers):
            first = block * BLOCK
            filled = min(BLOCK, count - first)
            _load_block(S, means, quats, scales, opacities, first, filled)
            for lane in range(filled):
                i, j = first + lane, u8(lane)
                v_splat = v_splats[i]
                S[G + j] = v_splat.sum
                S[G_U + j] = v_splat.u
                S[G_V + j] = v_splat.v
                S[G_UU + j] = v_splat.uu
                S[G_UV + j] = v_splat.uv
                S[G_VV + j] = v_splat.vv
                S[G_DEPTH + j] = v_splat.depth
            for lane in range(BLOCK):
                j = u8(lane)
                # the forward pass again
                x, y, z = _to_camera(R, t, S[MEAN_X + j], S[MEAN_Y + j], S[MEAN_Z + j])
                inverse_z = ONE / (z if z > NEAR_PLANE else ONE)
                slope_x, slope_y = x * inverse_z, y * inverse_z
                held_x = _clamp(slope_x, limits[0], limits[1])
                held_y = _clamp(slope_y, limits[2], limits[3])
                qw, qx, qy, qz = S[QUAT_W + j], S[QUAT_X + j], S[QUAT_Y + j], S[QUAT_Z + j]
                norm2 = qw * qw + qx * qx + qy * qy + qz * qz
                n = ONE / square_root(norm2 if norm2 > MIN_QUAT_NORM2 else ONE)
                qw, qx, qy, qz = qw * n, qx * n, qy * n, qz * n
                Q = _rotation(qw, qx, qy, qz)
                j00, j11 = fx * inverse_z, fy * inverse_z
                A = _screen_axes(R, j00, -j00 * held_x, j11, -j11 * held_y)
                U = _times_rotation(A, Q)
                V = _scale_axes(U, S[SCALE_X + j], S[SCALE_Y + j], S[SCALE_Z + j])
                xx, xy, yy, det0, m01, m02, m12 = _covariance(V)
                along, across, down, kept = _whitening(xx, xy, yy, det0)

                # log alpha = log opacity' - (u^2 + v^2) ln 2, (u, v) = W (pixel - mean2d):
                #   dL/dmean2d = 2 ln 2 W^T (sum g (u, v))
                #   dL/dcov    = 1/2 W'^T (sum g w' w'^T) W',  W' = sqrt(2 ln 2) W the base-e factor
                v_mean_x = TWO_LN2 * along * S[G_U + j]
                v_mean_y = TWO_LN2 * (across * S[G_U + j] + down * S[G_V + j])
                # opacity' = opacity sqrt(det0 / det): its share of log det falls on the same quadratic form
                v_log_opacity = S[G + j]
                v_log_opacity = v_log_opacity if S[OPACITY + j] * kept < MAX_OPACITY else ZERO
                n_uu = TWO_LN2 * S[G_UU + j] - v_log_opacity
                n_uv = TWO_LN2 * S[G_UV + j]
                n_vv = TWO_LN2 * S[G_VV + j] - v_log_opacity
                half_k = HALF * TWO_LN2
                c_xx = half_k * along * along * n_uu
                c_xy = half_k * along * (across * n_uu + down * n_uv)
                c_yy = half_k * (across * (across * n_uu + TWO * down * n_uv) + down * down * n_vv)
                # dL/dV = 2 dL/dcov V + (dL/dlog det0) dlog det0/dV, the latter through the minors
                e = v_log_opacity / max(det0, f4(1e-30))
                v0 = TWO * (c_xx * V[0] + c_xy * V[3]) + e * (m01 * V[4] + m02 * V[5])
                v1 = TWO * (c_xx * V[1] + c_xy * V[4]) + e * (m12 * V[5] - m01 * V[3])
                v2 = TWO * (c_xx * V[2] + c_xy * V[5]) - e * (m02 * V[3] + m12 * V[4])
                v3 = TWO * (c_xy * V[0] + c_yy * V[3]) - e * (m01 * V[1] + m02 * V[2])
                v4 = TWO * (c_xy * V[1] + c_yy * V[4]) + e * (m01 * V[0] - m12 * V[2])
                v5 = TWO * (c_xy * V[2] + c_yy * V[5]) + e * (m02 * V[0] + m12 * V[1])

                # V = U S
                S[V_SCALE_X + j] = v0 * U[0] + v3 * U[3]
                S[V_SCALE_Y + j] = v1 * U[1] + v4 * U[4]
                S[V_SCALE_Z + j] = v2 * U[2] + v5 * U[5]
                v0, v1, v2, v3, v4, v5 = _scale_axes(
                    (v0, v1, v2, v3, v4, v5), S[SCALE_X + j], S[SCALE_Y + j], S[SCALE_Z + j]
                )

                # U = A Q: dL/dQ = A^T dL/dU, then to the quaternion and through its normalisation
                g00, g01, g02 = A[0] * v0 + A[3] * v3, A[0] * v1 + A[3] * v4, A[0] * v2 + A[3] * v5
                g10, g11, g12 = A[1] * v0 + A[4] * v3, A[1] * v1 + A[4] * v4, A[1] * v2 + A[4] * v5
                g20, g21, g22 = A[2] * v0 + A[5] * v3, A[2] * v1 + A[5] * v4, A[2] * v2 + A[5] * v5
                v_qw = TWO * (qz * (g10 - g01) + qy * (g02 - g20) + qx * (g21 - g12))
                v_qx = TWO * (qy * (g01 + g10) + qz * (g02 + g20) - TWO * qx * (g11 + g22) + qw * (g21 - g12))
                v_qy = TWO * (qx * (g01 + g10) + qz * (g12 + g21) - TWO * qy * (g00 + g22) + qw * (g02 - g20))
                v_qz = TWO * (qx * (g02 + g20) + qy * (g12 + g21) - TWO * qz * (g00 + g11) + qw * (g10 - g01))
                radial = v_qw * qw + v_qx * qx + v_qy * qy + v_qz * qz
                S[V_QUAT_W + j] = (v_qw - radial * qw) * n
                S[V_QUAT_X + j] = (v_qx - radial * qx) * n
                S[V_QUAT_Y + j] = (v_qy - radial * qy) * n
                S[V_QUAT_Z + j] = (v_qz - radial * qz) * n

                # A = J R_cam: dL/dA = dL/dU Q^T, dL/dJ = dL/dA R_cam^T
                a0 = v0 * Q[0] + v1 * Q[1] + v2 * Q[2]
                a1 = v0 * Q[3] + v1 * Q[4] + v2 * Q[5]
                a2 = v0 * Q[6] + v1 * Q[7] + v2 * Q[8]
                a3 = v3 * Q[0] + v4 * Q[1] + v5 * Q[2]
                a4 = v3 * Q[3] + v4 * Q[4] + v5 * Q[5]
                a5 = v3 * Q[6] + v4 * Q[7] + v5 * Q[8]
                v_j00 = a0 * R[0] + a1 * R[1] + a2 * R[2]
                v_j02 = a0 * R[6] + a1 * R[7] + a2 * R[8]
                v_j11 = a3 * R[3] + a4 * R[4] + a5 * R[5]
                v_j12 = a3 * R[6] + a4 * R[7] + a5 * R[8]
                # j00 = fx / z, j02 = -fx / z held_x; a held slope is constant
                v_inverse_z = fx * (v_j00 - held_x * v_j02) + fy * (v_j11 - held_y * v_j12)
                free_x = ONE if held_x == slope_x else ZERO
                free_y = ONE if held_y == slope_y else ZERO
                v_slope_x = fx * v_mean_x - free_x * j00 * v_j02
                v_slope_y = fy * v_mean_y - free_y * j11 * v_j12
                v_x, v_y = v_slope_x * inverse_z, v_slope_y * inverse_z
                v_z = S[G_DEPTH + j] - inverse_z * (
                    v_slope_x * slope_x + v_slope_y * slope_y + v_inverse_z * inverse_z
                )
                S[V_MEAN_X + j] = R[0] * v_x + R[3] * v_y + R[6] * v_z
                S[V_MEAN_Y + j] = R[1] * v_x + R[4] * v_y + R[7] * v_z
                S[V_MEAN_Z + j] = R[2] * v_x + R[5] * v_y + R[8] * v_z
                S[V_OPACITY + j] = v_log_opacity / max(S[OPACITY + j], f4(1e-30))
            for lane in range(filled):
                i, j = first + lane, u8(lane)
                drawn = splats[i].extent > ZERO
                v_means[i, 0] = S[V_MEAN_X + j] if drawn else ZERO
                v_means[i, 1] = S[V_MEAN_Y + j] if drawn else ZERO
                v_means[i, 2] = S[V_MEAN_Z + j] if drawn else ZERO
                v_scales[i, 0] = S[V_SCALE_X + j] if drawn else ZERO
                v_scales[i, 1] = S[V_SCALE_Y + j] if drawn else ZERO
                v_scales[i, 2] = S[V_SCALE_Z + j] if drawn else ZERO
                v_quats[i, 0] = S[V_QUAT_W + j] if drawn else ZERO
                v_quats[i, 1] = S[V_QUAT_X + j] if drawn else ZERO
                v_quats[i, 2] = S[V_QUAT_Y + j] if drawn else ZERO
                v_quats[i, 3] = S[V_QUAT_Z + j] if drawn else ZERO
                v_opacities[i] = S[V_OPACITY + j] if drawn else ZERO
