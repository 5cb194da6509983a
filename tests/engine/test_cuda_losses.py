"""The device's losses beyond what both engines' must do (`test_losses.py`, `test_photometric.py`): many
programs, the same bits again, the worst tiles; interpreted."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import test_photometric
import torch
from rounding import after
from test_photometric import ALL, TERMS

pytest.importorskip("triton", reason="Triton comes with torch's CUDA builds, or by `pip install triton`")

from device_losses import DEVICE, as_colors, photometric, tensors, unwritten

from sags_node.engine.cuda import photometric as photometric_loss
from sags_node.engine.cuda.photometric import PhotometricLoss
from sags_node.engine.cuda.ssim import Dissimilarity
from sags_node.engine.losses.tissue import COVERED
from sags_node.engine.rasterizer.rasterize import TILE_HEIGHT, TILE_WIDTH
from sags_node.mapping.cuda import focus
from sags_node.mapping.focus import EVERY, worst_tiles
from sags_node.types import F32, U8, Bool

# the kernels divide by a coverage of zero and select afterwards; a GPU says nothing of it
pytestmark = [
    pytest.mark.filterwarnings("ignore::RuntimeWarning"),
    pytest.mark.usefixtures("quick_interpreter"),
]

SMALL = 15, 37  # height and width: one tile of SSIM, and not quite two blocks of pixels


def test_photometric_loss_is_the_cpu_engines_over_many_programs(monkeypatch: pytest.MonkeyPatch) -> None:
    """More programs than sums are combined at a time, the last ones half full, and smoothness everywhere."""
    monkeypatch.setattr(photometric_loss, "PROGRAMS", 2)
    inputs = test_photometric.frame(50, 53) | {"unseen": None}
    weights = replace(ALL, similarity=0.0)
    everywhere = inputs | {"unseen": np.ones((50, 53), np.bool_)}
    true_terms = test_photometric.exact_terms(everywhere, True, TERMS)
    for loss in (photometric, test_photometric.on_cpu):
        terms, v_planes, weight = loss(inputs, weights)
        for name, true in true_terms.items():
            if getattr(weights, name) != 0:
                true.check(getattr(terms, name), name)
        test_photometric.check(everywhere, weights, True, TERMS, terms.total(weights), v_planes)
        counts = weight != 0
        np.testing.assert_allclose(weight[counts], 1 / inputs["planes"][4][counts], rtol=after(2))


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


def tile_scene() -> tuple[F32, U8, Bool]:
    """Tiles that are well drawn and badly, with holes and instruments; no tile divides the picture."""
    inputs = test_photometric.frame(3 * TILE_HEIGHT + 7, 5 * TILE_WIDTH + 3)
    return inputs["planes"], inputs["image"], inputs["tissue"]


def chosen(scene: tuple[F32, U8, Bool], share: float) -> Bool:
    given = [torch.tensor(as_colors(array), device=DEVICE) for array in scene]
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
