"""The GPU rasteriser against the float64 twin and the CPU engine: on a GPU, or in Triton's interpreter, where
a pair of a splat and a tile takes milliseconds, so scenes are small."""

from __future__ import annotations

import dataclasses
import importlib
import sys
from typing import Any

import numpy as np
import pytest
import torch
from engine_scenes import (
    DERIVATIVES,
    camera,
    cotangents,
    draw_and_differentiate,
    one_gaussian,
    random_gaussians,
    rows,
    truth,
    with_filter,
    with_view_dependence,
)
from rounding import after

from sags_node import geometry
from sags_node.engine.interface import MAX_OPACITY, NEAR_PLANE, Pinhole
from sags_node.engine.rasterizer.rasterize import TILE_HEIGHT, TILE_WIDTH, Rasterizer, make_rasterizer
from sags_node.errors import SagsError, UsageError
from sags_node.types import Bool, Camera, Gaussians

pytest.importorskip("triton", reason="Triton comes with torch's CUDA builds, or by `pip install triton`")
# what the interpreter says of lanes without a Gaussian
pytestmark = [
    pytest.mark.filterwarnings("ignore::RuntimeWarning:triton.runtime.interpreter"),
    pytest.mark.usefixtures("quick_interpreter"),
]

from sags_node.engine import cuda  # noqa: E402  (needs triton)
from sags_node.engine.cuda import layout, rasterizer  # noqa: E402  (needs triton)
from sags_node.engine.cuda.backend import default_device  # noqa: E402
from sags_node.engine.cuda.scene import DeviceGaussians  # noqa: E402

VIEW = camera(width=35, height=21, focal=42.0)  # no whole number of tiles
TURNED = camera(width=35, height=21, focal=42.0, moved=True)


def kernels_are_interpreted() -> bool:
    return default_device().type == "cpu"


def new_rasterizer(view: Camera) -> Rasterizer:
    return make_rasterizer("cuda", view.width, view.height)


def inner(rasterizer: Rasterizer) -> Any:
    """The tensor-level rasteriser: the only way to see what was not done."""
    return rasterizer._backend._rasterizer  # type: ignore[attr-defined]  (of the CUDA backend)


def copies(gradients: Any) -> dict[str, Any]:
    return {name: getattr(gradients, name).copy() for name in DERIVATIVES}


def assert_agrees(gaussians: Gaussians, view: Camera, **options: Any) -> dict[str, Any]:
    """Planes, and gradients of a random cotangent, against the float64 twin."""
    planes, found = draw_and_differentiate(gaussians, view, "cuda", **options)
    true = truth(gaussians, view, **options)
    assert true.planes[4].max() > 0.05  # there is something to see
    true.check(planes, found)
    return found


# ---- the arithmetic ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("degree", "filtered", "antialias"),
    [(0, False, True), (1, True, False), (2, False, True), (3, True, True)],
)
def test_agrees_with_the_float64_twin(degree: int, filtered: bool, antialias: bool) -> None:
    """Every derivative, all degrees, both filters on and off."""
    gaussians = random_gaussians(degree, 10, TURNED)
    if degree:
        gaussians = with_view_dependence(gaussians, degree)
    if filtered:
        gaussians = with_filter(gaussians)
    assert_agrees(gaussians, TURNED, antialias=antialias)


def test_agrees_with_the_cpu_engine_on_a_larger_scene() -> None:
    view = camera(width=64, height=48, focal=80.0)
    gaussians = with_filter(random_gaussians(4, 110, view, spread=0.7))
    true = truth(gaussians, view)
    assert true.planes[4].mean() > 0.3
    for backend in ("cuda", "numba"):
        true.check(*draw_and_differentiate(gaussians, view, backend))


