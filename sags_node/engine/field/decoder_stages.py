"""The decoder's work cut into pieces for many workers.

Points that do not see each other are decoded block by block, from features to deltas at once. Nodes attend to
all nodes, so a stage begins when every block has finished the one before.

There is one parallel kernel for all of it, because each parallel kernel compiles anew what it calls.
"""

from __future__ import annotations

from typing import Any

import numba
import numpy as np

from sags_node.engine.field import decoder_nodes
from sags_node.engine.field.decoder_block import (
    Weights,
    Workspace,
    attend,
    attend_backward,
    embed,
    embed_backward,
    finish,
    finish_backward,
)
from sags_node.engine.field.decoder_nodes import Nodes
from sags_node.engine.field.dense import store_points
from sags_node.kernels.jit import kernel, parallel_kernel, take
from sags_node.types import F32, I64

# Points: one piece is a block forward, or a group of blocks backward.
DECODE, DECODE_BACKWARD = 0, 1
# Nodes: one piece is a block, or the queries of one block and one head in ATTEND and ATTEND_BACKWARD.
EMBED, ATTEND, FINISH, FINISH_BACKWARD, ATTEND_BACKWARD, EMBED_BACKWARD = 2, 3, 4, 5, 6, 7


@kernel
def _decode(
    backward: bool,
    item: int,
    slot: int,
    features: F32,
    v_deltas: F32,
    weights: Weights,
    head_rows: I64,
    heads: int,
    work: Workspace,
    gradients: Weights,
    deltas: F32,
    v_features: F32,
) -> None:
    """One block of points forward, or one group of blocks forward and backward."""
    groups, block_size = len(gradients.vectors), work.row.shape[1]
    blocks = (len(features) + block_size - 1) // block_size
    start, stop = item, item + 1
    if backward:
        start, stop = item * blocks // groups, (item + 1) * blocks // groups
    for first in range(start * block_size, stop * block_size, block_size):
        embed(first, slot, features, weights, heads, work)
        attend(slot, heads, work)
        finish(slot, weights, head_rows, work)
        if backward:
            finish_backward(first, slot, item, v_deltas, weights, head_rows, work, gradients)
            attend_backward(slot, heads, work)
            embed_backward(slot, item, weights, heads, work, gradients)
            store_points(work.v_features[slot], first, v_features)
        else:
            store_points(work.deltas[slot], first, deltas)


@kernel
def _decode_nodes(
    stage: int,
    item: int,
    worker: int,
    features: F32,
    v_deltas: F32,
    weights: Weights,
    head_rows: I64,
    heads: int,
    work: Workspace,
    nodes: Nodes,
    gradients: Weights,
    deltas: F32,
    v_features: F32,
) -> None:
    """One piece of a stage of nodes."""
    first = item * work.row.shape[1]
    if stage == EMBED:
        embed(first, item, features, weights, heads, work)
        decoder_nodes.share(item, work, nodes)
    elif stage == FINISH:
        finish(item, weights, head_rows, work)
        store_points(work.deltas[item], first, deltas)
    elif stage == FINISH_BACKWARD:
        finish_backward(first, item, item, v_deltas, weights, head_rows, work, gradients)
    elif stage == EMBED_BACKWARD:
        decoder_nodes.share_backward(item, work, nodes)
        embed_backward(item, item, weights, heads, work, gradients)
        store_points(work.v_features[item], first, v_features)
    else:
        backward, block, head = stage == ATTEND_BACKWARD, item // heads, item % heads
        decoder_nodes.attend(backward, block, head, work, nodes, nodes.scratch[worker])


@kernel
def _serve(
    stage: int,
    items: int,
    next_item: I64,
    worker: Any,
    features: F32,
    v_deltas: F32,
    weights: Weights,
    head_rows: I64,
    heads: int,
    work: Workspace,
    nodes: Nodes,
    gradients: Weights,
    deltas: F32,
    v_features: F32,
) -> None:
    """Take pieces until none are left."""
    item = take(next_item, 1)
    while item < items:
        if stage <= DECODE_BACKWARD:
            backward = stage == DECODE_BACKWARD
            _decode(
                backward, item, worker, features, v_deltas, weights, head_rows, heads, work, gradients,
                deltas, v_features,
            )  # fmt: skip
        else:
            _decode_nodes(
                stage, item, worker, features, v_deltas, weights, head_rows, heads, work, nodes, gradients,
                deltas, v_features,
            )  # fmt: skip
        item = take(next_item, 1)


@parallel_kernel
def run(
    stage: int,
    items: int,
    next_item: I64,
    workers: int,
    features: F32,
    v_deltas: F32,
    weights: Weights,
    head_rows: I64,
    heads: int,
    work: Workspace,
    nodes: Nodes,
    gradients: Weights,
    deltas: F32,
    v_features: F32,
) -> None:
    """Do all pieces of one stage.

    Args:
        stage: one of the constants above.
        items: how many pieces it has.
        next_item: [1], 0; counts them.
        workers: how many threads may take pieces.
        features: [N, T C].
        v_deltas: [N, D] cotangent of the deltas, read backward.
        weights: of the decoder.
        head_rows: [H + 1] where the deltas of each head begin, and D.
        heads: of the attention; 0 for points without it.
        work: one slot for each worker (points) or block (nodes).
        nodes: what nodes share.
        gradients: added to, one group for each backward piece.
        deltas: [N, D] written forward.
        v_features: [N, T C] written backward.
    """
    for w in numba.prange(workers):
        worker = np.int64(w)  # as everywhere else: for an unsigned index all would be compiled again
        _serve(
            stage, items, next_item, worker, features, v_deltas, weights, head_rows, heads, work, nodes,
            gradients, deltas, v_features,
        )  # fmt: skip
