"""The device's optimisers, interpreted, against the CPU's: Adam on rows, the mapper's step, control nodes."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import test_adam
import torch
from engine_scenes import camera, relative_error
from numpy.typing import NDArray

pytest.importorskip("triton", reason="Triton comes with torch's CUDA builds, or by `pip install triton`")

from sags_node.engine import adam as engine_adam
from sags_node.engine.cuda import adam
from sags_node.engine.cuda.backend import default_device
from sags_node.engine.interface import Gradients
from sags_node.mapping import optimiser as mapping_optimiser
from sags_node.mapping.cuda import optimiser
from sags_node.mapping.cuda.refiner import STEP
from sags_node.mapping.optimiser import LearningRates
from sags_node.model.cuda import nodes
from sags_node.model.deformation import NodeDeformation
from sags_node.model.gaussians import GaussianModel
from sags_node.types import F32, Bool

# the kernels take roots and logarithms of rows that they then leave out; a GPU says nothing of it
pytestmark = [
    pytest.mark.filterwarnings("ignore::RuntimeWarning"),
    pytest.mark.usefixtures("quick_interpreter"),
]

DEVICE = default_device()
COUNT = optimiser.BLOCK + 13
TABLES = (
    "means",
    "quats",
    "log_scales",
    "opacity_logits",
    "scales",
    "opacities",
    "colors",
    "adam_m",
    "adam_v",
)


def on_device(array: NDArray[Any]) -> torch.Tensor:
    return torch.tensor(array, device=DEVICE)


class Tables:
    """The same table with the same optimiser on the CPU engine and on the device."""

    def __init__(self, rows: int, columns: int) -> None:
        rng = np.random.default_rng(0)
        self.values = rng.normal(size=(rows, columns)).astype(np.float32)
        self.rates = rng.uniform(1e-3, 1e-1, columns).astype(np.float32)
        self.state = engine_adam.AdamState.new(rows, columns)
        self.device_values = on_device(self.values)
        self.device_state = adam.AdamState.new(rows, columns, DEVICE)

    def step(self, gradients: F32, taken: Bool) -> Bool:
        """Both; returns what sat out on the device."""
        rows = np.flatnonzero(taken)
        broken = engine_adam.adam_step(
            self.values, gradients, self.state, self.rates, rows=rows, betas=test_adam.BETAS
        )
        sat_out = adam.adam_step(
            self.device_values, on_device(gradients), self.device_state, on_device(self.rates),
            taken=on_device(taken), betas=test_adam.BETAS,
        )  # fmt: skip
        assert sat_out.sum() == broken
        found: Bool = sat_out.cpu().numpy()
        return found

    def check(self) -> None:
        np.testing.assert_allclose(self.device_values.cpu().numpy(), self.values, rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(self.device_state.moments.cpu().numpy(), self.state.moments, rtol=1e-5)
        np.testing.assert_allclose(self.device_state.shares.cpu().numpy(), self.state.shares, rtol=1e-6)


@pytest.mark.parametrize(("rows", "columns"), [(40, 19), (1, 200), (16, 64), (3, 1)])
def test_adam_is_the_cpu_engines(rows: int, columns: int) -> None:
    """Steps that take some rows only; those that are not taken hold NaN."""
    tables = Tables(rows, columns)
    rng = np.random.default_rng(1)
    for _ in range(5):
        taken = rng.uniform(size=rows) < 0.6
        gradients = rng.normal(size=(rows, columns)) * 10 ** rng.uniform(-6, 3, (rows, 1))
        gradients[~taken] = np.nan
        assert not tables.step(gradients.astype(np.float32), taken).any()
    tables.check()


@pytest.mark.parametrize("broken", [np.nan, np.inf, -np.inf, 1e30])
def test_a_broken_row_sits_out_and_starts_anew(broken: float) -> None:
    tables = Tables(test_adam.ROWS, test_adam.COLUMNS)
    everything = np.ones(test_adam.ROWS, np.bool_)
    tables.step(test_adam.gradients(0), everything)
    gradients = test_adam.gradients(1)
    gradients[11, 4] = broken
    spoilt = float(np.float32(broken) * np.float32(1e10))
    tables.state.moments[12, -1, 1] = tables.device_state.moments[12, -1, 1] = spoilt
    before = tables.device_values.cpu().numpy().copy()
    assert np.flatnonzero(tables.step(gradients, everything)).tolist() == [11, 12]
    np.testing.assert_array_equal(tables.device_values.cpu().numpy()[11:13], before[11:13])
    tables.check()
    tables.step(test_adam.gradients(2), everything)
    tables.check()


def test_adam_takes_all_rows_unless_told_and_none_of_an_empty_table() -> None:
    values, gradients, rates = (
        torch.zeros((3, 5), device=DEVICE),
        torch.ones((3, 5), device=DEVICE),
        torch.full((5,), 0.25, device=DEVICE),
    )
    adam.adam_step(values, gradients, adam.AdamState.new(3, 5, DEVICE), rates)
    assert (values + 0.25).abs().max() < 1e-6
    nothing = torch.zeros((0, 5), device=DEVICE)
    assert adam.adam_step(nothing, nothing, adam.AdamState.new(0, 5, DEVICE), rates).shape == (0,)


def test_adams_shapes_are_checked() -> None:
    values, rates, state = (
        torch.zeros((3, 5), device=DEVICE),
        torch.ones(5, device=DEVICE),
        adam.AdamState.new(3, 5, DEVICE),
    )
    with pytest.raises(ValueError, match="gradients"):
        adam.adam_step(values, values[:2], state, rates)
    with pytest.raises(ValueError, match="rates"):
        adam.adam_step(values, values, state, rates[:3])
    with pytest.raises(ValueError, match="eps"):
        adam.adam_step(values, values, state, rates, eps=0.0)
    with pytest.raises(ValueError, match="taken"):
        adam.adam_step(values, values, state, rates, taken=torch.ones(2, dtype=torch.bool, device=DEVICE))


def make_model() -> GaussianModel:
    rng = np.random.default_rng(0)
    model = GaussianModel(COUNT)
    means = rng.normal([0, 0, 0.06], 0.01, (COUNT, 3)).astype(np.float32)
    scales = rng.uniform(1e-5, 4e-3, (COUNT, 3)).astype(np.float32)
    model.append(means, scales, rng.uniform(0, 1, (COUNT, 3)).astype(np.float32), 0.7)
    model.quats[:] = rng.normal(size=(COUNT, 4))
    model.opacity_logits[:] = rng.uniform(-5.9, 5.9, COUNT)
    model.opacities[:] = 1 / (1 + np.exp(-model.opacity_logits))
    return model


def make_gradients(seed: int) -> Gradients:
    """Some rows were hardly seen, or not at all."""
    rng = np.random.default_rng(seed)

    def rows(*shape: int) -> F32:
        return (rng.normal(size=(COUNT, *shape)) * 10 ** rng.uniform(-4, 1, (COUNT, *shape))).astype(
            np.float32
        )

    contribution = rng.uniform(0, 2, COUNT).astype(np.float32)
    contribution[::5] = 0
    contribution[1::5] = 9e-4
    return Gradients(
        rows(3), rows(4), rows(3), rows(), rows(3), np.zeros((COUNT, 0, 3), np.float32), contribution,
    )  # fmt: skip


def model_on_device(model: GaussianModel) -> optimiser.Model:
    return optimiser.Model(**{name: on_device(getattr(model, name)) for name in TABLES})


def device_step(
    engine: optimiser.Optimiser, model: optimiser.Model, gradients: Gradients, rates: LearningRates
) -> None:
    names = ("means", "quats", "scales", "opacities", "colors", "contribution")
    slopes = optimiser.Slopes(**{name: on_device(getattr(gradients, name)) for name in names})
    lengths = rates.mean_px, rates.quat, rates.log_scale, rates.opacity_logit
    view = camera(moved=True)
    engine.step(model, slopes, lengths, tuple(view.viewmat[2].tolist()), float(view.K[0, 0]))


def check_model(found: optimiser.Model, model: GaussianModel) -> None:
    for name in TABLES:
        np.testing.assert_allclose(
            getattr(found, name).cpu().numpy(), getattr(model, name), rtol=1e-4, atol=1e-6, err_msg=name
        )


def test_the_mappers_step_is_the_mappers() -> None:
    model = make_model()
    found, before = model_on_device(model), model_on_device(model)
    host, device, rates = mapping_optimiser.Optimiser(), optimiser.Optimiser(STEP), LearningRates().scaled(20)
    for step in range(4):
        gradients = make_gradients(step)
        host.step(model, gradients, camera(moved=True), rates)
        device_step(device, found, gradients, rates)
    check_model(found, model)
    for name in TABLES:
        if name not in {"adam_m", "adam_v"}:
            moved, expected = getattr(found, name) - getattr(before, name), getattr(model, name)
            assert (
                relative_error(moved.cpu().numpy(), expected - getattr(before, name).cpu().numpy()) < 1e-4
            ), name
    unseen = np.s_[::5]
    assert torch.equal(found.means[unseen], before.means[unseen])
    # all ranges are met
    assert (found.opacity_logits.abs() == 6).any() and (found.colors == 1.5).any()
    assert (found.log_scales == np.float32(mapping_optimiser.LOG_SCALE_RANGE[1])).any()


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e25])
@pytest.mark.parametrize(
    "where",
    ["means", "quats", "scales", "opacities", "colors", "adam_m", "adam_v", "log_scales", "opacity_logits"],
)
def test_the_mappers_step_fixes_broken_rows(where: str, value: float) -> None:
    """Gradients (the first five) and hidden state; a sound row beside it moves on."""
    model, gradients = make_model(), make_gradients(0)
    broken = 2  # is seen
    hidden = where in {"adam_m", "adam_v", "log_scales", "opacity_logits"}
    table = getattr(model if hidden else gradients, where)
    table.reshape(COUNT, -1)[broken, -1] = value
    model.opacities[broken] = 1.0  # has no logit
    found = model_on_device(model)
    mapping_optimiser.Optimiser().step(model, gradients, camera(moved=True), LearningRates())
    device_step(optimiser.Optimiser(STEP), found, gradients, LearningRates())
    check_model(found, model)
    assert torch.isfinite(found.log_scales).all() and torch.isfinite(found.opacity_logits).all()


def test_no_gaussians_no_step() -> None:
    empty = optimiser.Model(**{name: torch.zeros((0, 3), device=DEVICE) for name in TABLES})
    slopes = optimiser.Slopes(*torch.zeros((6, 0, 3), device=DEVICE))
    optimiser.Optimiser(STEP).step(empty, slopes, (1.0, 1.0, 1.0, 1.0), (0.0, 0.0, 1.0, 0.0), 50.0)


class Follow:
    """A model on control nodes, on the host and on the device."""

    def __init__(self, count: int) -> None:
        self.model = make_model()
        self.host = NodeDeformation(self.model.means, count)
        self.host.attach(self.model, slice(0, COUNT))
        self.model.node_weight[7] = np.nan  # damaged, and seen
        self.nodes = nodes.Nodes.at(on_device(self.host.nodes))
        self.means = on_device(self.model.means)
        self.followers = nodes.Followers.of(
            on_device(self.model.node_index), on_device(self.model.node_weight), len(self.host.nodes)
        )

    def descend(self, gradients: F32, contribution: F32, step: float = 1e-4) -> None:
        self.host.descend(self.model, gradients, contribution, step)
        nodes.descend(
            self.nodes, self.followers, on_device(gradients), on_device(contribution), self.means,
            step=step, least_contribution=1e-3,
        )  # fmt: skip

    def check(self) -> None:
        np.testing.assert_allclose(self.nodes.places.cpu().numpy(), self.host.nodes, atol=1e-7)
        np.testing.assert_allclose(self.means.cpu().numpy(), self.model.means, atol=1e-7)


@pytest.mark.parametrize("count", [1, 20])
def test_nodes_descend_as_on_the_host(count: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(nodes, "BLOCK", 32)  # several blocks of followers for each node
    follow = Follow(count)
    before = follow.means.clone()
    for step in range(3):
        gradients = make_gradients(step)
        follow.descend(gradients.means, gradients.contribution)
    follow.check()
    assert (follow.means - before).abs().nanmean() > 1e-5


def test_a_node_that_little_was_seen_of_stays() -> None:
    """The weights of one Gaussian on its four nodes add up to 1: at most one of them learns from it."""
    follow = Follow(20)
    before = follow.nodes.places.clone()
    contribution = np.full(COUNT, 1e-4, np.float32)
    follow.descend(np.ones((COUNT, 3), np.float32), contribution)
    assert torch.equal(follow.nodes.places, before)
    contribution[8] = 1.0
    follow.descend(np.ones((COUNT, 3), np.float32), contribution)
    follow.check()
    assert (follow.nodes.places != before).any(dim=1).sum() <= 1


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_broken_gradient_stops_its_nodes_only(value: float) -> None:
    follow = Follow(20)
    gradients: Any = make_gradients(0)
    gradients.means[8, 1] = value
    gradients.contribution[8] = 1.0
    follow.descend(gradients.means, gradients.contribution)
    follow.descend(make_gradients(1).means, make_gradients(1).contribution)
    follow.check()
    assert torch.isfinite(follow.nodes.places).all()


def test_nodes_give_the_same_bits_again() -> None:
    places = []
    for _ in range(2):
        follow = Follow(20)
        follow.descend(make_gradients(0).means, make_gradients(0).contribution)
        places.append(follow.nodes.places)
    assert torch.equal(*places)


def test_nothing_follows_no_nodes() -> None:
    nobody = nodes.Followers.of(
        torch.zeros((0, 4), dtype=torch.int32, device=DEVICE), torch.zeros((0, 4), device=DEVICE), 2
    )
    places = torch.ones((2, 3), device=DEVICE)
    control = nodes.Nodes.at(places)
    nodes.descend(
        control,
        nobody,
        torch.zeros((0, 3), device=DEVICE),
        torch.zeros(0, device=DEVICE),
        torch.zeros((0, 3), device=DEVICE),
        step=1.0,
        least_contribution=0.0,
    )
    assert torch.equal(control.places, torch.ones((2, 3), device=DEVICE))
