"""The deformation decoder against its torch twin, and what must hold whatever its weights are."""

from __future__ import annotations

import numpy as np
import pytest
from engine_scenes import on_one_thread, relative_error

from sags_node.engine.reference import decoder as decoder_reference
from sags_node.errors import UsageError
from sags_node.model.decoder import Decoder, DecoderConfig
from sags_node.types import F32

CONFIGS = {
    "self": DecoderConfig(tokens="self", features=64),
    "planes": DecoderConfig(tokens="planes", features=30, levels=5, width=16, heads=2, sh_coefficients=4),
    "twelve planes": DecoderConfig(tokens="planes", features=12 * 8, levels=12),
    "nodes": DecoderConfig(tokens="nodes", features=20, width=24),
}
every_choice = pytest.mark.parametrize("config", CONFIGS.values(), ids=CONFIGS)


def trained(config: DecoderConfig, seed: int = 0) -> Decoder:
    """A decoder whose every parameter matters: gates near 1, last layers and biases not 0."""
    decoder = Decoder(config, seed)
    rng = np.random.default_rng(seed)
    for name, parameter in decoder.parameters.items():
        parameter[:] = parameter + rng.normal(name.endswith("_gate"), 0.1, parameter.shape)
    return decoder


def inputs(config: DecoderConfig, count: int, seed: int = 1) -> tuple[F32, F32]:
    """Features [count, F] and a cotangent [count, D]."""
    rng = np.random.default_rng(seed)
    features = rng.normal(0, 1, (count, config.features)).astype(np.float32)
    return features, rng.normal(0, 1, (count, sum(config.sizes.deltas))).astype(np.float32)


def run(decoder: Decoder, features: F32, v_deltas: F32) -> tuple[F32, F32, F32]:
    """Deltas, v_features and the gradients of all parameters, as copies."""
    deltas = decoder.forward(features).copy()
    v_features = decoder.backward(v_deltas).copy()
    return deltas, v_features, decoder.gradients.copy()


@every_choice
@pytest.mark.parametrize(("count", "size"), [(1, 1), (128, 1), (300, 1), (300, 10)])
def test_same_as_the_twin_with_every_gradient(config: DecoderConfig, count: int, size: float) -> None:
    """Features of size 10 drive GELU and softmax to where they are flat, and cost a digit."""
    import torch

    decoder = trained(config)
    features, v_deltas = inputs(config, count)
    features *= size
    bound = 1e-5 * size
    deltas, v_features, _ = run(decoder, features, v_deltas)

    weights = {
        name: torch.tensor(array, dtype=torch.float64, requires_grad=True)
        for name, array in decoder.parameters.items()
    }
    twin_features = torch.tensor(features, dtype=torch.float64, requires_grad=True)
    twin = decoder_reference.decode(weights, config.sizes, twin_features, config.tokens == "nodes")
    twin.backward(torch.tensor(v_deltas, dtype=torch.float64))

    assert relative_error(deltas, twin.detach().numpy()) < bound
    assert relative_error(v_features, twin_features.grad.numpy()) < bound
    largest = np.abs(decoder.gradients).max()
    for name, found in decoder.parameter_gradients.items():
        true = weights[name].grad.numpy()
        if np.abs(true).max() < 1e-12 * largest:  # softmax ignores what keys have in common, and a single key
            assert np.abs(found).max() < bound * largest, name
        else:
            assert relative_error(found, true) < bound, name


@every_choice
def test_gradient_is_the_slope_of_the_deltas(config: DecoderConfig) -> None:
    decoder = trained(config)
    features, v_deltas = inputs(config, 40)
    _, v_features, gradients = run(decoder, features, v_deltas)
    rng = np.random.default_rng(2)
    values = decoder.values.copy()
    step = 2e-3
    for varied, gradient in ((decoder.values, gradients), (features, v_features)):
        direction = rng.normal(0, 1, varied.shape).astype(np.float32) * (gradient != 0)
        centre, sums = varied.copy(), []
        for sign in (1, -1):
            varied[:] = centre + np.float32(sign * step) * direction
            sums.append(float((decoder.forward(features).astype(np.float64) * v_deltas).sum()))
        varied[:] = centre
        slope = (sums[0] - sums[1]) / (2 * step)
        assert slope == pytest.approx(float((gradient * direction).sum()), rel=2e-2)
    np.testing.assert_array_equal(decoder.values, values)


