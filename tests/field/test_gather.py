"""Sums of rows: the kernels against torch's own."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from engine_scenes import on_one_thread

from sags_node.field.gather import filled, gather


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


def test_same_bits_on_one_thread_and_on_all() -> None:
    arrays = inputs(2000, 23)
    alone = on_one_thread(lambda: run(*arrays))
    for found, wanted in zip(run(*arrays), alone, strict=True):
        assert torch.equal(found, wanted)


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
