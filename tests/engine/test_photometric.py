"""The training loss against autograd of its twin, term by term."""

from __future__ import annotations

from dataclasses import astuple, fields, replace
from typing import Any

import numpy as np
import pytest
import torch
from engine_scenes import as_bytes, camera, on_one_thread, random_gaussians, relative_error
from rounding import Exact, after, exact

from sags_node.engine.adam import AdamState, adam_step
from sags_node.engine.losses.photometric import LossTerms, LossWeights, PhotometricLoss
from sags_node.engine.losses.pieces import PIECE
from sags_node.engine.rasterizer.rasterize import make_rasterizer
from sags_node.types import F32

HEIGHT, WIDTH = 37, 53
TERMS = [field.name for field in fields(LossTerms)]
OFF = LossWeights(color=0, inverse_depth=0, smoothness=0, depth_smoothness=0)
ALL = LossWeights(0.8, 0.2, 1e-3, 0.5, 0.03, 30.0, 0.02)


def frame(height: int = HEIGHT, width: int = WIDTH, seed: int = 0) -> dict[str, Any]:
    """Planes of every coverage, and a frame to compare them with."""
    rng = np.random.default_rng(seed)
    coverage = rng.uniform(0.01, 1, (height, width))
    depth = rng.uniform(0.05, 0.06, (height, width))
    drawn = [
        *rng.uniform(0, 1, (3, height, width)),
        depth + rng.normal(0, 1e-3, depth.shape),
        np.ones_like(depth),
    ]
    depth[rng.uniform(size=depth.shape) < 0.3] = 0
    return {
        "planes": (np.stack(drawn) * coverage).astype(np.float32),
        "image": rng.integers(0, 256, (height, width, 3), np.uint8),
        "tissue": rng.uniform(size=(height, width)) < 0.7,
        "depth": depth.astype(np.float32),
        "unseen": rng.uniform(size=(height, width)) < 0.3,
    }


def run(inputs: dict[str, Any], weights: LossWeights, normalised: bool = True) -> tuple[LossTerms, F32, F32]:
    _, height, width = inputs["planes"].shape
    v_planes = np.full((5, height, width), np.nan, np.float32)  # every value must be written
    weight = np.full((height, width), np.nan, np.float32)
    terms = PhotometricLoss(width, height, weights, normalised).evaluate(
        **inputs, v_planes=v_planes, weight=weight
    )
    return terms, v_planes, weight


def twin(inputs: dict[str, Any], normalised: bool) -> tuple[Any, dict[str, Any]]:
    from sags_node.engine.reference import losses as losses_reference

    planes = torch.tensor(inputs["planes"], dtype=torch.float64, requires_grad=True)
    image, depth = torch.tensor(inputs["image"] / 255), torch.tensor(inputs["depth"]).double()
    tissue, unseen = (torch.tensor(inputs[name]) for name in ("tissue", "unseen"))
    return planes, losses_reference.photometric(planes, image, tissue, depth, unseen, normalised)


def exact_gradients(
    inputs: dict[str, Any], weights: LossWeights, normalised: bool, names: list[str]
) -> list[Exact]:
    """The sum of some terms in float64, and its gradient by each of the planes."""

    def total_and_gradient(**arrays: Any) -> list[Any]:
        planes, terms = twin(arrays, normalised)
        expected = sum(getattr(weights, name) * terms[name] for name in names)
        (gradient,) = torch.autograd.grad(expected, planes)
        return [expected.item(), *gradient.numpy()]

    return exact(
        total_and_gradient,
        inputs,
        additions=PIECE,  # pieces are added up in float64
        cancelled=cancelled(inputs, normalised) if "correlation" in names else 1.0,
        rough=(torch.nn.functional, "conv2d"),
    )


def check(
    inputs: dict[str, Any],
    weights: LossWeights,
    normalised: bool,
    names: list[str],
    total: float,
    v_planes: F32,
) -> None:
    true_total, *gradients = exact_gradients(inputs, weights, normalised, names)
    true_total.check(total, names)
    for plane, true in enumerate(gradients):
        true.check(v_planes[plane], (names, plane))


def exact_terms(inputs: dict[str, Any], normalised: bool, names: list[str]) -> dict[str, Exact]:
    """What the twin says of some terms."""

    def terms(**arrays: Any) -> list[Any]:
        found = twin(arrays, normalised)[1]
        return [found[name].item() for name in names]

    within = cancelled(inputs, normalised) if "correlation" in names else 1.0
    values = exact(terms, inputs, PIECE, within, rough=(torch.nn.functional, "conv2d"))
    return dict(zip(names, values, strict=True))


