"""The SAGS deformation field (arXiv 2510.27318): a HexPlane gives every place and time its features, a
self-adaptive decoder turns them into deltas of the Gaussians.

Two ways to ask it. `PointField`: every Gaussian samples it at its own canonical mean, as the paper does.
`NodeField`: a few hundred control nodes sample it, and the Gaussians follow the nodes (`skinning`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, Protocol

import numpy as np

from sags_node.engine.adam import AdamState, adam_step
from sags_node.engine.field.hexplane import FieldGradients
from sags_node.model import columns
from sags_node.model.decoder import Decoder
from sags_node.model.deformation import nearest_nodes
from sags_node.model.hexplane import HexPlaneField
from sags_node.model.skinning import skin, skin_backward
from sags_node.types import F32, I64

# What an output of 1 of the decoder means: small against a scene for a mean, of order one for the rest. A
# step of Adam has a fixed length in units of the outputs, so this sets how fast each kind of delta is learnt.
DELTA_UNITS = np.ones(columns.COUNT, np.float32)
DELTA_UNITS[columns.MEAN] = 0.01  # m

# What stands between the decoder's first layer and its heads. `adaptive`: the block of SAGS. `mlp`: only its
# linear layers learn, an MLP of its size with residual connections: the gates stay 1, the adaptations hand
# on. `none`: nothing is learnt there, as in EndoGaussian.
Block = Literal["adaptive", "mlp", "none"]
BLOCK = ("pre_", "attention_", "post_", "mlp_")  # names of the block's parameters begin so
ADAPTATION = ("_scale", "_shift", "_gate")  # of those, names of what adapts end so


def is_still(parameter: str, block: Block) -> bool:
    """Whether a parameter of the decoder is not learnt."""
    in_block = parameter.startswith(BLOCK)
    return in_block and (block == "none" or (block == "mlp" and parameter.endswith(ADAPTATION)))


@dataclass(frozen=True, slots=True)
class FieldRates:
    """Learning rates of Adam."""

    cells: float = 1.6e-2  # EndoGaussian and SAGS
    decoder: float = 1.6e-3

    def scaled(self, factor: float) -> FieldRates:
        return FieldRates(factor * self.cells, factor * self.decoder)


class Field(Protocol):
    """Deforms canonical Gaussians, and learns to."""

    deltas: Deltas

    def deform(self, rows: F32, t_ns: int) -> F32:
        """Canonical rows [N, 14] of `columns` at one time, in a fresh array."""

    def backward(self, v_deformed: F32) -> F32:
        """Gradient [N, 14] by the canonical rows of the last `deform`, which must be unchanged."""

    def step(self, rates: FieldRates) -> None:
        """Move the field's own parameters against the gradients of the last `backward`."""

    def follow(self, means: F32) -> None:
        """The canonical means [N, 3] m are others now."""


class Deltas:
    """HexPlane and decoder, one after the other: deltas of points at one time."""

    def __init__(
        self, hexplane: HexPlaneField, decoder: Decoder, block: Block = "adaptive", units: F32 = DELTA_UNITS
    ) -> None:
        """
        Args:
            hexplane: gives features.
            decoder: turns them into deltas.
            block: which of its parameters are learnt.
            units: [14] what an output of 1 means; 0: that parameter is not deformed.
        """
        self.hexplane = hexplane
        self.decoder = decoder
        self.units = units
        self.still = tuple(name for name in decoder.parameters if is_still(name, block))
        self._aside: tuple[I64, F32, F32] | None = None
        self.adam = AdamState.new(1, len(decoder.values))

    def forward(self, points: F32, t_ns: int) -> F32:
        """[N, 14] of points [N, 3] m, a fresh array."""
        return self.decoder.forward(self.hexplane.sample(points, t_ns)) * self.units

    def backward(self, v_deltas: F32) -> F32:
        """Gradient by the points, [N, 3]."""
        self._found = self.hexplane.backward(self.decoder.backward(v_deltas * self.units))
        return self._found.v_points

    def set_aside(self) -> None:
        """Keep the gradients by the parameters that the last `backward` found; `step` adds them to those of
        the next one."""
        rows = self._found.rows.copy()
        self._aside = rows, self._found.v_cells[rows], self.decoder.gradients.copy()

    def found(self) -> FieldGradients:
        """By the cells, of the last `backward` and what was set aside; `decoder.gradients` are the others."""
        if self._aside is not None:
            self._add(*self._aside)
            self._aside = None
        return self._found

    def step(self, rates: FieldRates) -> None:
        decoder, hexplane, found = self.decoder, self.hexplane, self.found()
        for name in self.still:
            decoder.parameter_gradients[name][:] = 0
        adam_step(
            decoder.values[None], decoder.gradients[None], self.adam,
            np.full(len(decoder.values), rates.decoder, np.float32),
        )  # fmt: skip
        cell_rates = np.full(hexplane.grid.channels, rates.cells, np.float32)
        adam_step(hexplane.cells, found.v_cells, hexplane.adam, cell_rates, rows=found.rows)

    def _add(self, rows: I64, v_cells: F32, v_decoder: F32) -> None:
        """Add gradients of cells [K, C] in `rows` [K] and of the decoder [P] to those found."""
        found = self._found
        found.v_cells[np.setdiff1d(rows, found.rows, assume_unique=True)] = 0
        found.v_cells[rows] += v_cells
        self._found = replace(found, rows=np.union1d(rows, found.rows))
        self.decoder.gradients += v_decoder


class PointField:
    """Every Gaussian asks the field at its own canonical mean."""

    def __init__(self, deltas: Deltas) -> None:
        self.deltas = deltas

    def deform(self, rows: F32, t_ns: int) -> F32:
        deformed: F32 = rows + self.deltas.forward(np.ascontiguousarray(rows[:, columns.MEAN]), t_ns)
        return deformed

    def backward(self, v_deformed: F32) -> F32:
        v_rows = v_deformed.copy()
        v_rows[:, columns.MEAN] += self.deltas.backward(v_deformed)
        return v_rows

    def step(self, rates: FieldRates) -> None:
        self.deltas.step(rates)

    def follow(self, means: F32) -> None:
        """Nothing to do: every Gaussian asks for itself."""


class NodeField:
    """Control nodes ask the field; each Gaussian follows its nearest ones. `follow` says who follows whom."""

    def __init__(self, deltas: Deltas, nodes: F32) -> None:
        """Nodes [M, 3] m are places among the canonical Gaussians; they stay where they are."""
        self.deltas = deltas
        self.nodes = np.ascontiguousarray(nodes)
        self.follow(self.nodes)

    def follow(self, means: F32) -> None:
        """Let Gaussians with these canonical means [N, 3] m follow their nearest nodes: those that
        `deform` is then given."""
        self.index, self.weight, _ = nearest_nodes(np.ascontiguousarray(means), self.nodes)

    def deform(self, rows: F32, t_ns: int) -> F32:
        self._rows, self._found = rows, self.deltas.forward(self.nodes, t_ns)
        deformed = np.empty_like(rows)
        skin(rows, self.nodes, self._found, self.index, self.weight, deformed)
        return deformed

    def backward(self, v_deformed: F32) -> F32:
        v_rows, v_deltas = skin_backward(
            self._rows, self.nodes, self._found, self.index, self.weight, v_deformed
        )
        self.deltas.backward(v_deltas)
        return v_rows

    def step(self, rates: FieldRates) -> None:
        self.deltas.step(rates)
