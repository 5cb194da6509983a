"""The HexPlane against its formula, the window that slides, and sums of rows against torch's own."""

import numpy as np
import pytest
import torch
from engine_scenes import on_one_thread

from sags_node.errors import SagsError, UsageError
from sags_node.field import hexplane as module
from sags_node.field.gather import filled, gather
from sags_node.field.hexplane import PAIRS, HexPlane, for_clip

BOX = np.array([[-0.05, -0.04, 0.03], [0.05, 0.04, 0.1]])  # m
SECOND = 1_000_000_000
T0 = 1_700_000_000 * SECOND


def small_field(slots: int = 4, levels: int = 2, channels: int = 16) -> HexPlane:
    return HexPlane(BOX, T0, SECOND, slots, cells=(8, 6, 5), levels=levels, channels=channels)


def shuffled(field: HexPlane, seed: int = 0) -> HexPlane:
    """With random cells everywhere, and all its slots."""
    field.newest = field.slots - 1
    values = field.cells.detach().numpy()
    values[:] = np.random.default_rng(seed).uniform(-1, 1, values.shape)
    return field


def by_the_formula(field: HexPlane, cells: torch.Tensor, points: torch.Tensor, t_ns: int) -> torch.Tensor:
    """Features of points, one plane after the other, by torch's own bilinear sampling."""
    low, high = torch.tensor(field.box)
    at = 2 * (points - low) / (high - low) - 1  # torch's coordinates: -1 and 1 are the first and last node
    since = min(max(t_ns - field.t0_ns, field.oldest * field.slot_ns), field.newest * field.slot_ns)
    slot, share = divmod(since, field.slot_ns)
    when = torch.full_like(at[:, 0], 2 * share / field.slot_ns - 1)
    levels, first = [], 0
    for level, (x, y, z) in enumerate(field.nodes.tolist()):
        feature = torch.ones((), dtype=points.dtype)
        for a, b in PAIRS:
            sizes = (x, y, z)[a], (x, y, z)[b]
            plane = cells[first : first + sizes[0] * sizes[1]].view(*sizes, -1)
            first += sizes[0] * sizes[1]
            feature = feature * bilinear(plane, at[:, b], at[:, a])
        skipped = int(field.nodes[:level].sum())
        for axis, count in enumerate((x, y, z)):
            begin = skipped + sum((x, y, z)[:axis])
            lines = [cells[field.slot(slot + k)][begin : begin + count] for k in (0, 1)]
            feature = feature * bilinear(torch.stack(lines), at[:, axis], when)
        levels.append(feature)
    return torch.cat(levels, 1)


def bilinear(picture: torch.Tensor, across: torch.Tensor, down: torch.Tensor) -> torch.Tensor:
    """Values [N, C] of an image [rows, columns, C] at places from -1 to 1."""
    places = torch.stack([across, down], -1)[None, None]
    sampled = torch.nn.functional.grid_sample(
        picture.permute(2, 0, 1)[None], places, padding_mode="border", align_corners=True
    )
    return sampled[0, :, 0].T


def window(channels: int) -> HexPlane:
    """One that has slid: its newest slot lies before the older ones in the table."""
    field = small_field(channels=channels)
    field.advance(T0 + 6 * SECOND, lambda t_ns: None)
    values = np.random.default_rng(channels).normal(size=tuple(field.cells.shape))
    field.cells = torch.from_numpy(values.astype(np.float32)).requires_grad_()
    return field


def some_points(count: int) -> torch.Tensor:
    """Within the box and around it."""
    size = BOX[1] - BOX[0]
    points = np.random.default_rng(count).uniform(BOX[0] - size / 4, BOX[1] + size / 4, (count, 3))
    return torch.from_numpy(points.astype(np.float32))


def sampled(field: HexPlane, points: torch.Tensor, t_ns: int, formula: bool = False) -> list[torch.Tensor]:
    """Features, and gradients by cells and points; by the formula in double precision."""
    leaves = [each.detach().to(torch.float64 if formula else torch.float32) for each in (field.cells, points)]
    cells, places = (each.requires_grad_() for each in leaves)
    if formula:
        features = by_the_formula(field, cells, places, t_ns)
    else:
        field.cells = cells
        features = field.sample(places, t_ns)
    v = torch.randn(features.shape, generator=torch.Generator().manual_seed(1)).to(features.dtype)
    return [features.detach(), *torch.autograd.grad(features, (cells, places), v)]


@pytest.mark.parametrize("channels", [1, 16, 24, 48])
@pytest.mark.parametrize("slot", [1.0, 3.0, 3.75, 5.5, 6.0, 9.0])
def test_features_and_gradients_are_those_of_the_formula(channels: int, slot: float) -> None:
    """By kernels where there are sixteen channels or a multiple, else in torch."""
    field, points, t_ns = window(channels), some_points(700), T0 + int(slot * SECOND)
    wanted = sampled(field, points, t_ns, formula=True)
    # products of six sums of four float32, and places that are rounded by 1e-6 of a cell
    for got, want in zip(sampled(field, points, t_ns), wanted, strict=True):
        assert (got - want).norm() <= 1e-5 * want.norm()


