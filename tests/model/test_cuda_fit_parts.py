"""Parts of the offline fit on the device, in Triton's interpreter or on a GPU, against those on the CPU."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from engine_scenes import camera, relative_error
from test_skinning import scene, twin_and_gradients

pytest.importorskip("triton", reason="Triton comes with torch's CUDA builds, or by `pip install triton`")

from sags_node.engine.cuda import hexplane
from sags_node.engine.cuda.backend import default_device
from sags_node.fitting.cuda.field import DeviceField, Loan
from sags_node.fitting.cuda.model import smoothing_variances
from sags_node.fitting.field import make_box, make_decoder, make_field
from sags_node.model import alias_free, columns
from sags_node.model.cuda import skinning
from sags_node.model.cuda.nodes import Followers
from sags_node.model.field import Deltas, Field, FieldRates
from sags_node.model.hexplane import HexPlaneField
from sags_node.types import F32

pytestmark = pytest.mark.usefixtures("quick_interpreter")

DEVICE = default_device()
COUNT = 30
T_NS = 130_000_000


@pytest.fixture(autouse=True)
def few_programs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(hexplane, "POINTS", 64)


def on_device(array: Any) -> torch.Tensor:
    return torch.tensor(array, device=DEVICE)


def skinned(arrays: tuple[np.ndarray, ...], v: F32) -> tuple[F32, F32, F32]:
    """Gaussians, and the gradients by rows and deltas."""
    rows, nodes, deltas, index, weight = map(on_device, arrays)
    rows.requires_grad_()
    deltas.requires_grad_()
    found = skinning.skin(rows, nodes, deltas, Followers.of(index, weight, len(nodes)))
    v_rows, v_deltas = torch.autograd.grad(found, [rows, deltas], on_device(v))
    return tuple(tensor.detach().cpu().numpy() for tensor in (found, v_rows, v_deltas))


@pytest.mark.parametrize("block", [8, 64])  # several blocks of followers a node, and one
def test_skinning_is_its_twins_with_every_gradient(block: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(skinning, "BLOCK", block)
    arrays = scene(0)
    v = np.random.default_rng(1).normal(size=arrays[0].shape).astype(np.float32)
    for found, expected in zip(skinned(arrays, v), twin_and_gradients(*arrays, v), strict=True):
        assert relative_error(found, expected) < 1e-6


def test_skinning_gives_the_same_bits_again_and_leaves_idle_nodes_alone() -> None:
    rows, nodes, deltas, index, weight = scene(1)
    index[index == 3] = 4  # nobody follows the fourth
    v = np.ones_like(rows)
    first, again = (skinned((rows, nodes, deltas, index, weight), v) for _ in range(2))
    for a, b in zip(first, again, strict=True):
        np.testing.assert_array_equal(a, b)
    assert not first[2][3].any() and first[2][4].all()


def test_a_broken_gradient_reaches_the_nodes_of_its_gaussian_only() -> None:
    arrays = scene(2)
    v = np.ones_like(arrays[0])
    v[5, 0] = np.nan
    _, v_rows, v_deltas = skinned(arrays, v)
    assert np.isfinite(np.delete(v_rows, 5, axis=0)).all()
    broken = ~np.isfinite(v_deltas).all(axis=1)
    assert set(np.flatnonzero(broken)) == set(arrays[3][5])


def make(tokens: Any, seed: int = 0) -> tuple[Field, F32]:
    """A field whose every parameter matters, and canonical rows; of some, the mean lies outside its box."""
    rng = np.random.default_rng(seed)
    rows = rng.normal(size=(COUNT, columns.COUNT)).astype(np.float32)
    rows[:, columns.MEAN] = rng.uniform(-0.02, 0.02, (COUNT, 3)) + np.array([0, 0, 0.06])
    box = make_box(rows[: COUNT - 4, columns.MEAN])
    found = HexPlaneField.for_clip(box, 0, 300_000_000, slots=3, cells=1, channels=16, seed=seed)
    found.cells[found.grid.space_rows :] += rng.normal(0, 0.2, found.cells[found.grid.space_rows :].shape)
    decoder = make_decoder(found, tokens, seed)
    decoder.values += rng.normal(0, 0.1, decoder.values.shape).astype(np.float32)
    return make_field(Deltas(found, decoder), rows[:12, columns.MEAN], tokens), rows


def parameters(field: Field) -> dict[str, F32]:
    """All that a step changes."""
    deltas = field.deltas
    return {
        "cells": deltas.hexplane.cells, "cells' moments": deltas.hexplane.adam.moments,
        "cells' shares": deltas.hexplane.adam.shares, "decoder": deltas.decoder.values,
        "decoder's moments": deltas.adam.moments,
    }  # fmt: skip


@pytest.mark.parametrize(
    ("tokens", "broken"),
    [("self", False), ("planes", False), ("nodes", False), ("self", True), ("planes", True)],
)
def test_a_step_of_the_field_is_the_cpus(tokens: Any, broken: bool) -> None:
    """Also where a Gaussian's gradient and a cell are no numbers; some Gaussians were not seen."""
    host, rows = make(tokens)
    other, _ = make(tokens)
    v = np.random.default_rng(3).normal(size=rows.shape).astype(np.float32)
    v[::3] = 0
    if broken:
        v[4, 1] = np.nan
        for field in (host, other):
            field.deltas.hexplane.cells[field.deltas.hexplane.grid.space_rows - 1] = np.nan
    for field in (host, other):
        field.follow(rows[:, columns.MEAN])
    loan = Loan(DEVICE)
    device = DeviceField(other, loan)
    found, expected = device.deform(on_device(rows), T_NS), host.deform(rows, T_NS)
    np.testing.assert_allclose(found.cpu().numpy(), expected, rtol=1e-5, atol=1e-5)
    v_rows, v_expected = device.backward(on_device(v)).cpu().numpy(), host.backward(v)
    np.testing.assert_array_equal(np.isnan(v_rows), np.isnan(v_expected))
    sound = np.isfinite(v_expected)
    assert sound.all() != broken
    assert relative_error(v_rows[sound], v_expected[sound]) < 1e-5
    before = {name: array.copy() for name, array in parameters(other).items()}
    host.step(FieldRates())
    device.step(FieldRates())
    loan.download()
    for name, array in parameters(host).items():
        changed = parameters(other)[name]
        sound = np.isfinite(array)
        np.testing.assert_array_equal(np.isfinite(changed), sound, err_msg=name)
        assert not np.array_equal(changed[sound], before[name][sound]), name
        if name in {"cells", "decoder"}:
            # where a gradient is zero but for rounding, Adam makes a full step of it
            assert np.mean(np.abs(changed - array)[sound] < 1e-5) > 0.98, name
        else:
            assert relative_error(changed[sound], array[sound]) < 2e-5, name


