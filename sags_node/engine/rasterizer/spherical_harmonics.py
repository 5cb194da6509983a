"""View-dependent colour (real spherical harmonics, degree 1 to 3), and its derivative.

    color = colors + sum over k of sh_rest_k Y_k(direction)      direction = unit(mean - camera centre), world

Basis, signs and order are those of 3D Gaussian Splatting (Kerbl et al. 2023), as in other programs' files;
`colors` holds the whole constant part (there: 0.5 + 0.282 sh_0). The colour is not clamped: it stays linear
in `colors` and `sh_rest`, and one that leaves 0..1 still has a gradient that leads back.
"""

import math
from typing import Any

import numba
import numpy as np

from sags_node.kernels.jit import inlined, kernel, parallel_kernel, square_root
from sags_node.types import F32

f4 = np.float32
BLOCK = 64  # Gaussians per piece of work
DEGREE_2, DEGREE_3, MOST = 3, 8, 15  # where these degrees begin in the basis, and its end

ZERO, ONE, TWO, THREE, FOUR, SIX, EIGHT = f4(0.0), f4(1.0), f4(2.0), f4(3.0), f4(4.0), f4(6.0), f4(8.0)
C1 = f4(math.sqrt(3 / (4 * math.pi)))
C2_XY, C2_ZZ = f4(math.sqrt(15 / (4 * math.pi))), f4(math.sqrt(5 / (16 * math.pi)))
C2_XX = f4(math.sqrt(15 / (16 * math.pi)))
C3_XXX, C3_XYZ = f4(math.sqrt(35 / (32 * math.pi))), f4(math.sqrt(105 / (4 * math.pi)))
C3_XZZ, C3_ZZZ = f4(math.sqrt(21 / (32 * math.pi))), f4(math.sqrt(7 / (16 * math.pi)))
C3_ZXX = f4(math.sqrt(105 / (16 * math.pi)))

Row = tuple[Any, ...]


@inlined
def _write_basis(basis: F32, terms: int, x: Any, y: Any, z: Any) -> None:
    """Y_1 to Y_terms of a unit vector."""
    basis[0], basis[1], basis[2] = -C1 * y, C1 * z, -C1 * x
    if terms > DEGREE_2:
        xx, yy, zz = x * x, y * y, z * z
        basis[3] = C2_XY * x * y
        basis[4] = -C2_XY * y * z
        basis[5] = C2_ZZ * (TWO * zz - xx - yy)
        basis[6] = -C2_XY * x * z
        basis[7] = C2_XX * (xx - yy)
        if terms > DEGREE_3:
            basis[8] = -C3_XXX * y * (THREE * xx - yy)
            basis[9] = C3_XYZ * x * y * z
            basis[10] = -C3_XZZ * y * (FOUR * zz - xx - yy)
            basis[11] = C3_ZZZ * z * (TWO * zz - THREE * (xx + yy))
            basis[12] = -C3_XZZ * x * (FOUR * zz - xx - yy)
            basis[13] = C3_ZXX * z * (xx - yy)
            basis[14] = -C3_XXX * x * (xx - THREE * yy)


@inlined
def _slope(v_basis: F32, terms: int, x: Any, y: Any, z: Any) -> Row:
    """Gradient of sum(v_basis * basis), the polynomials as they stand in `_write_basis`."""
    v_x, v_y, v_z = -C1 * v_basis[2], -C1 * v_basis[0], C1 * v_basis[1]
    if terms > DEGREE_2:
        xy, yz, xz = C2_XY * v_basis[3], -C2_XY * v_basis[4], -C2_XY * v_basis[6]
        along, across = TWO * C2_ZZ * v_basis[5], TWO * C2_XX * v_basis[7]
        v_x += xy * y + xz * z + (across - along) * x
        v_y += xy * x + yz * z - (across + along) * y
        v_z += yz * y + xz * x + TWO * along * z
        if terms > DEGREE_3:
            xx, yy, zz = x * x, y * y, z * z
            c8, c9, c10 = -C3_XXX * v_basis[8], C3_XYZ * v_basis[9], -C3_XZZ * v_basis[10]
            c11, c12 = C3_ZZZ * v_basis[11], -C3_XZZ * v_basis[12]
            c13, c14 = C3_ZXX * v_basis[13], -C3_XXX * v_basis[14]
            v_x += SIX * c8 * x * y + c9 * y * z - TWO * c10 * x * y - SIX * c11 * x * z
            v_x += c12 * (FOUR * zz - THREE * xx - yy) + TWO * c13 * x * z + THREE * c14 * (xx - yy)
            v_y += THREE * c8 * (xx - yy) + c9 * x * z + c10 * (FOUR * zz - xx - THREE * yy)
            v_y += -SIX * c11 * y * z - TWO * c12 * x * y - TWO * c13 * y * z - SIX * c14 * x * y
            v_z += c9 * x * y + EIGHT * c10 * y * z + THREE * c11 * (TWO * zz - xx - yy)
            v_z += EIGHT * c12 * x * z + c13 * (xx - yy)
    return v_x, v_y, v_z


