"""Projection of Gaussians to splats (EWA, Zwicker et al. 2001) with the 2D Mip filter.

    V = J R_cam R_q S  [2, 3]      cov0 = V V^T      cov = cov0 + 0.1 px^2 I
    opacity' = opacity sqrt(det cov0 / det cov)               (Mip-Splatting, Yu et al. 2024)

or, for comparison, with the dilation of 3D Gaussian Splatting (Kerbl et al. 2023): cov = cov0 + 0.3 px^2 I
and opacity' = opacity. `screen_filter` says which: the variance, and 1 if the opacity is reduced as above,
else 0.

det cov0 is the sum of the squared 2x2 minors of V (Cauchy-Binet): no cancellation for flat Gaussians. J is
evaluated at x/z, y/z clamped to the widened frustum, as Mip-Splatting and gsplat do.

The kernel takes Gaussians in blocks: it copies their parameters into planes of a small scratch array, works
on LANES of them at a time, one in each lane of a vector, and copies the finished records out.
`projection_backward` differentiates it with the same helpers.
"""

import math
from typing import Any

import numba
import numpy as np

from sags_node.engine import interface
from sags_node.engine.pinhole import to_camera
from sags_node.kernels.jit import copy, inlined, kernel, parallel_kernel, take
from sags_node.kernels.vectors import (
    LANES,
    RECORD,
    larger,
    load,
    magnitudes,
    select,
    smaller,
    split_powers,
    spread,
    square_roots,
    store,
    store_records,
)
from sags_node.types import F32, I64

f4 = np.float32
BLOCK = 64  # Gaussians per block
GRAIN = 16  # blocks that a worker takes at a time: neighbours in memory

# Planes of a block's scratch
MEAN_X, MEAN_Y, MEAN_Z, SCALE_X, SCALE_Y, SCALE_Z = (k * BLOCK for k in range(6))
QUAT_W, QUAT_X, QUAT_Y, QUAT_Z, OPACITY = (k * BLOCK for k in range(6, 11))
SLOPE_X, SLOPE_Y, SLOPE_Z = (k * BLOCK for k in range(11, 14))
INPUTS = 14  # planes up to here
RED, GREEN, BLUE, DEPTH = (k * BLOCK for k in range(INPUTS, INPUTS + 4))
RECORDS = (INPUTS + 4) * BLOCK  # finished splats, one after the other
SCRATCH = RECORDS + RECORD * BLOCK  # floats per worker

NEAR_PLANE, MAX_OPACITY = f4(interface.NEAR_PLANE), f4(interface.MAX_OPACITY)
LOG2_MIN_ALPHA = f4(math.log2(interface.MIN_ALPHA))
MIN_QUAT_NORM2, MAX_QUAT_NORM2 = f4(interface.MIN_QUAT_NORM**2), f4(1e36)  # where float32 can still square

ZERO, HALF, ONE, TWO = f4(0.0), f4(0.5), f4(1.0), f4(2.0)
MAX_COORDINATE = f4(1e9)  # px; a comparison with it also rejects NaN and infinity
MAX_VALUE = f4(1e18)  # its square is still finite
TWO_LN2 = f4(2.0 * math.log(2.0))
WHITEN2 = f4(0.5 / math.log(2.0))  # exp(-q / 2) = 2**(-WHITEN2 q)
# log2 m = 2 / ln 2 artanh s with s = (m - 1) / (m + 1); for |s| <= 0.172 these terms of its series suffice
L1, L3, L5, L7, L9 = (f4(2.0 / math.log(2.0) / k) for k in (1, 3, 5, 7, 9))

Row = tuple[Any, ...]


@inlined
def unpack(view: F32) -> Row:
    """Return pose, intrinsics and limits of a camera of `pinhole.pack` as tuples, which stay in registers."""
    pose = (
        view[0], view[1], view[2], view[3], view[4], view[5], view[6], view[7], view[8],
        view[9], view[10], view[11],
    )  # fmt: skip
    return pose, (view[12], view[13], view[14], view[15]), (view[16], view[17], view[18], view[19])


@inlined
def rotation(w: Any, x: Any, y: Any, z: Any) -> Row:
    """Return the rotation matrix of a unit quaternion, row by row."""
    return (
        ONE - TWO * (y * y + z * z), TWO * (x * y - w * z), TWO * (x * z + w * y),
        TWO * (x * y + w * z), ONE - TWO * (x * x + z * z), TWO * (y * z - w * x),
        TWO * (x * z - w * y), TWO * (y * z + w * x), ONE - TWO * (x * x + y * y),
    )  # fmt: skip