def test_broken_nodes_spoil_no_others() -> None:
    """As on the CPU, but for what others learn of such nodes, which it leaves out."""
    host, rows = make("nodes")
    host.follow(rows[:, columns.MEAN])
    host.deltas.hexplane.cells[host.deltas.hexplane.grid.space_rows - 1] = np.nan
    assert 0 < np.isnan(host.deltas.hexplane.sample(host.nodes, T_NS)).any(axis=1).sum() < len(host.nodes)
    expected = host.deform(rows, T_NS)
    loan, v = Loan(DEVICE), np.ones_like(rows)
    v[4, 1] = np.nan
    device = DeviceField(host, loan)
    before = host.deltas.decoder.values.copy()
    found = device.deform(on_device(rows), T_NS)
    np.testing.assert_allclose(found.cpu().numpy(), expected, rtol=1e-5, atol=1e-5)
    device.backward(on_device(v))
    device.step(FieldRates())
    loan.download()
    assert np.isfinite(host.deltas.decoder.values).all()
    assert not np.array_equal(host.deltas.decoder.values, before)
    assert (~np.isfinite(host.deltas.hexplane.cells).all(axis=1)).sum() == 1


def test_a_field_that_picks_some_gaussians_follows_their_nodes() -> None:
    host, rows = make("nodes")
    host.follow(rows[:, columns.MEAN])
    device, picked = DeviceField(host, Loan(DEVICE)), np.array([7, 2, 19])
    everything = host.deform(rows, T_NS)
    device.pick(on_device(picked))
    found = device.deform(on_device(rows[picked]), T_NS).cpu().numpy()
    np.testing.assert_allclose(found, everything[picked], rtol=1e-5, atol=1e-5)


def test_the_3d_filter_is_the_cpus() -> None:
    """Behind the camera, beside the picture, in its margin, in it; and none at all."""
    view = camera(moved=True)
    rng = np.random.default_rng(0)
    means = rng.uniform([-0.05, -0.05, -0.05], [0.05, 0.05, 0.15], (300, 3)).astype(np.float32)
    for part in (means, means[:0], means[means[:, 2] < -0.04]):
        expected = alias_free.smoothing_variances(part, [view])
        found = smoothing_variances(on_device(part), view).cpu().numpy()
        np.testing.assert_allclose(found, expected, rtol=1e-5)
    assert len(np.unique(alias_free.smoothing_variances(means, [view]))) > 50
