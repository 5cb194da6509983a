"""From raw rows to planes, and gradients against those of the rasteriser and of differences."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from engine_scenes import camera, random_gaussians

from sags_node.engine.rasterizer.rasterize import make_rasterizer
from sags_node.field.drawing import Drawing, activate, deactivate, to_gaussians
from sags_node.model import columns
from sags_node.model.alias_free import smoothing_variances

VIEW = camera(64, 48)
WEIGHT = np.random.default_rng(1).uniform(0, 1, (48, 64)).astype(np.float32)


def leaves(count: int = 60) -> tuple[torch.Tensor, torch.Tensor]:
    gaussians = random_gaussians(0, count, VIEW)
    assert gaussians.slopes is not None
    rows, slopes = torch.from_numpy(deactivate(gaussians)), torch.from_numpy(gaussians.slopes)
    return rows.requires_grad_(), slopes.requires_grad_()


def test_rows_and_gaussians_are_the_same_thing() -> None:
    gaussians = random_gaussians(0, 60, VIEW)
    rows = torch.from_numpy(deactivate(gaussians))
    names = ("means", "quats", "scales", "opacities", "colors")
    for name, found in zip(names, activate(rows), strict=True):
        np.testing.assert_allclose(found.numpy(), getattr(gaussians, name), rtol=1e-5, err_msg=name)


@pytest.mark.parametrize("smooth", [True, False])
def test_the_3d_filter_is_that_of_the_deformed_places(smooth: bool) -> None:
    rows, _ = leaves()
    found = to_gaussians(activate(rows), None, np.arange(60), [VIEW] if smooth else None)
    expected = smoothing_variances(np.ascontiguousarray(rows.detach()[:, columns.MEAN].numpy()), [VIEW])
    assert found.slopes is None
    if smooth:
        np.testing.assert_array_equal(found.smoothing, expected)
    else:
        assert found.smoothing is None


def test_planes_and_gradients_are_those_of_the_rasteriser() -> None:
    rows, slopes = leaves()
    drawing = Drawing(make_rasterizer("numba", 64, 48), VIEW, rows, slopes, np.arange(60), [VIEW])
    v_planes = np.random.default_rng(2).normal(size=(5, 48, 64)).astype(np.float32)
    drawing.differentiate(v_planes, WEIGHT)
    other = make_rasterizer("numba", 64, 48)
    gaussians = to_gaussians(activate(rows), slopes, np.arange(60), [VIEW])
    np.testing.assert_array_equal(drawing.planes.detach().numpy(), other.forward(gaussians, VIEW))
    expected = other.backward(v_planes, WEIGHT)
    np.testing.assert_array_equal(drawing.contribution, expected.contribution)
    np.testing.assert_array_equal(drawing.spread, expected.spread)
    found = rows.grad.numpy()
    opacities = gaussians.opacities
    for place, wanted in (
        (columns.MEAN, expected.means),
        (columns.LOG_SCALE, expected.scales * gaussians.scales),
        (columns.QUAT, expected.quats),
        (columns.COLOR, expected.colors),
        (columns.LOGIT, expected.opacities * opacities * (1 - opacities)),
    ):
        np.testing.assert_allclose(found[:, place], wanted, rtol=1e-5, atol=1e-6)
    np.testing.assert_array_equal(slopes.grad.numpy(), expected.slopes)


def test_the_next_drawing_leaves_what_the_last_one_found() -> None:
    """A batch draws several times before it looks at who was seen."""
    rasterizer = make_rasterizer("numba", 64, 48)
    away = camera(64, 48)
    away = replace(away, T_world_cam=away.T_world_cam @ np.diag([-1.0, 1.0, -1.0, 1.0]))  # sees nothing
    v_planes, found = np.ones((5, 48, 64), np.float32), []
    for view in (VIEW, away):
        rows, slopes = leaves()
        drawing = Drawing(rasterizer, view, rows, slopes, np.arange(60), [VIEW])
        drawing.differentiate(v_planes, WEIGHT)
        found.append(drawing)
    for part in ("v_means", "contribution", "spread"):
        assert getattr(found[0], part).any() and not getattr(found[1], part).any(), part


def test_a_loss_of_the_planes_reaches_what_the_rows_came_from() -> None:
    """By differences, along the gradient itself, with the 3D filter held."""
    rows, _ = leaves()
    brighter = torch.zeros((), requires_grad=True)
    rasterizer = make_rasterizer("numba", 64, 48)

    def loss(shift: torch.Tensor) -> tuple[Drawing, torch.Tensor]:
        change = torch.zeros(columns.COUNT).index_fill(0, torch.arange(10, 13), 1.0)
        drawing = Drawing(rasterizer, VIEW, rows.detach() + shift * change, None, np.arange(60), [VIEW])
        return drawing, drawing.planes[:3].square().sum()

    drawing, value = loss(brighter)
    drawing.differentiate(value, WEIGHT)
    above, below = (loss(torch.tensor(step))[1] for step in (1e-2, -1e-2))
    assert float(brighter.grad) == pytest.approx(float(above - below) / 2e-2, rel=1e-3)
