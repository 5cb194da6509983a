"""Adam on rows of a torch table, as `engine.adam` describes it: by its kernel on the host, elsewhere by the
same formula in torch on all rows at once, without waiting for the device."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from sags_node.engine.adam import AdamState, adam_step
from sags_node.field import twins

BETAS = (0.9, 0.999)
EPS = 1e-15


@dataclass(frozen=True, slots=True)
class RowAdam:
    """The state of Adam for a table of M rows and C columns, as in `AdamState`."""

    moments: Tensor  # [M, C, 2]
    shares: Tensor  # [M, 2]

    @classmethod
    def of(cls, table: Tensor) -> RowAdam:
        """Make the state of a table [M, C] that was never touched, on its device."""
        return cls(table.new_zeros((*table.shape, 2)), table.new_zeros((len(table), 2)))

    def rows(self, rows: slice | Tensor) -> RowAdam:
        """The state of some rows; for a slice, it is the same memory."""
        return RowAdam(self.moments[rows], self.shares[rows])

    def grown(self, fresh: int) -> RowAdam:
        """The same state, with `fresh` rows appended that were never touched."""
        new = [
            torch.cat([each, each.new_zeros((fresh, *each.shape[1:]))])
            for each in (self.moments, self.shares)
        ]
        return RowAdam(*new)

    def step(self, values: Tensor, gradient: Tensor, rates: Tensor, taken: Tensor) -> None:
        """Move rows of a table against their gradient. A row that is not finite stays; its state is reset.

        Args:
            values: [M, C] changed in place.
            gradient: [M, C]
            rates: [C] learning rate of each column.
            taken: [M] True: this row takes the step.
        """
        values = values.detach()
        if twins.by_kernels(values):
            state = AdamState(self.moments.numpy(), self.shares.numpy())
            rows = np.flatnonzero(taken.numpy())
            adam_step(values.numpy(), gradient.numpy(), state, rates.numpy(), rows=rows, betas=BETAS, eps=EPS)
            return
        move_m, move_v = 1 - BETAS[0], 1 - BETAS[1]
        m, v = self.moments.unbind(2)
        sound = (gradient.square() + m.abs() + v.abs()).sum(1).isfinite()
        broken, taken = taken & ~sound, taken & sound
        self.moments.masked_fill_(broken[:, None, None], 0)
        self.shares.masked_fill_(broken[:, None], 0)
        moves = torch.where(taken, 1.0, 0.0).to(values.dtype)[:, None]
        gradient = torch.where(taken[:, None], gradient, 0)
        m += move_m * moves * (gradient - m)
        v += move_v * moves * (gradient * gradient - v)
        by_m, by_v = self.shares.unbind(1)
        by_m += move_m * moves[:, 0] * (1 - by_m)
        by_v += move_v * moves[:, 0] * (1 - by_v)
        step = (m / by_m[:, None]) / ((v / by_v[:, None]).sqrt() + EPS)
        values -= torch.where(taken[:, None], rates * step, 0)
