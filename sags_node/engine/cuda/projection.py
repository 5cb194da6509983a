"""Projection of Gaussians to splats (EWA, Zwicker et al. 2001) with both filters of Mip-Splatting (Yu et al.
2024): the formulas of `engine.rasterizer.smoothing` and `.projection`, with the covariance's two rows as
vectors.

    V = J R_cam R_q S, rows V_x and V_y      xx, xy, yy = V V^T      det cov0 = |V_x x V_y|^2 (Cauchy-Binet)

A row of J R_cam is turned into the Gaussian's own axes by its quaternion, and there scaled.
"""

from __future__ import annotations

import math

import triton
import triton.language as tl

from sags_node.engine import interface
from sags_node.engine.cuda.layout import (
    BLUE,
    BOX_COLUMNS,
    BOX_INTS,
    BOX_LEFT,
    BOX_TOP,
    DEPTH,
    GREEN,
    INTRINSICS,
    LIMITS,
    LOG2_OPACITY,
    MEAN_X,
    MEAN_Y,
    RED,
    SPLAT_FLOATS,
    TILE_HEIGHT_BITS,
    TILE_WIDTH_BITS,
    TRANSLATION,
    WHITEN_XX,
    WHITEN_XY,
    WHITEN_YY,
)
from sags_node.engine.cuda.signatures import Compiled
from sags_node.engine.cuda.spherical_harmonics import view_color
from sags_node.engine.cuda.vectors import (
    add,
    cross,
    dot,
    load3,
    load_vector,
    multiply,
    rotate,
    size,
    times_matrix,
    times_transposed,
)

BLOCK = 128  # Gaussians per program

NEAR_PLANE = tl.constexpr(interface.NEAR_PLANE)
MAX_OPACITY = tl.constexpr(interface.MAX_OPACITY)
MIP_VARIANCE, DILATION_VARIANCE = (
    tl.constexpr(interface.MIP_VARIANCE),
    tl.constexpr(interface.DILATION_VARIANCE),
)
MIN_QUAT_NORM2, MAX_QUAT_NORM2 = tl.constexpr(interface.MIN_QUAT_NORM**2), tl.constexpr(1e36)
LOG2_MIN_ALPHA = tl.constexpr(math.log2(interface.MIN_ALPHA))
MAX_COORDINATE = tl.constexpr(1e9)  # px; a comparison with it also rejects NaN and infinity
MAX_VALUE = tl.constexpr(1e18)  # its square is still finite
WHITEN2 = tl.constexpr(0.5 / math.log(2.0))  # exponents of base e and 1/2 to base 2


@triton.jit
def load_view(camera: tl.tensor) -> tl.tuple:
    """Rows of the rotation, translation, and fx fy cx cy of a camera's record."""
    rotation = load_vector(camera), load_vector(camera + 3), load_vector(camera + 6)
    at = camera + INTRINSICS
    intrinsics = tl.load(at), tl.load(at + 1), tl.load(at + 2), tl.load(at + 3)
    return rotation, load_vector(camera + TRANSLATION), intrinsics


@triton.jit
def load_turn(quats: tl.tensor, rows: tl.tensor, mask: tl.tensor) -> tl.tuple:
    """Unit quaternion w and (x, y, z), one over the given length, and whether there is a direction."""
    w, q = tl.load(quats + 4 * rows, mask=mask, other=0.0), load3(quats + 4 * rows + 1, mask)
    norm2 = w * w + dot(q, q)
    has_direction = (norm2 > MIN_QUAT_NORM2) & (norm2 < MAX_QUAT_NORM2)
    n = 1.0 / tl.sqrt(tl.where(has_direction, norm2, 1.0))
    return w * n, multiply(q, (n, n, n)), n, has_direction


@triton.jit
def smooth(scale: tl.tensor, variance: tl.tensor) -> tl.tuple:
    """A scale after the 3D filter, and its share of that."""
    root = tl.where(variance <= 0.0, scale, tl.sqrt(scale * scale + variance))
    return root, tl.where(variance <= 0.0, 1.0, scale / root)


@triton.jit
def load_scales(
    scales: tl.tensor, smoothing: tl.tensor, rows: tl.tensor, mask: tl.tensor, SMOOTHED: tl.constexpr
) -> tl.tuple:
    """Scales after the 3D filter, and each one's share of its filtered scale."""
    a, b, c = load3(scales + 3 * rows, mask)
    share_a, share_b, share_c = tl.zeros_like(a) + 1.0, tl.zeros_like(a) + 1.0, tl.zeros_like(a) + 1.0
    if SMOOTHED:
        variance = tl.load(smoothing + rows, mask=mask, other=0.0)
        a, share_a = smooth(a, variance)
        b, share_b = smooth(b, variance)
        c, share_c = smooth(c, variance)
    return (a, b, c), (share_a, share_b, share_c)


