"""Control nodes on the device: each averages what its Gaussians want, steps, and takes them along.

The node step of `model.deformation.NodeDeformation`. A node's sum has one writer, which goes through the
node's Gaussians in a fixed order: the same bits every time. Atomic additions would need no list of those
Gaussians, but hundreds of them meet on each node, in another order every time. The list (`Followers`) is made
when Gaussians are added or removed, once per frame, and serves all steps.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
import triton
import triton.language as tl

from sags_node.engine.cuda.signatures import Compiled

if TYPE_CHECKING:
    from torch import Tensor

BLOCK = 128  # followers that a program takes at a time, or Gaussians of a program
NEIGHBOURS = tl.constexpr(4)  # nodes that a Gaussian follows
LEAST_MASS = tl.constexpr(0.5)  # Gaussians: from fewer a node learns nothing
INERTIA, CALM = tl.constexpr(0.2), tl.constexpr(0.05)  # how fast momentum and variance follow the gradient
STEEPEST = tl.constexpr(2.0)  # see `NodeDeformation`
EPS = tl.constexpr(1e-12)
INFINITY = tl.constexpr(float("inf"))


@dataclass(frozen=True, slots=True)
class Followers:
    """Who follows whom, N Gaussians and M nodes, in both directions."""

    index: Tensor  # [N, 4] int32 nodes of each Gaussian
    weight: Tensor  # [N, 4] float32, summing to 1
    entries: Tensor  # [4 N] int64 places in `index`, node by node, in the order of the Gaussians
    starts: Tensor  # [M + 1] int64 where each node's entries begin

    @classmethod
    def of(cls, index: Tensor, weight: Tensor, nodes: int) -> Followers:
        """From the nodes [N, 4] int32 of each Gaussian and their weights [N, 4], both contiguous."""
        ordered, entries = torch.sort(index.flatten(), stable=True)
        wanted = torch.arange(nodes + 1, dtype=index.dtype, device=index.device)
        return cls(index, weight, entries, torch.searchsorted(ordered, wanted))


@dataclass(frozen=True, slots=True)
class Nodes:
    """M control nodes and what their optimiser remembers; float32, on one device."""

    places: Tensor  # [M, 3] m
    momentum: Tensor  # [M, 3]
    variance: Tensor  # [M, 3]

    @classmethod
    def at(cls, places: Tensor) -> Nodes:
        return cls(places, torch.zeros_like(places), torch.zeros_like(places))


@triton.jit
def _descend(
    gradients: tl.tensor,  # [N, 3]
    contribution: tl.tensor,  # [N]
    weight: tl.tensor,  # [N, 4]
    entries: tl.tensor,  # [4 N]
    starts: tl.tensor,  # [M + 1]
    places: tl.tensor,  # [M, 3] changed
    momentum: tl.tensor,  # [M, 3] changed
    variance: tl.tensor,  # [M, 3] changed
    motion: tl.tensor,  # [M, 3] written
    least_contribution: tl.tensor,
    step: tl.tensor,
    BLOCK: tl.constexpr,
) -> None:
    """One program is one node."""
    node = tl.program_id(0)
    axis = tl.arange(0, 4)
    first, end = tl.load(starts + node), tl.load(starts + node + 1)
    masses, totals = tl.zeros([BLOCK], tl.float32), tl.zeros([BLOCK, 4], tl.float32)
    for start in range(first, end, BLOCK):
        k = start + tl.arange(0, BLOCK)
        ok = k < end
        entry = tl.load(entries + k, ok, other=0)
        gaussian = entry // NEIGHBOURS
        w = tl.load(weight + entry, ok, other=0.0)
        seen = tl.load(contribution + gaussian, ok, other=0.0) > least_contribution
        w = tl.where(seen & (w >= 0.0) & (w <= 1.0), w, 0.0)  # damaged ones are removed with what they move
        counts = (w > 0.0)[:, None] & (axis < 3)[None, :]
        at = gradients + 3 * gaussian[:, None] + axis[None, :]
        masses += w
        totals += w[:, None] * tl.load(at, counts, other=0.0)
    mass = tl.sum(masses)
    gradient = tl.where(mass > LEAST_MASS, tl.sum(totals, axis=0) / mass, 0.0)
    at, ok = 3 * node + axis, axis < 3
    m, v = tl.load(momentum + at, ok, other=0.0), tl.load(variance + at, ok, other=0.0)
    m += INERTIA * (gradient - m)
    v += CALM * (gradient * gradient - v)
    size = tl.sqrt_rn(v)
    sound = (tl.abs(m) <= STEEPEST * size) & (size < INFINITY)
    m, v, size = tl.where(sound, m, 0.0), tl.where(sound, v, 0.0), tl.where(sound, size, 0.0)
    moved = -step * m / (size + EPS)
    tl.store(momentum + at, m, ok)
    tl.store(variance + at, v, ok)
    tl.store(motion + at, moved, ok)
    tl.store(places + at, tl.load(places + at, ok, other=0.0) + moved, ok)


@triton.jit(do_not_specialize=("count",))
def _skin(
    motion: tl.tensor,  # [M, 3]
    index: tl.tensor,  # [N, 4]
    weight: tl.tensor,  # [N, 4]
    means: tl.tensor,  # [N, 3] changed
    count: tl.tensor,
    BLOCK: tl.constexpr,
) -> None:
    gaussian = (tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)).to(tl.int64)
    axis = tl.arange(0, 4)[None, :]
    ok = (gaussian < count)[:, None] & (axis < 3)
    moved = tl.zeros([BLOCK, 4], tl.float32)
    for k in tl.static_range(NEIGHBOURS):
        node = tl.load(index + NEIGHBOURS * gaussian + k, gaussian < count, other=0)
        w = tl.load(weight + NEIGHBOURS * gaussian + k, gaussian < count, other=0.0)
        moved += w[:, None] * tl.load(motion + 3 * node[:, None] + axis, ok, other=0.0)
    at = means + 3 * gaussian[:, None] + axis
    tl.store(at, tl.load(at, ok, other=0.0) + moved, ok)


def skin(motion: Tensor, followers: Followers, means: Tensor) -> None:
    """Move each Gaussian, `means` [N, 3] m, by the weighted motion [M, 3] m of its nodes."""
    count = len(means)
    if count > 0:
        _skin[(triton.cdiv(count, BLOCK),)](
            motion, followers.index, followers.weight, means, count, BLOCK=BLOCK
        )


def descend(
    nodes: Nodes,
    followers: Followers,
    gradients: Tensor,
    contribution: Tensor,
    means: Tensor,
    *,
    step: float,
    least_contribution: float,
) -> None:
    """Move nodes and Gaussians down the loss; the same bits every time. Nothing is read back to the host.

    Args:
        nodes: changed.
        followers: of these nodes and Gaussians, as they are now.
        gradients: [N, 3] of the loss by the means.
        contribution: [N] weight of each Gaussian in the picture.
        means: [N, 3] m, moved.
        step: length of one step, m.
        least_contribution: a Gaussian that contributes less was not seen.
    """
    motion = torch.empty_like(nodes.places)
    if len(motion) == 0:
        return
    _descend[(len(motion),)](
        gradients, contribution, followers.weight, followers.entries, followers.starts,
        nodes.places, nodes.momentum, nodes.variance, motion, least_contribution, step, BLOCK=BLOCK,
    )  # fmt: skip
    skin(motion, followers, means)


SIGNATURES = (
    Compiled(
        _descend,
        {
            **dict.fromkeys(("gradients", "contribution", "weight"), "*fp32"),
            **dict.fromkeys(("entries", "starts"), "*i64"),
            **dict.fromkeys(("places", "momentum", "variance", "motion"), "*fp32"),
            **dict.fromkeys(("least_contribution", "step"), "fp32"),
        },
        {"BLOCK": BLOCK},
    ),
    Compiled(
        _skin,
        {"motion": "*fp32", "index": "*i32", "weight": "*fp32", "means": "*fp32", "count": "i32"},
        {"BLOCK": BLOCK},
    ),
)
