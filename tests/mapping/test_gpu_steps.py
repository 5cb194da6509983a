"""The mapper's steps on a GPU, here on Warp's CPU device: as on the CPU."""

from typing import Any

import numpy as np
import pytest
import warp as wp
from engine_scenes import camera, relative_error

from sags_node.engine.gpu import runtime
from sags_node.engine.gpu.rasterizer import DERIVED
from sags_node.engine.interface import Gradients
from sags_node.mapping.gpu.device_map import DeviceMap
from sags_node.mapping.optimiser import LearningRates, Optimiser
from sags_node.model import columns
from sags_node.model.deformation import NodeDeformation
from sags_node.model.gaussians import GaussianModel
from sags_node.types import F32

COUNT = 141
VIEW = camera(moved=True)
TABLES = (
    "means", "quats", "log_scales", "opacity_logits", "scales", "opacities", "colors", "adam_m", "adam_v"
)  # fmt: skip


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
        sizes = 10 ** rng.uniform(-4, 1, (COUNT, *shape))
        return (rng.normal(size=(COUNT, *shape)) * sizes).astype(np.float32)

    contribution = rng.uniform(0, 2, COUNT).astype(np.float32)
    contribution[::5] = 0
    contribution[1::5] = 9e-4
    tables = rows(3), rows(4), rows(3), rows(), rows(3), rows(3), np.zeros((COUNT, 0, 3), np.float32)
    return Gradients(*tables, contribution, contribution * rng.uniform(1, 4, COUNT).astype(np.float32))


def in_warp(gradients: Gradients) -> dict[str, wp.array]:
    return {name: wp.array(getattr(gradients, name), dtype=kind) for name, kind in DERIVED.items()}


class Pair:
    """A model with control nodes on the host, and the same on a device."""

    def __init__(self) -> None:
        self.on_gpu, self.optimiser = DeviceMap(runtime.device_named("cpu")), Optimiser()
        self.renew(20)

    def renew(self, nodes: int) -> None:
        self.model = make_model()
        self.deformation = NodeDeformation(self.model.means, nodes)
        self.deformation.attach(self.model, slice(0, COUNT))
        self.begin()

    def begin(self) -> None:
        self.on_gpu.begin(self.model, self.deformation)

    def optimise(self, gradients: Gradients, rates: LearningRates) -> None:
        self.optimiser.step(self.model, gradients, VIEW, rates)
        self.on_gpu.optimise(in_warp(gradients), rates, VIEW)

    def descend(self, gradients: Gradients, step: float = 1e-4) -> None:
        self.deformation.descend(self.model, gradients.means, gradients.contribution, step)
        self.on_gpu.descend(in_warp(gradients), step)

    def row(self, name: str) -> Any:
        adam = {"adam_m": self.on_gpu.adam_m, "adam_v": self.on_gpu.adam_v}
        return (self.on_gpu.rows | adam)[name].numpy()

    def check_rows(self) -> None:
        for name in TABLES:
            expected = getattr(self.model, name)
            np.testing.assert_allclose(self.row(name), expected, rtol=1e-4, atol=1e-6, err_msg=name)

    def check_nodes(self) -> None:
        np.testing.assert_allclose(self.on_gpu.nodes.numpy(), self.deformation.nodes, atol=1e-7)
        np.testing.assert_allclose(self.row("means"), self.model.means, atol=1e-7)


@pytest.fixture
def pair() -> Pair:
    return Pair()


def test_the_optimisers_step_is_the_cpus(pair: Pair) -> None:
    """Each moves the same way; rows that are not seen stay, and all ranges are met."""
    before, rates = make_model(), LearningRates().scaled(20)
    for step in range(4):
        pair.optimise(make_gradients(step), rates)
    pair.check_rows()
    for name in TABLES[:-2]:
        start = getattr(before, name)
        assert relative_error(pair.row(name) - start, getattr(pair.model, name) - start) < 1e-4, name
    np.testing.assert_array_equal(pair.row("means")[::5], before.means[::5])
    assert (abs(pair.row("opacity_logits")) == 6).any() and (pair.row("colors") == 1.5).any()
    assert (pair.row("log_scales") == np.float32(columns.LOG_SCALE_RANGE[1])).any()


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e25])
@pytest.mark.parametrize("where", TABLES)
def test_the_optimisers_step_fixes_broken_rows(pair: Pair, where: str, value: float) -> None:
    """Gradients, or hidden state where there is one; a sound row beside it moves on."""
    gradients, broken = make_gradients(0), 2  # is seen
    hidden = where in {"adam_m", "adam_v", "log_scales", "opacity_logits"}
    table = getattr(pair.model if hidden else gradients, where)
    table.reshape(COUNT, -1)[broken, -1] = value
    pair.model.opacities[broken] = 1.0  # has no logit
    pair.begin()
    if where in {"adam_m", "adam_v"}:  # which the host does not send
        pair.row(where)[broken, -1] = value
    pair.optimise(gradients, LearningRates())
    pair.check_rows()
    assert np.isfinite(pair.row("log_scales")).all() and np.isfinite(pair.row("opacity_logits")).all()


@pytest.mark.parametrize("broken", [0.0, np.nan, np.inf], ids=["sound", "nan", "inf"])
def test_nodes_descend_as_on_the_cpu(pair: Pair, broken: float) -> None:
    """A broken gradient stops its own nodes only."""
    pair.model.node_weight[7] = np.nan  # damaged, and seen
    pair.begin()
    before = pair.row("means").copy()
    for step in range(3):
        gradients = make_gradients(step)
        if step == 0:
            gradients.means[8, 1] += broken
            gradients.contribution[8] = 1.0
        pair.descend(gradients)
    pair.check_nodes()
    assert np.nanmean(np.abs(pair.row("means") - before)) > 1e-5
    assert np.isfinite(pair.on_gpu.nodes.numpy()).all()


def test_the_nodes_of_a_new_model_remember_nothing(pair: Pair) -> None:
    """Also where they are fewer."""
    pair.descend(make_gradients(0))
    pair.renew(6)
    pair.descend(make_gradients(1))
    pair.check_nodes()


def test_a_node_that_little_was_seen_of_stays(pair: Pair) -> None:
    """The weights of one Gaussian on its four nodes add up to 1: at most one of them learns from it."""
    before = pair.deformation.nodes.copy()
    gradients = make_gradients(0)
    gradients.contribution[:] = 1e-4
    pair.descend(gradients)
    np.testing.assert_array_equal(pair.on_gpu.nodes.numpy(), before)
    gradients.contribution[8] = 1.0
    pair.descend(gradients)
    pair.check_nodes()
    assert (pair.on_gpu.nodes.numpy() != before).any(axis=1).sum() <= 1
