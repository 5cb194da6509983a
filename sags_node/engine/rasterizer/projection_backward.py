"""The derivative of the projection (`projection`) with respect to every parameter. The gradients of pairs are
summed first."""

from typing import Any

import numba
import numpy as np

from sags_node.engine.pinhole import to_camera
from sags_node.engine.rasterizer.layout import SPLAT_GRADIENT
from sags_node.engine.rasterizer.projection import (
    BLOCK,
    GRAIN,
    HALF,
    INPUTS,
    MAX_OPACITY,
    MEAN_X,
    MEAN_Y,
    MEAN_Z,
    NEAR_PLANE,
    ONE,
    OPACITY,
    QUAT_W,
    QUAT_X,
    QUAT_Y,
    QUAT_Z,
    SCALE_X,
    SCALE_Y,
    SCALE_Z,
    SLOPE_X,
    SLOPE_Y,
    SLOPE_Z,
    TWO,
    TWO_LN2,
    ZERO,
    Row,
    clamp,
    covariance,
    load_block,
    rotation,
    scale_axes,
    screen_axes,
    screen_slopes,
    times_axes,
    times_rotation,
    unit_quaternion,
    unpack,
    whitening,
)
from sags_node.kernels.jit import inlined, kernel, parallel_kernel, prefetch_read, take
from sags_node.kernels.vectors import (
    LANES,
    RECORD,
    larger,
    load,
    load_records,
    select,
    spread,
    store,
)
from sags_node.types import F32, I64

f4 = np.float32
TINY = f4(1e-30)  # keeps quotients of vanishing Gaussians finite
AHEAD = 8  # Gaussians between prefetch and use

# Planes of a block's scratch after the inputs, which `projection` lays out.
V_MEAN_X, V_MEAN_Y, V_MEAN_Z, V_SCALE_X, V_SCALE_Y, V_SCALE_Z = ((INPUTS + k) * BLOCK for k in range(6))
V_QUAT_W, V_QUAT_X, V_QUAT_Y, V_QUAT_Z, V_OPACITY, DRAWN = ((INPUTS + k) * BLOCK for k in range(6, 12))
V_SLOPE_X, V_SLOPE_Y, V_SLOPE_Z = ((INPUTS + k) * BLOCK for k in range(12, 15))
RECORDS = (INPUTS + 15) * BLOCK  # the block's SPLAT_GRADIENT, one after the other
SCRATCH = RECORDS + RECORD * BLOCK  # floats per worker
# Places in a record
V_RED, CONTRIBUTION, SPREAD = (
    list(SPLAT_GRADIENT.names or ()).index(name) for name in ("red", "contribution", "spread")
)


@inlined
def _sum_pairs(S: F32, slots: Any, v_pairs: F32, first: int, filled: int) -> Any:
    """Write each splat's sum over its pairs, in the order of their slots, to the block's records. Return
    whether any splat is drawn."""
    any_drawn = False
    for lane in range(filled):
        soon = slots[min(first + lane + AHEAD, slots.size - 1)].first * RECORD
        prefetch_read(v_pairs, soon)
        prefetch_read(v_pairs, soon + RECORD)
        begin, count = slots[first + lane].first, slots[first + lane].count
        for part in range(0, RECORD, LANES):
            total = spread(ZERO)
            for slot in range(begin, begin + count):
                total += load(v_pairs, slot * RECORD + part)
            store(S, RECORDS + lane * RECORD + part, total)
        S[DRAWN + lane] = f4(count)
        any_drawn |= count > 0
    return any_drawn


@inlined
def _clear(
    v_means: F32, v_quats: F32, v_scales: F32, v_opacities: F32, v_slopes: F32, first: int, filled: int
) -> None:
    for i in range(first, first + filled):
        for k in range(3):
            v_means[i, k] = v_scales[i, k] = v_slopes[i, k] = ZERO
        for k in range(4):
            v_quats[i, k] = ZERO
        v_opacities[i] = ZERO


