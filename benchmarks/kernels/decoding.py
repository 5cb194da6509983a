"""Times of the deformation decoder, for each choice of what a token is."""

from __future__ import annotations

from typing import Any

import numpy as np

from benchmarks.kernels.timing import median_ms
from benchmarks.kernels.work import Work, bytes_of, share_of_peak, stage_rows
from sags_node.engine.field.decoder_layout import Sizes
from sags_node.kernels.peak import Peak
from sags_node.kernels.threads import thread_count
from sags_node.model.decoder import Decoder, DecoderConfig
from sags_node.types import F32

LEVELS = 2
CONTROL_NODES = 300
GELU_OPERATIONS = 24


def make_decoder(tokens: str) -> Decoder:
    """With parameters as after some training: a new decoder gives zeros, and zero gradients."""
    decoder = Decoder(DecoderConfig(tokens, levels=LEVELS if tokens == "planes" else 1))
    decoder.values += np.random.default_rng(0).normal(0, 0.05, decoder.values.shape).astype(np.float32)
    return decoder


def measure_decoder(
    count: int, tokens: str, threads: int, runs: int, peak: Peak, twin_runs: int = 0
) -> dict[str, Any]:
    """One row of the table: `count` points, or control nodes. The calling thread must be set to `threads`,
    and `peak` be that of them."""
    decoder = make_decoder(tokens)
    sizes = decoder.config.sizes
    rng = np.random.default_rng(1)
    features = rng.normal(size=(count, decoder.config.features)).astype(np.float32)
    v_deltas = rng.normal(size=(count, sum(sizes.deltas))).astype(np.float32)
    times = {
        "forward": median_ms(lambda: decoder.forward(features), runs),
        "backward": median_ms(lambda: decoder.backward(v_deltas), runs),
    }
    each_way = bytes_of(features, v_deltas, decoder.values)
    operations = count * _operations(sizes, count if tokens == "nodes" else sizes.tokens)
    work = {
        "forward": Work(each_way, operations),
        "backward": Work(2 * each_way, 2 * operations),
    }
    both_ms = times["forward"] + times["backward"]
    row: dict[str, Any] = {
        "n": count,
        "tokens": tokens,
        "threads": threads,
        "forward_ms": times["forward"],
        "forward_backward_ms": both_ms,
        "share_of_peak": share_of_peak(both_ms, work, peak),
        "stages": stage_rows(times, work, peak),
    }
    if twin_runs > 0:
        twin_ms = median_ms(lambda: _twin(decoder, features, v_deltas), twin_runs, warm_up=1)
        row |= {"twin_forward_backward_ms": twin_ms, "speedup_over_twin": twin_ms / both_ms}
    return row


def _twin(decoder: Decoder, features: F32, v_deltas: F32) -> None:
    import torch

    from sags_node.engine.reference import decoder as decoder_reference

    torch.set_num_threads(thread_count())
    weights = {name: torch.tensor(value, requires_grad=True) for name, value in decoder.parameters.items()}
    points = torch.tensor(features, requires_grad=True)
    config = decoder.config
    deltas = decoder_reference.decode(weights, config.sizes, points, config.tokens == "nodes")
    torch.autograd.grad(deltas, [points, *weights.values()], torch.tensor(v_deltas), materialize_grads=True)


def _operations(sizes: Sizes, attended: int) -> int:
    """Of all matrices for one point, and of its GELUs. `attended`: how many tokens each token attends to."""
    w, heads, deltas = sizes.width, len(sizes.deltas), sum(sizes.deltas)
    attention = 3 * w * w + 2 * attended * w if sizes.attention_heads else 0
    per_token = w * sizes.channels + attention + 3 * w * w
    gelus = 2 * sizes.tokens * w + w + heads * w
    return sizes.tokens * per_token + heads * w * w + deltas * w + GELU_OPERATIONS * gelus
