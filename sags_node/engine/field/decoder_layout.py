"""How big the deformation decoder's arrays are, and what its parameters are called."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from sags_node.engine.field import decoder_block as block
from sags_node.engine.field.decoder_block import Weights, Workspace
from sags_node.engine.field.decoder_nodes import Nodes
from sags_node.engine.field.dense import COLUMNS
from sags_node.kernels.jit import aligned
from sags_node.types import F32

_VECTORS = {
    "pre_scale": block.PRE_SCALE,  # alpha of A_pre
    "pre_shift": block.PRE_SHIFT,  # beta of A_pre
    "query_bias": block.QUERY_BIAS,
    "key_bias": block.KEY_BIAS,
    "value_bias": block.VALUE_BIAS,
    "attention_bias": block.ATTENTION_BIAS,
    "attention_gate": block.ATTENTION_GATE,  # g1
    "post_scale": block.POST_SCALE,  # alpha of A_post
    "post_shift": block.POST_SHIFT,  # beta of A_post
    "mlp_in_bias": block.MLP_IN_BIAS,
    "mlp_out_bias": block.MLP_OUT_BIAS,
    "mlp_gate": block.MLP_GATE,  # g2
}
_MATRICES = {
    "query_weight": block.QUERY_WEIGHT,
    "key_weight": block.KEY_WEIGHT,
    "value_weight": block.VALUE_WEIGHT,
    "attention_weight": block.ATTENTION_WEIGHT,  # the attention's output layer
    "mlp_in_weight": block.MLP_IN_WEIGHT,
    "mlp_out_weight": block.MLP_OUT_WEIGHT,
}


@dataclass(frozen=True, slots=True)
class Sizes:
    """How big a decoder is."""

    tokens: int  # T per point
    channels: int  # C per token
    width: int  # w, of the MLP too
    attention_heads: int  # divides the width; 0: a token attends to itself only
    deltas: tuple[int, ...]  # how many numbers each of the H delta heads gives; D in all


def _weight_shapes(sizes: Sizes) -> list[tuple[int, ...]]:
    """Shapes of `Weights`, in its order."""
    w, heads, deltas = sizes.width, len(sizes.deltas), sum(sizes.deltas)
    return [
        (sizes.tokens, w, sizes.channels),
        (sizes.tokens, w),
        (block.VECTORS, w),
        (block.MATRICES, w, w),
        (heads, w, w),
        (heads, w),
        (deltas, w),
        (deltas,),
    ]


def flat_weights(sizes: Sizes) -> tuple[F32, Weights]:
    """Zeros for all weights in one array, and the weights as views into it."""
    flat = aligned((sum(math.prod(shape) for shape in _weight_shapes(sizes)),))
    return flat, weights_in(flat, sizes)


def weights_in(flat: Any, sizes: Sizes) -> Weights:
    """The weights as views into one array [P] that holds them all, or into such a tensor."""
    views, start = [], 0
    for shape in _weight_shapes(sizes):
        end = start + math.prod(shape)
        views.append(flat[start:end].reshape(shape))
        start = end
    return Weights(*views)


def named_weights(weights: Weights, attends: bool) -> dict[str, F32]:
    """The parts of the weights by name; without attention there are no queries and keys."""
    parts = {name: weights.vectors[row] for name, row in _VECTORS.items()}
    parts |= {name: weights.matrices[index] for name, index in _MATRICES.items()}
    if not attends:
        for name in ("query_weight", "query_bias", "key_weight", "key_bias"):
            del parts[name]
    others = {name: array for name, array in weights._asdict().items() if name not in {"vectors", "matrices"}}
    return parts | others


def make_gradients(sizes: Sizes, groups: int) -> Weights:
    """Room for the gradients of `groups` groups of blocks."""
    return Weights(*(aligned((groups, *shape)) for shape in _weight_shapes(sizes)))


def make_workspace(sizes: Sizes, slots: int) -> Workspace:
    """Room for the activations of `slots` blocks."""
    T, w, heads, deltas = sizes.tokens, sizes.width, len(sizes.deltas), sum(sizes.deltas)

    def room(*shape: int) -> F32:
        return aligned((slots, *shape, COLUMNS))

    return Workspace(
        usable=room(),
        features=room(T * sizes.channels),
        tokens=room(T, block.TOKEN_KINDS, w),
        shares=room(sizes.attention_heads, T, T),
        points=room(block.POINT_KINDS, w),
        head_before=room(heads, w),
        head_hidden=room(heads, w),
        deltas=room(deltas),
        v_features=room(T * sizes.channels),
        v_shares=room(T),
        v_deltas=room(deltas),
        row=room(),
    )


def make_nodes(sizes: Sizes, count: int, blocks: int, workers: int) -> Nodes:
    """Room for `count` nodes in `blocks` blocks."""
    per_head = (sizes.attention_heads, count, sizes.width // max(sizes.attention_heads, 1))
    return Nodes(
        keys=aligned(per_head),
        values=aligned(per_head),
        v_keys=aligned((blocks, *per_head)),
        v_values=aligned((blocks, *per_head)),
        scratch=aligned((workers, 2 * count + 1, COLUMNS)),
    )
