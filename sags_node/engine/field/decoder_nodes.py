"""The attention of control nodes: every node attends to all of them.

Between `embed` and `finish` of `decoder_block`, with one token per node. A piece of work is one head and the
queries of one block of 128 nodes; keys and values of all nodes are shared.
"""

from __future__ import annotations

from typing import NamedTuple

from sags_node.engine.field.attention import attend_nodes, attend_nodes_backward
from sags_node.engine.field.decoder_block import (
    ATTENDED,
    KEY,
    QUERY,
    V_ATTENDED,
    V_KEY,
    V_QUERY,
    V_VALUE,
    VALUE,
    Workspace,
)
from sags_node.engine.field.dense import load_points, store_points
from sags_node.kernels.jit import kernel
from sags_node.types import F32


class Nodes(NamedTuple):
    """What M nodes share; empty for points."""

    keys: F32  # [heads, M, w / heads]
    values: F32  # [heads, M, w / heads]
    v_keys: F32  # [blocks, heads, M, w / heads], from the queries of each block
    v_values: F32  # [blocks, heads, M, w / heads]
    scratch: F32  # [workers, 2 M + 1, 128] shares of the nodes in each query, their gradient, and a row


@kernel
def share(block: int, work: Workspace, nodes: Nodes) -> None:
    """Put keys and values of a block where the queries of all blocks find them."""
    heads, _, size = nodes.keys.shape
    token, first = work.tokens[block, 0], block * work.row.shape[1]
    for head in range(heads):
        start, stop = head * size, (head + 1) * size
        store_points(token[KEY, start:stop], first, nodes.keys[head])
        store_points(token[VALUE, start:stop], first, nodes.values[head])


@kernel
def attend(backward: bool, block: int, head: int, work: Workspace, nodes: Nodes, scratch: F32) -> None:
    """The queries of one block and one head attend to all nodes; if asked for, the gradient of that too.

    The gradient of the queries goes to `work`, those of keys and values to this block's part of `nodes`.
    """
    token, (_, count, size) = work.tokens[block, 0], nodes.keys.shape
    start, stop = head * size, (head + 1) * size
    queries, keys, values = token[QUERY, start:stop], nodes.keys[head], nodes.values[head]
    shares, v_shares, row = scratch[:count], scratch[count : 2 * count], scratch[2 * count]
    attend_nodes(queries, keys, values, shares, token[ATTENDED, start:stop], row)
    if backward:
        v_attended, v_queries = token[V_ATTENDED, start:stop], token[V_QUERY, start:stop]
        v_keys, v_values = nodes.v_keys[block, head], nodes.v_values[block, head]
        attend_nodes_backward(
            queries, keys, values, shares, v_attended, v_shares, v_queries, v_keys, v_values, row
        )


@kernel
def share_backward(block: int, work: Workspace, nodes: Nodes) -> None:
    """Gradient of `share`, once the first block's part of `nodes` holds the sums over all blocks."""
    heads, _, size = nodes.keys.shape
    token, usable, first = work.tokens[block, 0], work.usable[block], block * work.row.shape[1]
    for head in range(heads):
        start, stop = head * size, (head + 1) * size
        load_points(nodes.v_keys[0, head], first, token[V_KEY, start:stop], usable)
        load_points(nodes.v_values[0, head], first, token[V_VALUE, start:stop], usable)
