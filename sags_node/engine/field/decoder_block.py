"""The deformation decoder for one block of 128 points, forward and backward.

The self-adaptive weighted decoder of SAGS (arXiv 2510.27318): for every token x = GELU(W f + b) of a point,
with A(x) = alpha x + beta and the gates g1, g2 learnt per channel,

    y' = A_pre(x) + g1 MSA(A_pre(x))        y = A_post(y') + g2 MLP(A_post(y')) + x.

The mean of y over a point's tokens goes to five heads Linear(GELU(Linear(GELU(y)))), whose last layers give
the deltas. Forward: `embed`, `attend` (or the attention of `decoder_nodes`), `finish`.

Almost everything has the decoder's width, so few arrays hold it, by the indices below: a kernel that takes
dozens of arrays compiles for half a minute.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sags_node.engine.field.attention import attend_tokens, attend_tokens_backward
from sags_node.engine.field.dense import (
    accumulate,
    add,
    add_row_dots,
    add_scaled_rows,
    affine_rows,
    affine_rows_backward,
    copy,
    gelu,
    linear,
    linear_backward,
    load_points,
    multiply,
    multiply_by,
    scale_rows,
)
from sags_node.kernels.jit import kernel
from sags_node.types import F32, I64

f4 = np.float32
ZERO, ONE = f4(0.0), f4(1.0)

# Weights.vectors
PRE_SCALE, PRE_SHIFT, QUERY_BIAS, KEY_BIAS, VALUE_BIAS, ATTENTION_BIAS, ATTENTION_GATE = range(7)
POST_SCALE, POST_SHIFT, MLP_IN_BIAS, MLP_OUT_BIAS, MLP_GATE = range(7, 12)
VECTORS = 12
# Weights.matrices
QUERY_WEIGHT, KEY_WEIGHT, VALUE_WEIGHT, ATTENTION_WEIGHT, MLP_IN_WEIGHT, MLP_OUT_WEIGHT = range(6)
MATRICES = 6
# Workspace.tokens; ADAPTED is A_pre(x), MIXED is MSA(A_pre(x)), SUMMED is y', READAPTED is A_post(y')
EMBEDDED, TOKEN, ADAPTED, QUERY, KEY, VALUE, ATTENDED, MIXED, SUMMED, READAPTED = range(10)
MLP_BEFORE, MLP_HIDDEN, MLP_OUT, V_TOKEN, V_ADAPTED, V_QUERY, V_KEY, V_VALUE, V_ATTENDED = range(10, 19)
V_MIXED, V_READAPTED, V_MLP_HIDDEN = range(19, 22)
TOKEN_KINDS = 22
# Workspace.points
POOLED, HEAD_INPUT, V_POOLED, V_HEAD_HIDDEN = range(4)
POINT_KINDS = 4


class Weights(NamedTuple):
    """What the kernels read; or its gradients, with one leading axis more: groups of blocks, not summed yet.

    T tokens of C channels, width w, H heads that give D deltas.
    """

    embed_weight: F32  # [T, w, C]
    embed_bias: F32  # [T, w]
    vectors: F32  # [VECTORS, w]
    matrices: F32  # [MATRICES, w, w]
    head_in_weight: F32  # [H, w, w]
    head_in_bias: F32  # [H, w]
    head_out_weight: F32  # [D, w]
    head_out_bias: F32  # [D]


class Workspace(NamedTuple):
    """Activations of one block of 128 points in each of S slots, and their gradients.

    What goes into a GELU (EMBEDDED, MLP_BEFORE, POOLED, head_before) holds the GELU's derivative afterwards.
    """

    usable: F32  # [S, 128] 0: no such point, or one with a NaN
    features: F32  # [S, T C, 128]
    tokens: F32  # [S, T, TOKEN_KINDS, w, 128]
    shares: F32  # [S, attention heads, T, T, 128] of each token in each token
    points: F32  # [S, POINT_KINDS, w, 128]
    head_before: F32  # [S, H, w, 128]
    head_hidden: F32  # [S, H, w, 128]
    deltas: F32  # [S, D, 128]
    v_features: F32  # [S, T C, 128]
    v_shares: F32  # [S, T, 128]
    v_deltas: F32  # [S, D, 128]
    row: F32  # [S, 128] for anything


@kernel
def embed(
    first: int, slot: int, features: F32, weights: Weights, attention_heads: int, work: Workspace
) -> None:
    """From features [N, T C], starting at point `first`, to A_pre(x) and to queries, keys and values."""
    tokens, _, channels = weights.embed_weight.shape
    vectors, matrices = weights.vectors, weights.matrices
    work.usable[slot] = ONE
    load_points(features, first, work.features[slot], work.usable[slot])
    for t in range(tokens):
        token, inputs = work.tokens[slot, t], work.features[slot, t * channels : (t + 1) * channels]
        linear(weights.embed_weight[t], weights.embed_bias[t], inputs, token[EMBEDDED])
        gelu(token[EMBEDDED], token[TOKEN])
        affine_rows(vectors[PRE_SCALE], vectors[PRE_SHIFT], token[TOKEN], token[ADAPTED])
        if attention_heads > 0:
            for k in range(3):
                weight, bias = matrices[QUERY_WEIGHT + k], vectors[QUERY_BIAS + k]
                linear(weight, bias, token[ADAPTED], token[QUERY + k])


@kernel
def embed_backward(
    slot: int, group: int, weights: Weights, attention_heads: int, work: Workspace, gradients: Weights
) -> None:
    """From the gradients of x, A_pre(x) and queries, keys and values to that of the features."""
    tokens, _, channels = weights.embed_weight.shape
    v_vectors, v_matrices = gradients.vectors[group], gradients.matrices[group]
    for t in range(tokens):
        token = work.tokens[slot, t]
        if attention_heads > 0:
            for k in range(3):
                v_weight, v_bias = v_matrices[QUERY_WEIGHT + k], v_vectors[QUERY_BIAS + k]
                linear_backward(token[V_QUERY + k], token[ADAPTED], v_weight, v_bias)
                accumulate(weights.matrices[QUERY_WEIGHT + k].T, token[V_QUERY + k], token[V_ADAPTED])
        v_scale, v_shift = v_vectors[PRE_SCALE], v_vectors[PRE_SHIFT]
        affine_rows_backward(token[V_ADAPTED], token[TOKEN], v_scale, v_shift)
        add_scaled_rows(weights.vectors[PRE_SCALE], token[V_ADAPTED], token[V_TOKEN])
        multiply(token[EMBEDDED], token[V_TOKEN])
        start, stop = t * channels, (t + 1) * channels
        v_weight, v_bias = gradients.embed_weight[group, t], gradients.embed_bias[group, t]
        linear_backward(token[V_TOKEN], work.features[slot, start:stop], v_weight, v_bias)
        work.v_features[slot, start:stop] = ZERO
        accumulate(weights.embed_weight[t].T, token[V_TOKEN], work.v_features[slot, start:stop])


@kernel
def attend(slot: int, attention_heads: int, work: Workspace) -> None:
    """Attention among the tokens of each point; without heads each token attends to itself only."""
    tokens = work.tokens[slot]
    if attention_heads > 0:
        attend_tokens(tokens, QUERY, ATTENDED, work.shares[slot], work.row[slot])
    else:
        for t in range(len(tokens)):
            copy(tokens[t, ADAPTED], tokens[t, ATTENDED])


@kernel
def attend_backward(slot: int, attention_heads: int, work: Workspace) -> None:
    """From the gradient of what was attended to, to those of queries, keys and values, or of A_pre(x)."""
    tokens = work.tokens[slot]
    if attention_heads > 0:
        shares, v_shares = work.shares[slot], work.v_shares[slot]
        attend_tokens_backward(tokens, QUERY, V_QUERY, V_ATTENDED, shares, v_shares, work.row[slot])
    else:
        for t in range(len(tokens)):
            add(tokens[t, V_ATTENDED], tokens[t, V_ADAPTED])


@kernel
def finish(slot: int, weights: Weights, head_rows: I64, work: Workspace) -> None:
    """From A_pre(x) and what was attended to, to the deltas; they are 0 for points that are not usable."""
    tokens, point = work.tokens[slot], work.points[slot]
    vectors, matrices = weights.vectors, weights.matrices
    point[POOLED] = ZERO
    for t in range(len(tokens)):
        token = tokens[t]
        linear(matrices[ATTENTION_WEIGHT], vectors[ATTENTION_BIAS], token[ATTENDED], token[MIXED])
        copy(token[ADAPTED], token[SUMMED])
        add_scaled_rows(vectors[ATTENTION_GATE], token[MIXED], token[SUMMED])
        affine_rows(vectors[POST_SCALE], vectors[POST_SHIFT], token[SUMMED], token[READAPTED])
        linear(matrices[MLP_IN_WEIGHT], vectors[MLP_IN_BIAS], token[READAPTED], token[MLP_BEFORE])
        gelu(token[MLP_BEFORE], token[MLP_HIDDEN])
        linear(matrices[MLP_OUT_WEIGHT], vectors[MLP_OUT_BIAS], token[MLP_HIDDEN], token[MLP_OUT])
        add(token[READAPTED], point[POOLED])
        add_scaled_rows(vectors[MLP_GATE], token[MLP_OUT], point[POOLED])
        add(token[TOKEN], point[POOLED])
    multiply_by(ONE / f4(len(tokens)), point[POOLED])
    gelu(point[POOLED], point[HEAD_INPUT])
    for h in range(len(head_rows) - 1):
        before, hidden = work.head_before[slot, h], work.head_hidden[slot, h]
        linear(weights.head_in_weight[h], weights.head_in_bias[h], point[HEAD_INPUT], before)
        gelu(before, hidden)
        start, stop = head_rows[h], head_rows[h + 1]
        weight, bias = weights.head_out_weight[start:stop], weights.head_out_bias[start:stop]
        linear(weight, bias, hidden, work.deltas[slot, start:stop])
    for delta in range(len(weights.head_out_bias)):
        multiply(work.usable[slot], work.deltas[slot, delta])


@kernel
def finish_backward(
    first: int,
    slot: int,
    group: int,
    v_deltas: F32,
    weights: Weights,
    head_rows: I64,
    work: Workspace,
    gradients: Weights,
) -> None:
    """From v_deltas [N, D], starting at point `first`, to what the attention and `embed_backward` take."""
    tokens, point = work.tokens[slot], work.points[slot]
    load_points(v_deltas, first, work.v_deltas[slot], work.usable[slot])
    point[V_POOLED] = ZERO
    for h in range(len(head_rows) - 1):
        start, stop = head_rows[h], head_rows[h + 1]
        v_out, v_hidden = work.v_deltas[slot, start:stop], point[V_HEAD_HIDDEN]
        v_weight, v_bias = (
            gradients.head_out_weight[group, start:stop],
            gradients.head_out_bias[group, start:stop],
        )
        linear_backward(v_out, work.head_hidden[slot, h], v_weight, v_bias)
        v_hidden[:] = ZERO
        accumulate(weights.head_out_weight[start:stop].T, v_out, v_hidden)
        multiply(work.head_before[slot, h], v_hidden)
        v_weight, v_bias = gradients.head_in_weight[group, h], gradients.head_in_bias[group, h]
        linear_backward(v_hidden, point[HEAD_INPUT], v_weight, v_bias)
        accumulate(weights.head_in_weight[h].T, v_hidden, point[V_POOLED])
    multiply(point[POOLED], point[V_POOLED])
    multiply_by(ONE / f4(len(tokens)), point[V_POOLED])
    for t in range(len(tokens)):
        _token_backward(point[V_POOLED], tokens[t], group, weights, gradients)


@kernel
def _token_backward(v_y: F32, token: F32, group: int, weights: Weights, gradients: Weights) -> None:
    """From the gradient of one token's y to those of x, of A_pre(x) and of what was attended to."""
    vectors, matrices = weights.vectors, weights.matrices
    v_vectors, v_matrices = gradients.vectors[group], gradients.matrices[group]
    v_p, v_mlp, v_adapted = token[V_READAPTED], token[V_MLP_HIDDEN], token[V_ADAPTED]
    copy(v_y, token[V_TOKEN])

    add_row_dots(v_y, token[MLP_OUT], v_vectors[MLP_GATE])
    scale_rows(vectors[MLP_GATE], v_y, v_p)
    linear_backward(v_p, token[MLP_HIDDEN], v_matrices[MLP_OUT_WEIGHT], v_vectors[MLP_OUT_BIAS])
    v_mlp[:] = ZERO
    accumulate(matrices[MLP_OUT_WEIGHT].T, v_p, v_mlp)
    multiply(token[MLP_BEFORE], v_mlp)
    linear_backward(v_mlp, token[READAPTED], v_matrices[MLP_IN_WEIGHT], v_vectors[MLP_IN_BIAS])
    copy(v_y, v_p)
    accumulate(matrices[MLP_IN_WEIGHT].T, v_mlp, v_p)

    affine_rows_backward(v_p, token[SUMMED], v_vectors[POST_SCALE], v_vectors[POST_SHIFT])
    scale_rows(vectors[POST_SCALE], v_p, v_adapted)
    add_row_dots(v_adapted, token[MIXED], v_vectors[ATTENTION_GATE])
    scale_rows(vectors[ATTENTION_GATE], v_adapted, token[V_MIXED])
    v_weight, v_bias = v_matrices[ATTENTION_WEIGHT], v_vectors[ATTENTION_BIAS]
    linear_backward(token[V_MIXED], token[ATTENDED], v_weight, v_bias)
    token[V_ATTENDED] = ZERO
    accumulate(matrices[ATTENTION_WEIGHT].T, token[V_MIXED], token[V_ATTENDED])
