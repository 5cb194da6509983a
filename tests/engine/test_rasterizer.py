"""What every rasteriser must do: Numba's kernels and Warp's, here on its CPU device, against the twin in
float64, a closed form, or the same scene without what was spoilt."""

import dataclasses
import importlib
from collections.abc import Iterator
from itertools import product
from typing import Any

import numpy as np
import pytest
import warp as wp
from engine_scenes import (
    DERIVATIVES,
    EXPONENTIAL,
    INPUTS,
    camera,
    cotangents,
    draw_and_differentiate,
    one_gaussian,
    random_gaussians,
    rasterize,
    rows,
    truth,
    with_filter,
    with_view_dependence,
)
from numpy.typing import NDArray
from rounding import after
from warp_on_cpu import use_warp_on_cpu

from benchmarks.kernels.reference import ReferenceRasterizer
from sags_node import geometry
from sags_node.engine.interface import MIN_ALPHA, NEAR_PLANE
from sags_node.engine.rasterizer.rasterize import (
    TILE_HEIGHT,
    TILE_WIDTH,
    Gradients,
    Rasterizer,
    make_rasterizer,
)
from sags_node.errors import SagsError
from sags_node.types import F32, Camera, Gaussians

VIEW = camera()  # 48 x 40 px
MODULES = {  # where each has its MAX_PAIRS
    "numba": "sags_node.engine.rasterizer.cpu",
    "warp": "sags_node.engine.gpu.rasterizer",
}


@dataclasses.dataclass(frozen=True)
class Backend:
    """One of them."""

    name: str

    def rasterizer(self, view: Camera) -> Rasterizer:
        return make_rasterizer(self.name, view.width, view.height)

    def draw(self, gaussians: Gaussians, view: Camera = VIEW, **options: Any) -> tuple[F32, dict[str, Any]]:
        return draw_and_differentiate(gaussians, view, self.name, **options)

    def agrees(self, gaussians: Gaussians, view: Camera, shown: float, **options: Any) -> None:
        """Planes, and gradients of a random cotangent, with the float64 twin; `shown`: the least coverage of
        some pixel."""
        true = truth(gaussians, view, **options)
        assert true.planes[4].max() > shown
        true.check(*self.draw(gaussians, view, **options))


@pytest.fixture(params=MODULES)
def backend(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Backend:
    if request.param == "warp":
        use_warp_on_cpu(monkeypatch)
    return Backend(request.param)


def same(found: dict[str, Any], true: dict[str, Any], keep: Any = ...) -> None:
    """The gradients of `keep` are those, bit by bit."""
    for name in DERIVATIVES:
        np.testing.assert_array_equal(found[name][keep], true[name], err_msg=name)


def copies(gradients: Gradients) -> dict[str, NDArray[np.floating]]:
    return {name: getattr(gradients, name).copy() for name in DERIVATIVES}


def scene_of(gaussians: Gaussians, degree: int, filtered: bool, seed: int = 0) -> Gaussians:
    gaussians = with_view_dependence(gaussians, degree, seed) if degree else gaussians
    return with_filter(gaussians, seed) if filtered else gaussians


# ---- the arithmetic ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.parametrize(
    ("degree", "filtered", "antialias", "moved"),
    [(0, False, True, False), (0, False, True, True), (0, False, False, True), (1, True, False, True),
     (2, False, True, True), (3, True, True, True)],
)  # fmt: skip
def test_agrees_with_the_float64_twin(
    backend: Backend, seed: int, degree: int, filtered: bool, antialias: bool, moved: bool
) -> None:
    """Every derivative, all degrees, both filters on and off."""
    view = camera(moved=moved)
    gaussians = scene_of(random_gaussians(seed, 60, view), degree, filtered, seed)
    backend.agrees(gaussians, view, seed=seed, antialias=antialias, shown=0.25)


