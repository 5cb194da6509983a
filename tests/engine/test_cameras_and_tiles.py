"""Several cameras in one drawing, tiles that are left out, the median depth, and how the work is shared."""

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
CAMERAS = [LEFT, LEFT.moved_right(0.004), TURNED]
SHAPE = (len(CAMERAS), -(-HEIGHT // TILE_HEIGHT), -(-WIDTH // TILE_WIDTH))


def scene(count: int = 400) -> Gaussians:
    return with_view_dependence(random_gaussians(5, count, LEFT), 1)


def new_rasterizer(backend: str = "numba") -> Rasterizer:
    return make_rasterizer(backend, WIDTH, HEIGHT)


def copies(gradients: Gradients) -> dict[str, Any]:
    return {name: getattr(gradients, name).copy() for name in DERIVATIVES}


def some_tiles(seed: int) -> tuple[Bool, Bool]:
    """A fifth of the tiles [C, rows, columns], and their pixels [C, H, W]."""
    tiles = np.random.default_rng(seed).random(SHAPE) < 0.2
    return tiles, np.kron(tiles, np.ones((TILE_HEIGHT, TILE_WIDTH), bool))[:, :HEIGHT, :WIDTH]


# ---- cameras -----------------------------------------------------------------------------------------------


def test_cameras_together_draw_what_each_draws_alone() -> None:
    """Pictures to the bit. Gradients are added up in float32: to rounding."""
    gaussians = scene()
    v_planes, weight = cotangents(CAMERAS, 1)
    together = new_rasterizer()
    planes = together.forward(gaussians, CAMERAS)
    both = together.backward(v_planes, weight)
    sums: dict[str, Any] = dict.fromkeys(DERIVATIVES, 0.0)
    sizes = dict.fromkeys(DERIVATIVES, 0.0)
    for c, view in enumerate(CAMERAS):
        alone = new_rasterizer()
        np.testing.assert_array_equal(alone.forward(gaussians, [view])[0], planes[c])
        assert planes[c, 4].mean() > 0.3
        found = alone.backward(v_planes[c : c + 1], weight[c : c + 1])
        for name in DERIVATIVES:
            sums[name] = sums[name] + getattr(found, name).astype(np.float64)
            sizes[name] += float(np.linalg.norm(getattr(found, name)))
    for name in DERIVATIVES:
        error = np.linalg.norm(getattr(both, name) - sums[name])
        assert error <= after(2 * len(CAMERAS)) * sizes[name], name


def test_cameras_of_one_rasterizer_may_become_more_and_fewer() -> None:
    """And what is not drawn stays as it was: nothing is drawn in the later calls."""
    gaussians = scene()
    rasterizer = new_rasterizer()
    pictures = new_rasterizer().forward(gaussians, CAMERAS).copy()
    rasterizer.forward(gaussians, CAMERAS[:1])
    nothing = np.zeros(SHAPE, bool)
    grown = rasterizer.forward(gaussians, CAMERAS, nothing)
    np.testing.assert_array_equal(grown[0], pictures[0])
    assert not grown[1:].any()
    rasterizer.forward(gaussians, CAMERAS)
    shrunk = rasterizer.forward(gaussians, CAMERAS[:2], nothing[:2])
    np.testing.assert_array_equal(shrunk, pictures[:2])


# ---- tiles -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", [1, 2])
def test_active_tiles_are_those_of_the_whole_drawing(seed: int) -> None:
    gaussians, before = scene(), random_gaussians(9, 100, LEFT)
    tiles, drawn = some_tiles(seed)
    v_planes, weight = cotangents(CAMERAS, seed)
    whole = new_rasterizer()
    everything = whole.forward(gaussians, CAMERAS)
    inside = drawn[:, None]
    masked = np.where(inside, v_planes, 0), np.where(drawn, weight, 0)
    expected = whole.backward(*masked)
    part = new_rasterizer()
    old = part.forward(before, CAMERAS).copy()
    planes = part.forward(gaussians, CAMERAS, tiles)
    np.testing.assert_array_equal(planes, np.where(inside, everything, old))
    found = part.backward(v_planes, weight)
    for name in DERIVATIVES:
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name), err_msg=name)
    untouched = int((found.contribution == 0).sum())
    assert 10 < untouched < len(gaussians) - 10


def test_tiles_agree_with_the_twin() -> None:
    gaussians = scene(80)
    tiles, drawn = some_tiles(3)
    v_planes, weight = cotangents(CAMERAS, 0)
    rasterizer = new_rasterizer()
    rasterizer.forward(random_gaussians(9, 30, LEFT), CAMERAS)
    planes = rasterizer.forward(gaussians, CAMERAS, tiles).copy()
    asked = np.where(drawn[:, None], v_planes, 0), np.where(drawn, weight, 0)
    true = truth(gaussians, CAMERAS, given=asked)
    planes = np.where(drawn[:, None], planes, true.planes)  # elsewhere is what was there before
    true.check(planes, copies(rasterizer.backward(v_planes, weight)))


def test_without_active_tiles_nothing_happens() -> None:
    rasterizer = new_rasterizer()
    before = rasterizer.forward(scene(), CAMERAS).copy()
    after = rasterizer.forward(random_gaussians(9, 100, LEFT), CAMERAS, np.zeros(SHAPE, bool))
    np.testing.assert_array_equal(after, before)
    for name, found in copies(rasterizer.backward(*cotangents(CAMERAS, 0))).items():
        assert not found.any(), name


