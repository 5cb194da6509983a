"""Projection of Gaussians to splats with both filters of Mip-Splatting, and its derivative.

Formulas: `engine.rasterizer.projection` and `smoothing`. With W the triangular factor of half the conic,
(u, v) = W (pixel - mean), a splat's alpha is exp(log opacity - u^2 - v^2). A splat is four vectors:

    mean x, mean y, a, b
    c, log opacity, extent, depth
    red, green, blue, slope u
    slope v, reach x, reach y

with u = a dx + b dy and v = c dy. `extent` is the largest u^2 + v^2 that is drawn; 0: nothing is drawn.
"""

from __future__ import annotations

import math

import warp as wp

from sags_node.engine import interface

wp.set_module_options({"enable_backward": False})

vec16 = wp.types.vector(16, wp.float32)
RECORD = 4  # vectors of a splat
FAR_KEY = 0x7FFFFFFF  # sorts what is not drawn behind all else
NEAR_PLANE, MAX_OPACITY = interface.NEAR_PLANE, interface.MAX_OPACITY
LOG_MIN_ALPHA = math.log(interface.MIN_ALPHA)
LEAST_QUAT, MOST_QUAT = interface.MIN_QUAT_NORM**2, 1e36  # squared lengths
LARGE, FAR, TINY = 1e18, 1e9, 1e-30  # has a finite square; px; keeps quotients finite
# Sums over pixels that `project_backward` takes, in this order.
G, GU, GV, GUU, GUV, GVV, RED, GREEN, BLUE, DEPTH, SEEN, LIT_U, LIT_V, SPREAD = range(14)


@wp.func
def rotation(q: wp.vec4):
    w, x, y, z = q[0], q[1], q[2], q[3]
    return wp.mat33(
        1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y),
        2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x),
        2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y),
    )  # fmt: skip


@wp.func
def camera_rotation(view: wp.array(dtype=float)):
    return wp.mat33(view[0], view[1], view[2], view[3], view[4], view[5], view[6], view[7], view[8])


@wp.func
def smoothed(scale: float, variance: float):
    """Return a scale after the 3D filter, and the ratio of the scale before it to that."""
    root, share = float(scale), float(1.0)
    if not variance <= 0.0:
        root = wp.sqrt(scale * scale + variance)
        share = scale / root
    return root, share


@wp.func
def filtered(scales: wp.vec3, variance: float):
    """Return `smoothed` of all axes, and the share of the opacity that the 3D filter leaves."""
    x, share_x = smoothed(scales[0], variance)
    y, share_y = smoothed(scales[1], variance)
    z, share_z = smoothed(scales[2], variance)
    kept = wp.max(share_x * share_y, wp.max(share_x * share_z, share_y * share_z))
    return wp.vec3(x, y, z), wp.vec3(share_x, share_y, share_z), kept


@wp.func
def whitening(xx: float, xy: float, yy: float, det0: float, variance: float, compensates: int):
    """Return a, b, c of a splat, and the share of the opacity that the 2D filter leaves."""
    det = det0 + variance * (xx + yy) + variance * variance
    inverse_yy = 1.0 / (yy + variance)
    along = wp.sqrt(0.5 * (yy + variance) / det)
    kept = float(1.0)
    if compensates > 0:
        kept = wp.sqrt(det0 / det)
    return along, -along * xy * inverse_yy, wp.sqrt(0.5 * inverse_yy), kept


