"""The training loss: its terms by plain loops over pixels, and its gradient by differences."""

import dataclasses
from typing import Any

import numpy as np
import pytest
import torch

from sags_node.field.losses import LossWeights, compare, dissimilarity
from sags_node.kernels.threads import configure_threads, thread_count
from sags_node.quality import metrics

HEIGHT, WIDTH = 17, 23
TERMS = [field.name for field in dataclasses.fields(LossWeights)]
OFF = LossWeights(color=0, inverse_depth=0, smoothness=0, depth_smoothness=0)
ALL = LossWeights(0.8, 0.2, 1e-3, 0.5, 0.03, 30.0, 0.02)


def frame(seed: int = 0) -> dict[str, Any]:
    """Planes of every coverage, and a frame to compare them with."""
    rng = np.random.default_rng(seed)
    size = (HEIGHT, WIDTH)
    coverage = rng.uniform(0.01, 1, size)
    depth = rng.uniform(0.05, 0.06, size)
    drawn = [*rng.uniform(0, 1, (3, *size)), depth + rng.normal(0, 1e-3, size), np.ones(size)]
    depth[rng.uniform(size=size) < 0.3] = 0
    return {
        "planes": torch.from_numpy(np.stack(drawn) * coverage),
        "image": rng.integers(0, 256, (*size, 3), np.uint8),
        "tissue": rng.uniform(size=size) < 0.7,
        "depth": depth.astype(np.float32),
        "unseen": rng.uniform(size=size) < 0.3,
    }


def test_the_four_terms_of_the_paper_and_coverage_by_hand() -> None:
    given = frame()
    planes, image, tissue, depth, unseen = (np.asarray(values) for values in given.values())
    A = planes[4]
    color, distance = planes[:3] / A, planes[3] / A
    off, apart, lacks, tv, depth_tv = [], [], [], 0.0, 0.0
    for y in range(HEIGHT):
        for x in range(WIDTH):
            if tissue[y, x]:
                lacks.append(max(0.0, 0.9 - A[y, x]))
                if A[y, x] > 0.05:
                    off.append(np.abs(color[:, y, x] - image[y, x] / 255).mean())
                if A[y, x] > 0.3 and depth[y, x] > 0:
                    apart.append(abs(1 / distance[y, x] - 1 / depth[y, x]))
            for v, u in ((y, x + 1), (y + 1, x)):
                if v == HEIGHT or u == WIDTH or not (unseen[y, x] or unseen[v, u]):
                    continue
                if min(A[y, x], A[v, u]) > 0.05:
                    tv += np.abs(color[:, y, x] - color[:, v, u]).sum()
                if min(A[y, x], A[v, u]) > 0.3:
                    depth_tv += abs(distance[y, x] - distance[v, u])
    pixels = HEIGHT * WIDTH
    expected = {
        "color": np.mean(off), "inverse_depth": np.mean(apart), "coverage": np.mean(lacks),
        "smoothness": tv / (3 * pixels), "depth_smoothness": depth_tv / pixels,
    }  # fmt: skip
    found = compare(**given, weights=ALL)
    for name, value in expected.items():
        assert float(found.terms[name]) == pytest.approx(float(value), rel=1e-6), name
    weighted = sum(getattr(ALL, name) * float(term) for name, term in found.terms.items())
    assert set(found.terms) == set(TERMS) and float(found.loss) == pytest.approx(weighted)
    np.testing.assert_allclose(found.weight, np.where(tissue & (A > 0.05), 1 / A, 0), rtol=1e-6)


@pytest.mark.parametrize("term", [*TERMS, "all"])
def test_gradients_against_differences(term: str) -> None:
    given = frame()
    weights = ALL if term == "all" else dataclasses.replace(OFF, **{term: getattr(ALL, term)})
    planes = given.pop("planes").requires_grad_()
    (gradient,) = torch.autograd.grad(compare(planes, **given, weights=weights).loss, planes)
    assert gradient.any()
    direction = torch.randn(planes.shape, generator=torch.Generator().manual_seed(0), dtype=planes.dtype)
    step = 1e-8  # kinks of absolute values are rarely as near
    above, below = (compare(planes + s * step * direction, **given, weights=weights).loss for s in (1, -1))
    slope = float(above - below) / (2 * step)
    assert slope == pytest.approx(float((gradient * direction).sum()), rel=1e-3)