def test_no_points_have_no_features() -> None:
    features, v_cells, v_points = sampled(window(16), torch.zeros(0, 3), T0 + SECOND)
    assert features.shape == (0, 32) and v_points.shape == (0, 3) and not v_cells.any()


def test_same_bits_on_one_thread_and_on_all() -> None:
    field, points = window(32), some_points(2000)
    alone = on_one_thread(lambda: sampled(field, points, T0 + 4 * SECOND))
    for got, want in zip(sampled(field, points, T0 + 4 * SECOND), alone, strict=True):
        assert torch.equal(got, want)


def test_points_outside_take_the_value_of_the_border() -> None:
    field = shuffled(small_field())
    points = np.random.default_rng(3).uniform(BOX[0] - 0.1, BOX[1] + 0.1, (500, 3)).astype(np.float32)
    held = np.clip(points, *BOX.astype(np.float32))
    points[0, 0], held[0, 0] = np.inf, BOX[1, 0]
    asked = torch.from_numpy(points).requires_grad_()
    features = field.sample(asked, T0 + SECOND)
    (v_points,) = torch.autograd.grad(features.sum(), asked)
    outside = torch.from_numpy(points != held)
    assert outside.any(1).double().mean() > 0.5
    assert not v_points[outside].any() and (v_points[~outside] != 0).double().mean() > 0.95
    assert torch.allclose(features, field.sample(torch.from_numpy(held), T0 + SECOND), atol=1e-5)
    assert bool(field.sample(torch.full((1, 3), torch.nan), T0).isfinite().all())


def test_a_step_moves_the_cells_that_took_part_and_no_other() -> None:
    field = small_field()
    before = field.cells.detach().clone()
    field.sample(torch.tensor([[0.011, 0.007, 0.053]]), T0).sum().backward()
    field.step(0.1, 0.2)
    moved = (field.cells.detach() != before).any(1)
    assert 0 < int(moved.sum()) <= 2 * (3 * 4 + 3 * 2)  # levels, corners of planes, nodes of lines
    rates = torch.where(torch.arange(len(before)) < field.slot(0).start, 0.1, 0.2)  # planes, lines
    assert torch.allclose((field.cells.detach() - before)[moved].abs(), rates[moved, None], rtol=1e-3)
    field.step(0.1, 0.2)
    assert field.cells.grad is None  # nothing is learnt from the same gradient twice


@pytest.mark.parametrize(
    "change",
    [{"channels": 0}, {"slots": 0}, {"cells": (1, 0, 2)}, {"levels": 0}, {"levels": 9}, {"slot_ns": 0},
     {"box": [[0, 0, 0], [1, 0, 1]]}, {"box": [[0, 0, 0], [1, np.nan, 1]]}, {"box": [[0, 0], [1, 1]]}],
)  # fmt: skip
def test_impossible_numbers_are_refused(change: dict[str, object]) -> None:
    with pytest.raises(UsageError, match="needs"):
        HexPlane(**{"box": BOX, "t0_ns": 0, "slot_ns": SECOND} | change)  # type: ignore[arg-type]


# ---- The window over a stream ----------------------------------------------------------------------------


def write_time(field: HexPlane, number: int, value: float) -> None:
    """Make slot `number` say `value` on its lines of x."""
    lines, first = field.cells.detach()[field.slot(number)], 0
    for x, y, z in field.nodes.tolist():
        lines[first : first + x] = value
        first += x + y + z


def without_space(field: HexPlane) -> HexPlane:
    """What all planes in space say is 1, so that only time counts."""
    field.cells.detach()[: field.slot(0).start] = 1.0
    return field


def time_of(field: HexPlane, t_ns: int) -> float:
    """What the lines of x say at a time."""
    features = field.sample(torch.tensor([[0.01, 0.01, 0.05]]), t_ns).detach()
    assert features.max() - features.min() < 1e-4
    return float(features[0, 0])


def never(t_ns: int) -> None:
    raise AssertionError(f"the slot of {t_ns} retired")


def test_first_values() -> None:
    field = small_field()
    cells = field.cells.detach()
    space, time = cells[: field.slot(0).start], cells[field.slot(0).start :]
    assert 0.7 <= space.min() < 0.75 and 1.25 < space.max() <= 1.3
    assert abs(space.mean() - 1.0) < 0.01
    assert bool((time == 1).all())
    assert torch.equal(cells, small_field().cells)