def cancelled(inputs: dict[str, Any], normalised: bool) -> float:
    """Of the products that the correlation is the sum of."""
    coverage = inputs["planes"][4].astype(np.float64)
    drawn = inputs["planes"][3] / (coverage if normalised else 1)
    used = inputs["tissue"] & (inputs["depth"] > 0) & (drawn > 1e-3) & ((coverage > 0.3) | (not normalised))
    x, y = 1 / drawn[used], 1 / inputs["depth"][used].astype(np.float64)
    products = (x - x.mean()) * (y - y.mean())
    return float(np.abs(products).sum() / abs(products.sum()))


@pytest.mark.parametrize("normalised", [True, False])
@pytest.mark.parametrize("name", TERMS)
def test_value_and_gradient_of_each_term(name: str, normalised: bool) -> None:
    inputs = frame()
    weights = replace(OFF, **{name: 1.0})
    terms, v_planes, _ = run(inputs, weights, normalised)
    check(inputs, weights, normalised, [name], getattr(terms, name), v_planes)


@pytest.mark.parametrize("normalised", [True, False])
def test_gradient_of_the_weighted_sum(normalised: bool) -> None:
    inputs = frame()
    terms, v_planes, _ = run(inputs, ALL, normalised)
    check(inputs, ALL, normalised, TERMS, terms.total(ALL), v_planes)


@pytest.mark.parametrize("normalised", [True, False])
def test_twin_by_finite_differences(normalised: bool) -> None:
    from sags_node.engine.reference import losses as losses_reference

    inputs = {name: torch.tensor(array) for name, array in frame(5, 7).items()}
    inputs = {name: value.double() if value.is_floating_point() else value for name, value in inputs.items()}
    inputs["image"] = inputs["image"].double() / 255
    inputs["planes"][4].clamp_(min=0.06)  # finite differences must not step over the least coverage
    inputs["planes"].requires_grad_(True)
    inputs["normalised"] = normalised

    def terms(planes: Any) -> tuple[Any, ...]:
        return tuple(losses_reference.photometric(**{**inputs, "planes": planes}).values())

    assert torch.autograd.gradcheck(terms, inputs["planes"], eps=1e-7, rtol=1e-3)


def test_weight_is_the_derivative_of_the_colour() -> None:
    inputs = frame()
    coverage = inputs["planes"][4]
    _, _, weight = run(inputs, LossWeights())
    counts = inputs["tissue"] & (coverage > 0.05)
    np.testing.assert_allclose(weight[counts], 1 / coverage[counts], rtol=after(2))
    assert not weight[~counts].any()
    _, _, weight = run(inputs, LossWeights(), normalised=False)
    np.testing.assert_array_equal(weight, inputs["tissue"])


def test_correlation_knows_no_scale_and_offset() -> None:
    inputs = frame()
    inputs["depth"] = np.full((HEIGHT, WIDTH), 0.055, np.float32)
    inputs["depth"] += np.linspace(0, 0.005, WIDTH, dtype=np.float32)
    monocular = 1 / (0.3 / inputs["depth"] + 2)
    weights = replace(OFF, correlation=1.0)
    metric, v_metric, _ = run(inputs, weights)
    other, v_other, _ = run({**inputs, "depth": monocular}, weights)
    assert 0.1 < metric.correlation < 1.9
    within = 2 * cancelled(inputs, True) * after(PIECE)
    assert other.correlation == pytest.approx(metric.correlation, rel=within)
    assert relative_error(v_other, v_metric) < within


def test_flat_depth_has_no_correlation() -> None:
    inputs = frame()
    inputs["depth"][:] = 0.05
    terms, v_planes, _ = run(inputs, replace(OFF, correlation=1.0))
    assert terms.correlation == 0
    assert not v_planes.any()


def test_smoothness_everywhere_unless_a_region_is_given() -> None:
    inputs = frame()
    everywhere = {**inputs, "unseen": np.ones((HEIGHT, WIDTH), np.bool_)}
    nowhere = {**inputs, "unseen": np.zeros((HEIGHT, WIDTH), np.bool_)}
    weights = replace(OFF, smoothness=1.0, depth_smoothness=1.0)
    default, v_default, _ = run({**inputs, "unseen": None}, weights)
    expected, v_expected, _ = run(everywhere, weights)
    assert default == expected
    np.testing.assert_array_equal(v_default, v_expected)
    terms, v_planes, _ = run(nowhere, weights)
    assert (terms.smoothness, terms.depth_smoothness) == (0, 0)
    assert not v_planes.any()


def test_no_tissue_no_gradient() -> None:
    inputs = frame() | {
        "tissue": np.zeros((HEIGHT, WIDTH), np.bool_),
        "unseen": np.zeros((HEIGHT, WIDTH), np.bool_),
    }
    terms, v_planes, weight = run(inputs, ALL)
    assert not any(astuple(terms))
    assert not v_planes.any()
    assert not weight.any()