@every_choice
def test_a_new_decoder_changes_nothing_but_can_learn(config: DecoderConfig) -> None:
    decoder = Decoder(config)
    features, v_deltas = inputs(config, 50)
    deltas, _, gradients = run(decoder, features, v_deltas)
    assert not deltas.any()
    assert gradients.any()


def test_learns_what_it_is_shown() -> None:
    """Adam on the flat arrays: the deltas of 200 points come close to given ones."""
    decoder = Decoder(CONFIGS["self"])
    features, wanted = inputs(decoder.config, 200)
    m, v = np.zeros_like(decoder.values), np.zeros_like(decoder.values)
    losses = []
    for step in range(1, 301):
        residuals = decoder.forward(features) - wanted
        losses.append(float((residuals**2).mean()))
        decoder.backward(residuals)
        m += 0.1 * (decoder.gradients - m)
        v += 0.001 * (decoder.gradients**2 - v)
        rate = 3e-3 * (1 - 0.999**step) ** 0.5 / (1 - 0.9**step)
        decoder.values -= rate * m / (np.sqrt(v) + 1e-12)
    assert losses[-1] < 0.25 * losses[0]


def test_folded_attention_equals_attention_over_a_sequence_of_one() -> None:
    """Whatever queries and keys are: softmax over one key is 1."""
    import torch

    decoder = trained(CONFIGS["self"])
    config = decoder.config
    features, _ = inputs(config, 60)
    weights = {name: torch.tensor(array, dtype=torch.float64) for name, array in decoder.parameters.items()}
    generator = torch.Generator().manual_seed(0)
    for name, shape in (("query", (32, 32)), ("key", (32, 32))):
        weights[f"{name}_weight"] = torch.randn(shape, generator=generator, dtype=torch.float64)
        weights[f"{name}_bias"] = torch.randn(32, generator=generator, dtype=torch.float64)
    attending = DecoderConfig(tokens="planes", features=config.features, levels=1).sizes
    true = decoder_reference.decode(weights, attending, torch.tensor(features, dtype=torch.float64), False)
    assert relative_error(decoder.forward(features), true.numpy()) < 1e-5


@every_choice
def test_no_points(config: DecoderConfig) -> None:
    decoder = trained(config)
    run(decoder, *inputs(config, 10))
    deltas, v_features, gradients = run(decoder, *inputs(config, 0))
    assert deltas.shape == (0, sum(config.sizes.deltas))
    assert v_features.shape == (0, config.features)
    assert not gradients.any()


