"""The deformation field: HexPlane and decoder, evaluated at Gaussians or at control nodes.

    G(t) = G + D(f(x, y, z, t))         SAGS: mean, scale, rotation, colour and opacity of G

`PointField`: it is evaluated at the canonical mean of every Gaussian, as in the paper. `NodeField`: at a few
hundred nodes, which Gaussians follow, rotation included (embedded deformation: Sumner et al., SIGGRAPH 2007).
With nodes n_k, their weights w_k, and the decoder's shift t_k and rotation dq_k of each, a Gaussian becomes

    x' = x + sum_k w_k (A_k (x - n_k) + t_k)        A_k = R_k - 1, R_k of the unit quaternion of 1 + dq_k
    q' = (1 + sum_k w_k dq_k) q
    everything else: + sum_k w_k delta_k

All sums are linear in a node's record: [A_k | t_k - A_k n_k] and its other deltas, which that node alone
determines. So a Gaussian blends the records of its nodes. Places are measured from the middle of the nodes:
far from it A_k x and A_k n_k would cancel in many digits.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import normalize

from sags_node.field.decoder import Decoder
from sags_node.field.gather import gather
from sags_node.field.hexplane import HexPlane
from sags_node.model import columns
from sags_node.model.deformation import nearest_nodes
from sags_node.types import F32

# What an output of 1 of the decoder means: small against a scene for a mean, of order one for the rest. A
# step of Adam has a fixed length in units of the outputs, so this sets how fast each kind of delta is learnt.
DELTA_UNITS = np.ones(columns.COUNT, np.float32)
DELTA_UNITS[columns.MEAN] = 0.01  # m

SHORTEST = 1e-12  # a shorter quaternion has no direction


@dataclass(frozen=True, slots=True)
class FieldRates:
    """Learning rates of Adam."""

    cells: float = 1.6e-2  # of the planes in space; as in EndoGaussian and SAGS
    decoder: float = 1.6e-3
    lines: float = 1.6e-2  # of the lines in time

    def scaled(self, factor: float) -> FieldRates:
        return FieldRates(factor * self.cells, factor * self.decoder, factor * self.lines)


class Deltas:
    """HexPlane and decoder, one after the other, with their optimisers."""

    def __init__(self, hexplane: HexPlane, decoder: Decoder, units: F32 = DELTA_UNITS) -> None:
        """
        Args:
            hexplane: gives features.
            decoder: turns them into deltas.
            units: [14] what an output of 1 means; 0: that parameter is not deformed.
        """
        self.hexplane, self.decoder = hexplane, decoder.to(hexplane.cells.device)
        self.optimizer = torch.optim.Adam(decoder.parameters(), lr=0.0, eps=1e-15, fused=True)
        self._units = torch.from_numpy(units).to(hexplane.cells.device)

    def __call__(self, points: Tensor, t_ns: int) -> Tensor:
        """Deltas [N, 14] of raw parameters (`model.columns`) of points [N, 3] m."""
        deltas: Tensor = self.decoder(self.hexplane.sample(points, t_ns)) * self._units
        return deltas

    def step(self, rates: FieldRates) -> None:
        """Move cells and decoder against their gradients, and clear these. If a gradient of the decoder is
        not finite, the decoder stays as it is."""
        found = [each.grad.ravel() for each in self.decoder.parameters() if each.grad is not None]
        if found:
            # If this is 1, torch's fused Adam changes nothing; the host need not wait for the value
            self.optimizer.found_inf = (~torch.cat(found).isfinite().all()).float()  # type: ignore[attr-defined]
            self.optimizer.param_groups[0]["lr"] = rates.decoder
            self.optimizer.step()
        self.optimizer.zero_grad()
        self.hexplane.step(rates.cells, rates.lines)


class Field(Protocol):
    """Deforms canonical Gaussians."""

    deltas: Deltas

    def deform(self, rows: Tensor, t_ns: int, which: Tensor | None = None) -> Tensor:
        """Deform canonical rows [N, 14] to one time, differentiable in the rows and in the field. `which`
        [N]: their indices among the means given to `follow`; None: they are all of them."""

    def follow(self, means: F32) -> None:
        """Take the canonical means [N, 3] m as they are now."""


class PointField:
    """The field, evaluated at every Gaussian's own canonical mean."""

    def __init__(self, deltas: Deltas) -> None:
        self.deltas = deltas

    def deform(self, rows: Tensor, t_ns: int, which: Tensor | None = None) -> Tensor:
        return rows + self.deltas(rows[:, columns.MEAN], t_ns)

    def follow(self, means: F32) -> None:
        """Do nothing: the field is evaluated at the rows themselves."""


