"""Colour that depends on where one looks from: as `engine.rasterizer.spherical_harmonics`, in its order."""

from __future__ import annotations

import math

import triton
import triton.language as tl

from sags_node.engine.cuda.layout import CENTRE, V_RED, V_SPLAT_FLOATS
from sags_node.engine.cuda.signatures import Compiled
from sags_node.engine.cuda.vectors import dot, load3, load_vector, multiply, size, store3

BLOCK = 128  # Gaussians per program
C1 = tl.constexpr(math.sqrt(3 / (4 * math.pi)))
C2_XY, C2_ZZ = tl.constexpr(math.sqrt(15 / (4 * math.pi))), tl.constexpr(math.sqrt(5 / (16 * math.pi)))
C2_XX = tl.constexpr(math.sqrt(15 / (16 * math.pi)))
C3_XXX, C3_XYZ = tl.constexpr(math.sqrt(35 / (32 * math.pi))), tl.constexpr(math.sqrt(105 / (4 * math.pi)))
C3_XZZ, C3_ZZZ = tl.constexpr(math.sqrt(21 / (32 * math.pi))), tl.constexpr(math.sqrt(7 / (16 * math.pi)))
C3_ZXX = tl.constexpr(math.sqrt(105 / (16 * math.pi)))


@triton.jit
def direction(mean: tl.tuple, camera: tl.tensor) -> tl.tuple:
    """Unit vector from the camera (a pointer to its record) to the Gaussian, and one over their distance."""
    centre = load_vector(camera + CENTRE)
    x, y, z = mean[0] - centre[0], mean[1] - centre[1], mean[2] - centre[2]
    inverse = 1.0 / tl.sqrt(x * x + y * y + z * z)
    return (x * inverse, y * inverse, z * inverse), inverse


@triton.jit
def harmonic(K: tl.constexpr, x: tl.tensor, y: tl.tensor, z: tl.tensor) -> tl.tuple:
    """Y_(K + 1) of a unit vector, and the derivatives of that polynomial by x, y and z."""
    none = tl.zeros_like(x)
    xx, yy, zz = x * x, y * y, z * z
    if K == 0:
        value, dx, dy, dz = y * -C1, none, none - C1, none
    elif K == 1:
        value, dx, dy, dz = z * C1, none, none, none + C1
    elif K == 2:
        value, dx, dy, dz = x * -C1, none - C1, none, none
    elif K == 3:
        value, dx, dy, dz = x * y * C2_XY, y * C2_XY, x * C2_XY, none
    elif K == 4:
        value, dx, dy, dz = y * z * -C2_XY, none, z * -C2_XY, y * -C2_XY
    elif K == 5:
        value = (2.0 * zz - xx - yy) * C2_ZZ
        dx, dy, dz = -2.0 * x * C2_ZZ, -2.0 * y * C2_ZZ, 4.0 * z * C2_ZZ
    elif K == 6:
        value, dx, dy, dz = x * z * -C2_XY, z * -C2_XY, none, x * -C2_XY
    elif K == 7:
        value, dx, dy, dz = (xx - yy) * C2_XX, 2.0 * x * C2_XX, -2.0 * y * C2_XX, none
    elif K == 8:
        value = y * (3.0 * xx - yy) * -C3_XXX
        dx, dy, dz = x * y * (-6.0 * C3_XXX), (xx - yy) * (-3.0 * C3_XXX), none
    elif K == 9:
        value, dx, dy, dz = x * y * z * C3_XYZ, y * z * C3_XYZ, x * z * C3_XYZ, x * y * C3_XYZ
    elif K == 10:
        value = y * (4.0 * zz - xx - yy) * -C3_XZZ
        dx = x * y * (2.0 * C3_XZZ)
        dy, dz = (4.0 * zz - xx - 3.0 * yy) * -C3_XZZ, y * z * (-8.0 * C3_XZZ)
    elif K == 11:
        value = z * (2.0 * zz - 3.0 * (xx + yy)) * C3_ZZZ
        dx, dy = x * z * (-6.0 * C3_ZZZ), y * z * (-6.0 * C3_ZZZ)
        dz = (2.0 * zz - xx - yy) * (3.0 * C3_ZZZ)
    elif K == 12:
        value = x * (4.0 * zz - xx - yy) * -C3_XZZ
        dx, dy = (4.0 * zz - 3.0 * xx - yy) * -C3_XZZ, x * y * (2.0 * C3_XZZ)
        dz = x * z * (-8.0 * C3_XZZ)
    elif K == 13:
        value = z * (xx - yy) * C3_ZXX
        dx, dy, dz = x * z * (2.0 * C3_ZXX), y * z * (-2.0 * C3_ZXX), (xx - yy) * C3_ZXX
    else:
        value = x * (xx - 3.0 * yy) * -C3_XXX
        dx, dy, dz = (xx - yy) * (-3.0 * C3_XXX), x * y * (6.0 * C3_XXX), none
    return value, (dx, dy, dz)