def test_a_jacobian_held_within_the_frustum() -> None:
    """Large Gaussians whose centres lie outside the widened frustum reach into the picture."""
    rng = np.random.default_rng(11)
    pixels = rng.uniform([-40, -30], [-20, 40], (6, 2))
    gaussians = dataclasses.replace(
        random_gaussians(11, 6, TURNED),
        means=geometry.unproject(TURNED, pixels, rng.uniform(0.05, 0.09, 6)).astype(np.float32),
        scales=rng.uniform(0.02, 0.05, (6, 3)).astype(np.float32),
    )
    assert_agrees(gaussians, TURNED)


def test_scales_from_a_vanishing_dot_to_a_wall() -> None:
    """Turned Gaussians whose axes differ by 10, through a lens that can show 10 micrometres."""
    view = camera(width=35, height=21, focal=2000.0)
    sizes = np.array([1e-5, 1e-4, 1e-3, 1e-2, 1e-1, 1.0], np.float32)
    gaussians = dataclasses.replace(
        random_gaussians(3, 6, view), scales=sizes[:, None] * np.array([1, 0.1, 0.3], np.float32)
    )
    for scene in (gaussians, dataclasses.replace(gaussians, smoothing=0.01 * sizes**2)):
        planes, found = draw_and_differentiate(scene, view, "cuda")
        true = truth(scene, view)
        assert true.planes[4].max() > 0.05
        np.testing.assert_allclose(planes, true.planes, rtol=0, atol=true.off.max())
        for name in ("colors", "contribution", "opacities", "means", "scales", "quats"):
            for row in range(6):  # the gradients of a dot are far larger than those of a wall
                true.check_gradient(name, found[name], row)


@pytest.mark.parametrize("filtered", [False, True])
def test_flat_as_paper_and_thin_as_a_thread(filtered: bool) -> None:
    """Axes of 1e-7 m beside a millimetre, 1 : 10,000; with and without a filter of a micrometre."""
    scales = np.tile(np.array([[1e-3, 1e-7, 2e-3], [1e-3, 1.1e-3, 1e-7]], np.float32), (4, 1))
    scales[5:] = [3e-3, 3e-4, 3e-7]
    gaussians = dataclasses.replace(
        random_gaussians(7, 8, VIEW),
        scales=scales,
        opacities=np.full(8, 0.97, np.float32),
        smoothing=np.full(8, 1e-12, np.float32) if filtered else None,
    )
    assert_agrees(gaussians, VIEW)


def test_opacities_from_nothing_to_everything() -> None:
    opacities = np.array([1e-6, 1 / 255, 0.0045, 0.5, 0.9985, 0.9995, 1 - 1e-6, 1.0], np.float32)
    gaussians = dataclasses.replace(random_gaussians(5, 8, VIEW, spread=2.0), opacities=opacities)
    found = assert_agrees(gaussians, VIEW)
    assert not any(found[name][:2].any() for name in DERIVATIVES)
    wall, _ = draw_and_differentiate(one_gaussian(np.array([0, 0, 0.07]), 1.0, 1.0), VIEW, "cuda")
    assert wall[4].max() == pytest.approx(MAX_OPACITY, rel=after(8))


def test_quaternions_of_any_length_are_the_same_turn() -> None:
    gaussians = with_filter(random_gaussians(8, 8, VIEW))
    unit = gaussians.quats / np.linalg.norm(gaussians.quats, axis=1)[:, None]
    lengths = np.array([1e-11, 1e-6, 1e-3, 1, 1e3, 1e6, 1e15, 7], np.float32)
    true = truth(dataclasses.replace(gaussians, quats=unit), VIEW)
    scaled = dataclasses.replace(gaussians, quats=unit * lengths[:, None])
    planes, found = draw_and_differentiate(scaled, VIEW, "cuda")
    true.check(planes, found | {"quats": found["quats"].astype(np.float64) * lengths[:, None]})


