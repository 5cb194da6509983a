"""The self-adaptive decoder: its equation, its gradients, and what must hold whatever its weights are."""

import math
from typing import Any

import pytest
import torch
from torch.nn.functional import gelu, linear, multi_head_attention_forward

from sags_node.errors import UsageError
from sags_node.field.decoder import HEADS, Decoder, Tokens
from sags_node.model import columns

TOKENS: list[Tokens] = ["self", "nodes"]
every_choice = pytest.mark.parametrize("tokens", TOKENS)


def trained(tokens: Tokens, seed: int = 0, **sizes: Any) -> Decoder:
    """In double precision, and every parameter matters: gates near 1, last layers and biases not 0."""
    decoder = Decoder(20, tokens, seed=seed, xavier=True, **sizes).double()
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for name, parameter in decoder.named_parameters():
            noise = torch.randn(parameter.shape, generator=generator)
            parameter.add_(0.1 * noise + name.startswith("gamma"))
    return decoder


def features(count: int, seed: int = 1) -> torch.Tensor:
    return torch.randn(count, 20, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


@every_choice
def test_it_is_the_equation_of_the_paper(tokens: Tokens) -> None:
    """y' = A_pre(x) + g1 MSA(A_pre(x)),  y = A_post(y') + g2 MLP(A_post(y')) + x; MSA is torch's own. And its
    gradient."""
    d, f = trained(tokens), features(9).requires_grad_()
    w = dict(d.named_parameters())

    def layer(x: torch.Tensor, name: str) -> torch.Tensor:
        return linear(x, w[f"{name}.weight"], w[f"{name}.bias"])

    x = gelu(layer(f, "embed"))
    adapted = w["pre.alpha"] * x + w["pre.beta"]
    # `self`: whatever queries and keys are, softmax over one key is 1
    queries = torch.zeros(64, 32, dtype=f.dtype), torch.zeros(64, dtype=f.dtype)
    if tokens == "nodes":
        queries = w["attention.query_key.weight"], w["attention.query_key.bias"]
    sequence = adapted[:, None] if tokens == "nodes" else adapted[None]  # [length, how many, width]
    mixed, _ = multi_head_attention_forward(
        sequence, sequence, sequence, 32, 4,
        torch.cat([queries[0], w["attention.value.weight"]]),
        torch.cat([queries[1], w["attention.value.bias"]]),
        None, None, False, 0.0, w["attention.out.weight"], w["attention.out.bias"],
    )  # fmt: skip
    y = adapted + w["gamma_1"] * mixed.view_as(adapted)
    y = w["post.alpha"] * y + w["post.beta"]
    y = y + w["gamma_2"] * layer(gelu(layer(y, "mlp.0")), "mlp.2") + x
    hidden = gelu(layer(gelu(y), "head_in")).split(32, 1)
    heads = [linear(part, weights) for part, weights in zip(hidden, d.head_out, strict=True)]
    found, expected = d(f), torch.cat(heads, 1) + w["head_bias"]
    assert torch.allclose(found, expected, rtol=1e-10, atol=1e-12)
    learnt = [f, *w.values()]
    v = torch.randn(found.shape, generator=torch.Generator().manual_seed(2), dtype=f.dtype)
    for name, ours, theirs in zip(
        ("features", *w),
        torch.autograd.grad(found, learnt, v),
        torch.autograd.grad(expected, learnt, v),
        strict=True,
    ):
        assert torch.allclose(ours, theirs, rtol=1e-10, atol=1e-12), name


@every_choice
def test_a_new_decoder_changes_nothing_but_can_learn(tokens: Tokens) -> None:
    decoder = Decoder(20, tokens)
    deltas = decoder(features(50).float())
    assert deltas.shape == (50, columns.COUNT) and not deltas.any()
    deltas.sum().backward()
    assert any(bool(weights.grad.any()) for weights in decoder.head_out)
    decoder.awaken(0)
    assert decoder(features(50).float()).any()


def test_nodes_see_each_other_and_points_do_not() -> None:
    for tokens in TOKENS:
        decoder, f = trained(tokens), features(60)
        before = decoder(f)
        f[50] += 1
        changed = ((decoder(f) - before).abs() > 1e-12).any(1)  # sums of another order differ by less
        assert changed[50]
        assert bool(changed[:50].any()) == (tokens == "nodes")


def test_heads_stand_in_the_order_of_a_row() -> None:
    first = 0
    for name, count in HEADS.items():
        place = getattr(columns, name.upper())
        place = slice(place, place + 1) if isinstance(place, int) else place
        assert (place.start, place.stop) == (first, first + count)
        first += count
    assert first == columns.COUNT


@every_choice
def test_the_seed_decides_the_weights(tokens: Tokens) -> None:
    first, again, other = (dict(Decoder(20, tokens, seed=seed).named_parameters()) for seed in (3, 3, 4))
    for name, parameter in first.items():
        assert torch.equal(parameter, again[name])
        assert torch.equal(parameter, other[name]) == (not name.endswith("weight")), name
        if name.endswith("weight"):  # Xavier's bound, which a hundred uniform numbers nearly reach
            bound = math.sqrt(6 / (parameter.shape[1] + 32))
            assert 0.9 * bound < parameter.abs().max() <= bound


@pytest.mark.parametrize(
    ("wrong", "named"),
    [
        ({"heads": 5}, "heads"),
        ({"heads": 0}, "heads"),
        ({"features": 0}, "features"),
        ({"block": "mlp", "tokens": "nodes"}, "no attention"),
    ],
)
def test_what_does_not_fit_is_refused(wrong: dict[str, Any], named: str) -> None:
    with pytest.raises(UsageError, match=named):
        Decoder(**{"features": 20} | wrong)


def test_too_many_nodes_are_refused() -> None:
    with pytest.raises(UsageError, match="1025"):
        Decoder(20, "nodes")(torch.zeros(1025, 20))