class NodeField:
    """The field, evaluated at control nodes; each Gaussian follows its four nearest ones."""

    def __init__(self, deltas: Deltas, nodes: F32) -> None:
        """`nodes` [M, 3] m are fixed places among the canonical Gaussians."""
        self.deltas, self.nodes = deltas, np.ascontiguousarray(nodes)
        self._device = deltas.hexplane.cells.device
        self._asked = torch.from_numpy(self.nodes).to(self._device)
        self.follow(self.nodes)

    def follow(self, means: F32) -> None:
        index, weight, _ = nearest_nodes(np.ascontiguousarray(means), self.nodes)
        self.attach(torch.from_numpy(index.astype(np.int64)), torch.from_numpy(weight))

    def attach(self, index: Tensor, weight: Tensor) -> None:
        """Set which nodes each Gaussian follows, [N, K], and their weights."""
        self.index, self.weight = index.to(self._device), weight.to(self._device)

    def deform(self, rows: Tensor, t_ns: int, which: Tensor | None = None) -> Tensor:
        nodes, index, weight = self._asked, self.index, self.weight
        if which is not None:
            index, weight = index[which], weight[which]
        return skin(rows, nodes, self.deltas(nodes, t_ns), index, weight)


def skin(rows: Tensor, nodes: Tensor, deltas: Tensor, index: Tensor, weight: Tensor) -> Tensor:
    """Deform Gaussians by their nodes.

    Args:
        rows: [N, 14] canonical.
        nodes: [M, 3] m, canonical.
        deltas: [M, 14].
        index, weight: [N, K] the nodes of each Gaussian; weights sum to 1.
    """
    middle = nodes.mean(0)
    unturned = torch.eye(1, 4, dtype=deltas.dtype, device=deltas.device)[0]
    A = turns(unturned + deltas[:, columns.QUAT])
    shift = deltas[:, columns.MEAN] - (A @ (nodes - middle)[:, :, None])[:, :, 0]
    records = torch.cat([A.flatten(1), shift, deltas[:, columns.LOG_SCALE.start :]], 1)
    blend = gather(records, index, weight)
    A, shift, change = blend[:, :9].view(-1, 3, 3), blend[:, 9:12], blend[:, 9:]
    mean, quat = rows[:, columns.MEAN], rows[:, columns.QUAT]
    moved = mean + (A * (mean - middle)[:, None]).sum(2) + shift
    turned = product(unturned + change[:, columns.QUAT], quat)
    scale, rest = columns.LOG_SCALE, slice(columns.QUAT.stop, None)
    return torch.cat([moved, rows[:, scale] + change[:, scale], turned, rows[:, rest] + change[:, rest]], 1)


def product(a: Tensor, b: Tensor) -> Tensor:
    """Hamilton products a b of quaternions [N, 4], wxyz: first b, then a."""
    aw, av, bw, bv = a[:, :1], a[:, 1:], b[:, :1], b[:, 1:]
    w = aw * bw - (av * bv).sum(1, keepdim=True)
    return torch.cat([w, aw * bv + bw * av + torch.linalg.cross(av, bv)], 1)


def conjugate(q: Tensor) -> Tensor:
    """The inverse of unit quaternions."""
    return q * q.new_tensor([1, -1, -1, -1])


def unit(q: Tensor) -> Tensor:
    return normalize(q, dim=1, eps=SHORTEST)


def turns(quats: Tensor) -> Tensor:
    """R - 1 of the rotations R [N, 3, 3] of quaternions of any length: 2 (w K + K K), K v = (x, y, z) x v."""
    w, x, y, z = unit(quats).unbind(1)
    zero = torch.zeros_like(w)
    K = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], 1).view(-1, 3, 3)
    return 2 * (w[:, None, None] * K + K @ K)