def test_just_in_front_of_the_near_plane_and_not_behind_it() -> None:
    """On the axis, beside the picture, far outside; then at the plane, on the camera and behind it."""
    z = NEAR_PLANE * np.array([1 + 1e-6, 1.01, 2.0, 0.999, 1e-3, -1e-3, -1.0, -1e12])
    means = np.stack([z * [0, 0.45, 30, 0, 0, 0, 0, 0], z * [0, 0.1, -20, 0, 0, 0, 0, 0], z], 1)
    gaussians = dataclasses.replace(
        with_view_dependence(random_gaussians(1, 8, VIEW), 3),
        means=means.astype(np.float32),
        scales=np.tile(np.array([[1e-4, 5e-5, 7e-5]], np.float32), (8, 1)),
    )
    found = assert_agrees(gaussians, VIEW)
    assert not any(found[name][3:].any() for name in DERIVATIVES)


def test_a_larger_world_further_away_looks_the_same() -> None:
    gaussians = with_filter(with_view_dependence(random_gaussians(8, 8, VIEW), 1))
    true = truth(gaussians, VIEW)
    for factor in (np.float32(0.03), np.float32(1e9)):
        larger = dataclasses.replace(
            gaussians,
            means=gaussians.means * factor,
            scales=gaussians.scales * factor,
            smoothing=gaussians.smoothing * factor**2,
        )
        planes, _ = draw_and_differentiate(larger, VIEW, "cuda")
        unit = np.array([1, 1, 1, factor, 1])[:, None, None]
        np.testing.assert_allclose(planes / unit, true.planes, rtol=0, atol=true.off.max())


def test_a_crowd_on_one_pixel_follows_the_law_of_absorption() -> None:
    """n equal Gaussians behind each other, each larger than the picture: what is left is (1 - alpha)^n, down
    to 1e-4, where a tile stops. Those it hides have no gradient."""
    view = camera(width=3, height=2, focal=30.0)
    one = one_gaussian(geometry.unproject(view, np.array([1.0, 1.0]), np.array(0.07)), 0.3, 0.6)
    crowd = new_rasterizer(view)
    planes = crowd.forward(rows(one, np.zeros(40, int)), view).copy()
    bins, ends = inner(crowd)._bins, inner(crowd)._tile_ends
    assert ends[0] < bins.tile_starts[1] == 40
    alpha, _ = draw_and_differentiate(one, view, "cuda")
    left = np.maximum((1 - alpha[4].astype(np.float64)) ** 40, 1e-4)
    drawn = int(ends[0])
    np.testing.assert_allclose(1 - planes[4], left, rtol=0, atol=1e-4 + after(8 * drawn) * left.max())
    np.testing.assert_allclose(planes[0], 0.8 * planes[4], rtol=after(2 * drawn))
    v_planes, weight = cotangents(view, 0)
    found = crowd.backward(v_planes, weight)
    total = found.contribution.astype(np.float64).sum()
    assert total == pytest.approx((weight * planes[4]).sum(), rel=after(2 * drawn))
    assert (np.diff(found.contribution) <= 0).all()  # the nearest are the first of equals
    assert found.means[0].all() and not found.means[int(ends[0]) :].any()


# ---- what is not a number, nowhere, or too much ------------------------------------------------------------

SPOILED: list[tuple[str, float]] = [
    (name, number)
    for name in ("means", "quats", "scales", "opacities", "colors", "sh_rest")
    for number in (np.nan, np.inf, -np.inf)
]
SPOILED += [("quats", 0.0), ("quats", 1e-13), ("quats", 1e19), ("means", 0.0), ("means", -0.07)]
SPOILED += [("opacities", 0.0), ("opacities", -1.0), ("scales", 1e30)]
WITHOUT_FILTER = [*SPOILED, ("scales", 0.0), ("scales", 1e-30)]  # a filter gives these a size
WITH_FILTER = [*SPOILED, ("smoothing", np.nan), ("smoothing", np.inf)]