@inlined
def screen_axes(R: Row, j00: Any, j02: Any, j11: Any, j12: Any) -> Row:
    """Return J R_cam [2, 3]: how a small step in the world moves a point in the image."""
    return (
        j00 * R[0] + j02 * R[6], j00 * R[1] + j02 * R[7], j00 * R[2] + j02 * R[8],
        j11 * R[3] + j12 * R[6], j11 * R[4] + j12 * R[7], j11 * R[5] + j12 * R[8],
    )  # fmt: skip


@inlined
def times_rotation(A: Row, Q: Row) -> Row:
    """Return A [2, 3] Q [3, 3]."""
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
    """Return xx, xy, yy of V V^T, its determinant, and the minors of V that give it."""
    xx = V[0] * V[0] + V[1] * V[1] + V[2] * V[2]
    xy = V[0] * V[3] + V[1] * V[4] + V[2] * V[5]
    yy = V[3] * V[3] + V[4] * V[4] + V[5] * V[5]
    m01 = V[0] * V[4] - V[1] * V[3]
    m02 = V[0] * V[5] - V[2] * V[3]
    m12 = V[1] * V[5] - V[2] * V[4]
    return xx, xy, yy, m01 * m01 + m02 * m02 + m12 * m12, m01, m02, m12


@inlined
def whitening(xx: Any, xy: Any, yy: Any, det0: Any, screen_filter: Row) -> Row:
    """Return the triangular factor (xx, xy, yy) of the filtered covariance's conic, for exponents of base 2,
    and the share of the opacity that the filter leaves."""
    variance, compensates = screen_filter
    det = det0 + variance * (xx + yy) + variance * variance
    filtered_yy = yy + variance
    inverse_yy = ONE / filtered_yy
    along = square_roots(WHITEN2 * filtered_yy / det)
    kept = square_roots(det0 / det) if compensates > ZERO else spread(ONE)
    return along, -along * xy * inverse_yy, square_roots(WHITEN2 * inverse_yy), kept


@inlined
def clamp(value: Any, low: Any, high: Any) -> Any:
    return smaller(larger(value, low), high)


@inlined
def unit_quaternion(w: Any, x: Any, y: Any, z: Any) -> Row:
    """Return the quaternion with length 1, one over its former length, and whether it has a direction."""
    norm2 = w * w + x * x + y * y + z * z
    has_direction = (norm2 > MIN_QUAT_NORM2) & (norm2 < MAX_QUAT_NORM2)
    n = ONE / square_roots(select(has_direction, norm2, ONE))
    return w * n, x * n, y * n, z * n, n, has_direction


@inlined
def log2_of(x: Any) -> Any:
    """The log2 of positive numbers; relative error 1e-7."""
    m, n = split_powers(x)
    s = (m - ONE) / (m + ONE)
    ss = s * s
    return s * ((((ss * L9 + L7) * ss + L5) * ss + L3) * ss + L1) + n


@inlined
def ellipse(a: Any, b: Any, c: Any, extent: Any) -> Row:
    """Return reach_x, reach_y and lowest_x of a splat's record (`layout`)."""
    inverse_a = ONE / a
    reach_y = square_roots(extent) / c
    reach_x = square_roots(extent * (b * b + c * c)) * inverse_a / c
    return reach_x, reach_y, -b * inverse_a * reach_y


@inlined
def times_axes(V: Row, ax: Any, ay: Any, az: Any) -> Row:
    """Return V [2, 3] a [3]."""
    return V[0] * ax + V[1] * ay + V[2] * az, V[3] * ax + V[4] * ay + V[5] * az


@inlined
def screen_slopes(W: Row, px: Any, py: Any) -> Row:
    """Return the slopes of the luminance along u and v, given V a = (px, py): see `types.Gaussians.slopes`.
    With C = 2 ln 2 W^T W the conic, a V^T C d = (2 ln 2 W V a) . (W d)."""
    along, across, down = W
    return TWO_LN2 * (along * px + across * py), TWO_LN2 * down * py


@inlined
def load_block(
    S: F32, means: F32, quats: F32, scales: F32, opacities: F32, slopes: F32, first: int, filled: int
) -> None:
    for lane in range(filled):
        i = first + lane
        S[MEAN_X + lane] = means[i, 0]
        S[MEAN_Y + lane] = means[i, 1]
        S[MEAN_Z + lane] = means[i, 2]
        S[SCALE_X + lane] = scales[i, 0]
        S[SCALE_Y + lane] = scales[i, 1]
        S[SCALE_Z + lane] = scales[i, 2]
        S[QUAT_W + lane] = quats[i, 0]
        S[QUAT_X + lane] = quats[i, 1]
        S[QUAT_Y + lane] = quats[i, 2]
        S[QUAT_Z + lane] = quats[i, 3]
        S[OPACITY + lane] = opacities[i]
        S[SLOPE_X + lane] = slopes[i, 0]
        S[SLOPE_Y + lane] = slopes[i, 1]
        S[SLOPE_Z + lane] = slopes[i, 2]