def test_ring_over_a_stream_much_longer_than_the_window() -> None:
    """Each slot says its own number; the window must go on saying the time, and retire each slot once."""
    field = without_space(small_field(slots=4))
    write_time(field, 0, 0.0)
    cells, retired = field.cells, []

    def retire(t_ns: int) -> None:
        retired.append((t_ns, time_of(field, t_ns)))  # still there to be sampled

    for step in range(1, 400):
        t_ns = T0 + step * SECOND // 10
        before = field.newest
        field.advance(t_ns, retire)
        if field.newest > before:
            assert field.newest == before + 1
            assert time_of(field, T0 + field.newest * SECOND) == before  # a copy of the one before
            write_time(field, field.newest, field.newest)
        assert time_of(field, t_ns) == pytest.approx(step / 10, rel=1e-5)
    assert (field.oldest, field.newest) == (37, 40)
    assert retired == [(T0 + k * SECOND, float(k)) for k in range(37)]
    assert field.cells is cells
    assert time_of(field, T0 + 999 * SECOND) == 40  # constant after the newest and before the oldest
    assert time_of(field, T0) == time_of(field, T0 - 5) == 37


def test_times_within_the_window_retire_nothing() -> None:
    field = small_field(slots=4)
    for t_ns in (T0 + 3 * SECOND, T0 + SECOND, T0 - SECOND):
        field.advance(t_ns, never)
    assert (field.oldest, field.newest) == (0, 3)


def test_gap_longer_than_the_window() -> None:
    """All slots go, each once; the newest goes on; an hour takes no longer than a window."""
    field = without_space(small_field(slots=4))
    field.advance(T0 + 5 * SECOND, lambda t_ns: None)
    write_time(field, 5, 7.0)
    field.adam.moments[field.slot(5)] = 3.0
    retired: list[int] = []
    field.advance(T0 + 10**9 * SECOND, retired.append)
    assert retired == [T0 + k * SECOND for k in (2, 3, 4, 5)]
    for back in range(5):
        assert time_of(field, T0 + (10**9 - back) * SECOND) == 7.0
    assert (field.adam.moments[field.slot(0).start :] == 3.0).all()


def test_finished_clip() -> None:
    first, last = T0, T0 + 7 * SECOND + 3
    field = without_space(for_clip(BOX, first, last, slots=5, cells=4, channels=16))
    for slot in range(5):
        write_time(field, slot, slot)
    field.advance(last, never)
    assert time_of(field, first) == 0
    assert time_of(field, last) == pytest.approx(4, abs=1e-6)
    assert time_of(field, (first + last) // 2) == pytest.approx(2, abs=1e-6)


def test_one_slot_is_constant_in_time() -> None:
    field = small_field(slots=1)
    assert field.locate(T0 + 5 * SECOND) == field.locate(T0) == (0, 0, 0.0)


def test_the_memory_of_the_planes_has_a_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "MAX_BYTES", 1 << 20)
    small_field()
    for cells in (1000, 10**12):  # the second is out of the range of integers
        with pytest.raises(SagsError, match="MB, the limit is 1 MB"):
            HexPlane(BOX, T0, SECOND, cells=cells)


# ---- sums of rows ----------------------------------------------------------------------------------------


def inputs(bags: int, columns: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    """A table, rows of it, their weights and a cotangent."""
    generator = torch.Generator().manual_seed(bags + columns)
    table = torch.randn(50, columns, generator=generator)
    index = torch.randint(0, 40, (bags, 4), generator=generator)  # the last ten rows are never taken
    weight = torch.randn(bags, 4, generator=generator)
    return table, index, weight, torch.randn(bags, columns, generator=generator)


def run(
    table: torch.Tensor, index: torch.Tensor, weight: torch.Tensor, v: torch.Tensor
) -> list[torch.Tensor]:
    leaves = [table.clone().requires_grad_(), weight.clone().requires_grad_()]
    sums = gather(leaves[0], index, leaves[1])
    return [sums.detach(), *torch.autograd.grad(sums, leaves, v)]


@pytest.mark.parametrize("columns", [1, 16, 23, 32])
@pytest.mark.parametrize("bags", [0, 1, 700])
def test_kernels_equal_torch_in_double_precision(bags: int, columns: int) -> None:
    table, index, weight, v = inputs(bags, columns)
    expected = run(table.double(), index, weight.double(), v.double())
    for found, wanted in zip(run(table, index, weight, v), expected, strict=True):
        # a row of the table takes part in at most 4 bags sums of float32
        assert (found - wanted).norm() <= 1e-6 * max(1.0, float(wanted.norm()))


def test_only_what_is_learnt_gets_a_gradient() -> None:
    table, index, weight, _ = inputs(30, 8)
    gather(table.requires_grad_(), index, weight).sum().backward()
    assert table.grad is not None and weight.grad is None
    np.testing.assert_array_equal(np.flatnonzero(filled(table.grad)), np.unique(index.numpy()))


def test_rows_that_hold_something() -> None:
    table = torch.zeros(1300, 5)
    table[[0, 7, 512, 1299], [0, 4, 2, 3]] = torch.tensor([1e-30, -1, torch.nan, torch.inf])
    for kind in (table, table.double()):  # by the kernel, and in torch
        assert np.flatnonzero(filled(kind)).tolist() == [0, 7, 512, 1299]
