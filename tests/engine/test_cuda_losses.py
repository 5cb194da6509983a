"""The device's losses, interpreted, against the CPU engine's and against autograd of what both state."""

from __future__ import annotations

from dataclasses import astuple, replace
from typing import Any

import numpy as np
import pytest
import test_losses
import test_photometric
import torch
from rounding import after, exact
from test_photometric import ALL, OFF, TERMS

pytest.importorskip("triton", reason="Triton comes with torch's CUDA builds, or by `pip install triton`")

from sags_node.engine.cuda import losses
from sags_node.engine.cuda import photometric as photometric_loss
from sags_node.engine.cuda.backend import default_device
from sags_node.engine.cuda.photometric import PhotometricLoss
from sags_node.engine.cuda.ssim import Dissimilarity
from sags_node.engine.losses.photometric import LossTerms, LossWeights
from sags_node.engine.losses.pieces import PIECE
from sags_node.engine.losses.tissue import COVERED
from sags_node.engine.rasterizer.rasterize import TILE_HEIGHT, TILE_WIDTH
from sags_node.mapping.cuda import focus
from sags_node.mapping.focus import EVERY, worst_tiles
from sags_node.types import F32, Bool

# the kernels divide by a coverage of zero and select afterwards; a GPU says nothing of it
pytestmark = [
    pytest.mark.filterwarnings("ignore::RuntimeWarning"),
    pytest.mark.usefixtures("quick_interpreter"),
]

DEVICE = default_device()
SMALL = 15, 37  # height and width: one tile of SSIM, and not quite two blocks of pixels


def tensors(inputs: dict[str, Any]) -> dict[str, Any]:
    return {
        name: None if array is None else torch.tensor(array, device=DEVICE) for name, array in inputs.items()
    }


def unwritten(inputs: dict[str, Any]) -> dict[str, Any]:
    """Room for the results; every value must be written."""
    height, width = inputs["tissue"].shape
    return {
        "v_planes": torch.full((5, height, width), torch.nan, device=DEVICE),
        "weight": torch.full((height, width), torch.nan, device=DEVICE),
    }


def tissue_loss(inputs: dict[str, Any], **options: float) -> tuple[float, F32, F32]:
    written = unwritten(inputs)
    scales = {"depth_weight": test_losses.DEPTH_WEIGHT, "depth_scale": test_losses.DEPTH_SCALE}
    mean = losses.tissue_loss(**tensors(inputs), **written, **scales, **options)
    return mean.item(), written["v_planes"].cpu().numpy(), written["weight"].cpu().numpy()


def photometric(
    inputs: dict[str, Any], weights: LossWeights, normalised: bool = True
) -> tuple[LossTerms, F32, F32]:
    height, width = inputs["tissue"].shape
    loss = PhotometricLoss(width, height, weights, DEVICE, normalised)
    written = unwritten(inputs)
    loss.evaluate(**tensors(inputs), **written)
    return loss.terms(), written["v_planes"].cpu().numpy(), written["weight"].cpu().numpy()


def test_tissue_loss_is_the_cpu_engines() -> None:
    inputs = test_losses.frame()
    expected, v_expected, expected_weight = test_losses.run(inputs)
    mean, v_planes, weight = tissue_loss(inputs)
    assert mean == pytest.approx(expected, rel=2 * after(3 * PIECE))
    for plane, true in enumerate(exact(test_losses.twin, inputs)):
        true.check(v_planes[plane], plane)
        true.check(v_expected[plane], plane)
    np.testing.assert_allclose(weight, expected_weight, rtol=after(2))


@pytest.mark.parametrize("where", ["image", "depth", 0, 3, 4])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_tissue_loss_leaves_broken_pixels_out(where: str | int, value: float) -> None:
    inputs = test_losses.frame()
    inputs["tissue"][4, 5] = True
    (inputs["planes"][where] if isinstance(where, int) else inputs[where])[4, 5] = value
    expected, v_expected, expected_weight = test_losses.run(inputs)
    mean, v_planes, weight = tissue_loss(inputs)
    assert mean == pytest.approx(expected, rel=2 * after(3 * PIECE))
    for plane, true in enumerate(exact(test_losses.twin, test_losses.frame())):
        np.testing.assert_allclose(v_planes[plane], v_expected[plane], rtol=0, atol=2 * true.within)
    np.testing.assert_allclose(weight, expected_weight, rtol=after(2))


