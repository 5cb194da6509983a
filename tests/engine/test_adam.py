"""Adam on rows of a table against torch's, row by row."""

import numpy as np
import pytest
from engine_scenes import on_one_thread, relative_error

from sags_node.engine.adam import AdamState, adam_step
from sags_node.types import F32, F64

ROWS, COLUMNS = 40, 19  # a vector and a rest
BETAS = (0.8, 0.99)


def start() -> tuple[F32, F32, AdamState]:
    rng = np.random.default_rng(0)
    values = rng.normal(size=(ROWS, COLUMNS)).astype(np.float32)
    rates = rng.uniform(1e-3, 1e-1, COLUMNS).astype(np.float32)
    return values, rates, AdamState.new(ROWS, COLUMNS)


def gradients(step: int) -> F32:
    """Of all sizes, so that nothing hides behind the normalisation."""
    rng = np.random.default_rng(1000 + step)
    return (rng.normal(size=(ROWS, COLUMNS)) * 10 ** rng.uniform(-6, 3, (ROWS, 1))).astype(np.float32)


def torch_adam(values: F32, rates: F32, given: list[F32]) -> F64:
    """float64; each column is a parameter with a rate of its own."""
    import torch

    columns = [torch.tensor(column, dtype=torch.float64) for column in values.T]
    groups = [{"params": [column], "lr": float(rate)} for column, rate in zip(columns, rates, strict=True)]
    optimiser = torch.optim.Adam(groups, betas=BETAS, eps=1e-15)
    for gradient in given:
        for column, slope in zip(columns, gradient.T, strict=True):
            column.grad = torch.tensor(slope, dtype=torch.float64)
        optimiser.step()
    return torch.stack(columns, 1).numpy()


def test_dense_steps_are_torch_adam() -> None:
    values, rates, state = start()
    before = values.copy()
    given = [gradients(step) for step in range(60)]
    for gradient in given:
        assert adam_step(values, gradient, state, rates, betas=BETAS) == 0
    assert relative_error(values - before, torch_adam(before, rates, given) - before) < 1e-5


def test_each_row_is_an_optimiser_that_saw_its_own_steps_only() -> None:
    values, rates, state = start()
    before = values.copy()
    rng = np.random.default_rng(2)
    seen: list[list[F32]] = [[] for _ in range(ROWS)]
    for step in range(50):
        rows = rng.permutation(ROWS)[: rng.integers(0, ROWS // 2)]
        rows = rows[rows != 7] if step < 49 else np.array([7, 3])  # row 7 comes late, row 3 at least once
        gradient = np.full((ROWS, COLUMNS), np.nan, np.float32)  # rows that are not taken may hold anything
        gradient[rows] = gradients(step)[rows]
        for row in rows:
            seen[row].append(gradient[row : row + 1])
        rows = rows.astype(np.int32 if step % 2 else np.int64)
        assert adam_step(values, gradient, state, rates, rows=rows, betas=BETAS) == 0
    for row in range(ROWS):
        expected = torch_adam(before[row : row + 1], rates, seen[row]) - before[row]
        np.testing.assert_allclose((values - before)[row], expected[0], rtol=1e-4, atol=2e-6)
    # the first step of a row is one rate long however late it comes
    np.testing.assert_allclose(np.abs(values - before)[7], rates, rtol=1e-3)


@pytest.mark.parametrize(
    ("place", "broken"),
    [
        ("gradient", 1e30),  # overflows when squared
        *((place, value) for place in ("gradient", "state") for value in (np.nan, np.inf, -np.inf)),
    ],
)
def test_a_broken_row_sits_out_and_starts_anew(place: str, broken: float) -> None:
    clean_values, rates, clean_state = start()
    values, _, state = start()
    for step in range(5):
        for table, memory in ((clean_values, clean_state), (values, state)):
            adam_step(table, gradients(step), memory, rates)
    before = values.copy()
    spoilt = gradients(5)
    if place == "gradient":
        spoilt[11, 4] = broken
        spoilt[12, COLUMNS - 1] = broken
    else:
        state.moments[11, 4, 0] = state.moments[12, COLUMNS - 1, 1] = broken
    adam_step(clean_values, gradients(5), clean_state, rates)
    assert adam_step(values, spoilt, state, rates) == 2
    np.testing.assert_array_equal(values[11:13], before[11:13])
    assert not state.moments[11:13].any()
    assert not state.shares[11:13].any()
    others = np.delete(np.arange(ROWS), [11, 12])
    np.testing.assert_array_equal(values[others], clean_values[others])
    # its next step is a first one
    before = values.copy()
    assert adam_step(values, gradients(6), state, rates) == 0
    np.testing.assert_allclose(np.abs(values - before)[11:13], np.stack([rates, rates]), rtol=1e-3)


def test_same_bits_for_one_and_all_threads() -> None:
    def run() -> F32:
        values, rates, state = start()
        for step in range(5):
            adam_step(values, gradients(step), state, rates, rows=np.arange(0, ROWS, 3))
        return values

    together = run()
    np.testing.assert_array_equal(on_one_thread(run), together)


def test_shapes_are_checked() -> None:
    values, rates, state = start()
    with pytest.raises(ValueError, match="gradients"):
        adam_step(values, np.zeros((ROWS, 3), np.float32), state, rates)
    with pytest.raises(ValueError, match="rates"):
        adam_step(values, gradients(0), state, rates[:3])
    with pytest.raises(ValueError, match="eps"):
        adam_step(values, gradients(0), state, rates, eps=0.0)