def extremes() -> Iterator[tuple[str, Camera, Gaussians, float]]:
    """What it shows, a camera, a scene, and the least coverage of some pixel."""
    for scale, filtered in product((1e-5, 1e-4, 1e-3, 1e-2, 1e-1, 1.0), (False, True)):
        # six turned Gaussians whose axes differ by 10, through a lens that can show 10 micrometres
        view = camera(focal=2000.0)
        axes = np.tile(np.array([scale, scale / 10, scale / 3], np.float32), (6, 1))
        smoothing = np.full(6, 0.01 * scale**2, np.float32) if filtered else None
        scene = dataclasses.replace(random_gaussians(3, 6, view), scales=axes, smoothing=smoothing)
        yield f"from a vanishing dot to a wall: {scale} m, {filtered=}", view, scene, 0.05
    flat = [(1e-3, 1e-7, 2e-3), (1e-3, 1.1e-3, 1e-7), (3e-3, 3e-4, 3e-7), (0.1, 1e-5, 1e-3)]
    for axes_m, filtered in product(flat, (False, True)):
        scene = dataclasses.replace(
            random_gaussians(7, 8, VIEW),
            scales=np.tile(np.array(axes_m, np.float32), (8, 1)),
            opacities=np.full(8, 0.97, np.float32),
            smoothing=np.full(8, 1e-12, np.float32) if filtered else None,  # of a micrometre
        )
        yield f"flat as paper, thin as a thread: {axes_m} m, {filtered=}", VIEW, scene, 0.01
    for size in [(1, 1), (1, 70), (33, 1), (15, 31), (16, 32), (17, 33), (17, 65), (100, 7)]:
        view = camera(*size, focal=30.0, moved=True)
        yield f"of odd size: {size}", view, scene_of(random_gaussians(3, 25, view, 2.0), 1, True), 0.05
    K = np.array([[20000.0, 0, -900.0], [0, 21000, 700], [0, 0, 1]])
    view = Camera(31, 29, K, np.eye(4))
    yield "a principal point far outside, a telephoto lens", view, random_gaussians(2, 40, view), 0.2
    view, rng = camera(moved=True), np.random.default_rng(11)
    means = geometry.unproject(view, rng.uniform([-60, -30], [-30, 60], (6, 2)), rng.uniform(0.05, 0.09, 6))
    scales = rng.uniform(0.02, 0.05, (6, 3)).astype(np.float32)
    scene = dataclasses.replace(random_gaussians(11, 6, view), means=means.astype(np.float32), scales=scales)
    yield "a Jacobian held: large, with centres beyond the widened frustum", view, scene, 0.05


EXTREMES = {what: scene for what, *scene in extremes()}


@pytest.mark.parametrize("what", EXTREMES)
def test_extremes_agree_with_the_float64_twin(backend: Backend, what: str) -> None:
    view, gaussians, shown = EXTREMES[what]
    backend.agrees(gaussians, view, shown)


@pytest.mark.parametrize("opacity", [1e-6, 1 / 255, 0.0045, 0.5, 0.9985, 0.9995, 1 - 1e-6, 1.0])
def test_opacities_from_nothing_to_everything(backend: Backend, opacity: float) -> None:
    """On the GPU a pixel ends by itself where it lets 1e-4 through, not with its tile. What is left out there
    counts a thousandfold, 1 / (1 - alpha), in the gradients of what hides it."""
    gaussians = random_gaussians(5, 8, VIEW, spread=3.0)
    gaussians = dataclasses.replace(gaussians, opacities=np.full(8, opacity, np.float32))
    planes, found = backend.draw(gaussians)
    assert planes[4].any() == (opacity > 1 / 255)
    true = truth(gaussians, VIEW)
    if backend.name == "warp" and opacity > 0.9:
        np.testing.assert_allclose(planes, true.planes, rtol=0, atol=1e-4 + true.off.max())
    else:
        true.check(planes, found)