@wp.kernel(grid_stride=False)
def project(
    means: wp.array(dtype=wp.vec3), quats: wp.array(dtype=wp.vec4), scales: wp.array(dtype=wp.vec3),
    opacities: wp.array(dtype=float), colors: wp.array(dtype=wp.vec3), slopes: wp.array(dtype=wp.vec3),
    smoothing: wp.array(dtype=float), view: wp.array(dtype=float), variance: float, compensates: int,
    splats: wp.array2d(dtype=wp.vec4), keys: wp.array(dtype=int), order: wp.array(dtype=int),
):  # fmt: skip
    i = wp.tid()
    R = camera_rotation(view)
    p = R * means[i] + wp.vec3(view[9], view[10], view[11])
    fx, fy, z = view[12], view[13], p[2]
    inverse_z = float(1.0)
    if z > NEAR_PLANE:
        inverse_z = 1.0 / z
    slope_x, slope_y = p[0] * inverse_z, p[1] * inverse_z
    held_x = wp.min(wp.max(slope_x, view[16]), view[17])
    held_y = wp.min(wp.max(slope_y, view[18]), view[19])
    q = quats[i]
    norm2 = wp.dot(q, q)
    has_direction = norm2 > LEAST_QUAT and norm2 < MOST_QUAT
    if has_direction:
        q = q / wp.sqrt(norm2)
    Q = rotation(q)
    scale, share, left = filtered(scales[i], smoothing[i])
    V0 = wp.cw_mul(wp.transpose(Q) * (fx * inverse_z * (R[0] - held_x * R[2])), scale)
    V1 = wp.cw_mul(wp.transpose(Q) * (fy * inverse_z * (R[1] - held_y * R[2])), scale)
    xx, xy, yy = wp.dot(V0, V0), wp.dot(V0, V1), wp.dot(V1, V1)
    normal = wp.cross(V0, V1)  # its square is the determinant: no cancellation for flat Gaussians
    along, across, down, kept = whitening(xx, xy, yy, wp.dot(normal, normal), variance, compensates)
    mean_x, mean_y = fx * slope_x + view[14], fy * slope_y + view[15]
    slope = wp.cw_mul(share, slopes[i])
    px, py = wp.dot(V0, slope), wp.dot(V1, slope)
    slope_u, slope_v = 2.0 * (along * px + across * py), 2.0 * down * py
    c = colors[i]
    opacity = wp.min(opacities[i] * left * kept, MAX_OPACITY)
    drawn = z > NEAR_PLANE and has_direction and xx + yy < LARGE and opacities[i] < LARGE
    drawn = drawn and wp.abs(mean_x) + wp.abs(mean_y) < FAR and opacity > 0.0
    drawn = drawn and wp.abs(slope_u) + wp.abs(slope_v) < LARGE
    drawn = drawn and wp.abs(c[0]) + wp.abs(c[1]) + wp.abs(c[2]) < LARGE
    log_opacity, extent = float(0.0), float(0.0)
    if drawn:
        log_opacity = wp.log(opacity)
        extent = wp.max(log_opacity - LOG_MIN_ALPHA, 0.0)
    reach_x = wp.sqrt(extent * (across * across + down * down)) / (along * down)
    splats[i, 0] = wp.vec4(mean_x, mean_y, along, across)
    splats[i, 1] = wp.vec4(down, log_opacity, extent, z)
    splats[i, 2] = wp.vec4(c[0], c[1], c[2], slope_u)
    splats[i, 3] = wp.vec4(slope_v, reach_x, wp.sqrt(extent) / down, 0.0)
    order[i] = i
    keys[i] = FAR_KEY
    if extent > 0.0:
        keys[i] = wp.cast(z, wp.int32)  # positive floats sort like their bits


@wp.func
def by_scale(scale: float, variance: float, by_root: float, by_share: float):
    """Return the derivative with respect to a scale, given those with respect to `smoothed`'s results."""
    found = float(by_root)
    if variance > 0.0:
        root = wp.sqrt(scale * scale + variance)
        found = by_root * scale / root + by_share * variance / (root * root) / root
    return found


