"""How the tissue moves: what every deformation must offer, and the one made of control nodes.

A deformation turns what was observed of some Gaussians into a motion of all of them, the hidden ones too.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numba import prange

from sags_node.engine.jit import kernel, parallel_kernel
from sags_node.model.gaussians import NEIGHBOURS, GaussianModel
from sags_node.types import F32, I32

_SMOOTHING_ROUNDS = 3  # how far, in nodes, motion spreads into hidden tissue per frame
_NEW_NODE_DISTANCE = 1.5  # in node spacings: farther new tissue gets nodes of its own


class Deformation(Protocol):
    """What the mapper asks of a deformation."""

    def attach(self, model: GaussianModel, rows: slice) -> None:
        """Let the Gaussians in `rows` follow this deformation."""

    def follow(self, model: GaussianModel, displacements: F32, seen: F32) -> None:
        """Move all Gaussians by what was observed.

        Args:
            model: its `means` are moved.
            displacements: [N, 3] m, observed where `seen`.
            seen: [N] weight of the observation, 0 = not seen.
        """

    def descend(self, model: GaussianModel, gradients: F32, contribution: F32, step: float) -> None:
        """Move all Gaussians down the loss.

        Args:
            model: its `means` are moved.
            gradients: [N, 3] of the loss by the means.
            contribution: [N] weight of each Gaussian in the picture, 0 = not seen.
            step: length of one step, m.
        """


class NodeDeformation:
    """Control nodes spread over the tissue; each Gaussian follows its nearest ones (embedded deformation:
    R. W. Sumner et al., SIGGRAPH 2007, translations only).

    Hundreds of nodes average thousands of noisy per-Gaussian motions, which is what keeps identity: a
    Gaussian stays on its piece of tissue.
    """

    def __init__(self, means: F32, count: int) -> None:
        """Place about `count` nodes over `means` [N, 3] m: the centres of occupied cells of a cubic grid."""
        self.spacing = _spacing_for(means, count)
        self._most = 4 * count  # beyond this, new tissue follows the nodes there are
        self.nodes = _cell_centres(means, self.spacing)  # [M, 3] m
        self._momentum = np.zeros_like(self.nodes)
        self._variance = np.zeros_like(self.nodes)
        self._neighbours = self._find_neighbours()

    def attach(self, model: GaussianModel, rows: slice) -> None:
        means = model.means[rows]
        if len(means) == 0:
            return
        index, weight, distance = nearest_nodes(means, self.nodes)
        far = distance > _NEW_NODE_DISTANCE * self.spacing
        if far.any() and len(self.nodes) < self._most:
            self._add_nodes(_cell_centres(means[far], self.spacing))
            index, weight, _ = nearest_nodes(means, self.nodes)
        model.node_index[rows] = index
        model.node_weight[rows] = weight

    def follow(self, model: GaussianModel, displacements: F32, seen: F32) -> None:
        motion, weight = _average(displacements, seen, model.node_index, model.node_weight, len(self.nodes))
        _spread(motion, weight, self._neighbours, _SMOOTHING_ROUNDS)
        self.nodes += motion
        _skin(motion, model.node_index, model.node_weight, model.means)

    def descend(self, model: GaussianModel, gradients: F32, contribution: F32, step: float) -> None:
        gradient, _ = _average(
            gradients,
            (contribution > 1e-3).astype(np.float32),
            model.node_index,
            model.node_weight,
            len(self.nodes),
        )
        self._momentum += 0.2 * (gradient - self._momentum)
        self._variance += 0.05 * (gradient * gradient - self._variance)
        damaged = ~np.isfinite(self._momentum + self._variance)
        self._momentum[damaged] = self._variance[damaged] = 0
        motion = (-step * self._momentum / (np.sqrt(self._variance) + 1e-12)).astype(np.float32)
        self.nodes += motion
        _skin(motion, model.node_index, model.node_weight, model.means)

    def _add_nodes(self, nodes: F32) -> None:
        zeros = np.zeros_like(nodes)
        self.nodes = np.concatenate([self.nodes, nodes])
        self._momentum = np.concatenate([self._momentum, zeros])
        self._variance = np.concatenate([self._variance, zeros])
        self._neighbours = self._find_neighbours()

    def _find_neighbours(self) -> I32:
        """[M, 6] nearest other nodes."""
        k = min(6, max(len(self.nodes) - 1, 1))
        return _nearest(self.nodes, self.nodes, k + 1)[0][:, 1:]


def spread_nodes(means: F32, count: int) -> F32:
    """About `count` places [M, 3] m spread evenly over points [N, 3] m."""
    return _cell_centres(means, _spacing_for(means, count))


def _spacing_for(means: F32, count: int) -> float:
    """Cell size that gives about `count` occupied cells (bisection: the surface may have any shape)."""
    low, high = 1e-5, float(np.ptp(means, axis=0).max()) + 1e-5
    for _ in range(20):
        middle = (low * high) ** 0.5
        occupied = len(np.unique(np.floor(means / middle).astype(np.int64), axis=0))
        low, high = (middle, high) if occupied > count else (low, middle)
    return high


def _cell_centres(means: F32, cell: float) -> F32:
    """Mean of the points in each occupied cell of a cubic grid, [M, 3]."""
    _, inverse, counts = np.unique(
        np.floor(means / cell).astype(np.int64), axis=0, return_inverse=True, return_counts=True
    )
    sums = np.stack([np.bincount(inverse.ravel(), means[:, k]) for k in range(3)], 1)
    return (sums / counts[:, None]).astype(np.float32)


def nearest_nodes(points: F32, nodes: F32) -> tuple[I32, F32, F32]:
    """Indices [N, 4], skinning weights [N, 4] and distance [N] of the nearest nodes.

    The weights fall off as a Gaussian whose width is the mean distance, so they are smooth and scale-free.
    """
    index, squared = _nearest(points, nodes, NEIGHBOURS)
    weight = np.zeros_like(squared)
    found = min(NEIGHBOURS, len(nodes))
    near = squared[:, :found]
    width = np.float32(1e-12) + np.float32(1.2) * near.mean(1, keepdims=True)
    weight[:, :found] = np.exp((near[:, :1] - near) / width)
    weight /= weight.sum(1, keepdims=True)
    return index, weight, np.sqrt(squared[:, 0])


@parallel_kernel
def _nearest(points: F32, nodes: F32, count: int) -> tuple[I32, F32]:
    """Indices [N, count] of the nearest nodes, nearest first, and squared distances; where there are fewer
    nodes, 0 and infinity."""
    index = np.zeros((len(points), count), np.int32)
    squared = np.full((len(points), count), np.float32(np.inf))
    for i in prange(len(points)):
        _nearest_of(points[i], nodes, index[i], squared[i])
    return index, squared


@kernel
def _nearest_of(point: F32, nodes: F32, index: I32, squared: F32) -> None:
    last = len(index) - 1
    for j in range(len(nodes)):
        d = np.float32(0)
        for k in range(3):
            e = point[k] - nodes[j, k]
            d += e * e
        if d < squared[last]:
            slot = last
            while slot > 0 and squared[slot - 1] > d:
                squared[slot] = squared[slot - 1]
                index[slot] = index[slot - 1]
                slot -= 1
            squared[slot] = d
            index[slot] = j


@kernel
def _average(values: F32, seen: F32, index: I32, weight: F32, nodes: int) -> tuple[F32, F32]:
    """Weighted mean [M, 3] of per-Gaussian values at each node, and the weight [M] behind it.

    Serial on purpose: a third of a millisecond, and the same bits for any number of threads.
    """
    total = np.zeros((nodes, 3), np.float32)
    mass = np.zeros(nodes, np.float32)
    for i in range(len(values)):
        if seen[i] > 0:
            for k in range(NEIGHBOURS):
                w = weight[i, k] * seen[i]
                if not (w >= 0 and w <= 1):
                    continue  # damaged: it is removed with what it moves to
                j = index[i, k]
                mass[j] += w
                for a in range(3):
                    total[j, a] += w * values[i, a]
    for j in range(nodes):
        for a in range(3):
            total[j, a] = total[j, a] / mass[j] if mass[j] > 0.5 else np.float32(0)
    return total, mass


@kernel
def _spread(motion: F32, mass: F32, neighbours: I32, rounds: int) -> None:
    """Nodes that nothing was seen of take the mean motion of the neighbours that have one."""
    known = mass > 0.5
    for _ in range(rounds):
        reached = known.copy()
        for j in range(len(motion)):
            if known[j]:
                continue
            n = 0
            for k in range(neighbours.shape[1]):
                i = neighbours[j, k]
                if known[i]:
                    n += 1
                    for a in range(3):
                        motion[j, a] += motion[i, a]
            if n > 0:
                for a in range(3):
                    motion[j, a] /= n
                reached[j] = True
        known = reached


@parallel_kernel
def _skin(motion: F32, index: I32, weight: F32, means: F32) -> None:
    """Move each Gaussian by the weighted motion of its nodes."""
    for i in prange(len(means)):
        for a in range(3):
            s = np.float32(0)
            for k in range(NEIGHBOURS):
                s += weight[i, k] * motion[index[i, k], a]
            means[i, a] += s