@pytest.mark.parametrize("kinds", [WITH_FILTER, WITHOUT_FILTER], ids=["filter", "no filter"])
def test_a_spoilt_gaussian_is_left_out_and_harms_no_other(kinds: list[tuple[str, float]]) -> None:
    """One of each kind among sound ones, and the same scene without them: the same bits."""
    spoilt = with_view_dependence(random_gaussians(8, 2 * len(kinds), VIEW, spread=0.9), 1)
    if kinds is WITH_FILTER:
        spoilt = with_filter(spoilt)
    for index, (name, number) in enumerate(kinds):
        getattr(spoilt, name)[2 * index] = number
    sound = np.arange(2 * len(kinds)) % 2 == 1
    planes, found = draw_and_differentiate(spoilt, VIEW, "cuda")
    expected, true = draw_and_differentiate(rows(spoilt, sound), VIEW, "cuda")
    assert expected[4].mean() > 0.3
    np.testing.assert_array_equal(planes, expected)
    for name in DERIVATIVES:
        np.testing.assert_array_equal(found[name][sound], true[name], err_msg=name)
        assert not found[name][~sound].any(), name


def test_a_machine_without_triton_is_told_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "triton", None)
    with pytest.raises(UsageError, match=r"needs Triton.*choose the numba backend"):
        importlib.reload(cuda)


@pytest.mark.parametrize("what", ["v_planes", "weight"])
def test_a_spoilt_cotangent_stays_in_its_tile(what: str) -> None:
    view = camera(width=70, height=60, focal=90.0)
    gaussians = with_view_dependence(random_gaussians(8, 40, view, spread=0.25), 1)
    drawing = new_rasterizer(view)
    drawing.forward(gaussians, view)
    v_planes, weight = cotangents(view, 0)
    clean = copies(drawing.backward(v_planes, weight))
    (v_planes if what == "v_planes" else weight)[..., 20, 40] = np.nan
    found = drawing.backward(v_planes, weight)
    bins = inner(drawing)._bins
    tile = 20 // layout.TILE_HEIGHT.value * 5 + 40 // layout.TILE_WIDTH.value
    first, end = bins.tile_starts[tile : tile + 2].tolist()
    away = np.ones(40, bool)
    away[bins.splats[first:end].cpu().numpy()] = False
    assert 10 < away.sum() < 40
    for name in DERIVATIVES:
        np.testing.assert_array_equal(getattr(found, name)[away], clean[name][away], err_msg=name)
    assert not np.isfinite(found.contribution if what == "weight" else found.means).all()


def test_nothing_to_draw() -> None:
    """No Gaussians at all, or none that the camera sees."""
    some = with_filter(with_view_dependence(random_gaussians(2, 6, VIEW), 2))
    away = dataclasses.replace(some, means=some.means + np.array([0, 50, 0], np.float32))
    for gaussians in (rows(some, np.zeros(6, bool)), away):
        drawing = new_rasterizer(VIEW)
        assert not drawing.forward(gaussians, VIEW).any()
        depths, rows_of = drawing.median()
        assert not depths.any() and (rows_of == -1).all()
        found = drawing.backward(*cotangents(VIEW, 0))
        assert found.sh_rest.shape == (len(gaussians), 8, 3)
        assert not any(getattr(found, name).any() for name in DERIVATIVES)


@pytest.mark.parametrize("size", [(1, 1), (1, 40), (33, 1), (17, 9)])
def test_pictures_of_odd_sizes(size: tuple[int, int]) -> None:
    view = camera(*size, focal=30.0, moved=True)
    gaussians = with_filter(with_view_dependence(random_gaussians(3, 10, view, spread=2.0), 1))
    assert_agrees(gaussians, view)


def test_too_many_pairs_and_too_little_memory_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    gaussians = random_gaussians(1, 20, VIEW)

    def full(*_: Any) -> None:
        raise torch.OutOfMemoryError("CUDA out of memory")

    with monkeypatch.context() as patch:
        patch.setattr(rasterizer, "MAX_PAIRS", 30)
        with pytest.raises(SagsError, match=r"20 Gaussians .* pairs, the limit is 30: .* draw fewer"):
            new_rasterizer(VIEW).forward(gaussians, VIEW)
    drawing = new_rasterizer(VIEW)
    drawing.forward(rows(gaussians, slice(2)), VIEW)
    monkeypatch.setattr(rasterizer, "bin_splats", full)
    with pytest.raises(SagsError, match="not enough free memory to draw 20 Gaussians at 35x21 px"):
        drawing.forward(gaussians, VIEW)
    for use in (drawing.median, lambda: drawing.backward(*cotangents(VIEW, 0))):
        with pytest.raises(UsageError, match="last drawing was refused"):  # not the lists of the one before
            use()


