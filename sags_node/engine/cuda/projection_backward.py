"""The derivative of the projection by every parameter: `engine.rasterizer.projection_backward` in vectors.

Quaternion: turning a Gaussian by a small vector d in its own axes moves a row a of J R_cam, seen there as
U = R_q^T a, by U x d, so dL/dd = sum v_U x U. The unit quaternion q then moves by q (0, d) / 2, across q and
half as far as d. So v_q = 2 q (0, dL/dd), divided by the length of the given quaternion.
"""

from __future__ import annotations

import math

import triton
import triton.language as tl

from sags_node.engine.cuda.layout import (
    V_DEPTH,
    V_RED,
    V_SPLAT_FLOATS,
    V_SUM,
    V_U,
    V_UU,
    V_V,
)
from sags_node.engine.cuda.projection import (
    MAX_OPACITY,
    MIP_VARIANCE,
    jacobian,
    kept_by_smoothing,
    load_scales,
    load_turn,
    load_view,
    whitening,
)
from sags_node.engine.cuda.signatures import Compiled
from sags_node.engine.cuda.spherical_harmonics import direction_backward
from sags_node.engine.cuda.vectors import (
    add,
    combine,
    cross,
    dot,
    load3,
    multiply,
    rotate,
    select,
    size,
    store3,
    times_matrix,
    times_transposed,
)

BLOCK = 64  # Gaussians per program
WARPS = 2
TINY = tl.constexpr(1e-30)  # keeps quotients of vanishing Gaussians finite
TWO_LN2 = tl.constexpr(2.0 * math.log(2.0))


@triton.jit
def covariance_backward(
    v_x: tl.tuple,
    v_y: tl.tuple,
    minors: tl.tuple,
    factor: tl.tuple,
    moments: tl.tuple,
    v_log_opacity: tl.tensor,
    ANTIALIASED: tl.constexpr,
) -> tl.tuple:
    """Gradients of the rows of V.

    dL/dcov = 1/2 W'^T (sum g w' w'^T) W' with the base-e factor W' = sqrt(2 ln 2) W. And opacity' = opacity
    sqrt(det cov0 / det cov) gives dlog opacity'/dV = variance cov^-1 cov0^-1 V. As a difference that would
    cancel for large Gaussians; but det cov0 cov0^-1 V has the rows V_y x m and m x V_x with m = V_x x V_y.
    """
    along, across, down = factor
    uu, uv, vv = moments
    k = TWO_LN2 * TWO_LN2  # both halves of the symmetric dL/dcov
    c_xx = along * along * uu * k
    c_xy = along * (across * uu + down * uv) * k
    c_yy = (across * (across * uu + 2.0 * down * uv) + down * down * vv) * k
    by_x, by_y = combine(c_xx, v_x, c_xy, v_y), combine(c_xy, v_x, c_yy, v_y)
    if ANTIALIASED:
        share = v_log_opacity * (TWO_LN2 * MIP_VARIANCE) / tl.maximum(dot(minors, minors), TINY)
        s_xx, s_xy = share * along * along, share * along * across
        s_yy = share * (across * across + down * down)
        w_x, w_y = cross(v_y, minors), cross(minors, v_x)
        by_x, by_y = add(by_x, combine(s_xx, w_x, s_xy, w_y)), add(by_y, combine(s_xy, w_x, s_yy, w_y))
    return by_x, by_y


@triton.jit
def smoothing_backward(
    axes: tl.tuple,
    shares: tl.tuple,
    opacity: tl.tensor,
    variance: tl.tensor,
    v_axes: tl.tuple,
    v_opacity: tl.tensor,
) -> tl.tuple:
    """Gradients of the given scales and opacity from those of the filtered ones.

    With r = scale / scale': d scale' / d scale = r, and d opacity' / d scale = opacity f / scale'^3 times the
    other large r, which stays finite for a scale of 0; it is 0 for the smallest axis.
    """
    a, b, c = shares
    share = opacity * v_opacity * variance
    thin_c = c <= tl.minimum(a, b)
    thin_b = (c > tl.minimum(a, b)) & (b <= a)
    by_a = tl.where(thin_c, b, tl.where(thin_b, c, 0.0))
    by_b = tl.where(thin_c, a, tl.where(thin_b, 0.0, c))
    by_c = tl.where(thin_c, 0.0, tl.where(thin_b, a, b))
    x, y, z = axes
    changed = (
        v_axes[0] * a + share * by_a / (x * x) / x,
        v_axes[1] * b + share * by_b / (y * y) / y,
        v_axes[2] * c + share * by_c / (z * z) / z,
    )
    # 0 for all that was not drawn, whatever its scales: 0 * NaN is not 0
    on = (variance > 0.0) & (size(v_axes) + tl.abs(v_opacity) > 0.0)
    v_scales = (
        tl.where(on, changed[0], v_axes[0]),
        tl.where(on, changed[1], v_axes[1]),
        tl.where(on, changed[2], v_axes[2]),
    )
    return v_scales, tl.where(on, v_opacity * kept_by_smoothing(shares), v_opacity)