def test_quaternions_of_any_length_are_the_same_turn(backend: Backend) -> None:
    gaussians = scene_of(random_gaussians(8, 8, VIEW), 2, True)
    unit = gaussians.quats / np.linalg.norm(gaussians.quats, axis=1)[:, None]
    lengths = np.array([1e-11, 1e-6, 1e-3, 1, 1e3, 1e6, 1e15, 7], np.float32)[:, None]
    true = truth(dataclasses.replace(gaussians, quats=unit), VIEW)
    planes, found = backend.draw(dataclasses.replace(gaussians, quats=unit * lengths))
    true.check(planes, found | {"quats": found["quats"].astype(np.float64) * lengths})


@pytest.mark.parametrize("height", [1.0 + 1e-6, 1.01, 2.0])  # in near planes
@pytest.mark.parametrize("scale", [1e-6, 1e-4, 1e-2])
def test_just_in_front_of_the_near_plane_and_not_behind_it(
    backend: Backend, height: float, scale: float
) -> None:
    """On the axis, beside the image, far outside; then at the plane, on the camera and behind it."""
    z = NEAR_PLANE * np.array([height, height, height, 0.999, 1e-3, -1e-3, -1.0, -1e12])
    aside = np.zeros((2, 8))
    aside[:, 1:3] = [[0.45, 30], [0.1, -20]]
    gaussians = dataclasses.replace(
        with_view_dependence(random_gaussians(1, 8, VIEW), 3),
        means=np.stack([*(z * aside), z], 1).astype(np.float32),
        scales=np.full((8, 3), scale, np.float32) * np.array([1, 0.5, 0.7], np.float32),
    )
    planes, found = backend.draw(gaussians)
    truth(gaussians, VIEW).check(planes, found)
    assert not any(found[name][3:].any() for name in DERIVATIVES)


@pytest.mark.parametrize("factor", [0.03, 1e3, 1e6, 1e9])
def test_a_larger_world_further_away_looks_the_same(backend: Backend, factor: float) -> None:
    """Images do not know the unit of length: depths and derivatives scale, the rest stays."""
    gaussians = scene_of(random_gaussians(8, 30, VIEW), 2, True)
    larger = dataclasses.replace(
        gaussians,
        means=gaussians.means * np.float32(factor),
        scales=gaussians.scales * np.float32(factor),
        smoothing=gaussians.smoothing * np.float32(factor) ** 2,
    )
    v_planes, weight = cotangents(VIEW, 0)
    v_planes[3] = 0
    true = truth(gaussians, VIEW, given=(v_planes, weight))
    rasterizer = backend.rasterizer(VIEW)
    planes = rasterizer.forward(larger, VIEW).copy()
    unit = np.array([1, 1, 1, factor, 1])[:, None, None]
    np.testing.assert_allclose(planes / unit, true.planes, rtol=0, atol=true.off.max())
    lengths = {"means": factor, "scales": factor}
    for name, gradient in copies(rasterizer.backward(v_planes, weight)).items():
        true.check_gradient(name, gradient.astype(np.float64) * lengths.get(name, 1.0))


def test_a_crowd_on_one_pixel_follows_the_law_of_absorption(backend: Backend) -> None:
    """n equal Gaussians behind each other, larger than the image and smaller than a tile, whose rest beyond
    its border never fills: what is left is (1 - alpha)^n, down to 1e-4, where a tile stops. Those that it
    hides have no gradient."""
    view = camera(width=3, height=2, focal=30.0)
    for count, opacity in [(100_000, 0.9), (100_000, 0.01), (300, 0.01)]:
        one = one_gaussian(geometry.unproject(view, np.array([1.0, 1.0]), np.array(0.07)), 0.01, opacity)
        planes, found = backend.draw(rows(one, np.zeros(count, int)), view)
        alpha = backend.draw(one, view)[0][4].astype(np.float64)
        through = (1 - alpha) ** count
        left = np.maximum(through, 1e-4)
        drawn = int(np.count_nonzero(found["contribution"]))  # until the tile stops
        assert (drawn < count) == (through.max() < 1e-4)
        assert found["means"][0].all() and not found["means"][drawn:].any()
        rough = drawn * EXPONENTIAL * opacity * left.max()
        np.testing.assert_allclose(1 - planes[4], left, rtol=0, atol=1e-4 + rough)
        np.testing.assert_allclose(planes[0], 0.8 * planes[4], rtol=after(2 * drawn))
        total = found["contribution"].astype(np.float64).sum()
        assert total == pytest.approx((cotangents(view, 0)[1] * planes[4]).sum(), rel=after(2 * drawn))
        assert (np.diff(found["contribution"]) <= 0).all()  # the nearest are the first of equals


