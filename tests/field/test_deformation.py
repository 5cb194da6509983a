"""Gaussians that follow control nodes, against the formula for each Gaussian and node in float64."""

from collections.abc import Callable

import numpy as np
import pytest
import torch
from engine_scenes import on_one_thread, relative_error

from sags_node.field.decoder import Decoder
from sags_node.field.deformation import Deltas, FieldRates, product, skin
from sags_node.field.hexplane import HexPlane
from sags_node.model import columns


def scene(seed: int, count: int = 40, nodes: int = 7) -> tuple[np.ndarray, ...]:
    rng = np.random.default_rng(seed)
    rows = rng.normal(size=(count, columns.COUNT)).astype(np.float32)
    places = rng.normal(size=(nodes, 3)).astype(np.float32)
    deltas = (0.4 * rng.normal(size=(nodes, columns.COUNT))).astype(np.float32)
    index = np.stack([rng.permutation(nodes)[:4] for _ in range(count)]).astype(np.int32)
    weight = rng.uniform(0.1, 1, (count, 4)).astype(np.float32)
    return rows, places, deltas, index, weight / weight.sum(1, keepdims=True)


def of_each(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """Products of quaternions [N, K, 4]."""
    return product(a.flatten(0, 1), b.flatten(0, 1)).view_as(a)


Skin = Callable[[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor], torch.Tensor]


def skinned_and_gradients(*arrays: np.ndarray, by: Skin = skin) -> tuple[np.ndarray, ...]:
    """Of rows, nodes, deltas, index, weight and a cotangent; the gradients by rows and by deltas."""
    rows, nodes, deltas, index, weight, cotangent = map(torch.tensor, arrays)
    inputs = rows.requires_grad_(), deltas.requires_grad_()
    skinned = by(inputs[0], nodes, inputs[1], index.long(), weight)
    found = torch.autograd.grad(skinned, inputs, cotangent)
    return skinned.detach().numpy(), *(gradient.numpy() for gradient in found)


def assert_equals_twin(*arrays: np.ndarray, atol: float = 2e-6, of: slice = np.s_[:]) -> None:
    """`of`: columns of the deltas whose gradient counts."""
    exact = (a if a.dtype.kind == "i" else a.astype(np.float64) for a in arrays)
    expected, by_rows, by_deltas = skinned_and_gradients(*exact, by=twin)
    skinned, *found = skinned_and_gradients(*arrays)
    np.testing.assert_allclose(skinned, expected, atol=atol)
    assert relative_error(found[0], by_rows) < 1e-5
    assert relative_error(found[1][:, of], by_deltas[:, of]) < 1e-5


def twin(
    rows: torch.Tensor, nodes: torch.Tensor, deltas: torch.Tensor, index: torch.Tensor, weight: torch.Tensor
) -> torch.Tensor:
    own = deltas[index]  # [N, 4, 14]
    identity = rows.new_tensor([1.0, 0, 0, 0])
    turn = identity + own[..., columns.QUAT]
    unit = torch.nn.functional.normalize(turn, dim=-1)
    arm = rows[:, None, columns.MEAN] - nodes[index]
    arm4 = torch.cat([torch.zeros_like(arm[..., :1]), arm], -1)
    conjugate = unit * rows.new_tensor([1.0, -1, -1, -1])
    turned = of_each(of_each(unit, arm4), conjugate)[..., 1:]
    w = weight[..., None]
    mean = rows[:, columns.MEAN] + (w * (turned - arm + own[..., columns.MEAN])).sum(1)
    plain = rows + (w * own).sum(1)
    quat = product((w * turn).sum(1), rows[:, columns.QUAT])
    return torch.cat([mean, plain[:, columns.LOG_SCALE], quat, plain[:, 10:]], 1)


@pytest.mark.parametrize("count", [5, 40, 1500])
def test_skinning_and_its_gradients_equal_the_twin(count: int) -> None:
    arrays = scene(count, count)
    cotangent = np.random.default_rng(count + 9).normal(size=arrays[0].shape).astype(np.float32)
    assert_equals_twin(*arrays, cotangent)
    arrays[3][::2, 2:] = arrays[3][::2, :1]  # a node twice, as the first where there are fewer than four
    assert_equals_twin(*arrays, cotangent)


def test_rotations_learn_from_short_arms_far_from_the_origin() -> None:
    """Arms of 4 mm at 10 m: what the place contributes to the gradient by a rotation must cancel."""
    rows, nodes, *others = scene(4, count=1500)
    offset, pull = np.array([0, 0, 10], np.float32), np.zeros_like(rows)
    nodes[:] = 0.004 * nodes + offset
    rows[:, columns.MEAN] = 0.004 * rows[:, columns.MEAN] + offset
    pull[:, columns.MEAN] = [0.3, 0.5, 1.0]
    assert_equals_twin(rows, nodes, *others, pull, atol=3e-6, of=columns.QUAT)


def test_no_delta_leaves_everything_as_it_is() -> None:
    rows, nodes, deltas, index, weight = scene(0)
    skinned, *_ = skinned_and_gradients(rows, nodes, np.zeros_like(deltas), index, weight, rows)
    np.testing.assert_array_equal(skinned, rows)


def test_a_rigid_motion_of_all_nodes_moves_everything_rigidly() -> None:
    rows, nodes, deltas, index, weight = scene(1)
    half = 0.3
    turn = np.array([np.cos(half), 0, 0, np.sin(half)])
    R = np.array([[np.cos(0.6), -np.sin(0.6), 0], [np.sin(0.6), np.cos(0.6), 0], [0, 0, 1]])
    shift = np.array([0.1, -0.2, 0.3])
    deltas[:] = 0
    deltas[:, columns.QUAT] = turn - [1, 0, 0, 0]
    deltas[:, columns.MEAN] = nodes @ R.T + shift - nodes
    skinned, *_ = skinned_and_gradients(rows, nodes, deltas, index, weight, rows)
    np.testing.assert_allclose(skinned[:, :3], rows[:, :3] @ R.T + shift, atol=2e-6)


def test_the_same_bits_on_one_and_two_threads() -> None:
    arrays = scene(2, count=1000, nodes=50)
    together = skinned_and_gradients(*arrays, arrays[0])
    alone = on_one_thread(lambda: skinned_and_gradients(*arrays, arrays[0]))
    for one, two in zip(together, alone, strict=True):
        np.testing.assert_array_equal(one, two)


def test_a_field_that_is_not_finite_takes_no_step() -> None:
    hexplane = HexPlane(np.array([[0, 0, 0], [1, 1, 1.0]]), 0, 1, slots=2, cells=4, channels=8)
    deltas = Deltas(hexplane, Decoder(hexplane.features, xavier=True))
    before = [parameter.clone() for parameter in deltas.decoder.parameters()]
    (deltas(torch.rand(5, 3), 0) * torch.nan).sum().backward()
    deltas.step(FieldRates())
    for parameter, known in zip(deltas.decoder.parameters(), before, strict=True):
        assert torch.equal(parameter, known) and parameter.grad is None
    assert bool(hexplane.cells.isfinite().all())
    deltas(torch.rand(5, 3), 0).sum().backward()
    deltas.step(FieldRates())
    assert not torch.equal(deltas.decoder.embed.weight, before[0]) or not torch.equal(
        deltas.decoder.head_bias, before[-1]
    )
