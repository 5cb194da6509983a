"""Gaussians follow control nodes, rotation included, on the device; `model.skinning` states the formulas.

What belongs to one node or one Gaussian is torch, differentiated by autograd. Only the sum over the
Gaussians of a node is a kernel: torch would add atomically, in another order every time. Here a node's sum
has one writer, which goes through its Gaussians in order.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch
import triton
import triton.language as tl

from sags_node.engine.cuda.signatures import Compiled
from sags_node.model.cuda.nodes import NEIGHBOURS, Followers

if TYPE_CHECKING:
    from torch import Tensor

BLOCK = 64  # followers that a program takes at a time
COLUMNS = 32  # of a record, or the next power of 2
SHORTEST = 1e-12  # a shorter quaternion has no direction

# Rows [14] of Gaussians and of what nodes add to them: mean, log scale, quaternion, colour, opacity logit.
MEAN, LOG_SCALE, QUAT, REST = slice(0, 3), slice(3, 6), slice(6, 10), slice(10, 14)
# A node's record: three rows of [A | t - A n], and its row of deltas from the log scale on.
MOTION, OTHERS = 12, 12 - 3  # column c >= 3 of a row stands at c + OTHERS


def skin(rows: Tensor, nodes: Tensor, deltas: Tensor, followers: Followers) -> Tensor:
    """Deform Gaussians by their nodes: [N, 14], differentiable in `rows` and `deltas`; the same bits every
    time. Takes up to 1 kB of memory per Gaussian.

    Args:
        rows: [N, 14] canonical.
        nodes: [M, 3] m, canonical.
        deltas: [M, 14].
        followers: of these Gaussians and nodes.
    """
    middle = nodes.mean(dim=0)
    blends = _Blend.apply(_records(nodes - middle, deltas), followers)  # type: ignore[no-untyped-call]  # torch's own
    motion = blends[:, :MOTION].reshape(-1, 3, 4)
    moved = (motion[:, :, :3] * (rows[:, None, MEAN] - middle)).sum(dim=2) + motion[:, :, 3]
    turn = blends[:, QUAT.start + OTHERS : QUAT.stop + OTHERS] + _identity(blends)
    parts = [
        rows[:, MEAN] + moved,
        rows[:, LOG_SCALE] + blends[:, LOG_SCALE.start + OTHERS : LOG_SCALE.stop + OTHERS],
        _product(turn, rows[:, QUAT]),
        rows[:, REST] + blends[:, REST.start + OTHERS :],
    ]
    return torch.cat(parts, dim=1)


def _records(places: Tensor, deltas: Tensor) -> Tensor:
    """[M, 23] of nodes at places [M, 3] as seen from their middle."""
    turn = deltas[:, QUAT] + _identity(deltas)
    unit = turn / torch.linalg.vector_norm(turn, dim=1, keepdim=True).clamp(min=SHORTEST)
    A = _rotation(unit) - torch.eye(3, device=deltas.device)
    shift = deltas[:, MEAN] - (A * places[:, None]).sum(dim=2)
    return torch.cat([torch.cat([A, shift[:, :, None]], dim=2).flatten(1), deltas[:, MEAN.stop :]], dim=1)


def _identity(like: Tensor) -> Tensor:
    """[1, 4], made on the device."""
    return torch.eye(1, 4, device=like.device)


def _rotation(quats: Tensor) -> Tensor:
    """Matrices [M, 3, 3] of unit quaternions [M, 4] wxyz."""
    w, x, y, z = quats.unbind(dim=1)
    entries = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(entries, dim=1).reshape(-1, 3, 3)


def _product(a: Tensor, b: Tensor) -> Tensor:
    """Hamilton products [N, 4] of quaternions wxyz."""
    aw, ax, ay, az = a.unbind(dim=1)
    bw, bx, by, bz = b.unbind(dim=1)
    entries = [
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    ]
    return torch.stack(entries, dim=1)


class _Blend(torch.autograd.Function):
    """[N, C] of records [M, C]: those of each Gaussian's nodes, weighted and summed."""

    @staticmethod
    def forward(ctx: Any, records: Tensor, followers: Followers) -> Tensor:
        ctx.followers, ctx.nodes = followers, len(records)
        return (followers.weight[:, :, None] * records[followers.index.long()]).sum(dim=1)

    @staticmethod
    def backward(ctx: Any, *v_blends: Tensor) -> tuple[Tensor, None]:
        return _sum_followers(v_blends[0].contiguous(), ctx.followers, ctx.nodes), None


def _sum_followers(values: Tensor, followers: Followers, nodes: int) -> Tensor:
    """[M, C] sums over each node's Gaussians of their values [N, C], weighted as they follow it."""
    columns = values.shape[1]
    sums = values.new_empty((nodes, columns))
    _add_up[(nodes,)](
        values, followers.weight, followers.entries, followers.starts, sums, columns,
        BLOCK=BLOCK, COLUMNS=COLUMNS,
    )  # fmt: skip
    return sums


@triton.jit(do_not_specialize=("columns",))
def _add_up(
    values: tl.tensor,  # [N, C]
    weight: tl.tensor,  # [N, 4]
    entries: tl.tensor,  # [4 N]
    starts: tl.tensor,  # [M + 1]
    sums: tl.tensor,  # [M, C] written
    columns: tl.tensor,  # C
    BLOCK: tl.constexpr,
    COLUMNS: tl.constexpr,
) -> None:
    """One program is one node."""
    node = tl.program_id(0).to(tl.int64)
    column = tl.arange(0, COLUMNS)
    total = tl.zeros([BLOCK, COLUMNS], tl.float32)
    end = tl.load(starts + node + 1)
    for start in range(tl.load(starts + node), end, BLOCK):
        k = start + tl.arange(0, BLOCK)
        entry = tl.load(entries + k, k < end, other=0)
        w = tl.load(weight + entry, k < end, other=0.0)
        at = values + (entry // NEIGHBOURS)[:, None] * columns + column[None, :]
        total += w[:, None] * tl.load(at, (k < end)[:, None] & (column < columns)[None, :], other=0.0)
    tl.store(sums + node * columns + column, tl.sum(total, axis=0), column < columns)


SIGNATURES = (
    Compiled(
        _add_up,
        {
            **dict.fromkeys(("values", "weight"), "*fp32"),
            **dict.fromkeys(("entries", "starts"), "*i64"),
            "sums": "*fp32",
            "columns": "i32",
        },
        {"BLOCK": BLOCK, "COLUMNS": COLUMNS},
    ),
)