@kernel
def _blocks_backward(
    means: F32, quats: F32, scales: F32, opacities: F32, slopes: F32, view: F32, screen_filter: Row, S: F32,
    next_block: I64, slots: Any, v_pairs: F32, v_colors: F32, contribution: F32, spreads: F32, v_means: F32,
    v_quats: F32, v_scales: F32, v_opacities: F32, v_slopes: F32,
) -> None:  # fmt: skip
    count, blocks = means.shape[0], (means.shape[0] + BLOCK - 1) // BLOCK
    pose, (fx, fy, _, _), limits = unpack(view)
    given_up = screen_filter[0] * screen_filter[1]
    block, end = 0, 0
    while True:
        block += 1
        if block >= end:
            block = take(next_block, GRAIN)
            end = block + GRAIN
        if block >= blocks:
            break
        first = block * BLOCK
        filled = min(BLOCK, count - first)
        any_drawn = _sum_pairs(S, slots, v_pairs, first, filled)
        for lane in range(filled):
            i, record = first + lane, RECORDS + lane * RECORD
            for k in range(3):
                v_colors[i, k] = S[record + V_RED + k]
            contribution[i] = S[record + CONTRIBUTION]
            spreads[i] = TWO_LN2 * S[record + SPREAD]
        if not any_drawn:
            _clear(v_means, v_quats, v_scales, v_opacities, v_slopes, first, filled)
            continue
        load_block(S, means, quats, scales, opacities, slopes, first, filled)
        for lane in range(filled, BLOCK):
            S[DRAWN + lane] = ZERO
        for j in range(0, filled, LANES):
            g, g_u, g_v, g_uu, g_uv, g_vv, g_red, g_green, g_blue, g_depth, _, b_u, b_v, _, _, _ = (
                load_records(S, RECORDS + j * RECORD)
            )
            # the forward pass again
            x, y, z = to_camera(pose, load(S, MEAN_X + j), load(S, MEAN_Y + j), load(S, MEAN_Z + j))
            inverse_z = ONE / select(z > NEAR_PLANE, z, ONE)
            slope_x, slope_y = x * inverse_z, y * inverse_z
            held_x = clamp(slope_x, limits[0], limits[1])
            held_y = clamp(slope_y, limits[2], limits[3])
            qw, qx, qy, qz, n, _ = unit_quaternion(
                load(S, QUAT_W + j), load(S, QUAT_X + j), load(S, QUAT_Y + j), load(S, QUAT_Z + j)
            )
            Q = rotation(qw, qx, qy, qz)
            j00, j11 = fx * inverse_z, fy * inverse_z
            j02, j12 = -j00 * held_x, -j11 * held_y
            A = screen_axes(pose, j00, j02, j11, j12)
            U = times_rotation(A, Q)
            sx, sy, sz = load(S, SCALE_X + j), load(S, SCALE_Y + j), load(S, SCALE_Z + j)
            V = scale_axes(U, sx, sy, sz)
            xx, xy, yy, det0, m01, m02, m12 = covariance(V)
            along, across, down, kept = whitening(xx, xy, yy, det0, screen_filter)

            # log alpha = log opacity' - (u^2 + v^2) ln 2, (u, v) = W (pixel - mean2d):
            #   dL/dmean2d = 2 ln 2 W^T (sum g (u, v))
            #   dL/dcov    = 1/2 W'^T (sum g w' w'^T) W',  W' = sqrt(2 ln 2) W the base-e factor
            v_mean_x = TWO_LN2 * along * g_u
            v_mean_y = TWO_LN2 * (across * g_u + down * g_v)
            v_log_opacity = select(load(S, OPACITY + j) * kept < MAX_OPACITY, g, ZERO)
            half_k = HALF * TWO_LN2 * TWO_LN2
            c_xx = half_k * along * along * g_uu
            c_xy = half_k * along * (across * g_uu + down * g_uv)
            c_yy = half_k * (across * (across * g_uu + TWO * down * g_uv) + down * down * g_vv)
            # Slopes add p^T C d to the luminance, with p = V a, C = cov^-1. With b = sum w g (u, v) over the
            # pixels, g the luminance's cotangent, x = C sum w g d = 2 ln 2 W^T b and y = C p = W^T s:
            #   dL/dp = x,   dL/dmean2d = -y sum w g,   dL/dcov = -1/2 (y x^T + x y^T)
            a_x, a_y, a_z = load(S, SLOPE_X + j), load(S, SLOPE_Y + j), load(S, SLOPE_Z + j)
            slope_u, slope_v = screen_slopes((along, across, down), *times_axes(V, a_x, a_y, a_z))
            x_x, x_y = TWO_LN2 * along * b_u, TWO_LN2 * (across * b_u + down * b_v)
            y_x, y_y = along * slope_u, across * slope_u + down * slope_v
            g_luminance = g_red + g_green + g_blue
            v_mean_x -= y_x * g_luminance
            v_mean_y -= y_y * g_luminance
            c_xx -= x_x * y_x
            c_xy -= HALF * (x_x * y_y + x_y * y_x)
            c_yy -= x_y * y_y
            store(S, V_SLOPE_X + j, V[0] * x_x + V[3] * x_y)
            store(S, V_SLOPE_Y + j, V[1] * x_x + V[4] * x_y)
            store(S, V_SLOPE_Z + j, V[2] * x_x + V[5] * x_y)
            # opacity' = opacity sqrt(det cov0 / det cov): dlog opacity'/dV = variance cov^-1 cov0^-1 V.
            # As a difference it would cancel for large Gaussians. cov0^-1 V comes from the minors
            share = TWO_LN2 * given_up * v_log_opacity / larger(det0, TINY)
            s_xx, s_xy = share * along * along, share * along * across
            s_yy = share * (across * across + down * down)
            w0, w3 = m01 * V[4] + m02 * V[5], -m01 * V[1] - m02 * V[2]
            w1, w4 = m12 * V[5] - m01 * V[3], m01 * V[0] - m12 * V[2]
            w2, w5 = -m02 * V[3] - m12 * V[4], m02 * V[0] + m12 * V[1]
            v0 = TWO * (c_xx * V[0] + c_xy * V[3]) + s_xx * w0 + s_xy * w3 + x_x * a_x
            v1 = TWO * (c_xx * V[1] + c_xy * V[4]) + s_xx * w1 + s_xy * w4 + x_x * a_y
            v2 = TWO * (c_xx * V[2] + c_xy * V[5]) + s_xx * w2 + s_xy * w5 + x_x * a_z
            v3 = TWO * (c_xy * V[0] + c_yy * V[3]) + s_xy * w0 + s_yy * w3 + x_y * a_x
            v4 = TWO * (c_xy * V[1] + c_yy * V[4]) + s_xy * w1 + s_yy * w4 + x_y * a_y
            v5 = TWO * (c_xy * V[2] + c_yy * V[5]) + s_xy * w2 + s_yy * w5 + x_y * a_z

            # V = U S
            store(S, V_SCALE_X + j, v0 * U[0] + v3 * U[3])
            store(S, V_SCALE_Y + j, v1 * U[1] + v4 * U[4])
            store(S, V_SCALE_Z + j, v2 * U[2] + v5 * U[5])
            v0, v1, v2, v3, v4, v5 = scale_axes((v0, v1, v2, v3, v4, v5), sx, sy, sz)

            # U = A Q: dL/dQ = A^T dL/dU, then to the quaternion and through its normalisation
            g00, g01, g02 = A[0] * v0 + A[3] * v3, A[0] * v1 + A[3] * v4, A[0] * v2 + A[3] * v5
            g10, g11, g12 = A[1] * v0 + A[4] * v3, A[1] * v1 + A[4] * v4, A[1] * v2 + A[4] * v5
            g20, g21, g22 = A[2] * v0 + A[5] * v3, A[2] * v1 + A[5] * v4, A[2] * v2 + A[5] * v5
            v_qw = TWO * (qz * (g10 - g01) + qy * (g02 - g20) + qx * (g21 - g12))
            v_qx = TWO * (qy * (g01 + g10) + qz * (g02 + g20) - TWO * qx * (g11 + g22) + qw * (g21 - g12))
            v_qy = TWO * (qx * (g01 + g10) + qz * (g12 + g21) - TWO * qy * (g00 + g22) + qw * (g02 - g20))
            v_qz = TWO * (qx * (g02 + g20) + qy * (g12 + g21) - TWO * qz * (g00 + g11) + qw * (g10 - g01))
            radial = v_qw * qw + v_qx * qx + v_qy * qy + v_qz * qz
            store(S, V_QUAT_W + j, (v_qw - radial * qw) * n)
            store(S, V_QUAT_X + j, (v_qx - radial * qx) * n)
            store(S, V_QUAT_Y + j, (v_qy - radial * qy) * n)
            store(S, V_QUAT_Z + j, (v_qz - radial * qz) * n)

            # A = J R_cam: dL/dA = dL/dU Q^T, dL/dJ = dL/dA R_cam^T
            a0 = v0 * Q[0] + v1 * Q[1] + v2 * Q[2]
            a1 = v0 * Q[3] + v1 * Q[4] + v2 * Q[5]
            a2 = v0 * Q[6] + v1 * Q[7] + v2 * Q[8]
            a3 = v3 * Q[0] + v4 * Q[1] + v5 * Q[2]
            a4 = v3 * Q[3] + v4 * Q[4] + v5 * Q[5]
            a5 = v3 * Q[6] + v4 * Q[7] + v5 * Q[8]
            v_j00 = a0 * pose[0] + a1 * pose[1] + a2 * pose[2]
            v_j02 = a0 * pose[6] + a1 * pose[7] + a2 * pose[8]
            v_j11 = a3 * pose[3] + a4 * pose[4] + a5 * pose[5]
            v_j12 = a3 * pose[6] + a4 * pose[7] + a5 * pose[8]
            # j00 = fx / z, j02 = -fx / z held_x; a held slope is constant
            v_inverse_z = fx * (v_j00 - held_x * v_j02) + fy * (v_j11 - held_y * v_j12)
            free_x = select(held_x == slope_x, spread(ONE), ZERO)
            free_y = select(held_y == slope_y, spread(ONE), ZERO)
            v_slope_x = fx * v_mean_x - free_x * j00 * v_j02
            v_slope_y = fy * v_mean_y - free_y * j11 * v_j12
            v_x, v_y = v_slope_x * inverse_z, v_slope_y * inverse_z
            v_z = g_depth - inverse_z * (v_slope_x * slope_x + v_slope_y * slope_y + v_inverse_z * inverse_z)
            store(S, V_MEAN_X + j, pose[0] * v_x + pose[3] * v_y + pose[6] * v_z)
            store(S, V_MEAN_Y + j, pose[1] * v_x + pose[4] * v_y + pose[7] * v_z)
            store(S, V_MEAN_Z + j, pose[2] * v_x + pose[5] * v_y + pose[8] * v_z)
            store(S, V_OPACITY + j, v_log_opacity / larger(load(S, OPACITY + j), TINY))
        for lane in range(filled):
            i, drawn = first + lane, S[DRAWN + lane] > ZERO
            for k in range(3):
                v_means[i, k] = S[V_MEAN_X + k * BLOCK + lane] if drawn else ZERO
                v_scales[i, k] = S[V_SCALE_X + k * BLOCK + lane] if drawn else ZERO
                v_slopes[i, k] = S[V_SLOPE_X + k * BLOCK + lane] if drawn else ZERO
            for k in range(4):
                v_quats[i, k] = S[V_QUAT_W + k * BLOCK + lane] if drawn else ZERO
            v_opacities[i] = S[V_OPACITY + lane] if drawn else ZERO


@parallel_kernel
def project_backward(
    means: F32,
    quats: F32,
    scales: F32,
    opacities: F32,
    slopes: F32,
    view: F32,  # [20] of `pinhole.pack`
    screen_filter: Row,
    scratch: F32,  # [workers, SCRATCH]
    next_block: I64,  # [1] shared counter of the workers
    slots: Any,  # [N] SLOTS
    v_pairs: F32,  # [16 slots] of `composite_backward`
    v_colors: F32,  # [N 3] written, as what follows: 0 where not drawn
    contribution: F32,  # [N]
    spreads: F32,  # [N]
    v_means: F32,
    v_quats: F32,
    v_scales: F32,
    v_opacities: F32,
    v_slopes: F32,
) -> None:
    """Turn the gradients of pairs into those of Gaussians."""
    next_block[0] = 0
    for worker in numba.prange(scratch.shape[0]):
        _blocks_backward(
            means, quats, scales, opacities, slopes, view, screen_filter, scratch[worker], next_block, slots,
            v_pairs, v_colors, contribution, spreads, v_means, v_quats, v_scales, v_opacities, v_slopes,
        )  # fmt: skip
