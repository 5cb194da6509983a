"""The rasteriser: kernels against the twin, the twin against finite differences, and hostile input."""

from __future__ import annotations

import dataclasses
import threading
from collections.abc import Callable
from typing import Any

import numba
import numpy as np
import pytest
import torch
from engine_scenes import (
    INPUTS,
    camera,
    cotangents,
    draw_and_differentiate,
    one_gaussian,
    random_gaussians,
    truth,
)
from numpy.typing import NDArray
from rounding import after

from sags_node import geometry
from sags_node.config.schema import LaunchConfig
from sags_node.engine.interface import MIN_ALPHA
from sags_node.engine.rasterizer import binning, compositing, projection, projection_backward, views
from sags_node.engine.rasterizer import cpu as numba_rasterizer
from sags_node.engine.rasterizer.rasterize import Gradients, as_pinhole, make_rasterizer, rasterize, to_view
from sags_node.engine.reference import rasterizer as reference
from sags_node.errors import SagsError, UsageError
from sags_node.pipeline.warm_up import warm_up
from sags_node.types import F32, Camera, Gaussians

GRADIENTS = (*INPUTS, "contribution")


def copies(gradients: Gradients) -> dict[str, NDArray[np.floating]]:
    return {name: getattr(gradients, name).copy() for name in GRADIENTS}


def assert_same_bits(a: tuple[F32, dict[str, Any]], b: tuple[F32, dict[str, Any]]) -> None:
    np.testing.assert_array_equal(a[0], b[0])
    for name in GRADIENTS:
        np.testing.assert_array_equal(a[1][name], b[1][name], err_msg=name)


def subset(gaussians: Gaussians, keep: np.ndarray) -> Gaussians:
    rows = {name: getattr(gaussians, name)[keep] for name in (*INPUTS, "ids")}
    return dataclasses.replace(gaussians, **rows)


# ---- the arithmetic ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", [1, 2, 3])
@pytest.mark.parametrize("moved", [False, True])
def test_kernels_agree_with_the_float64_twin(seed: int, moved: bool) -> None:
    view = camera(moved=moved)
    gaussians = random_gaussians(seed, 60, view)
    true = truth(gaussians, view, seed)
    assert true.planes[4].mean() > 0.3  # the scene does cover the picture
    true.check(*draw_and_differentiate(gaussians, view, "numba", seed))


def test_held_jacobian_agrees_with_the_twin() -> None:
    """Large Gaussians whose centres lie outside the widened frustum reach into the picture."""
    view = camera(moved=True)
    rng = np.random.default_rng(11)
    inside = random_gaussians(11, 12, view, spread=2.0)
    pixels = rng.uniform([-60, -50], [-30, 80], (12, 2))
    means = geometry.unproject(view, pixels, rng.uniform(0.05, 0.09, 12)).astype(np.float32)
    scales = rng.uniform(0.02, 0.05, (12, 3)).astype(np.float32)
    gaussians = dataclasses.replace(inside, means=means, scales=scales)
    true = truth(gaussians, view)
    assert true.planes[4].mean() > 0.05
    true.check(*draw_and_differentiate(gaussians, view))


def test_needles_of_one_to_ten_thousand_stay_exact() -> None:
    view = camera(width=64, height=64, focal=80.0)
    gaussians = random_gaussians(7, 12, view)
    scales = np.tile(np.array([[0.1, 1e-5, 1e-3]], np.float32), (12, 1))
    gaussians = dataclasses.replace(gaussians, scales=scales)
    true = truth(gaussians, view)
    assert true.planes[4].max() > 0.01
    true.check(*draw_and_differentiate(gaussians, view))