@pytest.mark.parametrize(("height", "width"), [(1, 1), (1, losses.BLOCK), (losses.BLOCK + 1, 1)])
def test_tissue_loss_of_every_size(height: int, width: int) -> None:
    rng = np.random.default_rng(1)
    inputs = {
        "planes": rng.uniform(0.1, 1, (5, height, width)).astype(np.float32),
        "image": rng.uniform(0, 1, (height, width, 3)).astype(np.float32),
        "tissue": np.ones((height, width), np.bool_),
        "depth": rng.uniform(0.5, 2, (height, width)).astype(np.float32),
    }
    v_expected, expected_weight = (
        np.empty((5, height, width), np.float32),
        np.empty((height, width), np.float32),
    )
    scales = {"depth_weight": test_losses.DEPTH_WEIGHT, "depth_scale": test_losses.DEPTH_SCALE}
    expected = test_losses.tissue_loss(**inputs, v_planes=v_expected, weight=expected_weight, **scales)
    mean, v_planes, _ = tissue_loss(inputs)
    assert mean == pytest.approx(expected, rel=2 * after(3 * PIECE))
    for plane, true in enumerate(exact(test_losses.twin, inputs)):
        true.check(v_planes[plane], plane)
        true.check(v_expected[plane], plane)


def test_no_tissue_no_loss() -> None:
    nothing = {"tissue": np.zeros(SMALL, np.bool_), "unseen": np.zeros(SMALL, np.bool_)}
    inputs = test_photometric.frame(*SMALL) | nothing
    for terms, v_planes, weight in (
        tissue_loss({name: array for name, array in inputs.items() if name != "unseen"}),
        photometric(inputs, ALL),
    ):
        assert not np.any(terms if isinstance(terms, float) else astuple(terms))
        assert not v_planes.any()
        assert not weight.any()


@pytest.mark.parametrize("normalised", [True, False])
def test_photometric_loss_is_the_stated_one(normalised: bool) -> None:
    """All terms together, each heavy enough to be seen in the gradient."""
    inputs = test_photometric.frame(*SMALL)
    terms, v_planes, _ = photometric(inputs, ALL, normalised)
    for name, true in test_photometric.exact_terms(inputs, normalised, TERMS).items():
        true.check(getattr(terms, name), name)
    test_photometric.check(inputs, ALL, normalised, TERMS, terms.total(ALL), v_planes)


@pytest.mark.parametrize("name", TERMS)
def test_gradient_of_each_term(name: str) -> None:
    inputs = test_photometric.frame(*SMALL)
    weights = replace(OFF, **{name: 1.0})
    terms, v_planes, _ = photometric(inputs, weights)
    test_photometric.check(inputs, weights, True, [name], getattr(terms, name), v_planes)


def test_photometric_loss_is_the_cpu_engines_over_many_programs(monkeypatch: pytest.MonkeyPatch) -> None:
    """More programs than sums are combined at a time, the last ones half full, and smoothness everywhere."""
    monkeypatch.setattr(photometric_loss, "PROGRAMS", 2)
    inputs = test_photometric.frame(50, 53) | {"unseen": None}
    weights = replace(ALL, similarity=0.0)
    everywhere = inputs | {"unseen": np.ones((50, 53), np.bool_)}
    true_terms = test_photometric.exact_terms(everywhere, True, TERMS)
    for loss in (photometric, test_photometric.run):
        terms, v_planes, weight = loss(inputs, weights)
        for name, true in true_terms.items():
            if getattr(weights, name) != 0:
                true.check(getattr(terms, name), name)
        test_photometric.check(everywhere, weights, True, TERMS, terms.total(weights), v_planes)
        counts = weight != 0
        np.testing.assert_allclose(weight[counts], 1 / inputs["planes"][4][counts], rtol=after(2))