def test_unprojected_pixel_peaks_at_that_pixel(backend: Backend) -> None:
    """The first pixel's middle is at (0, 0), as in OpenCV: also in corners and beside borders of tiles."""
    view = camera(48, 40, moved=True)
    for pixel in [(0, 0), (17, 5), (47, 39), (15, 31), (16, 32)]:
        mean = geometry.unproject(view, np.array(pixel, float), np.array(0.07))
        drawn = rasterize(one_gaussian(mean, 0.001), view, backend=backend.name)
        row, column = np.unravel_index(np.argmax(drawn.alpha), drawn.alpha.shape)
        assert (int(column), int(row)) == pixel
        assert drawn.depth[row, column] == pytest.approx(0.07, rel=after(20))  # one weight, divided out again
        assert drawn.rgb[row, column] == pytest.approx([204, 127.5, 51], abs=0.5)  # 0.8, 0.5 and 0.2 of 255


# ---- what is not a number, or nowhere ----------------------------------------------------------------------

SPOILED: list[tuple[str, Any]] = [
    (name, number) for name in (*INPUTS, "sh_rest") for number in (np.nan, np.inf, -np.inf)
]
SPOILED += [("quats", 0.0), ("quats", 1e-13), ("quats", 1e-30), ("quats", 1e19)]
SPOILED += [
    *(("means", place) for place in (0.0, -0.07, (0, 0, 0.9 * NEAR_PLANE))),
    *(("opacities", opacity) for opacity in (0.99 * MIN_ALPHA, 0.0, -1.0)),
    ("scales", 1e30),
]
WITHOUT_FILTER = [*SPOILED, ("scales", 0.0), ("scales", 1e-30)]  # a filter gives these a size
WITH_FILTER = [*SPOILED, ("smoothing", np.nan), ("smoothing", np.inf)]


@pytest.mark.parametrize("kinds", [WITH_FILTER, WITHOUT_FILTER], ids=["filter", "no filter"])
def test_a_spoilt_gaussian_is_left_out_and_harms_no_other(
    backend: Backend, kinds: list[tuple[str, Any]]
) -> None:
    """One of each kind among sound ones, and the same scene without them: the same bits."""
    filtered = kinds is WITH_FILTER
    spoilt = scene_of(random_gaussians(8, 2 * len(kinds), VIEW, spread=0.9), 1, filtered)
    for index, (name, number) in enumerate(kinds):
        getattr(spoilt, name)[2 * index] = number
    sound = np.arange(2 * len(kinds)) % 2 == 1
    planes, found = backend.draw(spoilt)
    expected, true = backend.draw(rows(spoilt, sound))
    assert expected[4].mean() > 0.3
    np.testing.assert_array_equal(planes, expected)
    same(found, true, sound)
    for name in DERIVATIVES:
        harmed = np.nonzero(found[name][~sound].reshape(len(kinds), -1).any(1))[0]
        assert not len(harmed), (name, [kinds[index] for index in harmed])


def test_a_negative_filter_is_none(backend: Backend) -> None:
    negative, none = (scene_of(random_gaussians(8, 8, VIEW), 1, True) for _ in range(2))
    assert negative.smoothing is not None and none.smoothing is not None
    negative.smoothing[3], none.smoothing[3] = -np.inf, 0
    planes, found = backend.draw(negative)
    expected, true = backend.draw(none)
    np.testing.assert_array_equal(planes, expected)
    same(found, true)


