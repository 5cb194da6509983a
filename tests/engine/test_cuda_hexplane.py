"""The device's HexPlane, interpreted, against the CPU engine's twin, and the decoder's twin on a device."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from test_decoder import CONFIGS, inputs, trained
from test_hexplane import BOX, dense, error, random_cells, random_points, twin

pytest.importorskip("triton", reason="Triton comes with torch's CUDA builds, or by `pip install triton`")

from sags_node.engine.cuda import hexplane as cuda
from sags_node.engine.cuda.backend import default_device
from sags_node.engine.cuda.hexplane import FieldGradients
from sags_node.engine.cuda.hexplane_kernels import PART
from sags_node.engine.field.hexplane import Grid, HexPlane, Moment
from sags_node.engine.reference import decoder as decoder_reference
from sags_node.errors import UsageError
from sags_node.model.decoder import DecoderConfig
from sags_node.types import F32

pytestmark = pytest.mark.usefixtures("quick_interpreter")

DEVICE = default_device()
GRID = Grid(BOX, ((3, 3, 2), (4, 3, 3)), slots=4, channels=16)
BETWEEN = Moment(1, 2, 0.3)


def cotangent(grid: Grid, count: int) -> F32:
    return np.random.default_rng(2).normal(size=(count, grid.features)).astype(np.float32)


def run(
    grid: Grid, cells: F32, points: F32, moment: Moment, v_features: F32
) -> tuple[F32, FieldGradients, F32]:
    """Features, gradients, and those by all cells, 0 where none was touched."""
    field = cuda.HexPlane(grid, DEVICE)
    given = [torch.tensor(array, device=DEVICE) for array in (cells, points, v_features)]
    features = field.forward(given[0], given[1], moment).cpu().numpy()
    found = field.backward(given[2])
    found = FieldGradients(found.v_cells.cpu(), found.touched.cpu(), found.v_points.cpu())
    return features, found, dense(grid, found.v_cells.numpy(), found.touched.numpy())


@pytest.mark.parametrize(
    ("channels", "moment", "count"),
    [(16, BETWEEN, 2 * PART + 3), (48, Moment(3, 0, 0.75), 20), (32, Moment(3, 3, 0.5), 20)],
)
def test_equals_the_twin(channels: int, moment: Moment, count: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cuda, "CHUNK", cuda.PART)  # the interpreter is slow
    grid = replace(GRID, channels=channels)
    cells, points, v_features = random_cells(grid), random_points(count), cotangent(grid, count)
    features, found, v_cells = run(grid, cells, points, moment, v_features)
    expected, v_expected, v_points = twin(grid, cells, points, moment, v_features)
    assert error(features, expected) < 1e-5
    assert error(v_cells, v_expected) < 1e-5
    assert error(found.v_points.numpy(), v_points) < 1e-4


def test_one_level_and_lines_longer_than_a_program_takes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cuda, "NODES", 16)
    grid = Grid(BOX, ((19, 3, 2),), slots=1, channels=16)
    cells, points, v_features = random_cells(grid), random_points(30), cotangent(grid, 30)
    now = Moment(0, 0, 0.0)
    _, found, v_cells = run(grid, cells, points, now, v_features)
    _, v_expected, v_points = twin(grid, cells, points, now, v_features)
    assert error(v_cells, v_expected) < 1e-5
    assert error(found.v_points.numpy(), v_points) < 1e-4


def test_touches_the_same_cells_as_the_cpu_engine() -> None:
    """Points with and without a cotangent, outside the box, on nodes, and at places that are no numbers."""
    points = random_points(24, margin=0.02)
    v_features = cotangent(GRID, 24)
    points[:, 0] = -0.02 - 0.5 * np.abs(points[:, 0])
    points[8:16, 0] *= -1  # so these have cells of their own
    points[:4] = [[np.nan, 0, 0.05], [np.inf, 0, 0.05], [-np.inf, 0, 0.05], BOX[0]]
    v_features[8:16] = 0
    cells = random_cells(GRID)
    features, found, v_cells = run(GRID, cells, points, BETWEEN, v_features)
    engine = HexPlane(GRID)
    np.testing.assert_allclose(features, engine.forward(cells, points, BETWEEN), rtol=1e-4, atol=1e-6)
    expected = engine.backward(v_features)
    np.testing.assert_array_equal(np.flatnonzero(found.touched), expected.rows)
    assert error(v_cells, dense(GRID, expected.v_cells, expected.rows).astype(np.float64)) < 1e-5
    assert error(found.v_points.numpy(), expected.v_points.astype(np.float64)) < 1e-5
    assert not found.v_points[8:16].any()


@pytest.mark.parametrize("count", [0, 1])
def test_few_points(count: int) -> None:
    points = random_points(1, margin=0.0)[:count]
    features, found, _ = run(GRID, random_cells(GRID), points, BETWEEN, cotangent(GRID, count))
    assert features.shape == (count, GRID.features)
    assert found.v_points.shape == (count, 3)
    assert found.touched.sum() == count * 2 * (3 * 4 + 3 * 2 * 2)  # levels, corners, nodes in two slots


def test_one_broken_point_breaks_its_own_cells_only() -> None:
    points, v_features = random_points(20, margin=0.0), cotangent(GRID, 20)
    points[0] = np.array(BOX[0]) + 1e-3  # a corner of the box
    v_features[0, 3] = np.nan
    _, found, v_cells = run(GRID, random_cells(GRID), points, BETWEEN, v_features)
    broken = ~np.isfinite(v_cells).all(1)
    assert broken.sum() == 3 * 4  # in space, on the first level
    assert np.isfinite(found.v_points[1:].numpy()).all()


def test_same_bits_again_and_all_points_in_one_cell() -> None:
    points = np.float32([0.001, 0.001, 0.061]) + np.linspace(0, 1e-4, 40, dtype=np.float32)[:, None]
    cells, v_features = random_cells(GRID), cotangent(GRID, 40)
    _, found, v_cells = run(GRID, cells, points, BETWEEN, v_features)
    _, again, v_cells_again = run(GRID, cells, points, BETWEEN, v_features)
    np.testing.assert_array_equal(v_cells, v_cells_again)
    assert torch.equal(found.v_points, again.v_points)
    _, v_expected, _ = twin(GRID, cells, points, BETWEEN, v_features)
    assert error(v_cells, v_expected) < 1e-5


def test_shapes_and_slots_are_checked() -> None:
    field = cuda.HexPlane(GRID, DEVICE)
    cells, points = torch.tensor(random_cells(GRID), device=DEVICE), torch.zeros((2, 3), device=DEVICE)
    with pytest.raises(UsageError, match="cells have shape"):
        field.forward(cells[1:], points, BETWEEN)
    with pytest.raises(UsageError, match="points have shape"):
        field.forward(cells, points[:, :2], BETWEEN)
    with pytest.raises(UsageError, match="outside the 4 slots"):
        field.forward(cells, points, Moment(1, 4, 0.5))
    field.forward(cells, points, BETWEEN)
    with pytest.raises(UsageError, match="v_features have shape"):
        field.backward(torch.zeros((1, GRID.features), device=DEVICE))


@pytest.mark.parametrize("config", CONFIGS.values(), ids=CONFIGS)
def test_the_decoders_twin_makes_no_tensor_on_another_device(config: DecoderConfig) -> None:
    """Its matrix products are the device's own, so on a GPU it is the decoder. On `meta`, a device without
    numbers, any tensor that it made on the CPU would be refused."""
    decoder = trained(config)
    features, v_deltas = (torch.tensor(array, device="meta") for array in inputs(config, 5))
    weights = {
        name: torch.tensor(array, device="meta").requires_grad_()
        for name, array in decoder.parameters.items()
    }
    features.requires_grad_()
    deltas = decoder_reference.decode(weights, config.sizes, features, config.tokens == "nodes")
    gradients = torch.autograd.grad(deltas, [features, *weights.values()], v_deltas, allow_unused=False)
    assert deltas.shape == v_deltas.shape
    assert all(gradient.device.type == "meta" for gradient in gradients)