@kernel
def _project_blocks(
    means: F32, quats: F32, scales: F32, opacities: F32, colors: F32, slopes: F32, view: F32,
    screen_filter: Row, S: F32,
    next_block: I64, splats: F32, depths: F32,
) -> None:  # fmt: skip
    count, blocks = means.shape[0], (means.shape[0] + BLOCK - 1) // BLOCK
    pose, (fx, fy, cx, cy), limits = unpack(view)
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
        load_block(S, means, quats, scales, opacities, slopes, first, filled)
        for lane in range(filled):
            S[RED + lane] = colors[first + lane, 0]
            S[GREEN + lane] = colors[first + lane, 1]
            S[BLUE + lane] = colors[first + lane, 2]
        for j in range(0, filled, LANES):
            x, y, z = to_camera(pose, load(S, MEAN_X + j), load(S, MEAN_Y + j), load(S, MEAN_Z + j))
            in_front = z > NEAR_PLANE
            inverse_z = ONE / select(in_front, z, ONE)
            slope_x, slope_y = x * inverse_z, y * inverse_z
            held_x = clamp(slope_x, limits[0], limits[1])
            held_y = clamp(slope_y, limits[2], limits[3])
            qw, qx, qy, qz, _, has_direction = unit_quaternion(
                load(S, QUAT_W + j), load(S, QUAT_X + j), load(S, QUAT_Y + j), load(S, QUAT_Z + j)
            )
            Q = rotation(qw, qx, qy, qz)
            j00, j11 = fx * inverse_z, fy * inverse_z
            A = screen_axes(pose, j00, -j00 * held_x, j11, -j11 * held_y)
            U = times_rotation(A, Q)
            V = scale_axes(U, load(S, SCALE_X + j), load(S, SCALE_Y + j), load(S, SCALE_Z + j))
            xx, xy, yy, det0, _, _, _ = covariance(V)
            along, across, down, kept = whitening(xx, xy, yy, det0, screen_filter)
            mean_x, mean_y = fx * slope_x + cx, fy * slope_y + cy
            given, red, green, blue = (
                load(S, OPACITY + j),
                load(S, RED + j),
                load(S, GREEN + j),
                load(S, BLUE + j),
            )
            drawn = in_front & has_direction & (xx + yy < MAX_VALUE) & (given < MAX_VALUE)
            drawn &= magnitudes(mean_x) + magnitudes(mean_y) < MAX_COORDINATE
            a = load(S, SLOPE_X + j), load(S, SLOPE_Y + j), load(S, SLOPE_Z + j)
            px, py = times_axes(V, *a)
            slope_u, slope_v = screen_slopes((along, across, down), px, py)
            drawn &= magnitudes(slope_u) + magnitudes(slope_v) < MAX_VALUE
            drawn &= magnitudes(red) + magnitudes(green) + magnitudes(blue) < MAX_VALUE
            opacity = smaller(given * kept, MAX_OPACITY)
            drawn &= opacity > ZERO
            log2_opacity = log2_of(select(drawn, opacity, ONE))
            extent = select(drawn, larger(log2_opacity - LOG2_MIN_ALPHA, ZERO), ZERO)
            reach_x, reach_y, lowest_x = ellipse(along, across, down, extent)
            store(S, DEPTH + j, select(extent > ZERO, z, ZERO))
            store_records(
                S,
                RECORDS + j * RECORD,
                (
                    mean_x, mean_y, along, across, down, log2_opacity, extent, red, green, blue, z,
                    reach_x, reach_y, lowest_x, slope_u, slope_v,
                ),
            )  # fmt: skip
        copy(splats, first * RECORD, S, RECORDS, filled * RECORD)
        copy(depths, first, S, DEPTH, filled)


@parallel_kernel
def project(
    means: F32,
    quats: F32,
    scales: F32,
    opacities: F32,
    colors: F32,
    slopes: F32,
    view: F32,  # [20] of `pinhole.pack`
    screen_filter: Row,
    scratch: F32,  # [workers, SCRATCH]
    next_block: I64,  # [1] shared counter of the workers
    splats: F32,  # [16 N] written: SPLAT records
    depths: F32,  # [N] written; 0 where not drawn
) -> None:
    next_block[0] = 0
    for worker in numba.prange(scratch.shape[0]):
        _project_blocks(
            means, quats, scales, opacities, colors, slopes, view, screen_filter, scratch[worker],
            next_block, splats, depths,
        )  # fmt: skip
