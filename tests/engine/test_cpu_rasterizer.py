"""The CPU's rasteriser beyond what all must do (`test_rasterizer.py`): which splats rounding cuts, threads,
kernels that compile once, room that grows, and wrong use."""

import dataclasses
import threading
from typing import Any

import cv2
import numba
import numpy as np
import pytest
import torch
from engine_scenes import (
    DERIVATIVES,
    EXPONENTIAL,
    INPUTS,
    camera,
    cotangents,
    draw_and_differentiate,
    on_one_thread,
    random_gaussians,
    rasterize,
    rows,
    truth,
    with_filter,
    with_view_dependence,
)
from numpy.typing import NDArray
from rounding import after

from benchmarks.kernels import reference
from sags_node import geometry
from sags_node.config.schema import LaunchConfig
from sags_node.engine.interface import MIN_ALPHA
from sags_node.engine.rasterizer import binning, compositing, cpu, projection, projection_backward, smoothing
from sags_node.engine.rasterizer import spherical_harmonics as harmonics
from sags_node.engine.rasterizer.rasterize import TILE_HEIGHT, TILE_WIDTH, make_rasterizer, to_view
from sags_node.errors import UsageError
from sags_node.kernels.jit import parallel_kernel, take
from sags_node.kernels.threads import configure_threads, leave_a_core, thread_count
from sags_node.pipeline.warm_up import warm_up
from sags_node.types import I64, Bool, Camera, Gaussians

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


# ---- the arithmetic ----------------------------------------------------------------------------------------


def alphas(gaussians: Gaussians, view: Camera) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Of the twin: [pixels, splats], 0 where cut; and which Gaussians the splats are."""
    inputs = [torch.tensor(getattr(gaussians, name), dtype=torch.float64) for name in INPUTS]
    splats = reference.project(view, inputs)
    alpha, _, touching, _ = reference.alphas(splats, 0, 0, view.width, view.height)
    return alpha.numpy(), splats.rows[touching].numpy()


@pytest.mark.parametrize("seed", [20, 23, 25, 28])
def test_rounding_changes_no_more_than_whether_a_splat_is_cut(
    seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where alpha is 1/255, rounding decides whether a splat shows. In a large scene some always are so, and
    one of them moves gradients by more than all rounding. Image and gradients are then those of the twin
    that decides likewise, and the image and its gradients decide alike. Here one splat meets the cut in one
    pixel."""
    view = camera()
    gaussians = random_gaussians(seed, 60, view)
    alpha, rows = alphas(gaussians, view)
    pixel, splat = np.unravel_index(np.abs(alpha - 0.01).argmin(), alpha.shape)  # near its rim
    opacities = gaussians.opacities.copy()
    opacities[rows[splat]] *= MIN_ALPHA / alpha[pixel, splat]
    gaussians = dataclasses.replace(gaussians, opacities=opacities)
    found, found_gradients = draw_and_differentiate(gaussians, view, seed=seed)

    wrong = []
    for moved_cut in (1 - 1e-4, 1 + 1e-4):  # far more than rounding
        monkeypatch.setattr(reference, "MIN_ALPHA", moved_cut * MIN_ALPHA)
        shown = np.count_nonzero(alphas(gaussians, view)[0])
        true = truth(gaussians, view, seed)
        off = [np.abs(found - true.planes).max() / true.off.max()]
        for name in (*INPUTS, "contribution"):
            error = np.linalg.norm(found_gradients[name] - true.gradients[name])
            off.append(error / true.gradients_within[name])
        wrong.append((shown, max(off)))
    (with_it, shown_off), (without, cut_off) = wrong
    assert with_it == without + 1  # no other is near the cut
    assert min(shown_off, cut_off) <= 1 < max(shown_off, cut_off)


def test_view_is_normalised_by_coverage() -> None:
    view = camera(width=4, height=3)
    planes = np.zeros((5, 3, 4), np.float32)
    planes[:, 0, 0] = [0.3, 0.15, 0.9, 0.03, 0.6]
    planes[:, 1, 1] = [0.075, 0.075, 0.075, 0.01, 0.3]  # too thin for a depth
    planes[:, 2, 2] = [1e-5, 1e-5, 1e-5, 1e-6, 1e-4]  # nothing there
    drawn = to_view(planes, view, 5, 6)
    assert drawn.rgb[0, 0].tolist() == [128, 64, 255]
    assert drawn.depth[0, 0] == pytest.approx(0.05, rel=after(4))
    assert drawn.rgb[1, 1].tolist() == [64, 64, 64]
    assert drawn.depth[1, 1] == 0
    assert not drawn.rgb[2, 2].any()
    assert drawn.alpha[2, 2] == np.float32(1e-4)
    assert (drawn.frame_id, drawn.t_capture_ns) == (5, 6)
    planes[:] = 0.9
    assert drawn.rgb[0, 0, 0] == 128  # fresh arrays


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


def test_buffers_grow_when_a_picture_needs_more_pairs() -> None:
    """100 Gaussians that all cover all 54 tiles, from a fresh rasteriser with room for 4096 pairs."""
    view = camera(width=140, height=180, focal=150.0)
    gaussians = random_gaussians(1, 100, view)
    gaussians = dataclasses.replace(
        gaussians, scales=np.full((100, 3), 0.2, np.float32), opacities=np.full(100, 0.02, np.float32)
    )
    planes, found = draw_and_differentiate(gaussians, view)
    assert (found["contribution"] > 0).all()
    truth(gaussians, view, moves=1).check(planes, found, ["colors", "contribution"])


