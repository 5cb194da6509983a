"""The float64 twin that all rasterisers are compared with: its derivatives by finite differences, the 3D
filter by its definition, and splats that rounding cuts."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
import torch
from engine_scenes import (
    INPUTS,
    camera,
    draw_and_differentiate,
    random_gaussians,
    relative_error,
    truth,
    with_filter,
)
from numpy.typing import NDArray

from benchmarks.kernels import reference
from sags_node import geometry
from sags_node.engine.interface import MIN_ALPHA
from sags_node.engine.rasterizer.rasterize import make_rasterizer
from sags_node.types import F64, Camera, Gaussians

VIEW = camera(moved=True)


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


def alphas(gaussians: Gaussians, view: Camera) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Of the twin: [pixels, splats], 0 where cut; and which Gaussians the splats are."""
    inputs = [torch.tensor(getattr(gaussians, name), dtype=torch.float64) for name in INPUTS]
    splats = reference.project(view, inputs)
    alpha, _, touching, _ = reference.alphas(splats, 0, 0, view.width, view.height)
    return alpha.numpy(), splats.rows[touching].numpy()


@pytest.mark.parametrize("seed", [20, 23, 25, 28])
def test_rounding_changes_no_more_than_whether_a_splat_is_cut(
    seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where alpha is 1/255, rounding decides whether a splat shows. In a large scene some always are so, and
    one of them moves gradients by more than all rounding. Image and gradients are then those of the twin
    that decides likewise, and the image and its gradients decide alike. Here one splat meets the cut in one
    pixel."""
    view = camera()
    gaussians = random_gaussians(seed, 60, view)
    alpha, rows = alphas(gaussians, view)
    pixel, splat = np.unravel_index(np.abs(alpha - 0.01).argmin(), alpha.shape)  # near its rim
    opacities = gaussians.opacities.copy()
    opacities[rows[splat]] *= MIN_ALPHA / alpha[pixel, splat]
    gaussians = dataclasses.replace(gaussians, opacities=opacities)
    found, found_gradients = draw_and_differentiate(gaussians, view, seed=seed)

    wrong = []
    for moved_cut in (1 - 1e-4, 1 + 1e-4):  # far more than rounding
        monkeypatch.setattr(reference, "MIN_ALPHA", moved_cut * MIN_ALPHA)
        shown = np.count_nonzero(alphas(gaussians, view)[0])
        true = truth(gaussians, view, seed)
        off = [np.abs(found - true.planes).max() / true.off.max()]
        for name in (*INPUTS, "contribution"):
            error = np.linalg.norm(found_gradients[name] - true.gradients[name])
            off.append(error / true.gradients_within[name])
        wrong.append((shown, max(off)))
    (with_it, shown_off), (without, cut_off) = wrong
    assert with_it == without + 1  # no other is near the cut
    assert min(shown_off, cut_off) <= 1 < max(shown_off, cut_off)