@pytest.mark.parametrize(
    ("where", "value"),
    [("image", np.nan), ("depth", np.inf), (1, np.nan), (2, 1e6), (3, np.inf), (4, np.nan), (4, np.inf)],
)
def test_photometric_loss_leaves_broken_pixels_out(where: str | int, value: float) -> None:
    inputs = test_photometric.frame(9, 13)
    inputs["tissue"][4, 5] = inputs["unseen"][4, 5] = True
    (inputs["planes"][where] if isinstance(where, int) else inputs[where])[4, 5] = value
    expected, v_expected, expected_weight = test_photometric.run(inputs, ALL)
    terms, v_planes, weight = photometric(inputs, ALL)
    clean = test_photometric.frame(9, 13)
    for name, true in test_photometric.exact_terms(clean, True, TERMS).items():
        assert getattr(terms, name) == pytest.approx(getattr(expected, name), abs=2 * true.within), name
    for plane, true in enumerate(test_photometric.exact_gradients(clean, ALL, True, TERMS)[1:]):
        assert np.linalg.norm(v_planes[plane] - v_expected[plane]) <= 2 * true.within, plane
    np.testing.assert_allclose(weight, expected_weight, rtol=after(2))


@pytest.mark.parametrize(("height", "width"), [(1, 1), (1, 2), (2, 1), (3, 70), (17, 4)])
def test_photometric_loss_of_every_size(height: int, width: int) -> None:
    """Pictures smaller than the window of SSIM are mirrored more than once."""
    inputs = test_photometric.frame(height, width)
    inputs["tissue"][:] = True
    inputs["planes"][4] += np.float32(0.5)
    weights = replace(ALL, correlation=0.0)  # of one pixel, or two, there is none
    names = [name for name in TERMS if name != "correlation"]
    true_terms = test_photometric.exact_terms(inputs, True, names)
    for loss in (photometric, test_photometric.run):
        terms, v_planes, _ = loss(inputs, weights)
        for name, true in true_terms.items():
            true.check(getattr(terms, name), name)
        test_photometric.check(inputs, weights, True, names, terms.total(weights), v_planes)


def test_losses_give_the_same_bits_again() -> None:
    """Also where memory of an earlier frame lies in the buffers."""
    height, width = SMALL
    loss = PhotometricLoss(width, height, ALL, DEVICE)
    found = []
    for seed in (1, 2, 1):
        inputs = test_photometric.frame(height, width, seed)
        written = unwritten(inputs)
        loss.evaluate(**tensors(inputs), **written)
        found.append((loss.terms(), written["v_planes"]))
    assert found[0][0] == found[2][0] != found[1][0]
    assert torch.equal(found[0][1], found[2][1])


def test_equal_pictures_are_similar_without_a_gradient() -> None:
    picture = torch.rand((3, *SMALL), generator=torch.Generator().manual_seed(0)).to(DEVICE)
    dissimilarity = Dissimilarity(SMALL[1], SMALL[0], DEVICE)
    assert dissimilarity.forward(picture, picture.clone(), torch.ones(SMALL, device=DEVICE)).item() == 0
    v_picture = torch.full_like(picture, torch.nan)
    dissimilarity.backward(torch.ones((), device=DEVICE), v_picture)
    assert not v_picture.any()


def tile_scene() -> tuple[F32, F32, Bool]:
    """Tiles that are well drawn and badly, with holes and instruments; no tile divides the picture."""
    inputs = test_photometric.frame(3 * TILE_HEIGHT + 7, 5 * TILE_WIDTH + 3)
    return inputs["planes"], inputs["image"], inputs["tissue"]


def chosen(scene: tuple[F32, F32, Bool], share: float) -> Bool:
    given = [torch.tensor(array, device=DEVICE) for array in scene]
    tiles = focus.worst_tiles(*given, share, every=EVERY, least_coverage=float(COVERED))
    found: Bool = tiles.cpu().numpy()
    return found


@pytest.mark.parametrize("share", [0.0, 0.15, 1.0])
def test_worst_tiles_are_the_mappers(share: float) -> None:
    scene = tile_scene()
    np.testing.assert_array_equal(chosen(scene, share), worst_tiles(*scene, share))


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e30])
def test_what_is_not_finite_chooses_no_tile(value: float) -> None:
    scene = tile_scene()
    scene[2][:] = True
    scene[0][:3, :TILE_HEIGHT, :TILE_WIDTH] = value
    tiles = chosen(scene, 0.9)
    np.testing.assert_array_equal(tiles, worst_tiles(*scene, 0.9))
    assert not tiles[0, 0]
