"""The fused SSIM kernels against the published formula, the metric and finite differences."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest
import torch
from engine_scenes import on_one_thread
from rounding import after, exact

from sags_node.engine.losses.ssim import TILE_HEIGHT, TILE_WIDTH, Dissimilarity
from sags_node.evaluation import metrics
from sags_node.types import F32, Bool


def pictures(height: int, width: int, seed: int = 0) -> tuple[F32, F32, F32]:
    """A drawn picture, the truth [3, H, W] and a weight [H, W] with holes."""
    rng = np.random.default_rng(seed)
    truth = rng.uniform(0, 1, (3, height, width)).astype(np.float32)
    truth = np.stack([cv2.blur(channel, (3, 3)) for channel in truth]).reshape(truth.shape)
    drawn = truth + rng.normal(0, 0.1, truth.shape).astype(np.float32)
    weight = rng.uniform(0.2, 3, (height, width)).astype(np.float32)
    weight[rng.uniform(size=weight.shape) < 0.3] = 0
    weight[0, 0] = 1
    return drawn, truth, weight


def run(drawn: F32, truth: F32, weight: F32) -> tuple[float, F32]:
    _, height, width = drawn.shape
    dissimilarity = Dissimilarity(width, height)
    v_drawn = np.full_like(drawn, np.nan)  # every value must be written
    total = dissimilarity.forward(drawn, truth, weight)
    dissimilarity.backward(1.0, v_drawn)
    return total, v_drawn


SIZES = [
    (1, 1), (1, 2), (2, 1), (3, 4), (6, 5), (11, 7),  # around and below the window
    (TILE_HEIGHT, TILE_WIDTH), (TILE_HEIGHT + 1, TILE_WIDTH + 1), (TILE_HEIGHT + 5, TILE_WIDTH + 6),
    (2 * TILE_HEIGHT + 3, 2 * TILE_WIDTH - 9),
]  # fmt: skip


@pytest.mark.parametrize(("height", "width"), SIZES)
def test_value_and_gradient_of_the_published_formula(height: int, width: int) -> None:
    from sags_node.engine.reference import losses as losses_reference

    drawn, truth, weight = pictures(height, width)
    total, v_drawn = run(drawn, truth, weight)

    def twin(drawn: Any, truth: Any) -> list[Any]:
        picture = torch.tensor(drawn, dtype=torch.float64, requires_grad=True)
        other, counted = torch.tensor(truth, dtype=torch.float64), torch.tensor(weight > 0)
        value = losses_reference.dissimilarity(picture, other, counted)
        (gradient,) = torch.autograd.grad(value, picture)
        return [value.item(), gradient.numpy()]

    inputs = {"drawn": drawn, "truth": truth}
    true, gradient = exact(twin, inputs, TILE_WIDTH, rough=(torch.nn.functional, "conv2d"))
    true.check(total)
    gradient.check(v_drawn)


def test_twin_by_finite_differences() -> None:
    from sags_node.engine.reference import losses as losses_reference

    drawn, truth, weight = (torch.tensor(array).double() for array in pictures(7, 13))
    drawn.requires_grad_(True)
    assert torch.autograd.gradcheck(lambda x: losses_reference.dissimilarity(x, truth, weight > 0), drawn)


def test_loss_and_metric_agree() -> None:
    drawn, truth, weight = pictures(70, 150)
    tissue: Bool = weight > 0
    total, _ = run(drawn, truth, weight)
    interleaved = (np.ascontiguousarray(picture.transpose(1, 2, 0)) for picture in (drawn, truth))
    similarity = metrics.ssim(*interleaved, tissue)
    assert 0.1 < similarity < 0.95
    assert 1 - total / (3 * tissue.sum()) == pytest.approx(similarity, abs=after(TILE_WIDTH))


def test_equal_pictures_are_at_rest() -> None:
    _, truth, weight = pictures(40, 140)
    total, v_drawn = run(truth, truth, weight)
    assert total == 0
    assert not v_drawn.any()


def test_what_does_not_count_may_hold_anything() -> None:
    drawn, truth, weight = pictures(40, 140)
    expected = run(drawn, truth, weight)
    drawn[:, weight == 0] = np.nan
    drawn[1, weight == 0] = np.inf
    total, v_drawn = run(drawn, truth, weight)
    assert total == expected[0]
    np.testing.assert_array_equal(v_drawn, expected[1])
    assert not v_drawn[:, weight == 0].any()
    total, v_drawn = run(drawn, truth, np.zeros_like(weight))
    assert total == 0
    assert not v_drawn.any()


def test_scale_multiplies_the_gradient() -> None:
    drawn, truth, weight = pictures(20, 30)
    _, v_drawn = run(drawn, truth, weight)
    dissimilarity = Dissimilarity(30, 20)
    dissimilarity.forward(drawn, truth, weight)
    scaled = np.empty_like(drawn)
    dissimilarity.backward(0.25, scaled)
    np.testing.assert_array_equal(scaled, 0.25 * v_drawn)


def test_same_bits_for_one_and_all_threads() -> None:
    inputs = pictures(100, 300)
    together = run(*inputs)
    alone = on_one_thread(lambda: run(*inputs))
    assert alone[0] == together[0]
    np.testing.assert_array_equal(alone[1], together[1])