def test_pairs_are_made_for_active_tiles_only() -> None:
    rasterizer = new_rasterizer()
    backend: Any = rasterizer._backend  # type: ignore[attr-defined]  # only inside is seen what was not done
    rasterizer.forward(scene(), CAMERAS)
    everywhere = np.diff(backend._tile_starts)
    tiles = np.zeros(SHAPE, bool)
    tiles[1, 0, 2] = True
    rasterizer.forward(scene(), CAMERAS, tiles)
    np.testing.assert_array_equal(np.diff(backend._tile_starts), everywhere * tiles.ravel())
    drawn = backend._splats["extent"][: len(CAMERAS) * len(scene())] > 0
    assert drawn.sum() == everywhere[tiles.ravel()]  # one pair each


@pytest.mark.parametrize("backend", ["numba", "reference"])
def test_nothing_to_draw_for_several_cameras(backend: str) -> None:
    rasterizer = new_rasterizer(backend)
    nobody = random_gaussians(0, 0, LEFT)
    tiles, drawn = some_tiles(1)
    rasterizer.forward(scene(30), CAMERAS)
    planes = rasterizer.forward(nobody, CAMERAS, tiles)
    assert not planes[np.broadcast_to(drawn[:, None], planes.shape)].any()
    depths, rows = rasterizer.median()
    assert not depths[drawn].any()
    assert (rows[drawn] == -1).all()
    assert rasterizer.backward(*cotangents(CAMERAS, 0)).means.shape == (0, 3)


# ---- median ------------------------------------------------------------------------------------------------


def test_median_agrees_with_the_twin() -> None:
    """A pixel whose transmittance passes 1/2 by less than rounding may name the next Gaussian: transmittances
    are off by 1e-5 of themselves, so this is one pixel in 100,000."""
    gaussians = scene()
    results = []
    for backend in ("numba", "reference"):
        rasterizer = new_rasterizer(backend)
        rasterizer.forward(gaussians, CAMERAS)
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
        rasterizer.forward(two, [TURNED])
        depths, rows = rasterizer.median()
        assert rows[0, 38, 50] == row
        assert depths[0, 38, 50] == pytest.approx([0.05, 0.08][row], rel=after(8))


def test_median_leaves_the_other_tiles_alone() -> None:
    rasterizer = new_rasterizer()
    rasterizer.forward(scene(), CAMERAS)
    old_depths, old_rows = (array.copy() for array in rasterizer.median())
    tiles, drawn = some_tiles(4)
    others = random_gaussians(9, 300, LEFT)
    rasterizer.forward(others, CAMERAS, tiles)
    depths, rows = rasterizer.median()
    whole = new_rasterizer()
    whole.forward(others, CAMERAS)
    all_depths, all_rows = whole.median()
    np.testing.assert_array_equal(depths, np.where(drawn, all_depths, old_depths))
    np.testing.assert_array_equal(rows, np.where(drawn, all_rows, old_rows))


# ---- sharing the work --------------------------------------------------------------------------------------


def everything(tiles: Bool | None) -> list[Any]:
    rasterizer = new_rasterizer()
    planes = rasterizer.forward(scene(), CAMERAS, tiles).copy()
    return [planes, *rasterizer.median(), *copies(rasterizer.backward(*cotangents(CAMERAS, 0))).values()]


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
    planes = new_rasterizer().forward(gaussians, [LEFT]).copy()
    assert planes[0, 4].max() > 0.99
    true = new_rasterizer("reference").forward(gaussians, [LEFT])
    # a tile stops at a transmittance of 1e-4
    np.testing.assert_allclose(planes, true, rtol=0, atol=1e-4 + 2 * EXPONENTIAL)
    order = np.random.default_rng(5).permutation(2000)
    shuffled = Gaussians(
        *(
            getattr(gaussians, name)[order]
            for name in ("means", "quats", "scales", "opacities", "colors", "ids")
        )
    )
    np.testing.assert_array_equal(new_rasterizer().forward(shuffled, [LEFT]), planes)


def test_threads_with_rasterizers_of_their_own() -> None:
    """Four Python threads, other scenes, cameras, tiles and numbers of cores, at once."""
    cases: list[tuple[Gaussians, list[Camera], Bool | None]] = [
        (scene(300), CAMERAS, None),
        (random_gaussians(2, 500, LEFT), CAMERAS[:1], None),
        (scene(200), CAMERAS, some_tiles(1)[0]),
        (random_gaussians(4, 400, LEFT), CAMERAS[1:], None),
    ]

    def work(case: tuple[Gaussians, list[Camera], Bool | None]) -> tuple[F32, dict[str, Any]]:
        gaussians, views, tiles = case
        rasterizer = new_rasterizer()
        planes = rasterizer.forward(gaussians, views, tiles).copy()
        return planes, copies(rasterizer.backward(*cotangents(views, 0)))

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
    with pytest.raises(UsageError, match="takes one or several"):
        rasterizer.forward(gaussians, [])
    with pytest.raises(UsageError, match=r"tiles is bool \[1, 3, 7\], expected bool \[3, 3, 7\]"):
        rasterizer.forward(gaussians, CAMERAS, np.ones((1, *SHAPE[1:]), bool))
    with pytest.raises(UsageError, match="tiles is float64"):
        rasterizer.forward(gaussians, CAMERAS, np.ones(SHAPE))  # type: ignore[arg-type]  # that is the mistake
    rasterizer.forward(gaussians, CAMERAS)
    with pytest.raises(UsageError, match=r"weight has shape \[1, 77, 100\], expected \[3, 77, 100\]"):
        rasterizer.backward(cotangents(CAMERAS, 0)[0], cotangents(CAMERAS[:1], 0)[1])