@pytest.mark.parametrize("normalised", [True, False])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("where", ["depth", *range(5)])
def test_broken_pixels_are_left_out(where: str | int, value: float, normalised: bool) -> None:
    clean, broken = frame(9, 13), frame(9, 13)
    for inputs in (clean, broken):
        inputs["tissue"][4, 5] = True
        inputs["depth"][4, 5] = 0
        inputs["unseen"][3:6, 4:7] = False
    clean["tissue"][4, 5] = False
    if where == "depth":
        broken["depth"][4, 5] = value
        clean["tissue"][4, 5] = True
    else:
        broken["planes"][where, 4, 5] = value
    terms, v_broken, weight = run(broken, ALL, normalised)
    assert np.isfinite(astuple(terms)).all()
    assert np.isfinite(v_broken).all()
    assert np.isfinite(weight).all()
    if where == 3:  # only the depth is broken: its colour still counts
        clean["tissue"][4, 5] = True
    # similarity sees the pixel from its surroundings, and the mean lack of coverage is over the whole mask
    weights = replace(ALL, similarity=0.0, coverage=0.0)
    expected, v_clean, _ = run(clean, weights, normalised)
    terms, v_broken, _ = run(broken, weights, normalised)
    elsewhere = np.ones((9, 13), bool)
    elsewhere[4, 5] = False
    assert replace(terms, coverage=0.0) == replace(expected, coverage=0.0)
    np.testing.assert_array_equal(v_broken[:, elsewhere], v_clean[:, elsewhere])


@pytest.mark.parametrize(
    ("height", "width"), [(1, 1), (1, 2), (2, 1), (1, 300), (257, 1), (16, 16), (3, 70), (17, 4)]
)
def test_every_size(height: int, width: int) -> None:
    inputs = frame(height, width)
    inputs["tissue"][:] = True
    inputs["planes"][4] += np.float32(0.5)
    inputs["depth"][inputs["depth"] == 0] = 0.052
    terms, v_planes, _ = run(inputs, replace(ALL, correlation=0.0))
    weights = replace(ALL, correlation=0.0)
    check(
        inputs,
        weights,
        True,
        [name for name in TERMS if name != "correlation"],
        terms.total(weights),
        v_planes,
    )


def test_memory_of_an_earlier_frame_does_not_show() -> None:
    loss = PhotometricLoss(WIDTH, HEIGHT, ALL)
    v_planes, weight = np.empty((5, HEIGHT, WIDTH), np.float32), np.empty((HEIGHT, WIDTH), np.float32)
    loss.evaluate(**frame(seed=1), v_planes=v_planes, weight=weight)
    terms = loss.evaluate(**frame(seed=2), v_planes=v_planes, weight=weight)
    expected, v_expected, _ = run(frame(seed=2), ALL)
    assert terms == expected
    np.testing.assert_array_equal(v_planes, v_expected)


def test_same_bits_for_one_and_all_threads() -> None:
    together = run(frame(), ALL)
    alone = on_one_thread(lambda: run(frame(), ALL))
    assert alone[0] == together[0]
    np.testing.assert_array_equal(alone[1], together[1])


@pytest.mark.parametrize("normalised", [True, False])
def test_descending_it_paints_the_picture(normalised: bool) -> None:
    """Colours that start grey become those that the same Gaussians drew the picture with."""
    view = camera(WIDTH, HEIGHT, focal=50.0)
    gaussians = random_gaussians(3, 150, view)
    rasterizer = make_rasterizer("numba", WIDTH, HEIGHT)
    planes = rasterizer.forward(gaussians, view)
    divisor = np.maximum(planes[4], 1e-6) if normalised else np.float32(1)
    inputs = {
        "image": as_bytes((planes[:3] / divisor).transpose(1, 2, 0)),
        "tissue": planes[4] > 0.3,
        "depth": np.zeros((HEIGHT, WIDTH), np.float32),
    }
    loss = PhotometricLoss(WIDTH, HEIGHT, replace(OFF, color=0.8, similarity=0.2), normalised)
    v_planes, weight = np.empty((5, HEIGHT, WIDTH), np.float32), np.empty((HEIGHT, WIDTH), np.float32)
    gaussians.colors[:] = 0.5
    state, rates = AdamState.new(150, 3), np.full(3, 0.02, np.float32)
    history = []
    for _ in range(60):
        planes = rasterizer.forward(gaussians, view)
        history.append(loss.evaluate(planes, **inputs, v_planes=v_planes, weight=weight))
        gradients = rasterizer.backward(v_planes, weight)
        adam_step(gaussians.colors, gradients.colors, state, rates)
    assert history[-1].color < 0.15 * history[0].color
    assert history[-1].similarity < 0.15 * history[0].similarity