@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize("what", ["v_planes", "weight"])
def test_a_spoilt_cotangent_stays_in_its_tile(backend: Backend, what: str, value: float) -> None:
    """Gaussians that do not reach the pixel's tile keep their gradients bit by bit."""
    view = camera(width=110, height=80, focal=140.0)
    count = 200
    gaussians = scene_of(random_gaussians(8, count, view, spread=np.sqrt(count / 200)), 1, True)
    rasterizer = backend.rasterizer(view)
    rasterizer.forward(gaussians, view)
    v_planes, weight = cotangents(view, 0)
    clean = copies(rasterizer.backward(v_planes, weight))
    (v_planes if what == "v_planes" else weight)[..., 70, 10] = value
    found = rasterizer.backward(v_planes, weight)
    pixels, _ = geometry.project(view, gaussians.means.astype(np.float64))
    reach = 4 * gaussians.scales.max(1) / gaussians.means[:, 2] * 144.2 + 2
    away = np.abs(pixels - [10, 70]).max(1) > reach + 32
    assert 0.1 * count < away.sum() < 0.95 * count
    for name in DERIVATIVES:
        np.testing.assert_array_equal(getattr(found, name)[away], clean[name][away], err_msg=name)
    assert not np.isfinite(found.contribution if what == "weight" else found.means).all()


def test_nothing_to_draw(backend: Backend) -> None:
    """No Gaussians at all, or none that the camera sees, also where there was something before."""
    some = scene_of(random_gaussians(2, 6, VIEW), 2, True)
    away = dataclasses.replace(some, means=some.means + np.array([0, 50, 0], np.float32))
    nothing = [rows(some, np.zeros(6, bool)), away]
    for gaussians in nothing:
        rasterizer = backend.rasterizer(VIEW)
        assert rasterizer.forward(some, VIEW).any()
        planes = rasterizer.forward(gaussians, VIEW)
        assert planes.shape == (5, VIEW.height, VIEW.width) and not planes.any()
        depths, rows_of = rasterizer.median()
        assert not depths.any() and (rows_of == -1).all()
        found = rasterizer.backward(*cotangents(VIEW, 0))
        assert found.sh_rest.shape == (len(gaussians), 8, 3)
        assert not any(getattr(found, name).any() for name in DERIVATIVES)


# ---- repeatable; tiles; median -----------------------------------------------------------------------------

