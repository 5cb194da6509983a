"""Tiles that are left out, the median depth, and how the work is shared."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from typing import Any

import numba
import numpy as np
import pytest
from engine_scenes import (
    DERIVATIVES,
    EXPONENTIAL,
    camera,
    cotangents,
    random_gaussians,
    truth,
    with_view_dependence,
)
from rounding import after

from sags_node import geometry
from sags_node.engine.rasterizer import cpu as numba_rasterizer
from sags_node.engine.rasterizer import projector
from sags_node.engine.rasterizer.rasterize import (
    TILE_HEIGHT,
    TILE_WIDTH,
    Gradients,
    Rasterizer,
    make_rasterizer,
)
from sags_node.errors import UsageError
from sags_node.kernels.jit import parallel_kernel, take
from sags_node.kernels.threads import configure_threads
from sags_node.types import F32, I64, Bool, Camera, Gaussians

WIDTH, HEIGHT = 100, 77  # no whole number of tiles
LEFT = camera(WIDTH, HEIGHT, focal=110.0, moved=True)
TURNED = camera(WIDTH, HEIGHT, focal=95.0)
SHAPE = (-(-HEIGHT // TILE_HEIGHT), -(-WIDTH // TILE_WIDTH))


def scene(count: int = 400) -> Gaussians:
    return with_view_dependence(random_gaussians(5, count, LEFT), 1)


def new_rasterizer(backend: str = "numba") -> Rasterizer:
    return make_rasterizer(backend, WIDTH, HEIGHT)


def copies(gradients: Gradients) -> dict[str, Any]:
    return {name: getattr(gradients, name).copy() for name in DERIVATIVES}


def some_tiles(seed: int) -> tuple[Bool, Bool]:
    """A fifth of the tiles [rows, columns], and their pixels [H, W]."""
    tiles = np.random.default_rng(seed).permutation(SHAPE[0] * SHAPE[1]).reshape(SHAPE) < 4
    return tiles, np.kron(tiles, np.ones((TILE_HEIGHT, TILE_WIDTH), bool))[:HEIGHT, :WIDTH]


# ---- tiles -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", [1, 2])
def test_active_tiles_are_those_of_the_whole_drawing(seed: int) -> None:
    gaussians, before = scene(), random_gaussians(9, 100, LEFT)
    tiles, drawn = some_tiles(seed)
    v_planes, weight = cotangents(LEFT, seed)
    whole = new_rasterizer()
    everything = whole.forward(gaussians, LEFT)
    expected = whole.backward(np.where(drawn, v_planes, 0), np.where(drawn, weight, 0))
    part = new_rasterizer()
    old = part.forward(before, LEFT).copy()
    planes = part.forward(gaussians, LEFT, tiles)
    np.testing.assert_array_equal(planes, np.where(drawn, everything, old))
    found = part.backward(v_planes, weight)
    for name in DERIVATIVES:
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name), err_msg=name)
    untouched = int((found.contribution == 0).sum())
    assert 10 < untouched < len(gaussians) - 10


def test_tiles_agree_with_the_twin() -> None:
    gaussians = scene(80)
    tiles, drawn = some_tiles(3)
    v_planes, weight = cotangents(LEFT, 0)
    rasterizer = new_rasterizer()
    rasterizer.forward(random_gaussians(9, 30, LEFT), LEFT)
    planes = rasterizer.forward(gaussians, LEFT, tiles).copy()
    asked = np.where(drawn, v_planes, 0), np.where(drawn, weight, 0)
    true = truth(gaussians, LEFT, given=asked)
    planes = np.where(drawn, planes, true.planes)  # elsewhere is what was there before
    true.check(planes, copies(rasterizer.backward(v_planes, weight)))


def test_without_active_tiles_nothing_happens() -> None:
    rasterizer = new_rasterizer()
    before = rasterizer.forward(scene(), LEFT).copy()
    after = rasterizer.forward(random_gaussians(9, 100, LEFT), LEFT, np.zeros(SHAPE, bool))
    np.testing.assert_array_equal(after, before)
    for name, found in copies(rasterizer.backward(*cotangents(LEFT, 0))).items():
        assert not found.any(), name


def test_pairs_are_made_for_active_tiles_only() -> None:
    rasterizer = new_rasterizer()
    backend: Any = rasterizer._backend  # type: ignore[attr-defined]  # only inside is seen what was not done
    rasterizer.forward(scene(), LEFT)
    everywhere = np.diff(backend._tile_starts)
    tiles = np.zeros(SHAPE, bool)
    tiles[0, 2] = True
    rasterizer.forward(scene(), LEFT, tiles)
    np.testing.assert_array_equal(np.diff(backend._tile_starts), everywhere * tiles.ravel())
    drawn = backend._splats["extent"][: len(scene())] > 0
    assert drawn.sum() == everywhere[tiles.ravel()]  # one pair each


@pytest.mark.parametrize("backend", ["numba", "reference"])
def test_nothing_to_draw_in_some_tiles(backend: str) -> None:
    rasterizer = new_rasterizer(backend)
    nobody = random_gaussians(0, 0, LEFT)
    tiles, drawn = some_tiles(1)
    rasterizer.forward(scene(30), LEFT)
    planes = rasterizer.forward(nobody, LEFT, tiles)
    assert not planes[:, drawn].any()
    depths, rows = rasterizer.median()
    assert not depths[drawn].any()
    assert (rows[drawn] == -1).all()
    assert rasterizer.backward(*cotangents(LEFT, 0)).means.shape == (0, 3)


# ---- median ------------------------------------------------------------------------------------------------


def test_median_agrees_with_the_twin() -> None:
    """A pixel whose transmittance passes 1/2 by less than rounding may name the next Gaussian: transmittances
    are off by 1e-5 of themselves, so this is one pixel in 100,000."""
    gaussians = scene()
    results = []
    for backend in ("numba", "reference"):
        rasterizer = new_rasterizer(backend)
        rasterizer.forward(gaussians, LEFT)
        results.append(rasterizer.median())
    (depths, rows), (true_depths, true_rows) = results
    assert 0.2 < (true_rows >= 0).mean() < 0.99
    assert np.count_nonzero(rows != true_rows) <= 2
    same = rows == true_rows
    np.testing.assert_allclose(depths[same], true_depths[same], rtol=after(8))
    assert not depths[rows < 0].any()


def test_median_is_the_surface_that_is_seen() -> None:
    """Behind a thin veil the wall, in front of it the veil if that is dense enough."""
    middle = geometry.unproject(TURNED, np.full((2, 2), [50.0, 38.0]), np.array([0.05, 0.08]))
    two = random_gaussians(0, 2, TURNED)
    two.means[:] = middle
    two.scales[:] = 0.01
    for veil, row in ((0.45, 1), (0.55, 0)):
        two.opacities[:] = [veil, 0.9]
        rasterizer = new_rasterizer()
        rasterizer.forward(two, TURNED)
        depths, rows = rasterizer.median()
        assert rows[38, 50] == row
        assert depths[38, 50] == pytest.approx([0.05, 0.08][row], rel=after(8))


def test_median_leaves_the_other_tiles_alone() -> None:
    rasterizer = new_rasterizer()
    rasterizer.forward(scene(), LEFT)
    old_depths, old_rows = (array.copy() for array in rasterizer.median())
    tiles, drawn = some_tiles(4)
    others = random_gaussians(9, 300, LEFT)
    rasterizer.forward(others, LEFT, tiles)
    depths, rows = rasterizer.median()
    whole = new_rasterizer()
    whole.forward(others, LEFT)
    all_depths, all_rows = whole.median()
    np.testing.assert_array_equal(depths, np.where(drawn, all_depths, old_depths))
    np.testing.assert_array_equal(rows, np.where(drawn, all_rows, old_rows))


# ---- sharing the work --------------------------------------------------------------------------------------


def everything(tiles: Bool | None) -> list[Any]:
    rasterizer = new_rasterizer()
    planes = rasterizer.forward(scene(), LEFT, tiles).copy()
    return [planes, *rasterizer.median(), *copies(rasterizer.backward(*cotangents(LEFT, 0))).values()]


@pytest.mark.parametrize("tiles", [None, some_tiles(2)[0]], ids=["all", "some"])
def test_same_bits_however_many_share_the_work(tiles: Bool | None, monkeypatch: pytest.MonkeyPatch) -> None:
    expected = everything(tiles)
    cores = numba.get_num_threads()
    numba.set_num_threads(1)
    try:
        found = [everything(tiles)]
    finally:
        numba.set_num_threads(cores)
    for pieces in (2, 7, 64):  # more workers than this machine may have cores
        for module in (numba_rasterizer, projector):
            monkeypatch.setattr(module, "thread_count", lambda pieces=pieces: pieces)
        found.append(everything(tiles))
    for results in found:
        for a, b in zip(results, expected, strict=True):
            np.testing.assert_array_equal(a, b)


@parallel_kernel
def _mark(next_item: I64, taken: I64, workers: int) -> None:
    for _ in numba.prange(workers):
        item = take(next_item, 1)
        while item < taken.size:
            taken[item] += 1
            item = take(next_item, 1)


def test_every_item_is_taken_once() -> None:
    taken, next_item = np.zeros(100_000, np.int64), np.zeros(1, np.int64)
    workers = 8
    _mark(next_item, taken, workers)
    assert (taken == 1).all()
    assert next_item[0] == taken.size + workers


def crowd(corner: Sequence[float]) -> Gaussians:
    """2000 Gaussians on a few pixels."""
    gaussians = random_gaussians(3, 2000, LEFT)
    rng = np.random.default_rng(4)
    pixels = np.asarray(corner) + rng.uniform(-3, 3, (2000, 2))
    gaussians.means[:] = geometry.unproject(LEFT, pixels, rng.uniform(0.05, 0.09, 2000))
    return gaussians


@pytest.mark.parametrize("corner", [(2.0, 2.0), (97.0, 74.0), (47.5, 31.5)])
def test_a_crowd_in_one_corner(corner: tuple[float, float]) -> None:
    """All pairs in one or four tiles; the storage order does not matter either."""
    gaussians = crowd(corner)
    planes = new_rasterizer().forward(gaussians, LEFT).copy()
    assert planes[4].max() > 0.99
    true = new_rasterizer("reference").forward(gaussians, LEFT)
    # a tile stops at a transmittance of 1e-4
    np.testing.assert_allclose(planes, true, rtol=0, atol=1e-4 + 2 * EXPONENTIAL)
    order = np.random.default_rng(5).permutation(2000)
    shuffled = Gaussians(
        *(
            getattr(gaussians, name)[order]
            for name in ("means", "quats", "scales", "opacities", "colors", "ids")
        )
    )
    np.testing.assert_array_equal(new_rasterizer().forward(shuffled, LEFT), planes)


def test_threads_with_rasterizers_of_their_own() -> None:
    """Four Python threads, other scenes, cameras, tiles and numbers of cores, at once."""
    cases: list[tuple[Gaussians, Camera, Bool | None]] = [
        (scene(300), LEFT, None),
        (random_gaussians(2, 500, LEFT), TURNED, None),
        (scene(200), LEFT, some_tiles(1)[0]),
        (random_gaussians(4, 400, LEFT), LEFT, None),
    ]

    def work(case: tuple[Gaussians, Camera, Bool | None]) -> tuple[F32, dict[str, Any]]:
        gaussians, view, tiles = case
        rasterizer = new_rasterizer()
        planes = rasterizer.forward(gaussians, view, tiles).copy()
        return planes, copies(rasterizer.backward(*cotangents(view, 0)))

    expected = [work(case) for case in cases]
    failures: list[BaseException] = []

    def repeat(index: int) -> None:
        try:
            configure_threads(1 + index % 2)
            for _ in range(10):
                planes, gradients = work(cases[index])
                np.testing.assert_array_equal(planes, expected[index][0])
                for name in DERIVATIVES:
                    np.testing.assert_array_equal(gradients[name], expected[index][1][name])
        except BaseException as error:  # carried to the test's own thread
            failures.append(error)

    threads = [threading.Thread(target=repeat, args=(index,)) for index in range(len(cases))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60)
    assert not any(thread.is_alive() for thread in threads)
    assert not failures, failures[0]


# ---- wrong use ---------------------------------------------------------------------------------------------


def test_wrong_use_is_explained() -> None:
    rasterizer = new_rasterizer()
    gaussians = scene(10)
    with pytest.raises(UsageError, match="call forward before median"):
        rasterizer.median()
    with pytest.raises(UsageError, match=r"tiles is bool \[7, 3\], expected bool \[3, 7\]"):
        rasterizer.forward(gaussians, LEFT, np.ones(SHAPE[::-1], bool))
    with pytest.raises(UsageError, match="tiles is float64"):
        rasterizer.forward(gaussians, LEFT, np.ones(SHAPE))  # type: ignore[arg-type]  # that is the mistake
    rasterizer.forward(gaussians, LEFT)
    with pytest.raises(UsageError, match=r"weight has shape \[100, 77\], expected \[77, 100\]"):
        rasterizer.backward(cotangents(LEFT, 0)[0], cotangents(LEFT, 0)[1].T)
