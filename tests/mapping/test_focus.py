"""Which tiles are worst, against numpy, and what may stand in the images."""

import itertools
from typing import Any

import numpy as np
import pytest
from engine_scenes import worst_tiles
from recorded_session import frames_of, fresh, opened

from sags_node.engine.losses.tissue import COVERED
from sags_node.engine.rasterizer.rasterize import TILE_HEIGHT, TILE_WIDTH
from sags_node.mapping import focus, refiner
from sags_node.mapping.budget import StepBudget
from sags_node.mapping.focus import EVERY, largest, with_neighbours
from sags_node.mapping.ladder import Rung
from sags_node.mapping.refiner import CpuRefiner
from sags_node.types import F32, U8, Bool

HEIGHT, WIDTH = 3 * TILE_HEIGHT + 7, 5 * TILE_WIDTH + 3  # no tile divides it
SHAPE = -(-HEIGHT // TILE_HEIGHT), -(-WIDTH // TILE_WIDTH)


@pytest.fixture
def scene() -> tuple[F32, U8, Bool]:
    """Planes that show the image well in some tiles and badly in others, with holes and instruments."""
    rng = np.random.default_rng(0)
    image = rng.integers(25, 231, (HEIGHT, WIDTH, 3), np.uint8)
    planes = np.empty((5, HEIGHT, WIDTH), np.float32)
    planes[4] = rng.uniform(0, 1, (HEIGHT, WIDTH))
    planes[3] = 0.08 * planes[4]
    badness = np.kron(rng.uniform(0, 0.3, SHAPE), np.ones((TILE_HEIGHT, TILE_WIDTH)))[:HEIGHT, :WIDTH]
    shown = np.moveaxis(image / 255, -1, 0) + badness * rng.normal(0, 1, (3, HEIGHT, WIDTH))
    planes[:3] = shown * planes[4]
    return planes, image, rng.random((HEIGHT, WIDTH)) > 0.3


def numpy_sums(planes: F32, image: U8, tissue: Bool) -> F32:
    """Squared residuals of every second pixel, added up by tile."""
    with np.errstate(all="ignore"):
        squares = np.square(planes[:3] / planes[4] - np.moveaxis(image / 255, -1, 0))
    counts = tissue & (planes[4] > COVERED) & (squares < 1)
    picture = np.where(counts, squares, 0).sum(0)
    sums = np.zeros(SHAPE, np.float32)
    for y in range(0, HEIGHT, EVERY):
        for x in range(0, WIDTH, EVERY):
            sums[y // TILE_HEIGHT, x // TILE_WIDTH] += picture[y, x]
    return sums


def test_the_kernel_its_source_and_numpy_agree(scene: tuple[F32, U8, Bool]) -> None:
    compiled, source = np.zeros((2, *SHAPE), np.float32)
    focus.sum_residuals(*scene, np.ones(SHAPE, np.bool_), compiled)
    focus.sum_residuals.py_func(*scene, np.ones(SHAPE, np.bool_), source)
    assert compiled.min() >= 0 and compiled.max() > 10
    assert np.allclose(compiled, source, rtol=1e-5)
    assert np.allclose(compiled, numpy_sums(*scene), rtol=1e-4)


@pytest.mark.parametrize("share", [0.0, 0.15, 0.5, 1.0])
def test_the_worst_are_chosen_and_no_more_than_asked_for(scene: tuple[F32, U8, Bool], share: float) -> None:
    tiles = worst_tiles(*scene, share)
    assert tiles.shape == SHAPE and tiles.dtype == np.bool_
    assert tiles.sum() == max(1, round(share * tiles.size))
    sums = numpy_sums(*scene)
    assert sums[tiles].min() >= sums[~tiles].max(initial=0.0)


@pytest.mark.parametrize(
    ("where", "value"),
    [*itertools.product(["colour", "everywhere"], [np.nan, np.inf, -np.inf]), ("colour", 1e30)],
)
def test_what_is_not_finite_chooses_no_tile(scene: tuple[F32, U8, Bool], where: str, value: float) -> None:
    """A damaged tile is not taken for the worst, and the worst are still found."""
    planes, image, tissue = scene
    tissue[:] = True
    planes[:3] = np.moveaxis(image / 255, -1, 0) * planes[4]
    bad, damaged = np.s_[TILE_HEIGHT : 2 * TILE_HEIGHT, : 2 * TILE_WIDTH], np.s_[:TILE_HEIGHT, -TILE_WIDTH:]
    planes[0][bad] += 0.3 * planes[4][bad]
    planes[:3][:, *damaged] = value
    if where == "everywhere":
        planes[4][damaged] = value
    tiles = worst_tiles(planes, image, tissue, 2 / (SHAPE[0] * SHAPE[1]))
    assert np.argwhere(tiles).tolist() == [[1, 0], [1, 1]]


def test_a_picture_without_tissue_still_names_tiles(scene: tuple[F32, U8, Bool]) -> None:
    planes, image, _ = scene
    assert worst_tiles(planes, image, np.zeros((HEIGHT, WIDTH), bool), 0.2).sum() == round(
        0.2 * SHAPE[0] * SHAPE[1]
    )


@pytest.mark.parametrize("place", [(3, 4), (0, 0), (6, 8), (0, 8)])
def test_neighbours_are_all_around_and_stay_inside(place: tuple[int, int]) -> None:
    tiles = np.zeros((7, 9), bool)
    tiles[place] = True
    grown = with_neighbours(tiles)
    y, x = np.indices((7, 9))
    touching = np.maximum(abs(y - place[0]), abs(x - place[1])) <= 1
    assert tiles.sum() == 1 and grown.shape == tiles.shape and grown.dtype == np.bool_
    assert grown[touching].all()
    reach = np.argwhere(grown)
    assert (reach.max(0) - reach.min(0) <= [2, 4]).all()  # tiles are twice as high as wide


def test_the_worst_tiles_are_those_of_what_was_drawn_last(monkeypatch: pytest.MonkeyPatch) -> None:
    """Tiles that were not drawn again are not looked at again: nothing in them has changed."""
    compared, begin = [], CpuRefiner.begin

    def noted(one: CpuRefiner, *given: Any) -> None:
        begin(one, *given)
        seen = given[2]

        def compare(residuals: F32, share: float) -> Bool:
            compared.append(largest(residuals, share))
            expected = worst_tiles(one.planes(), seen.image, seen.tissue, share)
            np.testing.assert_array_equal(compared[-1], expected)
            return compared[-1]

        monkeypatch.setattr(refiner, "largest", compare)

    monkeypatch.setattr(CpuRefiner, "begin", noted)
    pipeline = fresh("mapping.max_gaussians:=4000")
    for frame in frames_of(opened("source.frames:=4")):
        pipeline.process(frame, StepBudget(3, Rung(4000, redraw=0.4)))
    assert len(compared) == 3 * 3  # two steps on what is worst, and what is shown; not in the first frame