def test_larger_picture_by_percentiles() -> None:
    """Single pixels may differ by a splat cut at 1/255 or by two splats of equal depth in another order."""
    view = camera(width=110, height=80, focal=110.0)
    gaussians = random_gaussians(4, 800, view)
    true = truth(gaussians, view, moves=1)
    planes, found = draw_and_differentiate(gaussians, view)
    assert np.percentile(np.abs(planes - true.planes), 99.9) < np.percentile(true.off, 99.9)
    for name in GRADIENTS:
        true.check_gradient(name, found[name])


def alphas(gaussians: Gaussians, view: Camera) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Of the twin: [pixels, splats], 0 where cut; and which Gaussians the splats are."""
    inputs = [torch.tensor(getattr(gaussians, name), dtype=torch.float64) for name in INPUTS]
    splats = reference.project(as_pinhole(view), inputs)
    alpha, _, touching = reference._alphas(splats, 0, 0, view.width, view.height)
    return alpha.numpy(), splats.rows[touching].numpy()


@pytest.mark.parametrize("seed", [20, 23, 25, 28])
def test_rounding_changes_no_more_than_whether_a_splat_is_cut(
    seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where alpha is 1/255, rounding decides whether a splat shows. In a large scene some always are so, and
    one of them moves gradients by more than all rounding. Picture and gradients are then those of the twin
    that decides likewise, and the picture and its gradients decide alike. Here one splat meets the cut in one
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
        for name in GRADIENTS:
            error = np.linalg.norm(found_gradients[name] - true.gradients[name])
            off.append(error / true.gradients_within[name])
        wrong.append((shown, max(off)))
    (with_it, shown_off), (without, cut_off) = wrong
    assert with_it == without + 1  # no other is near the cut
    assert min(shown_off, cut_off) <= 1 < max(shown_off, cut_off)


def test_opaque_layers_stop_early_without_being_seen() -> None:
    """Many opaque splats behind each other: what a finished tile leaves out is below 1e-4."""
    view = camera(width=40, height=40)
    gaussians = random_gaussians(9, 300, view, spread=6.0)
    gaussians = dataclasses.replace(gaussians, opacities=np.full(300, 0.99, np.float32))
    rasterizer = make_rasterizer("numba", 40, 40)
    planes = rasterizer.forward(gaussians, view)
    backend = rasterizer._backend  # type: ignore[attr-defined]  # the only way to see that tiles did stop
    assert (backend._tile_ends < backend._tile_starts[1:]).all()  # also those that overhang the picture
    true = truth(gaussians, view)
    left_out = 1e-4 * max(1, gaussians.colors.max())  # of what is seen, and of every pixel of a gradient
    np.testing.assert_allclose(planes, true.planes, rtol=0, atol=left_out + true.off.max())
    found = copies(rasterizer.backward(*cotangents(view, 0)))
    v_colors = np.abs(cotangents(view, 0)[0][:3]).sum(axis=(1, 2))
    error = np.linalg.norm(found["colors"] - true.gradients["colors"])
    assert error < left_out * np.linalg.norm(v_colors) + true.gradients_within["colors"]


# ---- conventions -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("backend", ["numba", "reference"])
@pytest.mark.parametrize("pixel", [(0, 0), (17, 5), (47, 39), (15, 31), (16, 32)])
def test_unprojected_pixel_peaks_at_that_pixel(backend: str, pixel: tuple[int, int]) -> None:
    view = camera(moved=True)
    mean = geometry.unproject(view, np.array(pixel, float), np.array(0.07))
    drawn = rasterize(one_gaussian(mean, 0.001), view, backend=backend)
    row, column = np.unravel_index(np.argmax(drawn.alpha), drawn.alpha.shape)
    assert (int(column), int(row)) == pixel
    assert drawn.depth[row, column] == pytest.approx(0.07, rel=after(20))  # one weight, divided out again
    np.testing.assert_allclose(drawn.rgb[row, column], [0.8, 0.5, 0.2], rtol=after(8))


def test_subpixel_splats_dim_with_the_square_of_the_distance() -> None:
    """The 2D Mip filter keeps the light of a splat smaller than a pixel: coverage * z^2 stays the same."""
    view = camera(width=160, height=160, focal=160.0)
    rng = np.random.default_rng(3)
    light = []
    for distance in (0.05, 0.1):
        grid = np.stack(np.meshgrid(np.arange(5, 155, 10.0), np.arange(5, 155, 10.0)), -1).reshape(-1, 2)
        means = geometry.unproject(
            view, grid + rng.uniform(-0.5, 0.5, grid.shape), np.full(len(grid), distance)
        )
        gaussians = random_gaussians(0, len(grid), view)
        gaussians = dataclasses.replace(
            gaussians,
            means=means.astype(np.float32),
            scales=np.full((len(grid), 3), 0.5 * 0.05 / 160, np.float32),  # half a pixel, then a quarter
            opacities=np.full(len(grid), 0.9, np.float32),
        )
        light.append(float(rasterize(gaussians, view).alpha.sum()) * distance**2)
    assert light[1] / light[0] == pytest.approx(1.0, abs=0.06)


def test_view_is_normalised_by_coverage() -> None:
    view = camera(width=4, height=3)
    planes = np.zeros((5, 3, 4), np.float32)
    planes[:, 0, 0] = [0.3, 0.15, 0.9, 0.03, 0.6]
    planes[:, 1, 1] = [0.1, 0.1, 0.1, 0.01, 0.4]  # too thin for a depth
    planes[:, 2, 2] = [1e-5, 1e-5, 1e-5, 1e-6, 1e-4]  # nothing there
    drawn = to_view(planes, view, 5, 6)
    np.testing.assert_allclose(drawn.rgb[0, 0], [0.5, 0.25, 1.0], rtol=after(4))
    assert drawn.depth[0, 0] == pytest.approx(0.05, rel=after(4))
    np.testing.assert_allclose(drawn.rgb[1, 1], 0.25, rtol=after(4))
    assert drawn.depth[1, 1] == 0
    assert not drawn.rgb[2, 2].any()
    assert drawn.alpha[2, 2] == np.float32(1e-4)
    assert (drawn.frame_id, drawn.t_capture_ns) == (5, 6)
    planes[:] = 0.9
    assert drawn.rgb[0, 0, 0] == pytest.approx(0.5, rel=after(4))  # fresh arrays


# ---- repeatable --------------------------------------------------------------------------------------------


def test_what_is_not_asked_of_a_tile_leaves_nothing_of_an_earlier_answer() -> None:
    """Tiles without a cotangent are passed over; their pairs still hold the gradients of the call before."""
    view = camera()
    gaussians = random_gaussians(4, 60, view)
    v_planes, weight = cotangents(view, 4)
    used, fresh = (make_rasterizer("numba", view.width, view.height) for _ in range(2))
    used.forward(gaussians, view)
    used.backward(v_planes, weight)
    asked = np.zeros((view.height, view.width), np.bool_)
    asked[: view.height // 2, : view.width // 3] = True
    fresh.forward(gaussians, view)
    found, again = (copies(r.backward(v_planes * asked, weight * asked)) for r in (used, fresh))
    true = truth(gaussians, view, given=(v_planes * asked, weight * asked))
    for name in GRADIENTS:
        np.testing.assert_array_equal(found[name], again[name], err_msg=name)
        true.check_gradient(name, found[name])
    assert 0 < np.count_nonzero(found["contribution"]) < len(gaussians)


def test_same_bits_for_any_number_of_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    view = camera(width=100, height=77, focal=100.0)
    gaussians = random_gaussians(6, 700, view)
    cores = numba.get_num_threads()
    numba.set_num_threads(1)
    try:
        alone = draw_and_differentiate(gaussians, view)
    finally:
        numba.set_num_threads(cores)
    assert_same_bits(alone, draw_and_differentiate(gaussians, view))
    for pieces in (2, 3, 7, 64):  # the work cut for more threads than this machine may have
        monkeypatch.setattr(numba_rasterizer, "thread_count", lambda pieces=pieces: pieces)
        assert_same_bits(alone, draw_and_differentiate(gaussians, view))


def test_repeated_runs_of_one_rasterizer_give_the_same_bits() -> None:
    view = camera()
    many, few = random_gaussians(6, 300, view, spread=3.0), random_gaussians(7, 20, view)
    fresh_many, fresh_few = draw_and_differentiate(many, view), draw_and_differentiate(few, view)
    rasterizer = make_rasterizer("numba", view.width, view.height)
    for gaussians, fresh in [(few, fresh_few), (many, fresh_many), (few, fresh_few), (many, fresh_many)]:
        planes = rasterizer.forward(gaussians, view).copy()
        assert_same_bits((planes, copies(rasterizer.backward(*cotangents(view, 0)))), fresh)


def test_two_python_threads_draw_at_once() -> None:
    view = camera(width=100, height=77, focal=100.0)
    scenes = [random_gaussians(seed, 500, view) for seed in (1, 2)]
    alone = [draw_and_differentiate(scene, view) for scene in scenes]
    failures: list[BaseException] = []

    def work(index: int) -> None:
        try:
            for _ in range(20):
                assert_same_bits(draw_and_differentiate(scenes[index], view), alone[index])
        except BaseException as error:  # carried to the test's own thread
            failures.append(error)

    threads = [threading.Thread(target=work, args=(index,)) for index in (0, 1)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not failures, failures[0]


def test_warm_up_leaves_nothing_to_compile() -> None:
    """Also not for frozen arrays, which are another type to Numba."""
    warm_up(LaunchConfig())
    kernels: list[Any] = [
        projection.project,
        projection_backward.project_backward,
        binning.sort_by_depth,
        binning.emit_pairs,
        binning.sort_into_tiles,
        compositing.composite,
        compositing.composite_backward,
        views._normalise,
    ]
    compiled = [len(kernel.signatures) for kernel in kernels]
    view = camera(moved=True)
    gaussians = random_gaussians(1, 50, view)
    for name in INPUTS:
        getattr(gaussians, name).flags.writeable = False
    draw_and_differentiate(gaussians, view)
    rasterize(gaussians, view)
    assert [len(kernel.signatures) for kernel in kernels] == compiled == [1] * len(kernels)


# ---- what breaks rasterisers -------------------------------------------------------------------------------


def spoil(name: str, value: float) -> Callable[[Gaussians, int], None]:
    def change(gaussians: Gaussians, index: int) -> None:
        getattr(gaussians, name)[index] = value

    return change


def put_behind(gaussians: Gaussians, index: int) -> None:
    gaussians.means[index, 2] *= -1


SPOILERS = {
    **{f"nan {name}": spoil(name, np.nan) for name in INPUTS},
    **{f"infinite {name}": spoil(name, np.inf) for name in INPUTS},
    "minus infinite means": spoil("means", -np.inf),
    "zero quaternion": spoil("quats", 0.0),
    "zero opacity": spoil("opacities", 0.0),
    "negative opacity": spoil("opacities", -1.0),
    "zero scale": spoil("scales", 0.0),
    "vanishing scale": spoil("scales", 1e-30),
    "huge scale": spoil("scales", 1e30),
    "on the camera plane": spoil("means", 0.0),
    "behind the camera": put_behind,
}


@pytest.mark.parametrize("name", SPOILERS)
def test_a_spoilt_gaussian_is_left_out_and_harms_no_other(name: str) -> None:
    view = camera()
    clean = random_gaussians(8, 30, view)
    spoilt = random_gaussians(8, 30, view)
    SPOILERS[name](spoilt, 13)
    others = np.arange(30) != 13
    planes, found = draw_and_differentiate(spoilt, view)
    true_planes, true = draw_and_differentiate(subset(clean, others), view)
    np.testing.assert_array_equal(planes, true_planes)
    for key in (*INPUTS, "contribution"):
        np.testing.assert_array_equal(found[key][others], true[key], err_msg=key)
        assert not found[key][13].any(), key


@pytest.mark.parametrize("scale", [1e-7, 1e-5, 1e-3, 1e-1, 1.0])
@pytest.mark.parametrize("distance", [1.001e-3, 0.07, 1e3])
@pytest.mark.parametrize("opacity", [1e-6, 1 - 1e-6])
def test_extreme_values_give_finite_pictures_and_gradients(
    scale: float, distance: float, opacity: float
) -> None:
    view = camera(width=33, height=35)
    planes, found = draw_and_differentiate(one_gaussian(np.array([0.0, 0.0, distance]), scale, opacity), view)
    assert np.isfinite(planes).all()
    assert (planes[4] >= 0).all()
    assert planes[4].max() <= 1
    for name in GRADIENTS:
        assert np.isfinite(found[name]).all(), name


@pytest.mark.parametrize("backend", ["numba", "reference"])
def test_no_gaussians(backend: str) -> None:
    view = camera()
    planes, found = draw_and_differentiate(
        subset(random_gaussians(0, 1, view), np.zeros(1, bool)), view, backend
    )
    assert planes.shape == (5, 40, 48)
    assert not planes.any()
    assert found["means"].shape == (0, 3)
    assert found["contribution"].shape == (0,)


@pytest.mark.parametrize("size", [(1, 1), (1, 40), (50, 1), (15, 31), (17, 33), (16, 32), (100, 7)])
def test_sizes_that_no_tile_divides(size: tuple[int, int]) -> None:
    view = camera(*size, focal=30.0)
    gaussians = random_gaussians(3, 25, view, spread=2.0)
    truth(gaussians, view).check(*draw_and_differentiate(gaussians, view))


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


def test_too_many_pairs_are_refused_with_a_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(numba_rasterizer, "MAX_PAIRS", 50)
    view = camera()
    with pytest.raises(SagsError, match="pairs, the limit is 50"):
        draw_and_differentiate(random_gaussians(1, 60, view), view)


def test_hundred_thousand_on_one_pixel() -> None:
    view = camera()
    count = 100_000
    one = one_gaussian(geometry.unproject(view, np.array([20.0, 20.0]), np.array(0.07)), 1e-4)
    index = np.zeros(count, int)
    planes, found = draw_and_differentiate(subset(one, index), view)
    assert planes[4, 20, 20] > 0.9999
    assert np.isfinite(found["means"]).all()


def test_wrong_input_is_explained() -> None:
    view = camera()
    gaussians = random_gaussians(0, 5, view)
    rasterizer = make_rasterizer("numba", view.width, view.height)
    with pytest.raises(UsageError, match="call forward before backward"):
        rasterizer.backward(*cotangents(view, 0))
    with pytest.raises(UsageError, match=r"quats has shape \[5, 3\], expected \[5, 4\]"):
        rasterizer.forward(dataclasses.replace(gaussians, quats=gaussians.means), view)
    with pytest.raises(UsageError, match="draws 48x40 px, the camera has 50x40"):
        rasterizer.forward(gaussians, camera(width=50))
    rasterizer.forward(gaussians, view)
    with pytest.raises(UsageError, match="v_planes has shape"):
        rasterizer.backward(np.zeros((5, 3, 3), np.float32), cotangents(view, 0)[1])
    with pytest.raises(UsageError, match="unknown engine backend 'cudnn'; choose"):
        make_rasterizer("cudnn", 8, 8)
    with pytest.raises(UsageError, match="0x8"):
        make_rasterizer("numba", 0, 8)
    spoilt = Camera(view.width, view.height, view.K, np.full((4, 4), np.nan))
    with pytest.raises(UsageError, match="NaN or infinity"):
        rasterizer.forward(gaussians, spoilt)
