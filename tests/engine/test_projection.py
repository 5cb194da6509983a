"""From Gaussians to splats: view-dependent colour, the 3D filter, and the derivatives of the float64 twin."""

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from engine_scenes import (
    DERIVATIVES,
    INPUTS,
    camera,
    draw_and_differentiate,
    one_gaussian,
    random_gaussians,
    rasterize,
    relative_error,
    truth,
    with_filter,
    with_view_dependence,
)
from numpy.typing import NDArray
from rounding import after

from benchmarks.kernels import reference
from sags_node import geometry
from sags_node.engine.rasterizer import smoothing
from sags_node.engine.rasterizer import spherical_harmonics as harmonics
from sags_node.engine.rasterizer.rasterize import make_rasterizer
from sags_node.kernels.jit import read_only
from sags_node.types import F64, Camera

VIEW = camera(moved=True)


def same_bits(a: tuple[Any, dict[str, Any]], b: tuple[Any, dict[str, Any]]) -> None:
    np.testing.assert_array_equal(a[0], b[0])
    for name in DERIVATIVES:
        np.testing.assert_array_equal(a[1][name], b[1][name], err_msg=name)


# ---- derivatives -------------------------------------------------------------------------------------------


def smooth_scene() -> tuple[Camera, list[F64], F64]:
    """Alpha stays above 1/255 everywhere, so that a loss is smooth: inputs in float64, and the filter. The
    last Gaussian lies beyond the widened frustum, where the Jacobian is held."""
    view = camera(width=7, height=6, focal=12.0, moved=True)
    rng = np.random.default_rng(5)
    pixels = np.append(rng.uniform(1, 5, (5, 2)), [[11.0, 2.0]], 0)
    inputs = [
        geometry.unproject(view, pixels, rng.uniform(0.05, 0.09, 6)),
        rng.normal(size=(6, 4)),
        np.append(rng.uniform(0.02, 0.05, (5, 3)), [[0.06, 0.05, 0.07]], 0),
        rng.uniform(0.6, 0.9, 6),
        rng.uniform(0, 1, (6, 3)),
        rng.normal(0, 0.4, (6, 3)),
        rng.normal(0, 0.4, (6, 15, 3)),
    ]
    return view, inputs, rng.uniform(1e-5, 1e-4, 6)


def twin_planes(view: Camera, inputs: Sequence[Any], variance: F64) -> Any:
    tensors = [torch.as_tensor(array) for array in inputs]
    splats = reference.project(view, tensors, torch.tensor(variance))
    return reference.blend(splats, view.width, view.height)


def test_twin_agrees_with_finite_differences() -> None:
    view, inputs, variance = smooth_scene()
    weights = torch.tensor(np.random.default_rng(6).normal(size=(5, view.height, view.width)))
    tensors = [torch.tensor(array, requires_grad=True) for array in inputs]
    planes = twin_planes(view, tensors, variance)
    found = torch.autograd.grad((planes * weights).sum(), tensors)

    def loss(inputs: list[F64]) -> float:
        return float((twin_planes(view, inputs, variance) * weights).sum())

    for index, name in enumerate((*INPUTS, "sh_rest")):
        differences = np.empty_like(inputs[index])
        for at in np.ndindex(differences.shape):
            step = 1e-6 * max(float(abs(inputs[index][at])), 1e-3)
            up, down = list(inputs), list(inputs)
            up[index], down[index] = inputs[index].copy(), inputs[index].copy()
            up[index][at] += step
            down[index][at] -= step
            differences[at] = (loss(up) - loss(down)) / (2 * step)
        assert np.abs(differences[-1]).max() > 0, name  # the one with the held Jacobian takes part
        # steps of 1e-6 leave ten digits of a float64 loss, and the square of 1e-6 of its third derivative
        assert relative_error(found[index].numpy(), differences) < 1e-6, name


# ---- spherical harmonics -----------------------------------------------------------------------------------


