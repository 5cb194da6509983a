"""The readable twin of the decoder kernels in torch: any precision, gradients by autograd."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from sags_node.engine.field.decoder_layout import Sizes

if TYPE_CHECKING:  # torch takes seconds to import; only who uses this twin pays
    from torch import Tensor


def decode(weights: Mapping[str, Tensor], sizes: Sizes, features: Tensor, nodes: bool) -> Tensor:
    """Deltas [N, D] of features [N, T C], differentiable in the features and all weights.

    Args:
        weights: by the names of `decoder_layout.named_weights`.
        sizes: of the decoder.
        features: [N, T C].
        nodes: True: all N attend to each other; False: the T tokens of each do.
    """
    import torch
    from torch.nn.functional import gelu, linear

    w = weights
    tokens = features.reshape(len(features), sizes.tokens, sizes.channels)
    x = gelu(torch.einsum("ntc,twc->ntw", tokens, w["embed_weight"]) + w["embed_bias"])
    adapted = w["pre_scale"] * x + w["pre_shift"]
    attended = linear(adapted, w["value_weight"], w["value_bias"])
    if sizes.attention_heads > 0:
        queries = linear(adapted, w["query_weight"], w["query_bias"])
        keys = linear(adapted, w["key_weight"], w["key_bias"])
        attended = _attend(queries, keys, attended, sizes.attention_heads, nodes)
    mixed = linear(attended, w["attention_weight"], w["attention_bias"])
    p = w["post_scale"] * (adapted + w["attention_gate"] * mixed) + w["post_shift"]
    hidden = gelu(linear(p, w["mlp_in_weight"], w["mlp_in_bias"]))
    y = p + w["mlp_gate"] * linear(hidden, w["mlp_out_weight"], w["mlp_out_bias"]) + x
    head_input = gelu(y.mean(dim=1))
    deltas, start = [], 0
    for head, count in enumerate(sizes.deltas):
        hidden = gelu(linear(head_input, w["head_in_weight"][head], w["head_in_bias"][head]))
        rows = slice(start, start + count)
        deltas.append(linear(hidden, w["head_out_weight"][rows], w["head_out_bias"][rows]))
        start += count
    return torch.cat(deltas, dim=1)


def _attend(queries: Tensor, keys: Tensor, values: Tensor, heads: int, nodes: bool) -> Tensor:
    """Attention before its output layer, [N, T, w], of queries, keys and values [N, T, w]."""
    from torch.nn.functional import scaled_dot_product_attention

    def by_head(x: Tensor) -> Tensor:
        x = x.transpose(0, 1) if nodes else x  # nodes: one sequence of N
        return x.reshape(*x.shape[:2], heads, -1).transpose(1, 2)

    attended = scaled_dot_product_attention(by_head(queries), by_head(keys), by_head(values))
    joined: Tensor = attended.transpose(1, 2).flatten(2)
    return joined.transpose(0, 1) if nodes else joined