@every_choice
def test_nothing_is_left_of_the_call_before(config: DecoderConfig) -> None:
    decoder = trained(config)
    for count in (200, 7, 390):
        found = run(decoder, *inputs(config, count, seed=count))
        fresh = run(trained(config), *inputs(config, count, seed=count))
        for a, b in zip(found, fresh, strict=True):
            np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("name", ["self", "planes"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize("where", ["features", "v_deltas"])
def test_a_broken_point_stays_alone(name: str, value: float, where: str) -> None:
    decoder = trained(CONFIGS[name])
    features, v_deltas = inputs(decoder.config, 150)
    healthy = np.arange(150) != 17
    v_deltas[17] = 0
    deltas, v_features, gradients = run(decoder, features, v_deltas)
    (features if where == "features" else v_deltas)[17, 3] = value
    broken_deltas, broken_v_features, broken_gradients = run(decoder, features, v_deltas)
    np.testing.assert_array_equal(broken_deltas[healthy], deltas[healthy])
    np.testing.assert_array_equal(broken_v_features[healthy], v_features[healthy])
    np.testing.assert_array_equal(broken_gradients, gradients)
    assert not broken_v_features[17].any()
    assert broken_deltas[17].any() == (where == "v_deltas")


def test_a_broken_node_counts_as_one_without_features() -> None:
    decoder = trained(CONFIGS["nodes"])
    features, v_deltas = inputs(decoder.config, 150)
    healthy = np.arange(150) != 17
    features[17], v_deltas[17] = 0, 0
    deltas, _, _ = run(decoder, features, v_deltas)
    features[17, 3] = np.nan
    broken_deltas, broken_v_features, broken_gradients = run(decoder, features, v_deltas)
    np.testing.assert_array_equal(broken_deltas[healthy], deltas[healthy])
    assert not broken_deltas[17].any()
    assert np.isfinite(broken_v_features).all()
    assert np.isfinite(broken_gradients).all()


def test_nodes_see_each_other_and_points_do_not() -> None:
    for name, seen in (("self", False), ("planes", False), ("nodes", True)):
        decoder = trained(CONFIGS[name])
        features, _ = inputs(decoder.config, 300)
        before = decoder.forward(features).copy()
        features[290] += 1
        changed = (decoder.forward(features) != before).any(axis=1)
        assert changed[290]
        assert changed[:290].any() == seen, name


@every_choice
def test_same_bits_for_one_and_all_threads(config: DecoderConfig) -> None:
    decoder = trained(config)
    arrays = inputs(config, 900)
    together = run(decoder, *arrays)
    alone = on_one_thread(lambda: run(trained(config), *arrays))
    for a, b in zip(together, alone, strict=True):
        np.testing.assert_array_equal(a, b)


def test_the_seed_decides_the_weights() -> None:
    config = CONFIGS["planes"]
    first, again, other = Decoder(config, 3), Decoder(config, 3), Decoder(config, 4)
    np.testing.assert_array_equal(first.values, again.values)
    for name, parameter in first.parameters.items():
        random = name.endswith("_weight") and name != "head_out_weight"
        assert (parameter != other.parameters[name]).any() == random, name


def test_columns_cover_a_row_of_deltas() -> None:
    columns = CONFIGS["planes"].columns
    assert list(columns) == ["means", "log_scales", "quats", "colors", "opacity_logits"]
    covered = np.concatenate([np.arange(30)[columns[name]] for name in columns])
    np.testing.assert_array_equal(covered, np.arange(3 + 3 + 4 + 12 + 1))


@pytest.mark.parametrize(
    ("wrong", "named"),
    [
        ({"tokens": "gaussians"}, "tokens"),
        ({"features": 0}, "features"),
        ({"levels": 2}, "levels"),
        ({"tokens": "planes", "levels": 5}, "levels"),
        ({"tokens": "planes", "levels": 16}, "levels"),
        ({"heads": 5}, "heads"),
        ({"heads": 0}, "heads"),
        ({"width": 4096}, "width"),
        ({"sh_coefficients": 2}, "sh_coefficients"),
    ],
)
def test_sizes_that_do_not_fit_are_refused(wrong: dict[str, object], named: str) -> None:
    with pytest.raises(UsageError, match=named):
        DecoderConfig(**wrong)


def test_wrong_arrays_are_refused() -> None:
    decoder = Decoder(CONFIGS["self"])
    with pytest.raises(UsageError, match="v_deltas"):
        decoder.backward(np.zeros((5, 14), np.float32))  # nothing was decoded yet
    for features in (np.zeros((5, 63), np.float32), np.zeros(64, np.float32), np.zeros((5, 64))):
        with pytest.raises(UsageError, match="features"):
            decoder.forward(features)
    decoder.forward(np.zeros((5, 64), np.float32))
    for v_deltas in (np.zeros((4, 14), np.float32), np.zeros((5, 15), np.float32), np.zeros((5, 14))):
        with pytest.raises(UsageError, match="v_deltas"):
            decoder.backward(v_deltas)
    with pytest.raises(UsageError, match="1025"):
        Decoder(CONFIGS["nodes"]).forward(np.zeros((1025, 20), np.float32))