def basis(directions: F64) -> NDArray[np.float32]:
    """Y_1 to Y_15 [M, 15] as the kernel has them."""
    means = directions.astype(np.float32)
    found = np.empty((len(means), 15), np.float32)
    for k in range(0, 15, 3):  # three terms per call, one in each colour
        sh_rest = np.zeros((len(means), 15, 3), np.float32)
        sh_rest[:, [k, k + 1, k + 2], [0, 1, 2]] = 1
        colors = np.zeros((len(means), 3), np.float32)
        centre = (np.float32(0), np.float32(0), np.float32(0))
        seen = np.empty_like(colors)
        harmonics.color(*map(read_only, (means, colors, sh_rest)), centre, seen)
        found[:, k : k + 3] = seen
    return found


def test_basis_has_the_order_and_the_signs_of_3d_gaussian_splatting() -> None:
    """Degree by degree, order from -l to l, with the Condon-Shortley phase, orthonormal on the sphere:
    Legendre's polynomials."""
    rng = np.random.default_rng(2)
    directions = rng.normal(size=(50, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    x, y, z = directions.T
    angle, flat = np.arctan2(y, x), np.hypot(x, y)
    expected = []
    for degree in (1, 2, 3):
        for order in range(-degree, degree + 1):
            m = abs(order)
            legendre = np.polynomial.Legendre.basis(degree)
            height = legendre.deriv(m)(z) if m else legendre(z)
            share = math.factorial(degree - m) / math.factorial(degree + m)
            scale = (-1) ** m * math.sqrt((2 - (m == 0)) * (2 * degree + 1) / (4 * math.pi) * share)
            turn = np.sin(m * angle) if order < 0 else np.cos(m * angle)
            expected.append(scale * flat**m * height * turn)
    np.testing.assert_allclose(basis(directions), np.stack(expected, 1), atol=1.8 * after(12))


def test_direction_runs_from_the_camera_to_the_gaussian_in_the_world() -> None:
    """One Gaussian with a green that grows along the world's z, seen from both sides."""
    sh_rest = np.zeros((1, 3, 3), np.float32)
    sh_rest[0, 1, 1] = 0.3
    gaussians = dataclasses.replace(one_gaussian(np.array([0, 0, 0.07]), 0.002), sh_rest=sh_rest)
    behind = np.diag([-1.0, 1.0, -1.0, 1.0])
    behind[2, 3] = 0.14
    for T, side in [(np.eye(4), 1), (behind, -1)]:
        view = Camera(41, 41, np.array([[60.0, 0, 20], [0, 60, 20], [0, 0, 1]]), T)
        seen = rasterize(gaussians, view).rgb[20, 20]
        green = 0.5 + side * 0.3 * math.sqrt(3 / (4 * math.pi))
        np.testing.assert_allclose(seen, 255 * np.array([0.8, green, 0.2]), atol=0.51)


def test_colour_is_linear_beyond_its_range() -> None:
    gaussians = random_gaussians(3, 40, VIEW)
    rasterizer = make_rasterizer("numba", VIEW.width, VIEW.height)
    strong = with_view_dependence(gaussians, 2)
    strong = dataclasses.replace(strong, sh_rest=strong.sh_rest * 10)
    plain, half, whole = (
        rasterizer.forward(scene, VIEW)[:3].astype(np.float64)
        for scene in (gaussians, dataclasses.replace(strong, sh_rest=strong.sh_rest / 2), strong)
    )
    assert whole.min() < -0.5
    # three sums over the Gaussians of a pixel, whose colours reach 20
    largest = np.abs(strong.sh_rest).sum(1).max()
    np.testing.assert_allclose(whole - plain, 2 * (half - plain), atol=4 * largest * after(40))


def test_no_view_dependence_and_no_filter_change_nothing() -> None:
    gaussians = random_gaussians(3, 60, VIEW)
    expected = draw_and_differentiate(gaussians, VIEW)
    empty = dataclasses.replace(gaussians, sh_rest=np.zeros((60, 0, 3), np.float32))
    same_bits(draw_and_differentiate(empty, VIEW), expected)
    unfiltered = dataclasses.replace(gaussians, smoothing=np.zeros(60, np.float32))
    same_bits(draw_and_differentiate(unfiltered, VIEW), expected)
    flat = dataclasses.replace(gaussians, sh_rest=np.zeros((60, 8, 3), np.float32))
    planes, found = draw_and_differentiate(flat, VIEW)
    np.testing.assert_array_equal(planes, expected[0])
    np.testing.assert_array_equal(found["means"], expected[1]["means"])


# ---- the 3D filter -----------------------------------------------------------------------------------------


def test_filter_enlarges_the_covariance_and_keeps_the_mass_on_the_surface() -> None:
    """R S S^T R^T + f I, taken apart again by its eigenvectors, drawn without a filter. The gradient of the
    luminance at the middle, R S'^-2 S a, is what remains of R S^-1 a."""
    gaussians = with_filter(random_gaussians(5, 60, VIEW))
    R = geometry.quat_to_matrix(gaussians.quats.astype(np.float64))
    scales = gaussians.scales.astype(np.float64)
    covariance = R * scales[:, None, :] ** 2 @ R.transpose(0, 2, 1)
    covariance += gaussians.smoothing[:, None, None] * np.eye(3)
    variances, axes = np.linalg.eigh(covariance)
    axes[np.linalg.det(axes) < 0] *= -1
    ratios = np.sort(scales) / np.sqrt(variances)  # eigenvalues come sorted
    kept = ratios[:, 1:].prod(1)  # thickness does not count
    assert kept.min() < 0.6
    gentler = gaussians.slopes * scales / (scales**2 + gaussians.smoothing[:, None])
    gradient = np.einsum("nij,nj->ni", R, gentler)
    enlarged = dataclasses.replace(
        gaussians,
        scales=np.sqrt(variances).astype(np.float32),
        quats=np.stack([geometry.matrix_to_quat(matrix) for matrix in axes]).astype(np.float32),
        opacities=(gaussians.opacities * kept).astype(np.float32),
        slopes=(np.sqrt(variances) * np.einsum("nji,nj->ni", axes, gradient)).astype(np.float32),
        smoothing=None,
    )
    rasterizer = make_rasterizer("numba", VIEW.width, VIEW.height)
    expected = rasterizer.forward(enlarged, VIEW).copy()
    assert expected[4].mean() > 0.1
    within = truth(gaussians, VIEW).off.max() + truth(enlarged, VIEW).off.max()
    np.testing.assert_allclose(rasterizer.forward(gaussians, VIEW), expected, rtol=0, atol=within)


def test_filter_of_vanishing_scales() -> None:
    scales = np.array([[1e-7, 1e-7, 1e-7], [1e-7, 1e-3, 1.0], [1e-7, 1e-7, 1e-7]], np.float32)
    slopes = np.full((3, 3), 0.1, np.float32)
    opacities = np.array([1 - 1e-6, 0.5, 1e-6], np.float32)
    variance = np.array([1e-9, 1e-9, 0], np.float32)
    found_scales, found_opacities, found_slopes = (
        np.empty_like(array) for array in (scales, opacities, slopes)
    )
    given = map(read_only, (scales, opacities, variance, slopes))
    smoothing.smooth(*given, found_scales, found_opacities, found_slopes)
    true_scales = np.sqrt(scales.astype(np.float64) ** 2 + variance[:, None])
    true_opacities = opacities * np.sort(scales / true_scales)[:, 1:].prod(1)
    np.testing.assert_allclose(found_scales, true_scales, rtol=after(3))
    np.testing.assert_allclose(found_opacities, true_opacities, rtol=after(8))
    np.testing.assert_allclose(found_slopes, slopes * (scales / true_scales), rtol=after(4))
    np.testing.assert_array_equal(found_scales[2], scales[2])
    np.testing.assert_array_equal(found_slopes[2], slopes[2])