@inlined
def _direction(means: F32, i: int, centre: Row) -> Row:
    """Unit vector from the camera to a Gaussian, and one over their distance."""
    x, y, z = means[i, 0] - centre[0], means[i, 1] - centre[1], means[i, 2] - centre[2]
    inverse = ONE / square_root(x * x + y * y + z * z)
    return x * inverse, y * inverse, z * inverse, inverse


@kernel
def _color_block(
    means: F32, colors: F32, sh_rest: F32, centre: Row, first: int, last: int, view_colors: F32
) -> None:
    terms = sh_rest.shape[1]
    basis = np.empty(MOST, f4)
    for i in range(first, last):
        x, y, z, _ = _direction(means, i, centre)
        _write_basis(basis, terms, x, y, z)
        red, green, blue = colors[i, 0], colors[i, 1], colors[i, 2]
        for k in range(terms):
            red += basis[k] * sh_rest[i, k, 0]
            green += basis[k] * sh_rest[i, k, 1]
            blue += basis[k] * sh_rest[i, k, 2]
        view_colors[i, 0] = red
        view_colors[i, 1] = green
        view_colors[i, 2] = blue


@parallel_kernel
def color(
    means: F32,  # [N, 3] m
    colors: F32,  # [N, 3]
    sh_rest: F32,  # [N, 3 or 8 or 15, 3]
    centre: Row,  # 3, of the camera in the world, m
    view_colors: F32,  # [N, 3] written
) -> None:
    count = means.shape[0]
    for block in numba.prange((count + BLOCK - 1) // BLOCK):
        first = block * BLOCK
        _color_block(means, colors, sh_rest, centre, first, min(first + BLOCK, count), view_colors)


@kernel
def _block_backward(
    means: F32,
    sh_rest: F32,
    centre: Row,
    first: int,
    last: int,
    v_colors: F32,
    v_sh_rest: F32,
    v_means: F32,
) -> None:
    terms = sh_rest.shape[1]
    basis, v_basis = np.empty(MOST, f4), np.empty(MOST, f4)
    for i in range(first, last):
        red, green, blue = v_colors[i, 0], v_colors[i, 1], v_colors[i, 2]
        if red == ZERO and green == ZERO and blue == ZERO:  # not drawn: its values may be anything, NaN too
            v_sh_rest[i] = ZERO
            continue
        x, y, z, inverse = _direction(means, i, centre)
        _write_basis(basis, terms, x, y, z)
        for k in range(terms):
            v_basis[k] = red * sh_rest[i, k, 0] + green * sh_rest[i, k, 1] + blue * sh_rest[i, k, 2]
            v_sh_rest[i, k, 0] = red * basis[k]
            v_sh_rest[i, k, 1] = green * basis[k]
            v_sh_rest[i, k, 2] = blue * basis[k]
        v_x, v_y, v_z = _slope(v_basis, terms, x, y, z)
        radial = v_x * x + v_y * y + v_z * z  # only the part across the direction turns it
        v_means[i, 0] += (v_x - radial * x) * inverse
        v_means[i, 1] += (v_y - radial * y) * inverse
        v_means[i, 2] += (v_z - radial * z) * inverse


@parallel_kernel
def color_backward(
    means: F32,
    sh_rest: F32,
    centre: Row,
    v_colors: F32,  # [N, 3] 0 for what was not drawn
    v_sh_rest: F32,  # [N, 3 or 8 or 15, 3] written
    v_means: F32,  # [N, 3] added to
) -> None:
    count = means.shape[0]
    for block in numba.prange((count + BLOCK - 1) // BLOCK):
        first = block * BLOCK
        _block_backward(
            means,
            sh_rest,
            centre,
            first,
            min(first + BLOCK, count),
            v_colors,
            v_sh_rest,
            v_means,
        )
