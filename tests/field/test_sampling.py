"""The HexPlane's kernels against its formula in torch, in double precision."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from engine_scenes import on_one_thread

from sags_node.field.hexplane import HexPlane

SECOND = 1_000_000_000
BOX = np.array([[-0.02, -0.01, 0.05], [0.03, 0.02, 0.09]])
SLOTS = 3


def window(channels: int) -> HexPlane:
    """A window that has slid: its newest slot lies before the older ones in the table."""
    field = HexPlane(BOX, 0, SECOND, SLOTS, cells=(5, 4, 3), channels=channels)
    field.advance((2 * SLOTS - 2) * SECOND, lambda t_ns: None)
    values = np.random.default_rng(channels).normal(size=tuple(field.cells.shape))
    field.cells = torch.from_numpy(values.astype(np.float32)).requires_grad_()
    return field


def some_points(count: int) -> torch.Tensor:
    """Within the box and around it."""
    size = BOX[1] - BOX[0]
    points = np.random.default_rng(count).uniform(BOX[0] - size / 4, BOX[1] + size / 4, (count, 3))
    return torch.from_numpy(points.astype(np.float32))


def sampled(field: HexPlane, points: torch.Tensor, t_ns: int, double: bool) -> list[torch.Tensor]:
    """Features, and gradients by cells and points."""
    kind = torch.float64 if double else torch.float32
    single, leaves = field.cells, [each.detach().to(kind).requires_grad_() for each in (field.cells, points)]
    field.cells = leaves[0]
    features = field.sample(leaves[1], t_ns)
    field.cells = single
    generator = torch.Generator().manual_seed(1)
    v = torch.randn(features.shape, generator=generator).to(kind)
    return [features.detach(), *torch.autograd.grad(features, leaves, v)]


@pytest.mark.parametrize("channels", [16, 48])
@pytest.mark.parametrize("slot", [1.0, 2.0, 2.75, 3.5, 4.0, 9.0])
def test_kernels_equal_the_formula(channels: int, slot: float) -> None:
    field, points, t_ns = window(channels), some_points(700), int(slot * SECOND)
    wanted = sampled(field, points, t_ns, double=True)
    # products of six sums of four float32, and places that are rounded by 1e-6 of a cell
    for got, want in zip(sampled(field, points, t_ns, double=False), wanted, strict=True):
        assert (got - want).norm() <= 1e-5 * want.norm()


def test_no_points_have_no_features() -> None:
    features, v_cells, v_points = sampled(window(16), torch.zeros(0, 3), SECOND, double=False)
    assert features.shape == (0, 32) and v_points.shape == (0, 3) and not v_cells.any()


def test_same_bits_on_one_thread_and_on_all() -> None:
    field, points = window(32), some_points(2000)
    alone = on_one_thread(lambda: sampled(field, points, 3 * SECOND, double=False))
    for got, want in zip(sampled(field, points, 3 * SECOND, double=False), alone, strict=True):
        assert torch.equal(got, want)