def test_soft_differences_of_colours_by_hand_and_their_gradient() -> None:
    given = frame()
    off, softness = dataclasses.replace(OFF, color=1.0), 0.15
    planes = given.pop("planes").requires_grad_()
    found = compare(planes, **given, weights=off, softness=softness)
    used, A = given["tissue"] & (planes[4] > 0.05).numpy(), planes[4].detach().numpy()
    difference = (planes[:3].detach().numpy() / A - np.moveaxis(given["image"] / 255, 2, 0))[:, used]
    length = np.hypot(difference, softness)
    assert float(found.loss) == pytest.approx(float(np.mean(length - softness)), rel=1e-6)
    (gradient,) = torch.autograd.grad(found.loss, planes)
    expected = difference / length / A[used] / difference.size
    np.testing.assert_allclose(gradient[:3].numpy()[:, used], expected, rtol=1e-6)


def test_a_correlation_does_not_care_for_scale_and_offset() -> None:
    given = frame()
    weights = dataclasses.replace(OFF, correlation=1.0)
    known, A = given["depth"] > 0, given["planes"][4]
    inverse = np.where(known, 7 / np.where(known, given["depth"], 1) + 30, 1)
    given["planes"][3] = A * torch.from_numpy(1 / inverse)
    assert float(compare(**given, weights=weights).loss) == pytest.approx(0, abs=1e-6)
    given["planes"][3] = 0.05 * A  # flat: nothing to learn
    assert float(compare(**given, weights=weights).loss) == 0


def test_similarity_is_that_of_the_metric() -> None:
    rng = np.random.default_rng(0)
    truth = rng.uniform(0, 1, (3, 40, 50)).astype(np.float32)
    drawn = (truth + rng.normal(0, 0.1, truth.shape)).astype(np.float32)
    everywhere = np.ones((40, 50), np.bool_)
    found = dissimilarity(*map(torch.from_numpy, (drawn, truth, everywhere)))
    similarity = metrics.ssim(np.moveaxis(drawn, 0, 2), np.moveaxis(truth, 0, 2), everywhere)
    assert float(found) / truth.size == pytest.approx(1 - similarity, abs=1e-4)


@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize("plane", range(5))
def test_a_broken_pixel_stays_alone(plane: int, value: float) -> None:
    given = frame()
    given["tissue"][3, 4] = given["unseen"][3, 4] = False
    planes = given.pop("planes")
    planes[:, 3, 4] = 0
    expected = compare(planes, **given, weights=ALL)
    planes[plane, 3, 4] = value
    broken = planes.clone().requires_grad_()
    found = compare(broken, **given, weights=ALL)
    assert float(found.loss) == pytest.approx(float(expected.loss))
    (gradient,) = torch.autograd.grad(found.loss, broken)
    assert bool(gradient.isfinite().all()) and not gradient[:, 3, 4].any()


def test_a_depth_that_is_not_a_number_is_not_a_depth() -> None:
    given = frame()
    given["depth"][5] = np.nan
    found = compare(**given, weights=ALL)
    given["depth"][5] = 0
    assert float(found.loss) == pytest.approx(float(compare(**given, weights=ALL).loss))


def test_nothing_to_explain_is_no_loss() -> None:
    given = frame()
    given["tissue"][:] = given["unseen"][:] = False
    planes = given.pop("planes").requires_grad_()
    found = compare(planes, **given, weights=ALL)
    (gradient,) = torch.autograd.grad(found.loss, planes)
    assert float(found.loss) == pytest.approx(ALL.correlation * 0) and not gradient.any()


@pytest.mark.parametrize("softness", [0.0, 0.15])
@pytest.mark.parametrize("threads", [1, 2])
def test_the_kernels_find_what_torch_finds(softness: float, threads: int) -> None:
    weights = dataclasses.replace(ALL, correlation=0.0, similarity=0.0)
    given = frame()
    planes = given.pop("planes")
    planes[1, 3, 4], planes[4, 5, 5], planes[3, 7, 7], planes[:, 9, 9] = np.nan, np.inf, 0, 0
    given["depth"][2, 2], given["depth"][2, 3] = np.nan, np.inf
    loss, gradients = [], []
    before = thread_count()
    configure_threads(threads)
    for each in (planes.requires_grad_(), planes.detach().float().requires_grad_()):
        found = compare(each, **given, weights=weights, softness=softness)
        gradients += torch.autograd.grad(2 * found.loss, each)
        loss.append(found)
    configure_threads(before)
    by_torch, by_kernels = loss
    for name in by_torch.terms:
        assert float(by_kernels.terms[name]) == pytest.approx(float(by_torch.terms[name]), rel=1e-5), name
    assert float(by_kernels.loss) == pytest.approx(float(by_torch.loss.detach()), rel=1e-5)
    expected = gradients[0].float().numpy()
    np.testing.assert_allclose(gradients[1].numpy(), expected, rtol=2e-5, atol=2e-7 * np.abs(expected).max())
    np.testing.assert_allclose(by_kernels.weight, by_torch.weight, rtol=1e-6)