@wp.kernel(grid_stride=False)
def project_backward(
    means: wp.array(dtype=wp.vec3), quats: wp.array(dtype=wp.vec4), scales: wp.array(dtype=wp.vec3),
    opacities: wp.array(dtype=float), slopes: wp.array(dtype=wp.vec3), smoothing: wp.array(dtype=float),
    view: wp.array(dtype=float), variance: float, compensates: int,
    own_slots: wp.array(dtype=wp.vec2i), sums: wp.array(dtype=vec16),
    v_means: wp.array(dtype=wp.vec3), v_quats: wp.array(dtype=wp.vec4), v_scales: wp.array(dtype=wp.vec3),
    v_opacities: wp.array(dtype=float), v_colors: wp.array(dtype=wp.vec3), v_slopes: wp.array(dtype=wp.vec3),
    contribution: wp.array(dtype=float), spreads: wp.array(dtype=float),
):  # fmt: skip
    """Turn each splat's sums over pixels into the gradients of its Gaussian; 0 where it was not drawn."""
    i = wp.tid()
    slots = own_slots[i]
    m = vec16()
    for slot in range(slots[0], slots[1]):
        m += sums[slot]
    v_colors[i] = wp.vec3(m[RED], m[GREEN], m[BLUE])
    contribution[i] = m[SEEN]
    spreads[i] = 2.0 * m[SPREAD]
    if slots[0] == slots[1]:
        v_means[i] = wp.vec3()
        v_scales[i] = wp.vec3()
        v_slopes[i] = wp.vec3()
        v_quats[i] = wp.vec4()
        v_opacities[i] = 0.0
        return
    # The forward pass again.
    R = camera_rotation(view)
    p = R * means[i] + wp.vec3(view[9], view[10], view[11])
    fx, fy = view[12], view[13]
    inverse_z = 1.0 / p[2]
    slope_x, slope_y = p[0] * inverse_z, p[1] * inverse_z
    held_x = wp.min(wp.max(slope_x, view[16]), view[17])
    held_y = wp.min(wp.max(slope_y, view[18]), view[19])
    q = quats[i]
    n = 1.0 / wp.sqrt(wp.dot(q, q))
    q = q * n
    Q = rotation(q)
    f = smoothing[i]
    scale, kept_share, left = filtered(scales[i], f)
    j00, j11 = fx * inverse_z, fy * inverse_z
    A0, A1 = j00 * (R[0] - held_x * R[2]), j11 * (R[1] - held_y * R[2])
    U0, U1 = wp.transpose(Q) * A0, wp.transpose(Q) * A1
    V0, V1 = wp.cw_mul(U0, scale), wp.cw_mul(U1, scale)
    xx, xy, yy = wp.dot(V0, V0), wp.dot(V0, V1), wp.dot(V1, V1)
    normal = wp.cross(V0, V1)
    det0 = wp.dot(normal, normal)
    along, across, down, kept = whitening(xx, xy, yy, det0, variance, compensates)
    a = wp.cw_mul(kept_share, slopes[i])
    px, py = wp.dot(V0, a), wp.dot(V1, a)
    slope_u, slope_v = 2.0 * (along * px + across * py), 2.0 * down * py

    # log alpha = log opacity' - u^2 - v^2; see `engine.rasterizer.projection_backward`; its 2 ln 2 is 2 here.
    x_x, x_y = 2.0 * along * m[LIT_U], 2.0 * (across * m[LIT_U] + down * m[LIT_V])
    y_x, y_y = along * slope_u, across * slope_u + down * slope_v
    luminance = m[RED] + m[GREEN] + m[BLUE]
    v_mean_x = 2.0 * along * m[GU] - y_x * luminance
    v_mean_y = 2.0 * (across * m[GU] + down * m[GV]) - y_y * luminance
    v_log_opacity = float(0.0)
    if opacities[i] * left * kept < MAX_OPACITY:
        v_log_opacity = m[G]
    c_xx = 2.0 * along * along * m[GUU] - x_x * y_x
    c_xy = 2.0 * along * (across * m[GUU] + down * m[GUV]) - 0.5 * (x_x * y_y + x_y * y_x)
    c_yy = 2.0 * (across * (across * m[GUU] + 2.0 * down * m[GUV]) + down * down * m[GVV]) - x_y * y_y
    by_opacity_share = float(0.0)
    if compensates > 0:
        by_opacity_share = 2.0 * variance * v_log_opacity / wp.max(det0, TINY)
    s_xx, s_xy = by_opacity_share * along * along, by_opacity_share * along * across
    s_yy = by_opacity_share * (across * across + down * down)
    W0, W1 = wp.cross(V1, normal), wp.cross(normal, V0)  # det0 cov0^-1 V
    v0 = 2.0 * (c_xx * V0 + c_xy * V1) + s_xx * W0 + s_xy * W1 + x_x * a
    v1 = 2.0 * (c_xy * V0 + c_yy * V1) + s_xy * W0 + s_yy * W1 + x_y * a

    # The 3D filter. The opacity depends on the two larger shares only.
    by_scales = wp.cw_mul(v0, U0) + wp.cw_mul(v1, U1)
    by_slopes = x_x * V0 + x_y * V1
    v_slopes[i] = wp.cw_mul(by_slopes, kept_share)
    by_left = v_log_opacity / wp.max(left, TINY)
    s = kept_share
    by_x, by_y, by_z = float(0.0), float(0.0), float(0.0)
    if s[2] <= wp.min(s[0], s[1]):
        by_x, by_y = s[1], s[0]
    elif s[1] <= s[0]:
        by_x, by_z = s[2], s[0]
    else:
        by_y, by_z = s[2], s[1]
    by_shares = by_left * wp.vec3(by_x, by_y, by_z) + wp.cw_mul(by_slopes, slopes[i])
    given = scales[i]
    v_scales[i] = wp.vec3(
        by_scale(given[0], f, by_scales[0], by_shares[0]),
        by_scale(given[1], f, by_scales[1], by_shares[1]),
        by_scale(given[2], f, by_scales[2], by_shares[2]),
    )
    v_opacities[i] = v_log_opacity / wp.max(opacities[i], TINY)

    v0, v1 = wp.cw_mul(v0, scale), wp.cw_mul(v1, scale)
    D = wp.outer(A0, v0) + wp.outer(A1, v1)  # gradient of the rotation
    w, x, y, z = q[0], q[1], q[2], q[3]
    turned_x, turned_y, turned_z = D[2, 1] - D[1, 2], D[0, 2] - D[2, 0], D[1, 0] - D[0, 1]
    with_y, with_z, of_yz = D[0, 1] + D[1, 0], D[0, 2] + D[2, 0], D[1, 2] + D[2, 1]
    v_q = 2.0 * wp.vec4(
        x * turned_x + y * turned_y + z * turned_z,
        w * turned_x + y * with_y + z * with_z - 2.0 * x * (D[1, 1] + D[2, 2]),
        w * turned_y + x * with_y + z * of_yz - 2.0 * y * (D[0, 0] + D[2, 2]),
        w * turned_z + x * with_z + y * of_yz - 2.0 * z * (D[0, 0] + D[1, 1]),
    )
    v_quats[i] = n * (v_q - wp.dot(v_q, q) * q)
    a0, a1 = Q * v0, Q * v1  # gradients of A0 and A1
    v_j02, v_j12 = wp.dot(a0, R[2]), wp.dot(a1, R[2])
    v_inverse_z = fx * (wp.dot(a0, R[0]) - held_x * v_j02) + fy * (wp.dot(a1, R[1]) - held_y * v_j12)
    v_slope_x, v_slope_y = fx * v_mean_x, fy * v_mean_y
    if held_x == slope_x:
        v_slope_x -= j00 * v_j02
    if held_y == slope_y:
        v_slope_y -= j11 * v_j12
    v_z = m[DEPTH] - inverse_z * (v_slope_x * slope_x + v_slope_y * slope_y + v_inverse_z * inverse_z)
    v_means[i] = wp.transpose(R) * wp.vec3(v_slope_x * inverse_z, v_slope_y * inverse_z, v_z)