@triton.jit
def kept_by_smoothing(shares: tl.tuple) -> tl.tensor:
    """Share of the opacity that is left: the product of the two largest of the axes' shares."""
    a, b, c = shares
    return tl.maximum(tl.maximum(a * b, a * c), b * c)


@triton.jit
def hold(value: tl.tensor, low: tl.tensor, high: tl.tensor) -> tl.tensor:
    return tl.minimum(tl.maximum(value, low), high)


@triton.jit
def jacobian(point: tl.tuple, intrinsics: tl.tuple, camera: tl.tensor) -> tl.tuple:
    """The projection's slope, at x/z and y/z held within the widened frustum: one over z, x/z and y/z, those
    held, and the rows of J."""
    x, y, z = point
    inverse_z = 1.0 / tl.where(z > NEAR_PLANE, z, 1.0)
    slope_x, slope_y = x * inverse_z, y * inverse_z
    limits = camera + LIMITS
    held_x = hold(slope_x, tl.load(limits), tl.load(limits + 1))
    held_y = hold(slope_y, tl.load(limits + 2), tl.load(limits + 3))
    j00, j11 = intrinsics[0] * inverse_z, intrinsics[1] * inverse_z
    zero = tl.zeros_like(z)
    return (
        inverse_z,
        (slope_x, slope_y),
        (held_x, held_y),
        (j00, zero, -j00 * held_x),
        (zero, j11, -j11 * held_y),
    )


@triton.jit
def whitening(v_x: tl.tuple, v_y: tl.tuple, ANTIALIASED: tl.constexpr) -> tl.tuple:
    """Triangular factor (xx, xy, yy) of the conic of the filtered covariance, for exponents of base 2; the
    share of the opacity that the filter leaves; and the minors of V."""
    variance = MIP_VARIANCE if ANTIALIASED else DILATION_VARIANCE
    minors = cross(v_x, v_y)
    det0 = dot(minors, minors)
    xx, yy = dot(v_x, v_x), dot(v_y, v_y)
    det = det0 + (xx + yy) * variance + variance * variance
    inverse_yy = 1.0 / (yy + variance)
    along = tl.sqrt((yy + variance) / det * WHITEN2)
    kept = tl.zeros_like(det) + 1.0
    if ANTIALIASED:
        kept = tl.sqrt(det0 / det)
    factor = along, -along * dot(v_x, v_y) * inverse_yy, tl.sqrt(inverse_yy * WHITEN2)
    return factor, kept, minors


@triton.jit
def radii(factor: tl.tuple, extent: tl.tensor) -> tl.tuple:
    """Half the width and height, px, of the ellipse u^2 + v^2 = extent."""
    a, b, c = factor
    return tl.sqrt(extent * (b * b + c * c)) / (a * c), tl.sqrt(extent) / c


@triton.jit
def pixels_within(mean: tl.tensor, radius: tl.tensor, length: tl.tensor) -> tl.tuple:
    """First and last of `length` pixels whose centre lies within `radius` of `mean`; where there is none the
    first is larger. Held in a range first: a far-off float does not fit an integer."""
    length = length.to(tl.float32)
    first = tl.ceil(hold(mean - radius - 0.5, 0.0, length))
    last = tl.floor(hold(mean + radius - 0.5, -1.0, length - 1.0))
    return first.to(tl.int32), last.to(tl.int32)