WIDE = camera(width=100, height=77, focal=110.0, moved=True)  # no whole number of tiles
SHAPE = (-(-77 // TILE_HEIGHT), -(-100 // TILE_WIDTH))


def wide_scene(seed: int = 5) -> Gaussians:
    return with_view_dependence(random_gaussians(seed, 400, WIDE, spread=0.5), 1)


def test_a_rasterizer_used_again_gives_what_a_fresh_one_gives(backend: Backend) -> None:
    """Other numbers of Gaussians and degrees, half of them out of sight."""
    view = camera(moved=True)
    many = scene_of(random_gaussians(6, 300, view, spread=0.7), 1, True)
    away = np.where(np.arange(len(many))[:, None] % 2, many.means, many.means + np.float32(9))
    few = with_view_dependence(random_gaussians(7, 3, view), 3)
    rasterizer = backend.rasterizer(view)
    for gaussians in (few, many, dataclasses.replace(many, means=away), random_gaussians(8, 60, view), many):
        planes = rasterizer.forward(gaussians, view).copy()
        expected, true = backend.draw(gaussians, view)
        np.testing.assert_array_equal(planes, expected)
        same(copies(rasterizer.backward(*cotangents(view, 0))), true)


@pytest.mark.parametrize("seed", [1, 2])
def test_active_tiles_are_those_of_the_whole_drawing(backend: Backend, seed: int) -> None:
    """What is not asked for stays, counts for nothing, and has left nothing behind from before."""
    gaussians, before = wide_scene(), random_gaussians(9, 60, WIDE, spread=0.5)
    tiles = np.random.default_rng(seed).permutation(SHAPE[0] * SHAPE[1]).reshape(SHAPE) < 4  # of 28
    drawn = np.kron(tiles, np.ones((TILE_HEIGHT, TILE_WIDTH), bool))[:77, :100]
    v_planes, weight = cotangents(WIDE, seed)
    whole, part = backend.rasterizer(WIDE), backend.rasterizer(WIDE)
    everything = whole.forward(gaussians, WIDE).copy()
    whole.backward(v_planes, weight)  # its pairs hold gradients of tiles that are then passed over
    expected = copies(whole.backward(np.where(drawn, v_planes, 0), np.where(drawn, weight, 0)))
    old = part.forward(before, WIDE).copy()
    medians = [[array.copy() for array in rasterizer.median()] for rasterizer in (whole, part)]
    planes = part.forward(gaussians, WIDE, tiles).copy()
    np.testing.assert_array_equal(planes, np.where(drawn, everything, old))
    found = copies(part.backward(v_planes, weight))
    same(found, expected)
    untouched = int((found["contribution"] == 0).sum())
    assert 2 < untouched < len(gaussians) - 2
    for now, all_of_it, then in zip(part.median(), *medians, strict=True):
        np.testing.assert_array_equal(now, np.where(drawn, all_of_it, then))


def test_without_active_tiles_nothing_happens(backend: Backend) -> None:
    rasterizer = backend.rasterizer(WIDE)
    before = rasterizer.forward(wide_scene(), WIDE).copy()
    others, nothing = random_gaussians(9, 12, WIDE), np.zeros(SHAPE, bool)
    np.testing.assert_array_equal(rasterizer.forward(others, WIDE, nothing), before)
    for name, found in copies(rasterizer.backward(*cotangents(WIDE, 0))).items():
        assert not found.any(), name


def test_pairs_are_made_for_active_tiles_only_and_too_many_are_refused(
    backend: Backend, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Room for half of the Gaussians is enough for one of 28 tiles; the CPU reserves it in blocks."""
    count = 5000
    gaussians, tiles = random_gaussians(5, count, WIDE, spread=0.1), np.zeros(SHAPE, bool)
    tiles[0, 2] = True
    rasterizer = backend.rasterizer(WIDE)
    rasterizer.forward(gaussians, WIDE)
    module = importlib.import_module(MODULES[backend.name])
    monkeypatch.setattr(module, "MAX_PAIRS", count // 2)
    rasterizer.forward(gaussians, WIDE, tiles)
    with pytest.raises(SagsError, match=rf"pairs, the limit is {module.MAX_PAIRS}: .* draw fewer"):
        rasterizer.forward(gaussians, WIDE)


def test_pairs_beyond_32_bits_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """Three Gaussians with a thousand million pairs each: their sum must not turn negative."""
    use_warp_on_cpu(monkeypatch)
    add_up = wp.utils.array_scan

    def scan(counts: wp.array, ends: wp.array, inclusive: bool) -> None:
        counts.numpy()[:] += 1 << 30
        add_up(counts, ends, inclusive)

    monkeypatch.setattr(wp.utils, "array_scan", scan)
    with pytest.raises(SagsError, match=r"draw fewer"):
        make_rasterizer("warp", WIDE.width, WIDE.height).forward(random_gaussians(5, 3, WIDE), WIDE)


def test_median_agrees_with_the_twin(backend: Backend) -> None:
    """A pixel whose transmittance passes 1/2 by less than rounding may name the next Gaussian: transmittances
    are off by 1e-5 of themselves, so this is one pixel in 100,000."""
    gaussians = random_gaussians(5, len(wide_scene()), WIDE)
    results = []
    for rasterizer in (backend.rasterizer(WIDE), ReferenceRasterizer()):
        rasterizer.forward(gaussians, WIDE)
        results.append(rasterizer.median())
    (depths, found), (true_depths, true) = results
    assert 0.2 < (true >= 0).mean() < 0.99
    assert np.count_nonzero(found != true) <= 2
    same = found == true
    np.testing.assert_allclose(depths[same], true_depths[same], rtol=after(8))
    assert not depths[found < 0].any()
