"""The CPU's rasteriser beyond what all must do (`test_rasterizer.py`): spherical harmonics by their
definition, views, threads and wrong use."""

import dataclasses
import math
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any

import cv2
import numpy as np
import pytest
from engine_scenes import (
    DERIVATIVES,
    EXPONENTIAL,
    camera,
    cotangents,
    on_one_thread,
    one_gaussian,
    random_gaussians,
    rasterize,
    rows,
    with_filter,
    with_view_dependence,
)
from numpy.typing import NDArray
from rounding import after

from benchmarks.kernels import reference
from sags_node import geometry
from sags_node.engine.rasterizer import cpu
from sags_node.engine.rasterizer import spherical_harmonics as harmonics
from sags_node.engine.rasterizer.rasterize import TILE_HEIGHT, TILE_WIDTH, make_rasterizer, to_view
from sags_node.engine.rasterizer.views import colours_of
from sags_node.errors import UsageError
from sags_node.kernels.jit import read_only
from sags_node.kernels.threads import configure_threads, leave_a_core, thread_count
from sags_node.types import F32, F64, Bool, Camera, Colours, Gaussians

WIDE = camera(100, 77, focal=110.0, moved=True)  # no whole number of tiles
TURNED = camera(100, 77, focal=95.0)
SHAPE = (-(-77 // TILE_HEIGHT), -(-100 // TILE_WIDTH))
SOME = np.random.default_rng(2).permutation(SHAPE[0] * SHAPE[1]).reshape(SHAPE) < 4  # of the tiles


def scene(count: int = 400) -> Gaussians:
    return with_filter(with_view_dependence(random_gaussians(5, count, WIDE), 3))


def everything(gaussians: Gaussians, view: Camera, tiles: Bool | None) -> list[Any]:
    """Planes, medians and gradients, of a fresh rasteriser."""
    rasterizer = make_rasterizer("numba", view.width, view.height)
    planes = rasterizer.forward(gaussians, view, tiles).copy()
    gradients = rasterizer.backward(*cotangents(view, 0))
    return [planes, *rasterizer.median(), *(getattr(gradients, name).copy() for name in DERIVATIVES)]


def assert_same_bits(found: list[Any], expected: list[Any]) -> None:
    for a, b in zip(found, expected, strict=True):
        np.testing.assert_array_equal(a, b)


def basis(directions: F64) -> NDArray[np.float32]:
    """Y_1 to Y_15 [M, 15] as the kernel has them."""
    means = directions.astype(np.float32)
    black, found = np.zeros_like(means), []
    for k in range(15):
        sh_rest, seen = np.zeros((len(means), 15, 3), np.float32), np.empty_like(means)
        sh_rest[:, k] = 1
        harmonics.color(*map(read_only, (means, black, sh_rest)), (np.float32(0),) * 3, seen)
        found.append(seen[:, 0])
    return np.stack(found, 1)


def test_basis_has_the_order_and_the_signs_of_3d_gaussian_splatting() -> None:
    """Degree by degree, order from -l to l, with the Condon-Shortley phase, orthonormal on the sphere:
    Legendre's polynomials."""
    rng = np.random.default_rng(2)
    directions = rng.normal(size=(50, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    x, y, z = directions.T
    angle, flat = np.arctan2(y, x), np.hypot(x, y)
    expected = []
    for degree in (1, 2, 3):
        for order in range(-degree, degree + 1):
            m = abs(order)
            legendre = np.polynomial.Legendre.basis(degree)
            height = legendre.deriv(m)(z) if m else legendre(z)
            share = math.factorial(degree - m) / math.factorial(degree + m)
            scale = (-1) ** m * math.sqrt((2 - (m == 0)) * (2 * degree + 1) / (4 * math.pi) * share)
            turn = np.sin(m * angle) if order < 0 else np.cos(m * angle)
            expected.append(scale * flat**m * height * turn)
    np.testing.assert_allclose(basis(directions), np.stack(expected, 1), atol=1.8 * after(12))


def test_direction_runs_from_the_camera_to_the_gaussian_in_the_world() -> None:
    """One Gaussian with a green that grows along the world's z, seen from both sides."""
    sh_rest = np.zeros((1, 3, 3), np.float32)
    sh_rest[0, 1, 1] = 0.3
    gaussians = dataclasses.replace(one_gaussian(np.array([0, 0, 0.07]), 0.002), sh_rest=sh_rest)
    behind = np.diag([-1.0, 1.0, -1.0, 1.0])
    behind[2, 3] = 0.14
    for T, side in [(np.eye(4), 1), (behind, -1)]:
        view = Camera(41, 41, np.array([[60.0, 0, 20], [0, 60, 20], [0, 0, 1]]), T)
        seen = rasterize(gaussians, view).rgb[20, 20]
        green = 0.5 + side * 0.3 * math.sqrt(3 / (4 * math.pi))
        np.testing.assert_allclose(seen, 255 * np.array([0.8, green, 0.2]), atol=0.51)


@pytest.mark.parametrize("corner", [(2.0, 2.0), (47.5, 31.5)])
def test_a_crowd_in_one_corner(corner: tuple[float, float]) -> None:
    """2000 Gaussians on a few pixels, all pairs in one or four tiles; the storage order does not matter
    either."""
    gaussians = random_gaussians(3, 2000, WIDE)
    rng = np.random.default_rng(4)
    pixels = corner + rng.uniform(-3, 3, (2000, 2))
    gaussians.means[:] = geometry.unproject(WIDE, pixels, rng.uniform(0.05, 0.09, 2000))
    planes = make_rasterizer("numba", 100, 77).forward(gaussians, WIDE).copy()
    assert planes[4].max() > 0.99
    true = reference.ReferenceRasterizer().forward(gaussians, WIDE)
    # a tile stops at a transmittance of 1e-4
    np.testing.assert_allclose(planes, true, rtol=0, atol=1e-4 + 2 * EXPONENTIAL)
    shuffled = rows(gaussians, np.random.default_rng(5).permutation(2000))
    np.testing.assert_array_equal(make_rasterizer("numba", 100, 77).forward(shuffled, WIDE), planes)


# ---- views ------------------------------------------------------------------------------------------------


def test_view_is_normalised_by_coverage() -> None:
    view = camera(width=4, height=3)
    planes = np.zeros((5, 3, 4), np.float32)
    planes[:, 0, 0] = [0.3, 0.15, 0.9, 0.03, 0.6]
    planes[:, 1, 1] = [0.075, 0.075, 0.075, 0.01, 0.3]  # too thin for a depth
    planes[:, 2, 2] = [1e-5, 1e-5, 1e-5, 1e-6, 1e-4]  # nothing there
    drawn = to_view(planes, view, 5, 6)
    assert drawn.rgb[0, 0].tolist() == [128, 64, 255]
    assert drawn.depth[0, 0] == pytest.approx(0.05, rel=after(4))
    assert drawn.rgb[1, 1].tolist() == [64, 64, 64] and drawn.depth[1, 1] == 0
    assert not drawn.rgb[2, 2].any() and drawn.alpha[2, 2] == np.float32(1e-4)
    assert (drawn.frame_id, drawn.t_capture_ns) == (5, 6)


def test_a_pixel_between_gaussians_has_its_own_depth_where_all_beside_it_have_one() -> None:
    planes = np.zeros((5, 6, 9), np.float32)
    planes[3], planes[4] = 0.05 * 0.8, 0.8
    planes[3:, 1, 1] = [0.06 * 0.2, 0.2]  # faint, and alone
    planes[3:, 1, 3:5] = [[0.05 * 0.2], [0.2]]  # two beside each other: a hole
    planes[3:, 3, 6] = 0  # nothing was drawn there
    planes[3:, 4, 0] = [0.05 * 0.2, 0.2]  # at the border: nobody knows what lies beyond
    holes = np.zeros((6, 9), bool)
    holes[1, 3:5] = holes[3, 6] = holes[4, 0] = True
    depth = to_view(planes, camera(width=9, height=6), 0, 0).depth
    assert np.array_equal(depth == 0, holes)
    assert depth[1, 1] == pytest.approx(0.06, rel=after(4))
    assert depth[0] == pytest.approx(0.05, rel=after(4))


WIDTH, HEIGHT = 96, 64


def waves() -> F32:
    """[H, W, 3] 0..255: a wave of 8 px along each axis, one for each channel."""
    v, u = np.indices((HEIGHT, WIDTH))
    phase = np.stack([u, v, u + v], -1) * (2 * np.pi / 8)
    return (127.5 + 100 * np.cos(phase)).astype(np.float32)


def test_what_is_enlarged_shows_the_middles_of_what_was_averaged() -> None:
    """Where two are averaged along each axis, a wave of 8 px keeps cos(pi / 8) of its height: 7.6 % are lost
    for each axis that it runs along. Taking out what the second difference says leaves less than half."""
    picture = waves()
    means = picture.reshape(HEIGHT // 2, 2, WIDTH // 2, 2, 3).mean((1, 3))
    small = np.rint(means).astype(np.uint8)
    whole = Colours(small, WIDTH, HEIGHT).whole.astype(np.float32)
    blurred = cv2.resize(small, (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC).astype(np.float32)
    inside = np.s_[8:-8, 8:-8]
    error, before = (np.sqrt(np.mean(np.square(each - picture)[inside])) for each in (whole, blurred))
    assert error < 0.5 * before


@pytest.mark.parametrize("scale", [1, 0.75, 0.5])
def test_few_pixels_are_the_same_whether_somebody_asked_for_all(scale: float) -> None:
    size = round(scale * WIDTH), round(scale * HEIGHT)
    small = cv2.resize(waves(), size, interpolation=cv2.INTER_AREA).astype(np.uint8)
    colours = Colours(small, WIDTH, HEIGHT)
    few = colours.every(8)
    assert few.shape == (HEIGHT // 8, WIDTH // 8, 3)
    enlarged = cv2.resize(small, (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC)
    assert np.abs(few.astype(int) - enlarged[::8, ::8]).max() <= 2  # another rounding of the weights
    assert colours.whole.shape == (HEIGHT, WIDTH, 3)
    assert np.array_equal(colours.every(8), few)


def test_a_view_has_its_own_memory() -> None:
    """Planes are overwritten by the next drawing, before somebody asks for the colours of this one."""
    planes = np.empty((5, HEIGHT // 2, WIDTH // 2), np.float32)
    planes[:] = np.array([0.4, 0.2, 0.6, 0.05, 0.8])[:, None, None]
    view = to_view(planes, camera(WIDTH, HEIGHT), 0, 0)
    expected = colours_of(planes)
    planes[:] = 0
    assert view.rgb is view.rgb  # enlarged once
    assert np.abs(view.rgb - 255 * expected[0, 0]).max() <= 0.5 + 1e-3  # rounded
    assert view.depth.min() == view.depth.max() == pytest.approx(0.0625)


def test_what_several_ask_for_at_once_is_enlarged_once(monkeypatch: pytest.MonkeyPatch) -> None:
    calls, resize = [], cv2.resize

    def slow(*args: Any, **named: Any) -> Any:
        calls.append(time.sleep(0.1))  # long enough for the others to come meanwhile
        return resize(*args, **named)

    view = to_view(np.ones((5, HEIGHT // 2, WIDTH // 2), np.float32), camera(WIDTH, HEIGHT), 0, 0)
    monkeypatch.setattr(cv2, "resize", slow)
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(lambda _: view.rgb, range(4), timeout=60))
    assert len(calls) == 1 and all(each is found[0] for each in found)


# ---- sharing the work --------------------------------------------------------------------------------------


@pytest.mark.parametrize("tiles", [None, SOME], ids=["all", "some"])
def test_same_bits_however_many_share_the_work(tiles: Bool | None, monkeypatch: pytest.MonkeyPatch) -> None:
    expected = everything(scene(), WIDE, tiles)
    assert_same_bits(on_one_thread(lambda: everything(scene(), WIDE, tiles)), expected)
    for pieces in (2, 3, 7, 64):  # more workers than this machine may have cores
        monkeypatch.setattr(cpu, "thread_count", lambda pieces=pieces: pieces)
        assert_same_bits(everything(scene(), WIDE, tiles), expected)


def test_threads_with_rasterizers_of_their_own() -> None:
    """Four Python threads, other scenes, cameras, tiles and numbers of cores, at once."""
    cases: list[tuple[Gaussians, Camera, Bool | None]] = [
        (scene(300), WIDE, None),
        (random_gaussians(2, 500, WIDE), TURNED, None),
        (scene(200), WIDE, SOME),
        (random_gaussians(4, 400, WIDE), WIDE, None),
    ]
    expected = [everything(*case) for case in cases]

    def repeat(index: int) -> None:
        configure_threads(1 + index % 2)
        for _ in range(10):
            assert_same_bits(everything(*cases[index]), expected[index])

    with ThreadPoolExecutor(len(cases)) as pool:
        list(pool.map(repeat, range(len(cases)), timeout=60))


def test_beside_others_one_core_is_left_for_kernels_and_for_opencv() -> None:
    every, of_opencv = configure_threads(None), cv2.getNumThreads()
    try:
        leave_a_core(None)
        assert thread_count() == cv2.getNumThreads() == max(1, every - 1)
        leave_a_core(every)
        assert thread_count() == cv2.getNumThreads() == every
    finally:
        configure_threads(None)
        cv2.setNumThreads(of_opencv)


# ---- wrong use ---------------------------------------------------------------------------------------------


def test_wrong_input_is_explained() -> None:
    gaussians = scene(5)
    v_planes, weight = cotangents(WIDE, 0)
    fresh, drawn = (make_rasterizer("numba", 100, 77) for _ in range(2))
    drawn.forward(gaussians, WIDE)
    tiles = np.ones(SHAPE)
    nowhere = Camera(100, 77, WIDE.K, np.full((4, 4), np.nan))
    spoilt: list[tuple[dict[str, Any], str]] = [
        ({"quats": gaussians.means}, r"quats has shape \[5, 3\], expected \[5, 4\]"),
        ({"smoothing": np.zeros(6, np.float32)}, r"smoothing has shape \[6\], expected \[5\]"),
        *(({"sh_rest": np.zeros(shape, np.float32)}, "sh_rest has shape")
          for shape in [(5, 4, 3), (4, 3, 3), (5, 3), (5, 3, 4)]),
    ]  # fmt: skip
    mistakes: list[tuple[Callable[[], object], str]] = [
        *((partial(fresh.forward, dataclasses.replace(gaussians, **changes), WIDE), words)
          for changes, words in spoilt),
        (lambda: fresh.backward(v_planes, weight), "call forward before backward"),
        (fresh.median, "call forward before median"),
        (lambda: fresh.forward(gaussians, camera(width=50)), "draws 100x77 px, the camera has 50x40"),
        (lambda: fresh.forward(gaussians, WIDE, tiles.T > 0), r"bool \[7, 3\], expected bool \[3, 7\]"),
        (lambda: fresh.forward(gaussians, WIDE, tiles), "tiles is float64"),  # type: ignore[arg-type]
        (lambda: fresh.forward(gaussians, nowhere), "NaN or infinity"),
        (lambda: drawn.backward(v_planes[:, :3, :3], weight), "v_planes has shape"),
        (lambda: drawn.backward(v_planes, weight.T), r"weight has shape \[100, 77\], expected \[77, 100\]"),
        (lambda: make_rasterizer("cudnn", 8, 8), "unknown engine backend 'cudnn'; choose"),
        (lambda: make_rasterizer("numba", 0, 8), "0x8"),
    ]  # fmt: skip
    for wrong, words in mistakes:
        with pytest.raises(UsageError, match=words):
            wrong()