@triton.jit(do_not_specialize=["count", "width", "height"])
def project(
    means: tl.tensor,  # [N, 3]
    quats: tl.tensor,  # [N, 4]
    scales: tl.tensor,  # [N, 3]
    opacities: tl.tensor,  # [N]
    colors: tl.tensor,  # [N, 3]
    sh_rest: tl.tensor,  # [N, TERMS, 3]; None where TERMS is 0
    smoothing: tl.tensor,  # [N]; None where not SMOOTHED
    camera: tl.tensor,  # [CAMERA_FLOATS]
    active_sums: tl.tensor,  # [tile rows + 1, tile columns + 1]: active tiles above and to the left
    splats: tl.tensor,  # [N, SPLAT_FLOATS] written
    boxes: tl.tensor,  # [N, BOX_INTS] written
    counts: tl.tensor,  # [N] written: tiles in the box; 0: not drawn
    count: tl.tensor,  # N
    width: tl.tensor,  # px
    height: tl.tensor,  # px
    TERMS: tl.constexpr,
    SMOOTHED: tl.constexpr,
    ANTIALIASED: tl.constexpr,
    BLOCK: tl.constexpr,
) -> None:
    rows = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    inside = rows < count

    mean = load3(means + 3 * rows, inside)
    rotation, translation, intrinsics = load_view(camera)
    point = add(times_matrix(rotation, mean), translation)
    w, q, _, has_direction = load_turn(quats, rows, inside)
    axes, shares = load_scales(scales, smoothing, rows, inside, SMOOTHED)
    _, (slope_x, slope_y), _, j_x, j_y = jacobian(point, intrinsics, camera)
    v_x = multiply(rotate(-w, q, times_transposed(rotation, j_x)), axes)
    v_y = multiply(rotate(-w, q, times_transposed(rotation, j_y)), axes)
    factor, kept, _ = whitening(v_x, v_y, ANTIALIASED)
    trace = dot(v_x, v_x) + dot(v_y, v_y)
    given = tl.load(opacities + rows, mask=inside, other=0.0) * kept_by_smoothing(shares)
    color = load3(colors + 3 * rows, inside)
    if TERMS > 0:
        color = view_color(mean, color, sh_rest + rows * TERMS * 3, camera, inside, TERMS)

    mean_x = intrinsics[0] * slope_x + intrinsics[2]
    mean_y = intrinsics[1] * slope_y + intrinsics[3]
    drawn = inside & (point[2] > NEAR_PLANE) & has_direction
    drawn &= (tl.abs(mean_x) + tl.abs(mean_y) < MAX_COORDINATE) & (trace < MAX_VALUE)
    drawn &= (given < MAX_VALUE) & (given * kept > 0.0) & (size(color) < MAX_VALUE)
    log2_opacity = tl.log2(tl.where(drawn, tl.minimum(given * kept, MAX_OPACITY), 1.0))
    extent = tl.where(drawn, log2_opacity - LOG2_MIN_ALPHA, 0.0)

    radius_x, radius_y = radii(factor, extent)
    x_first, x_last = pixels_within(tl.where(drawn, mean_x, 0.0), tl.where(drawn, radius_x, 0.0), width)
    y_first, y_last = pixels_within(tl.where(drawn, mean_y, 0.0), tl.where(drawn, radius_y, 0.0), height)
    drawn &= (extent > 0.0) & (x_first <= x_last) & (y_first <= y_last)
    left, right = x_first >> TILE_WIDTH_BITS, (x_last >> TILE_WIDTH_BITS) + 1
    top, bottom = y_first >> TILE_HEIGHT_BITS, (y_last >> TILE_HEIGHT_BITS) + 1
    line = ((width - 1) >> TILE_WIDTH_BITS) + 2
    upper = active_sums + top * line
    lower = upper + (bottom - top) * line
    active = tl.load(lower + right, mask=drawn, other=0) - tl.load(lower + left, mask=drawn, other=0)
    above = tl.load(upper + right, mask=drawn, other=0) - tl.load(upper + left, mask=drawn, other=0)
    drawn &= active > above

    splat = splats + rows * SPLAT_FLOATS
    tl.store(splat + MEAN_X, mean_x, mask=inside)
    tl.store(splat + MEAN_Y, mean_y, mask=inside)
    tl.store(splat + WHITEN_XX, factor[0], mask=inside)
    tl.store(splat + WHITEN_XY, factor[1], mask=inside)
    tl.store(splat + WHITEN_YY, factor[2], mask=inside)
    tl.store(splat + LOG2_OPACITY, log2_opacity, mask=inside)
    tl.store(splat + RED, color[0], mask=inside)
    tl.store(splat + GREEN, color[1], mask=inside)
    tl.store(splat + BLUE, color[2], mask=inside)
    tl.store(splat + DEPTH, point[2], mask=inside)
    box = boxes + rows * BOX_INTS
    tl.store(box + BOX_LEFT, left, mask=inside)
    tl.store(box + BOX_TOP, top, mask=inside)
    tl.store(box + BOX_COLUMNS, right - left, mask=inside)
    tl.store(counts + rows, tl.where(drawn, (right - left) * (bottom - top), 0), mask=inside)


SIGNATURES = tuple(
    Compiled(
        project,
        {
            "means": "*fp32", "quats": "*fp32", "scales": "*fp32", "opacities": "*fp32", "colors": "*fp32",
            **({"sh_rest": "*fp32"} if terms else {}), **({"smoothing": "*fp32"} if smoothed else {}),
            "camera": "*fp32", "active_sums": "*i32", "splats": "*fp32", "boxes": "*i32", "counts": "*i32",
            "count": "i32", "width": "i32", "height": "i32",
        },
        {
            **({} if terms else {"sh_rest": None}), **({} if smoothed else {"smoothing": None}),
            "TERMS": terms, "SMOOTHED": smoothed, "ANTIALIASED": antialiased, "BLOCK": BLOCK,
        },
    )
    for terms, smoothed, antialiased in ((0, False, False), (15, True, True))
)  # fmt: skip