def test_a_machine_without_a_gpu_is_told_so(monkeypatch: pytest.MonkeyPatch) -> None:

    monkeypatch.delenv("TRITON_INTERPRET", raising=False)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(UsageError, match=r"found no GPU.*choose the numba backend"):
        make_rasterizer("cuda", 8, 8)


# ---- tiles, cameras, median --------------------------------------------------------------------------------

WIDE = camera(width=50, height=44, focal=60.0)
SHAPE = (-(-44 // TILE_HEIGHT), -(-50 // TILE_WIDTH))


def some_tiles() -> tuple[Bool, Bool]:
    """Some of the tiles [rows, columns], whole and cut by the border, and their pixels [H, W]."""
    tiles = np.zeros(SHAPE, bool)
    tiles[[0, 1], [1, 3]] = True
    return tiles, np.kron(tiles, np.ones((TILE_HEIGHT, TILE_WIDTH), bool))[:44, :50]


def test_active_tiles_are_those_of_the_whole_drawing() -> None:
    gaussians, before = random_gaussians(5, 25, WIDE, spread=0.25), random_gaussians(9, 6, WIDE)
    tiles, drawn = some_tiles()
    v_planes, weight = cotangents(WIDE, 1)
    whole, part = new_rasterizer(WIDE), new_rasterizer(WIDE)
    everything = whole.forward(gaussians, WIDE).copy()
    expected = whole.backward(np.where(drawn, v_planes, 0), np.where(drawn, weight, 0))
    medians = [array.copy() for array in whole.median()]
    old = part.forward(before, WIDE).copy()
    old_medians = [array.copy() for array in part.median()]
    planes = part.forward(gaussians, WIDE, tiles)
    np.testing.assert_array_equal(planes, np.where(drawn, everything, old))
    found = part.backward(v_planes, weight)
    for name in DERIVATIVES:
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name), err_msg=name)
    untouched = int((found.contribution == 0).sum())
    assert 2 < untouched < len(gaussians) - 2
    for now, all_of_it, then in zip(part.median(), medians, old_medians, strict=True):
        np.testing.assert_array_equal(now, np.where(drawn, all_of_it, then))


