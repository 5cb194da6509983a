"""The closed-form step on colours and slopes."""

from dataclasses import replace

import numpy as np
import pytest
from engine_scenes import as_bytes, camera
from flat_scene import flat_means

from sags_node.engine.losses.tissue import tissue_loss
from sags_node.engine.rasterizer.rasterize import make_rasterizer
from sags_node.mapping.optimiser import LearningRates, Optimiser
from sags_node.model.gaussians import GaussianModel
from sags_node.types import F32, U8, Bool

VIEW = camera(width=96, height=80, focal=120.0)
STILL = LearningRates(0.0, 0.0, 0.0, 0.0)  # of the geometry


def model_of(width_px: float) -> GaussianModel:
    """Gaussians 4 px apart on a plane 7 cm away, as those of tissue, all gray."""
    rng, means = np.random.default_rng(0), flat_means(VIEW, 0.07, 4.0)
    model, shape = GaussianModel(len(means)), means.shape
    sides = np.array([width_px, width_px, 0.5 * width_px]) * 0.07 / VIEW.K[0, 0]
    scales = (sides * rng.uniform(0.8, 1.2, shape)).astype(np.float32)
    model.append(means, scales, np.full(shape, 0.5, np.float32), 0.8)
    model.quats[:, 0], model.quats[:, 3] = 1, rng.normal(size=len(means))
    return model


def picture_of(model: GaussianModel) -> U8:
    """What the same Gaussians show with other colours and slopes."""
    rng = np.random.default_rng(1)
    colors = rng.uniform(0.3, 0.7, model.colors.shape).astype(np.float32)
    slopes = rng.normal(0, 0.05, model.slopes.shape).astype(np.float32)
    planes = make_rasterizer("numba", VIEW.width, VIEW.height).forward(
        replace(model.gaussians(), colors=colors, slopes=slopes), VIEW
    )
    return as_bytes((planes[:3] / np.maximum(planes[4], 0.05)).transpose(1, 2, 0))


def errors(model: GaussianModel, picture: U8, steps: int) -> list[float]:
    """Mean squared error of the colour before each step."""
    rasterizer, optimiser = make_rasterizer("numba", VIEW.width, VIEW.height), Optimiser()
    tissue: Bool = np.ones(picture.shape[:2], np.bool_)
    depth: F32 = np.zeros(tissue.shape, np.float32)
    found = []
    for _ in range(steps):
        planes = rasterizer.forward(model.gaussians(), VIEW)
        shown = (planes[:3] / np.maximum(planes[4], 0.05)).transpose(1, 2, 0)
        found.append(float(np.mean((shown - picture / 255) ** 2)))
        v_planes, weight = np.zeros_like(planes), np.zeros_like(planes[0])
        tissue_loss(planes, picture, tissue, depth, v_planes, weight, 0.0, 1.0, 0.0)
        optimiser.step(model, rasterizer.backward(v_planes, weight), VIEW, STILL)
    return found


@pytest.mark.parametrize("width_px", [1.2, 2.0, 4.0, 8.0])
def test_no_step_makes_the_picture_worse_however_much_they_overlap(width_px: float) -> None:
    """As the bound in `Optimiser` says. What fades with SLOPE_DECAY may come to a hundredth of the error."""
    model = model_of(width_px)
    found = np.array(errors(model, picture_of(model), 60))
    assert (found[1:] < 1.001 * found[:-1]).all()
    assert found[-1] < 0.5 * found[0]


def test_noise_does_not_pile_up_in_slopes() -> None:
    """On a gray image with noise that changes every frame slopes stay as small as one step makes them."""
    model, rng = model_of(2.0), np.random.default_rng(3)
    for _ in range(150):
        noise = rng.normal(0.5, 0.02, (VIEW.height, VIEW.width, 3))
        errors(model, as_bytes(noise), 1)
    assert np.abs(model.slopes).mean() < 0.02  # of one pixel's noise, per standard deviation