@triton.jit(do_not_specialize=["count"])
def project_backward(
    means: tl.tensor,  # as in `project`
    quats: tl.tensor,
    scales: tl.tensor,
    opacities: tl.tensor,
    sh_rest: tl.tensor,
    smoothing: tl.tensor,
    camera: tl.tensor,
    v_splats: tl.tensor,  # [N, V_SPLAT_FLOATS] of `sum_pairs`
    v_means: tl.tensor,  # [N, 3] written, as the next three
    v_quats: tl.tensor,  # [N, 4]
    v_scales: tl.tensor,  # [N, 3]
    v_opacities: tl.tensor,  # [N]
    count: tl.tensor,  # N
    TERMS: tl.constexpr,
    SMOOTHED: tl.constexpr,
    ANTIALIASED: tl.constexpr,
    BLOCK: tl.constexpr,
) -> None:
    rows = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    inside = rows < count
    mean = load3(means + 3 * rows, inside)
    w, q, n, _ = load_turn(quats, rows, inside)
    axes, shares = load_scales(scales, smoothing, rows, inside, SMOOTHED)
    given = tl.load(opacities + rows, mask=inside, other=0.0)
    filtered = given * kept_by_smoothing(shares)

    v_splat = v_splats + rows * V_SPLAT_FLOATS
    g = tl.load(v_splat + V_SUM, mask=inside, other=0.0)
    g_u = tl.load(v_splat + V_U, mask=inside, other=0.0)
    g_v = tl.load(v_splat + V_V, mask=inside, other=0.0)
    moments = load3(v_splat + V_UU, inside)
    v_depth = tl.load(v_splat + V_DEPTH, mask=inside, other=0.0)
    v_color = load3(v_splat + V_RED, inside)
    total = size((g, g_u, g_v)) + size(moments) + size(v_color) + tl.abs(v_depth)
    drawn = total != 0.0  # also where it is NaN; what was not drawn may hold NaN itself

    # the forward pass again
    rotation, translation, intrinsics = load_view(camera)
    point = add(times_matrix(rotation, mean), translation)
    inverse_z, slope, held, j_x, j_y = jacobian(point, intrinsics, camera)
    a_x, a_y = times_transposed(rotation, j_x), times_transposed(rotation, j_y)
    u_x, u_y = rotate(-w, q, a_x), rotate(-w, q, a_y)
    v_x, v_y = multiply(u_x, axes), multiply(u_y, axes)
    factor, kept, minors = whitening(v_x, v_y, ANTIALIASED)

    v_log_opacity = tl.where(filtered * kept < MAX_OPACITY, g, 0.0)
    by_x, by_y = covariance_backward(v_x, v_y, minors, factor, moments, v_log_opacity, ANTIALIASED)
    v_axes = select(drawn, add(multiply(by_x, u_x), multiply(by_y, u_y)))
    by_x, by_y = multiply(by_x, axes), multiply(by_y, axes)
    v_turn = select(drawn, add(cross(by_x, u_x), cross(by_y, u_y)))
    v_opacity = tl.where(drawn, v_log_opacity / tl.maximum(filtered, TINY), 0.0)

    # J = (fx / z, 0, -fx / z held_x), (0, fy / z, -fy / z held_y); a held slope is constant
    v_j_x = times_matrix(rotation, rotate(w, q, by_x))
    v_j_y = times_matrix(rotation, rotate(w, q, by_y))
    fx, fy = intrinsics[0], intrinsics[1]
    v_inverse_z = fx * (v_j_x[0] - held[0] * v_j_x[2]) + fy * (v_j_y[1] - held[1] * v_j_y[2])
    v_slope_x = fx * TWO_LN2 * factor[0] * g_u
    v_slope_y = fy * TWO_LN2 * (factor[1] * g_u + factor[2] * g_v)
    v_slope_x -= tl.where(held[0] == slope[0], j_x[0] * v_j_x[2], 0.0)
    v_slope_y -= tl.where(held[1] == slope[1], j_y[1] * v_j_y[2], 0.0)
    along_z = v_slope_x * slope[0] + v_slope_y * slope[1] + v_inverse_z * inverse_z
    v_point = (v_slope_x * inverse_z, v_slope_y * inverse_z, v_depth - along_z * inverse_z)
    v_mean = select(drawn, times_transposed(rotation, v_point))
    if TERMS > 0:
        terms = sh_rest + rows * TERMS * 3
        by_direction = direction_backward(mean, v_color, terms, camera, inside, TERMS)
        v_mean = add(v_mean, select(drawn, by_direction))

    if SMOOTHED:
        variance = tl.load(smoothing + rows, mask=inside, other=0.0)
        v_axes, v_opacity = smoothing_backward(axes, shares, given, variance, v_axes, v_opacity)
    store3(v_means + 3 * rows, v_mean, inside)
    store3(v_scales + 3 * rows, v_axes, inside)
    tl.store(v_opacities + rows, v_opacity, mask=inside)
    # 2 q (0, v_turn); where v_turn is 0 the quaternion may be NaN
    turns = inside & (size(v_turn) != 0.0)
    vector = combine(2.0 * n * w, v_turn, 2.0 * n, cross(q, v_turn))
    tl.store(v_quats + 4 * rows, tl.where(turns, -2.0 * n * dot(q, v_turn), 0.0), mask=inside)
    store3(v_quats + 4 * rows + 1, select(turns, vector), inside)


SIGNATURES = tuple(
    Compiled(
        project_backward,
        {
            "means": "*fp32", "quats": "*fp32", "scales": "*fp32", "opacities": "*fp32",
            **({"sh_rest": "*fp32"} if terms else {}), **({"smoothing": "*fp32"} if smoothed else {}),
            "camera": "*fp32", "v_splats": "*fp32", "v_means": "*fp32", "v_quats": "*fp32",
            "v_scales": "*fp32", "v_opacities": "*fp32", "count": "i32",
        },
        {
            **({} if terms else {"sh_rest": None}), **({} if smoothed else {"smoothing": None}),
            "TERMS": terms, "SMOOTHED": smoothed, "ANTIALIASED": antialiased, "BLOCK": BLOCK,
        },
        WARPS,
    )
    for terms, smoothed, antialiased in ((0, False, False), (15, True, True))
)  # fmt: skip