def test_pairs_are_made_for_active_tiles_only() -> None:
    gaussians = random_gaussians(5, 25, WIDE, spread=0.4)
    drawing = new_rasterizer(WIDE)
    drawing.forward(gaussians, WIDE)
    everywhere = torch.diff(inner(drawing)._bins.tile_starts)
    tiles = np.zeros(SHAPE, bool)
    tiles[0, 2] = True
    drawing.forward(gaussians, WIDE, tiles)
    small = np.zeros((-(-44 // layout.TILE_HEIGHT.value), 4), bool)
    small[: TILE_HEIGHT // layout.TILE_HEIGHT.value, 2] = True
    starts = inner(drawing)._bins.tile_starts
    assert torch.equal(torch.diff(starts), everywhere * torch.tensor(small.ravel(), device=starts.device))
    counts = inner(drawing)._bins.counts
    assert 0 < int((counts > 0).sum()) < 20


def test_without_active_tiles_nothing_happens() -> None:
    gaussians, nothing = random_gaussians(5, 12, WIDE, spread=0.4), np.zeros(SHAPE, bool)
    drawing = new_rasterizer(WIDE)
    first = drawing.forward(gaussians, WIDE).copy()
    np.testing.assert_array_equal(drawing.forward(gaussians, WIDE, nothing), first)
    for found in copies(drawing.backward(*cotangents(WIDE, 0))).values():
        assert not found.any()


def test_median_agrees_with_the_cpu_engine() -> None:
    gaussians = random_gaussians(5, 20, WIDE, spread=0.7)
    results = []
    for backend in ("cuda", "numba"):
        drawing = make_rasterizer(backend, 50, 44)
        drawing.forward(gaussians, WIDE)
        results.append([array.copy() for array in drawing.median()])
    (depths, found), (true_depths, true) = results
    assert 0.2 < (true >= 0).mean() < 0.99
    # one that passes 1/2 by less than rounding may be the next one: 2200 pixels, each by chance 1e-5 of 1/2
    assert np.count_nonzero(found != true) <= 1
    same = found == true
    np.testing.assert_allclose(depths[same], true_depths[same], rtol=2 * after(8))


# ---- repeatable; what stays on the device ------------------------------------------------------------------


def test_a_rasterizer_used_again_gives_the_same_bits_as_a_fresh_one() -> None:
    many = with_filter(with_view_dependence(random_gaussians(6, 8, VIEW), 1))
    few = with_view_dependence(random_gaussians(7, 3, VIEW), 2)
    drawing = new_rasterizer(VIEW)
    for gaussians in (many, few, many):
        planes = drawing.forward(gaussians, VIEW).copy()
        found = copies(drawing.backward(*cotangents(VIEW, 0)))
        expected, true = draw_and_differentiate(gaussians, VIEW, "cuda")
        np.testing.assert_array_equal(planes, expected)
        for name in DERIVATIVES:
            np.testing.assert_array_equal(found[name], true[name], err_msg=name)


def drawn_on_device(gaussians: Gaussians) -> tuple[Any, DeviceGaussians, Any, Any]:
    """A tensor-level rasteriser after drawing, what it drew, and a cotangent and weight for it."""
    checked = new_rasterizer(VIEW)
    checked.forward(gaussians, VIEW)
    inside = inner(checked)
    v_planes, weight = (torch.tensor(array, device=inside.device) for array in cotangents(VIEW, 0))
    return inside, inside._gaussians, v_planes, weight


def test_wrong_tensors_are_explained() -> None:
    inside, drawn, v_planes, weight = drawn_on_device(random_gaussians(2, 5, VIEW))
    with pytest.raises(UsageError, match=r"quats is torch.float32 \[5, 3\], expected torch.float32 \[5, 4\]"):
        dataclasses.replace(drawn, quats=drawn.means)
    with pytest.raises(UsageError, match=r"scales is torch.float64"):
        dataclasses.replace(drawn, scales=drawn.scales.double())
    with pytest.raises(UsageError, match=r"means is on .* must be contiguous"):
        dataclasses.replace(drawn, means=drawn.means.T.contiguous().T)
    with pytest.raises(UsageError, match="sh_rest has 4 terms, expected 0, 3, 8 or 15"):
        dataclasses.replace(drawn, sh_rest=drawn.means.new_zeros((5, 4, 3)))
    with pytest.raises(UsageError, match="v_planes is"):
        inside.pull_back(v_planes[:4], weight)
    with pytest.raises(UsageError, match=r"tiles is torch.bool \[2, 3\], expected bool \[1, 3\]"):
        pinhole = Pinhole(35, 21, 42.0, 43.0, 17.0, 11.0, np.eye(3), np.zeros(3))
        inside.draw(drawn, pinhole, torch.ones((2, 3), dtype=torch.bool))


def test_tiles_of_the_kernels_fill_those_of_the_callers() -> None:
    assert layout.TILE_WIDTH.value == TILE_WIDTH
    assert TILE_HEIGHT % layout.TILE_HEIGHT.value == 0
    assert 1 << layout.TILE_WIDTH_BITS.value == layout.TILE_WIDTH.value
    assert 1 << layout.TILE_HEIGHT_BITS.value == layout.TILE_HEIGHT.value
    assert layout.TILE_PIXELS.value == layout.TILE_WIDTH.value * layout.TILE_HEIGHT.value
