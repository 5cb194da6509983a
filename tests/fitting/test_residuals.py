"""Deltas of single Gaussians at some times: linear in between, each slot with an optimiser of its own."""

import numpy as np
import pytest

from sags_node.errors import SagsError
from sags_node.model import columns
from sags_node.tools.fitting.residuals import Residuals, Steps
from sags_node.types import F32

TIMES = np.array([100, 200, 400])
STEPS = Steps(np.full(columns.COUNT, 0.01, np.float32), np.ones(3, np.float32))


def filled(count: int = 5) -> Residuals:
    residuals = Residuals(TIMES, count)
    residuals.values[:] = np.random.default_rng(0).normal(size=residuals.values.shape)
    return residuals


@pytest.mark.parametrize(
    ("t_ns", "shares"),
    [
        (50, (1, 0, 0)),
        (100, (1, 0, 0)),
        (150, (0.5, 0.5, 0)),
        (200, (0, 1, 0)),
        (350, (0, 0.25, 0.75)),
        (400, (0, 0, 1)),
        (900, (0, 0, 1)),
    ],
)
def test_between_slots_deltas_are_blended(t_ns: int, shares: tuple[float, ...]) -> None:
    residuals = filled()
    expected = np.tensordot(shares, residuals.values, 1)
    np.testing.assert_allclose(residuals.at(t_ns), expected, atol=1e-6)


def refine(residuals: Residuals, t_ns: int, v_rows: F32, v_colors: F32, contribution: F32) -> F32:
    """What a step changes."""
    before = residuals.values.copy()
    residuals.refine(t_ns, v_rows, v_colors, contribution, STEPS)
    changed: F32 = residuals.values - before
    return changed


def test_a_step_goes_against_the_gradient_at_its_time_and_nowhere_else() -> None:
    residuals = filled()
    v_rows = np.zeros((5, columns.COUNT), np.float32)
    v_rows[:, columns.MEAN] = 1.0
    changed = refine(residuals, 350, v_rows, np.zeros((5, 3), np.float32), np.ones(5, np.float32))
    assert not changed[0].any()
    np.testing.assert_allclose(changed[1:, :, columns.MEAN], -0.01, rtol=1e-3)  # Adam's first step: a rate
    assert not changed[:, :, columns.COLOR].any()


@pytest.mark.parametrize("t_ns", [200, 300, 350])
def test_colours_move_by_the_mean_residual_of_their_pixels(t_ns: int) -> None:
    residuals = filled()
    contribution = np.array([50, 50, 50, 50, 0], np.float32)
    v_colors = np.full((5, 3), 5.0, np.float32)  # a residual of 0.1 in each of 50 px
    before = residuals.at(t_ns)
    refine(residuals, t_ns, np.zeros((5, columns.COUNT), np.float32), v_colors, contribution)
    moved = (residuals.at(t_ns) - before)[:, columns.COLOR]
    np.testing.assert_allclose(moved[:4], -0.1, rtol=0.01)
    assert not moved[4].any()  # not in the image


def test_more_than_the_memory_they_may_take_is_refused() -> None:
    with pytest.raises(SagsError, match="fewer frames"):
        Residuals(np.arange(1000), 100_000)
