"""Softmax attention of several heads, with its derivative: among the few tokens of one point, and among all
points (control nodes).

Activations are blocks [channels, 128] of `dense`. Of queries, keys and values each head takes width / heads
channels after the other, as in torch.nn.MultiheadAttention.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from sags_node.engine.field.dense import (
    ONE,
    ZERO,
    accumulate,
    add,
    add_outer,
    copy,
    exp_negative,
    multiply,
    stays_a_call,
)
from sags_node.kernels.jit import inlined, kernel
from sags_node.types import F32

f4 = np.float32
u8 = np.uint64


@kernel
def _softmax(scores: F32, scale: Any, row: F32) -> None:
    """Each column of scores [S, 128] becomes softmax(scale * column); `row` [128] is scratch."""
    stays_a_call()
    count, columns = scores.shape
    copy(scores[0], row)
    for s in range(1, count):
        values = scores[s]
        for c in range(columns):
            row[u8(c)] = max(row[u8(c)], values[u8(c)])
    for s in range(count):
        values = scores[s]
        for c in range(columns):
            values[u8(c)] = exp_negative(scale * (values[u8(c)] - row[u8(c)]))
    copy(scores[0], row)
    for s in range(1, count):
        add(scores[s], row)
    for c in range(columns):
        row[u8(c)] = ONE / row[u8(c)]
    for s in range(count):
        multiply(row, scores[s])


@kernel
def _softmax_backward(shares: F32, scale: Any, v_shares: F32, row: F32) -> None:
    """The gradient of the scores, in place of that of the shares [S, 128] (the softmax of scale * scores)."""
    stays_a_call()
    count, columns = shares.shape
    row[:] = ZERO
    for s in range(count):
        _add_product(shares[s], v_shares[s], row)
    for s in range(count):
        share, v_share = shares[s], v_shares[s]
        for c in range(columns):
            v_share[u8(c)] = scale * share[u8(c)] * (v_share[u8(c)] - row[u8(c)])


@inlined
def _add_product(a: F32, b: F32, y: F32) -> None:
    """y += a b, all [128]."""
    for c in range(y.size):
        y[u8(c)] += a[u8(c)] * b[u8(c)]


@kernel
def attend_tokens(tokens: F32, query: int, attended: int, shares: F32, row: F32) -> None:
    """Every point attends to its own tokens.

    Args:
        tokens: [T, kinds, width, 128] of T tokens.
        query: the kind that holds queries; keys and values are the two after it.
        attended: the kind that is written.
        shares: [heads, T, T, 128] written: how much of token s (second) goes into token t (first).
        row: [128] scratch.
    """
    stays_a_call()
    heads, count, width = len(shares), len(tokens), tokens.shape[2]
    size = width // heads
    scale = f4(1.0 / math.sqrt(size))
    shares[:] = ZERO
    for t in range(count):
        tokens[t, attended] = ZERO
    for h in range(heads):
        for t in range(count):
            for s in range(count):
                for d in range(h * size, (h + 1) * size):
                    _add_product(tokens[t, query, d], tokens[s, query + 1, d], shares[h, t, s])
            _softmax(shares[h, t], scale, row)
            for s in range(count):
                for d in range(h * size, (h + 1) * size):
                    _add_product(shares[h, t, s], tokens[s, query + 2, d], tokens[t, attended, d])


@kernel
def attend_tokens_backward(
    tokens: F32, query: int, v_query: int, v_attended: int, shares: F32, v_shares: F32, row: F32
) -> None:
    """Gradient of `attend_tokens`.

    Args:
        tokens: [T, kinds, width, 128] as given.
        query: as given.
        v_query: the kind that is written with the gradient of queries; keys and values follow.
        v_attended: the kind that holds the gradient of what was attended to.
        shares: [heads, T, T, 128] as written.
        v_shares: [T, 128] scratch.
        row: [128] scratch.
    """
    stays_a_call()
    heads, count, width = len(shares), len(tokens), tokens.shape[2]
    size = width // heads
    scale = f4(1.0 / math.sqrt(size))
    for t in range(count):
        tokens[t, v_query : v_query + 3] = ZERO
    for h in range(heads):
        for t in range(count):
            v_shares[:] = ZERO
            for s in range(count):
                for d in range(h * size, (h + 1) * size):
                    v_out = tokens[t, v_attended, d]
                    _add_product(v_out, tokens[s, query + 2, d], v_shares[s])
                    _add_product(v_out, shares[h, t, s], tokens[s, v_query + 2, d])
            _softmax_backward(shares[h, t], scale, v_shares, row)
            for s in range(count):
                for d in range(h * size, (h + 1) * size):
                    _add_product(v_shares[s], tokens[s, query + 1, d], tokens[t, v_query, d])
                    _add_product(v_shares[s], tokens[t, query, d], tokens[s, v_query + 1, d])


@kernel
def attend_nodes(queries: F32, keys: F32, values: F32, shares: F32, attended: F32, row: F32) -> None:
    """128 queries attend to all M nodes, one head.

    Args:
        queries: [size, 128].
        keys: [M, size].
        values: [M, size].
        shares: [M, 128] written: how much of each node goes into each query.
        attended: [size, 128] written.
        row: [128] scratch.
    """
    stays_a_call()
    shares[:] = ZERO
    accumulate(keys, queries, shares)
    _softmax(shares, f4(1.0 / math.sqrt(len(queries))), row)
    attended[:] = ZERO
    accumulate(values.T, shares, attended)


@kernel
def attend_nodes_backward(
    queries: F32,
    keys: F32,
    values: F32,
    shares: F32,
    v_attended: F32,
    v_shares: F32,
    v_queries: F32,
    v_keys: F32,
    v_values: F32,
    row: F32,
) -> None:
    """Gradient of `attend_nodes`.

    Args:
        queries, keys, values: as given.
        shares: as written.
        v_attended: [size, 128]; zero in columns that are no query.
        v_shares: [M, 128] scratch.
        v_queries: [size, 128] written.
        v_keys, v_values: [M, size] added to.
        row: [128] scratch.
    """
    stays_a_call()
    add_outer(shares, v_attended, v_values)
    v_shares[:] = ZERO
    accumulate(values, v_attended, v_shares)
    _softmax_backward(shares, f4(1.0 / math.sqrt(len(queries))), v_shares, row)
    add_outer(v_shares, queries, v_keys)
    v_queries[:] = ZERO
    accumulate(keys.T, v_shares, v_queries)