@pytest.mark.parametrize("corner", [(2.0, 2.0), (97.0, 74.0), (47.5, 31.5)])
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


# ---- sharing the work --------------------------------------------------------------------------------------


@pytest.mark.parametrize("tiles", [None, SOME], ids=["all", "some"])
def test_same_bits_however_many_share_the_work(tiles: Bool | None, monkeypatch: pytest.MonkeyPatch) -> None:
    expected = everything(scene(), WIDE, tiles)
    assert_same_bits(on_one_thread(lambda: everything(scene(), WIDE, tiles)), expected)
    for pieces in (2, 3, 7, 64):  # more workers than this machine may have cores
        monkeypatch.setattr(cpu, "thread_count", lambda pieces=pieces: pieces)
        assert_same_bits(everything(scene(), WIDE, tiles), expected)


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


def test_threads_with_rasterizers_of_their_own() -> None:
    """Four Python threads, other scenes, cameras, tiles and numbers of cores, at once."""
    cases: list[tuple[Gaussians, Camera, Bool | None]] = [
        (scene(300), WIDE, None),
        (random_gaussians(2, 500, WIDE), TURNED, None),
        (scene(200), WIDE, SOME),
        (random_gaussians(4, 400, WIDE), WIDE, None),
    ]
    expected = [everything(*case) for case in cases]
    failures: list[BaseException] = []

    def repeat(index: int) -> None:
        try:
            configure_threads(1 + index % 2)
            for _ in range(10):
                assert_same_bits(everything(*cases[index]), expected[index])
        except BaseException as error:  # carried to the test's own thread
            failures.append(error)

    threads = [threading.Thread(target=repeat, args=(index,)) for index in range(len(cases))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60)
    assert not any(thread.is_alive() for thread in threads)
    assert not failures, failures[0]


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


def test_kernels_compile_once_and_warm_up_has_done_it() -> None:
    """Also for frozen arrays and other float types, which are other types to Numba."""
    warm_up(LaunchConfig())
    kernels: list[Any] = [
        projection.project, projection_backward.project_backward, binning.sort_by_depth, binning.emit_pairs,
        binning.sort_into_tiles, compositing.composite, compositing.composite_backward, smoothing.smooth,
        smoothing.smooth_backward, harmonics.color, harmonics.color_backward,
    ]  # fmt: skip
    compiled = [len(kernel.signatures) for kernel in kernels]
    plain, full = random_gaussians(1, 50, WIDE), scene(30)
    for gaussians in (plain, full):
        for name in (*INPUTS, "sh_rest", "smoothing"):
            if getattr(gaussians, name) is not None:
                getattr(gaussians, name).flags.writeable = False
    draw_and_differentiate(plain, WIDE)
    rasterize(plain, WIDE)
    assert [len(kernel.signatures) for kernel in kernels] == compiled
    wide = {name: getattr(full, name).astype(np.float64) for name in (*INPUTS, "sh_rest", "smoothing")}
    for gaussians in (full, dataclasses.replace(full, **wide)):
        draw_and_differentiate(gaussians, WIDE)
        smoothing.bake_filter(gaussians)
    assert [len(kernel.signatures) for kernel in kernels] == [1] * len(kernels)


# ---- wrong use ---------------------------------------------------------------------------------------------


def test_wrong_input_is_explained() -> None:
    gaussians = scene(5)
    rasterizer = make_rasterizer("numba", 100, 77)
    v_planes, weight = cotangents(WIDE, 0)
    with pytest.raises(UsageError, match="call forward before backward"):
        rasterizer.backward(v_planes, weight)
    with pytest.raises(UsageError, match="call forward before median"):
        rasterizer.median()
    for changes, words in [
        ({"quats": gaussians.means}, r"quats has shape \[5, 3\], expected \[5, 4\]"),
        ({"smoothing": np.zeros(6, np.float32)}, r"smoothing has shape \[6\], expected \[5\]"),
        *(({"sh_rest": np.zeros(shape, np.float32)}, "sh_rest has shape")
          for shape in [(5, 4, 3), (4, 3, 3), (5, 3), (5, 3, 4)]),
    ]:  # fmt: skip
        with pytest.raises(UsageError, match=words):
            rasterizer.forward(dataclasses.replace(gaussians, **changes), WIDE)
    with pytest.raises(UsageError, match="draws 100x77 px, the camera has 50x40"):
        rasterizer.forward(gaussians, camera(width=50))
    with pytest.raises(UsageError, match=r"tiles is bool \[7, 3\], expected bool \[3, 7\]"):
        rasterizer.forward(gaussians, WIDE, np.ones(SHAPE[::-1], bool))
    with pytest.raises(UsageError, match="tiles is float64"):
        rasterizer.forward(gaussians, WIDE, np.ones(SHAPE))  # type: ignore[arg-type]  # that is the mistake
    with pytest.raises(UsageError, match="NaN or infinity"):
        rasterizer.forward(gaussians, Camera(100, 77, WIDE.K, np.full((4, 4), np.nan)))
    rasterizer.forward(gaussians, WIDE)
    with pytest.raises(UsageError, match="v_planes has shape"):
        rasterizer.backward(np.zeros((5, 3, 3), np.float32), weight)
    with pytest.raises(UsageError, match=r"weight has shape \[100, 77\], expected \[77, 100\]"):
        rasterizer.backward(v_planes, weight.T)
    with pytest.raises(UsageError, match="unknown engine backend 'cudnn'; choose"):
        make_rasterizer("cudnn", 8, 8)
    with pytest.raises(UsageError, match="0x8"):
        make_rasterizer("numba", 0, 8)