@triton.jit
def view_color(
    mean: tl.tuple,
    color: tl.tuple,
    sh_rest: tl.tensor,  # pointers to the Gaussians' coefficients
    camera: tl.tensor,
    mask: tl.tensor,
    TERMS: tl.constexpr,
) -> tl.tuple:
    """Colour as the camera sees it; not clamped."""
    (x, y, z), _ = direction(mean, camera)
    red, green, blue = color
    for k in tl.static_range(TERMS):
        value, _ = harmonic(k, x, y, z)
        r, g, b = load3(sh_rest + 3 * k, mask)
        red += value * r
        green += value * g
        blue += value * b
    return red, green, blue


@triton.jit
def direction_backward(
    mean: tl.tuple,
    v_color: tl.tuple,
    sh_rest: tl.tensor,
    camera: tl.tensor,
    mask: tl.tensor,
    TERMS: tl.constexpr,
) -> tl.tuple:
    """Gradient of the colour by the Gaussian's place: what turns the direction, not what lengthens it."""
    (x, y, z), inverse = direction(mean, camera)
    v_x, v_y, v_z = tl.zeros_like(x), tl.zeros_like(x), tl.zeros_like(x)
    for k in tl.static_range(TERMS):
        _, slope = harmonic(k, x, y, z)
        v_value = dot(v_color, load3(sh_rest + 3 * k, mask))
        v_x += v_value * slope[0]
        v_y += v_value * slope[1]
        v_z += v_value * slope[2]
    radial = v_x * x + v_y * y + v_z * z
    return (v_x - radial * x) * inverse, (v_y - radial * y) * inverse, (v_z - radial * z) * inverse


@triton.jit(do_not_specialize=["count"])
def coefficients_backward(
    means: tl.tensor,  # [N, 3]
    camera: tl.tensor,  # [CAMERA_FLOATS]
    v_splats: tl.tensor,  # [N, V_SPLAT_FLOATS]
    v_sh_rest: tl.tensor,  # [N, TERMS, 3] written
    count: tl.tensor,  # N
    TERMS: tl.constexpr,
    BLOCK: tl.constexpr,
) -> None:
    rows = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    mask = rows < count
    mean = load3(means + 3 * rows, mask)
    (x, y, z), _ = direction(mean, camera)
    v_color = load3(v_splats + rows * V_SPLAT_FLOATS + V_RED, mask)
    drawn = size(v_color) != 0.0  # else its mean may be NaN
    for k in tl.static_range(TERMS):
        value, _ = harmonic(k, x, y, z)
        value = tl.where(drawn, value, 0.0)
        store3(v_sh_rest + (rows * TERMS + k) * 3, multiply((value, value, value), v_color), mask)


SIGNATURES = tuple(
    Compiled(
        coefficients_backward,
        {
            "means": "*fp32", "camera": "*fp32", "v_splats": "*fp32", "v_sh_rest": "*fp32", "count": "i32",
        },
        {"TERMS": terms, "BLOCK": BLOCK},
    )
    for terms in (3, 15)
)  # fmt: skip
