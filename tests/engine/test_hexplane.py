"""The HexPlane kernels against torch and finite differences, and the window that slides and grows."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
import torch

from sags_node.engine.adam import adam_step
from sags_node.engine.field.hexplane import Grid, HexPlane, Moment
from sags_node.engine.field.hexplane_kernels import BLOCK
from sags_node.engine.reference import hexplane as reference
from sags_node.errors import SagsError, UsageError
from sags_node.kernels.threads import configure_threads
from sags_node.model import hexplane as model
from sags_node.model.hexplane import HexPlaneField
from sags_node.types import F32, F64

BOX = ((-0.05, -0.04, 0.03), (0.05, 0.04, 0.1))  # m
GRID = Grid(BOX, ((17, 12, 9), (33, 23, 17)), slots=5, channels=32)
BETWEEN = Moment(1, 2, 0.3)


def random_cells(grid: Grid, seed: int = 0) -> F32:
    return np.random.default_rng(seed).uniform(-1, 1, (grid.rows, grid.channels)).astype(np.float32)


def random_points(count: int, seed: int = 1, margin: float = 0.01) -> F32:
    """Points in and a little outside the box, none of them near a node of `GRID`: slopes jump there."""
    rng = np.random.default_rng(seed)
    low, high = np.array(BOX)
    points = rng.uniform(low - margin, high + margin, (4 * count, 3)).astype(np.float32)
    keep = np.ones(len(points), bool)
    for nodes in GRID.nodes:
        u = (points - low) / (high - low) * (np.array(nodes) - 1)
        keep &= (np.abs(u - np.round(u)) > 1e-3).all(1)
    assert keep.sum() >= count
    return points[keep][:count]


def twin(
    grid: Grid, cells: F32, points: F32, moment: Moment, v_features: F32 | None = None
) -> tuple[F64, F64, F64]:
    """Features, and gradients by cells and points, in float64."""
    moment = moment._replace(fraction=float(np.float32(moment.fraction)))
    inputs = [torch.tensor(array, dtype=torch.float64, requires_grad=True) for array in (cells, points)]
    features = reference.sample(grid, *inputs, moment)
    if v_features is None:
        v_features = np.zeros(features.shape, np.float32)
    found = torch.autograd.grad(features, inputs, torch.tensor(v_features, dtype=torch.float64))
    return features.detach().numpy(), found[0].numpy(), found[1].numpy()


def error(found: F32, expected: F64) -> float:
    return float(np.linalg.norm(found - expected) / np.linalg.norm(expected))


def dense(grid: Grid, v_cells: F32, rows: np.ndarray) -> F32:
    """Gradients of all cells, from those that were touched."""
    found = np.zeros((grid.rows, grid.channels), np.float32)
    found[rows] = v_cells[rows]
    return found


@pytest.mark.parametrize("channels", [16, 32, 48])
@pytest.mark.parametrize("moment", [BETWEEN, Moment(4, 0, 0.75), Moment(3, 3, 0.5), Moment(0, 1, 0.0)])
def test_kernels_equal_their_twin(channels: int, moment: Moment) -> None:
    grid = replace(GRID, channels=channels)
    points = random_points(BLOCK + 300)
    cells = random_cells(grid)
    v_features = np.random.default_rng(2).normal(size=(len(points), grid.features)).astype(np.float32)
    field = HexPlane(grid)
    features = field.forward(cells, points, moment)
    gradients = field.backward(v_features)
    expected, v_cells, v_points = twin(grid, cells, points, moment, v_features)
    assert error(features, expected) < 1e-5
    assert error(dense(grid, gradients.v_cells, gradients.rows), v_cells) < 1e-5
    assert error(gradients.v_points, v_points) < 1e-4


def test_twin_against_finite_differences() -> None:
    grid = Grid(BOX, ((4, 3, 5),), slots=3, channels=16)
    cells, points = random_cells(grid), random_points(6, margin=0.0)
    inputs = [torch.tensor(array, dtype=torch.float64, requires_grad=True) for array in (cells, points)]
    assert torch.autograd.gradcheck(
        lambda *x: reference.sample(grid, *x, Moment(2, 0, 0.4)), inputs, eps=1e-7
    )


def test_features_by_hand() -> None:
    """Level 0 of a field that is linear in space and time, at a place where six factors are known."""
    grid = Grid(((0, 0, 0), (4, 2, 8)), ((5, 3, 9),), slots=2, channels=16)
    cells = np.ones((grid.rows, 16), np.float32)
    (xy, xz, yz), (x, _, _) = grid.plane_rows[0], grid.line_rows[0]
    cells[xy : xy + 15] = (np.arange(15) // 5)[:, None]  # y
    cells[xz : xz + 45] = (np.arange(45) // 9)[:, None]  # x
    cells[yz : yz + 27] = (np.arange(27) % 9)[:, None]  # z
    for slot in range(2):
        cells[grid.slot(slot)][x : x + 5] = 10.0 * slot
    features = HexPlane(grid).forward(cells, np.array([[2.5, 1.25, 3.75]], np.float32), Moment(0, 1, 0.2))
    assert features == pytest.approx(2.5 * 1.25 * 3.75 * 2.0)


def test_points_outside_take_the_value_of_the_border() -> None:
    low, high = np.array(BOX)
    rng = np.random.default_rng(3)
    points = rng.uniform(low - 0.1, high + 0.1, (500, 3)).astype(np.float32)
    points[:3] = [[np.nan, 0, 0.05], [np.inf, 0, 0.05], [-np.inf, 0, 0.05]]
    held = np.clip(points, low.astype(np.float32), high.astype(np.float32))
    held[0, 0] = low[0]
    field, cells = HexPlane(GRID), random_cells(GRID)
    features = field.forward(cells, points, BETWEEN).copy()
    v_points = field.backward(np.ones_like(features)).v_points
    outside = (points < low) | (points > high) | np.isnan(points)
    assert outside.any(1).mean() > 0.5
    assert (v_points[outside] == 0).all()
    assert (v_points[~outside] != 0).mean() > 0.99
    assert np.allclose(features, field.forward(cells, held, BETWEEN), atol=1e-5)


def test_points_on_nodes_and_borders() -> None:
    """On a node the value is the node's, the slope that of the cell behind it, and 0 on the box's faces."""
    grid = Grid(((0, 0, 0), (4, 4, 4)), ((5, 5, 5),), slots=1, channels=16)
    cells = random_cells(grid)
    points = np.array(list(itertools.product(range(5), repeat=3)), np.float32)
    v_features = np.random.default_rng(2).normal(size=(len(points), 16)).astype(np.float32)
    field = HexPlane(grid)
    now = Moment(0, 0, 0.0)
    features, gradients = field.forward(cells, points, now), field.backward(v_features)
    expected, v_cells, v_points = twin(grid, cells, points, now, v_features)
    assert np.allclose(features, expected, atol=1e-6)
    assert error(dense(grid, gradients.v_cells, gradients.rows), v_cells) < 1e-5
    assert error(gradients.v_points, v_points) < 1e-5


@pytest.mark.parametrize("count", [0, 1])
def test_few_points(count: int) -> None:
    field, cells, points = HexPlane(GRID), random_cells(GRID), random_points(1, margin=0.0)[:count]
    assert field.forward(cells, points, BETWEEN).shape == (count, 64)
    gradients = field.backward(np.ones((count, 64), np.float32))
    assert gradients.v_points.shape == (count, 3)
    assert len(gradients.rows) == count * 2 * (3 * 4 + 3 * 2 * 2)  # levels, corners, nodes in two slots


def test_all_points_in_one_cell() -> None:
    points = np.float32([0.001, 0.001, 0.061]) + np.linspace(0, 1e-4, 5000, dtype=np.float32)[:, None]
    field, cells = HexPlane(GRID), random_cells(GRID)
    v_features = np.random.default_rng(2).normal(size=(5000, 64)).astype(np.float32)
    field.forward(cells, points, BETWEEN)
    gradients = field.backward(v_features)
    _, v_cells, _ = twin(GRID, cells, points, BETWEEN, v_features)
    assert len(gradients.rows) == 48
    assert error(dense(GRID, gradients.v_cells, gradients.rows), v_cells) < 1e-4


def test_touched_rows_are_complete_and_minimal() -> None:
    """Also for a second call, whose points touch less: nothing of the first is left in its rows."""
    field, cells = HexPlane(GRID), random_cells(GRID)
    points = random_points(3000)
    v_features = np.random.default_rng(2).uniform(0.5, 1, (3000, 64)).astype(np.float32)
    field.forward(cells, points, BETWEEN)
    before = field.backward(v_features).rows.size
    v_features[:2980] = 0
    field.forward(cells, points, Moment(3, 3, 0.0))
    gradients = field.backward(v_features)
    _, v_cells, _ = twin(GRID, cells, points, Moment(3, 3, 0.0), v_features)
    assert np.array_equal(gradients.rows, np.flatnonzero((v_cells != 0).any(1)))
    assert gradients.rows.size < before / 2
    assert error(dense(GRID, gradients.v_cells, gradients.rows), v_cells) < 1e-5
    assert (gradients.v_points[:2980] == 0).all()


def test_threads_change_no_bit() -> None:
    points, cells = random_points(2 * BLOCK + 700), random_cells(GRID)
    v_features = np.random.default_rng(2).normal(size=(len(points), 64)).astype(np.float32)
    field = HexPlane(GRID)
    found = []
    try:
        for threads in (1, 2, 3):
            configure_threads(threads)
            features = field.forward(cells, points, BETWEEN).copy()
            gradients = field.backward(v_features)
            rows = gradients.rows.copy()
            found.append((features, gradients.v_points.copy(), rows, gradients.v_cells[rows]))
    finally:
        configure_threads(None)
    for other in found[1:]:
        for a, b in zip(found[0], other, strict=True):
            assert np.array_equal(a, b)


@pytest.mark.parametrize(
    "change",
    [{"channels": 24}, {"channels": 0}, {"slots": 0}, {"nodes": ((1, 2, 2),)}, {"nodes": ()},
     {"box": ((0, 0, 0), (1, 0, 1))}, {"box": ((0, 0, 0), (1, np.nan, 1))}],
)  # fmt: skip
def test_impossible_grids(change: dict[str, object]) -> None:
    with pytest.raises(UsageError, match="needs"):
        replace(GRID, **change)  # type: ignore[arg-type]  # wrong on purpose


def test_wrong_arrays() -> None:
    field, cells, points = HexPlane(GRID), random_cells(GRID), random_points(5)
    wrong: list[tuple[F32, F32, Moment]] = [
        (cells[1:], points, BETWEEN),
        (cells, points[:, :2], BETWEEN),
        (cells, points, Moment(0, 5, 0.5)),
        (cells, points, Moment(-1, 0, 0.5)),
        (cells, points, Moment(0, 1, float("nan"))),
    ]
    for arguments in wrong:
        with pytest.raises(UsageError):
            field.forward(*arguments)
    field.forward(cells, points, BETWEEN)
    with pytest.raises(UsageError, match=r"\[5, 64\]"):
        field.backward(np.zeros((4, 64), np.float32))


# The window over a stream

SECOND = 1_000_000_000
T0 = 1_700_000_000 * SECOND


def small_field(slots: int = 4, t0_ns: int = T0) -> HexPlaneField:
    return HexPlaneField(np.array(BOX), t0_ns, SECOND, slots, cells=(8, 6, 5), channels=16)


def write_time(field: HexPlaneField, number: int, value: float) -> None:
    """Make slot `number` say `value` on its lines of x."""
    lines = field.cells[field.grid.slot(number % field.grid.slots)]
    for level, sizes in enumerate(field.grid.nodes):
        first = field.grid.line_rows[level, 0]
        lines[first : first + sizes[0]] = value


def time_of(field: HexPlaneField, t_ns: int) -> float:
    """What the lines of x say at a time; the planes in space must be 1."""
    features = field.sample(np.array([[0.01, 0.01, 0.05]], np.float32), t_ns)
    assert np.ptp(features) < 1e-4
    return float(features[0, 0])


def never(t_ns: int) -> None:
    raise AssertionError(f"the slot of {t_ns} retired")


def test_first_values() -> None:
    field = small_field()
    space, time = field.cells[: field.grid.space_rows], field.cells[field.grid.space_rows :]
    assert 0.7 <= space.min() < 0.75 and 1.25 < space.max() <= 1.3
    assert abs(space.mean() - 1.0) < 0.01
    assert (time == 1).all()
    assert np.array_equal(field.cells, small_field().cells)


def test_ring_over_a_stream_much_longer_than_the_window() -> None:
    """Each slot says its own number; the window must go on saying the time, and retire each slot once."""
    field = small_field(slots=4)
    field.cells[: field.grid.space_rows] = 1.0
    write_time(field, 0, 0.0)
    cells, retired = field.cells, []

    def retire(t_ns: int) -> None:
        retired.append((t_ns, time_of(field, t_ns)))  # still there to be sampled

    for step in range(1, 2000):
        t_ns = T0 + step * SECOND // 10
        before = field.newest
        field.advance(t_ns, retire)
        if field.newest > before:
            assert field.newest == before + 1
            assert time_of(field, T0 + field.newest * SECOND) == before  # a copy of the one before
            write_time(field, field.newest, field.newest)
        assert time_of(field, t_ns) == pytest.approx(step / 10, rel=1e-6)
    assert field.newest == 200
    assert field.oldest == 197
    assert retired == [(T0 + k * SECOND, float(k)) for k in range(197)]
    assert field.cells is cells
    assert time_of(field, T0 + 999 * SECOND) == 200  # constant after the newest and before the oldest
    assert time_of(field, T0) == 197
    assert time_of(field, T0 - 5) == 197


def test_times_within_the_window_retire_nothing() -> None:
    field = small_field(slots=4)
    for t_ns in (T0 + 3 * SECOND, T0 + SECOND, T0 - SECOND):
        field.advance(t_ns, never)
    assert (field.oldest, field.newest) == (0, 3)


def test_gap_longer_than_the_window() -> None:
    """All slots go, each once; the newest goes on; an hour takes no longer than a window."""
    field = small_field(slots=4)
    field.cells[: field.grid.space_rows] = 1.0
    field.advance(T0 + 5 * SECOND, lambda t_ns: None)
    write_time(field, 5, 7.0)
    field.adam.moments[field.grid.slot(5 % 4)] = 3.0
    retired: list[int] = []
    field.advance(T0 + 10**9 * SECOND, retired.append)
    assert retired == [T0 + k * SECOND for k in (2, 3, 4, 5)]
    for back in range(5):
        assert time_of(field, T0 + (10**9 - back) * SECOND) == 7.0
    assert (field.adam.moments[field.grid.space_rows :] == 3.0).all()


def test_finished_clip() -> None:
    first, last = T0, T0 + 7 * SECOND + 3
    field = HexPlaneField.for_clip(np.array(BOX), first, last, slots=5, cells=4, channels=16)
    field.cells[: field.grid.space_rows] = 1.0
    for slot in range(5):
        write_time(field, slot, slot)
    field.advance(last, never)
    assert time_of(field, first) == 0
    assert time_of(field, last) == pytest.approx(4, abs=1e-6)
    assert time_of(field, (first + last) // 2) == pytest.approx(2, abs=1e-6)


def test_one_slot_is_constant_in_time() -> None:
    field = small_field(slots=1)
    assert field.locate(T0 + 5 * SECOND) == field.locate(T0) == Moment(0, 0, 0.0)


@pytest.mark.parametrize(
    "more", [([-0.06, 0, 0], [0, 0, 0]), ([0, 0, 0], [0.03, 0.2, 0.001]), ([-0.1, -0.1, -0.02], [0.1] * 3)]
)
def test_growth_changes_no_feature(more: tuple[list[float], list[float]]) -> None:
    field = small_field()
    rng = np.random.default_rng(4)
    field.advance(T0 + 9 * SECOND, lambda t_ns: None)
    for rows in (field.cells, field.adam.moments, field.adam.shares):
        rows[:] = rng.uniform(0.5, 1, rows.shape)
    wanted = np.array(BOX) + more
    points = rng.uniform(wanted[0] - 0.01, wanted[1] + 0.01, (2000, 3)).astype(np.float32)
    t_ns = T0 + 17 * SECOND // 2
    before, old = field.sample(points, t_ns).copy(), field.grid
    known = field.adam.shares[:, 0]
    assert field.grow(wanted)
    low, high = np.array(field.grid.box)
    assert (low <= wanted[0] + 1e-9).all()
    assert (high >= wanted[1] - 1e-9).all()
    size = [(np.array(g.box[1]) - g.box[0]) / (np.array(g.nodes[1]) - 1) for g in (old, field.grid)]
    assert np.allclose(*size)  # of a cell
    assert np.allclose(field.sample(points, t_ns), before, atol=2e-4)
    assert np.abs(before).max() > 0.3
    assert np.isin(known, field.adam.shares[:, 0]).all()  # no row was lost
    assert not field.grow(wanted)
    assert not field.grow(np.array(field.grid.box))


def test_growth_keeps_old_cells_trainable() -> None:
    """A target that was fitted stays fitted while the new part of the box is fitted to another one."""
    field = HexPlaneField(np.array(BOX), T0, SECOND, slots=2, cells=8, channels=16)
    rng = np.random.default_rng(5)

    def fit(points: F32, target: float, steps: int) -> None:
        for _ in range(steps):
            gradients = field.backward(field.sample(points, T0) - np.float32(target))
            rates = np.full(16, 0.02, np.float32)
            adam_step(field.cells, gradients.v_cells, field.adam, rates, rows=gradients.rows)

    def residual(points: F32, target: float) -> float:
        return float(np.abs(field.sample(points, T0) - target).mean())

    low, high = np.array(BOX)
    inside = rng.uniform(low, high, (2000, 3)).astype(np.float32)
    assert residual(inside, 0.5) > 0.4
    fit(inside, 0.5, 150)
    assert residual(inside, 0.5) < 0.01
    shift = 3 * (high - low)
    far = (inside + shift).astype(np.float32)
    field.grow(np.array([low, high + shift]))
    fit(far, 2.0, 100)
    assert residual(far, 2.0) < 0.05
    assert residual(inside, 0.5) < 0.01


def test_growth_has_a_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(model, "MAX_BYTES", 1 << 20)
    field = small_field()
    cells, grid = field.cells, field.grid
    with pytest.raises(SagsError, match="MB, the limit is 1 MB"):
        field.grow(np.array(BOX) * 1e6)
    with pytest.raises(UsageError, match="not finite"):
        field.grow(np.array(BOX) * np.inf)
    assert field.cells is cells
    assert field.grid is grid
