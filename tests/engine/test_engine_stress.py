"""The rasteriser at the edge of what float32 holds: every case against a closed form, the float64 twin, or
the same scene without what was spoilt."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from engine_scenes import (
    DERIVATIVES,
    EXPONENTIAL,
    INPUTS,
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
from sags_node.engine.interface import MAX_OPACITY, NEAR_PLANE
from sags_node.engine.rasterizer.rasterize import make_rasterizer
from sags_node.types import Camera, Gaussians

VIEW = camera()
FULL = with_filter(with_view_dependence(random_gaussians(8, 30, VIEW), 2))


def changed(gaussians: Gaussians, name: str, row: int, value: float) -> Gaussians:
    array = getattr(gaussians, name).copy()
    array[row] = value
    return dataclasses.replace(gaussians, **{name: array})


def assert_finite(planes: np.ndarray, found: dict[str, np.ndarray]) -> None:
    assert np.isfinite(planes).all()
    assert (planes[4] >= 0).all() and planes[4].max() <= 1 + after(1000)
    for name in DERIVATIVES:
        assert np.isfinite(found[name]).all(), name


# ---- sizes, distances, opacities ---------------------------------------------------------------------------


@pytest.mark.parametrize("factor", [0.03, 1e3, 1e6, 1e9])
def test_a_larger_world_further_away_looks_the_same(factor: float) -> None:
    """Pictures do not know the unit of length: depths and derivatives scale, the rest stays."""
    gaussians = dataclasses.replace(
        FULL,
        means=FULL.means * np.float32(factor),
        scales=FULL.scales * np.float32(factor),
        smoothing=FULL.smoothing * np.float32(factor) ** 2,
    )
    planes, _ = draw_and_differentiate(gaussians, VIEW)
    expected, _ = draw_and_differentiate(FULL, VIEW)
    v_planes, weight = cotangents(VIEW, 0)
    v_planes[3] = 0
    true = truth(FULL, VIEW, given=(v_planes, weight))
    unit = np.array([1, 1, 1, factor, 1])[:, None, None]
    np.testing.assert_allclose(planes / unit, expected, rtol=0, atol=2 * true.off.max())
    rasterizer = make_rasterizer("numba", VIEW.width, VIEW.height)
    rasterizer.forward(gaussians, VIEW)
    gradients = rasterizer.backward(v_planes, weight)
    lengths = {"means": factor, "scales": factor}
    for name in DERIVATIVES:
        true.check_gradient(name, getattr(gradients, name).astype(np.float64) * lengths.get(name, 1.0))


@pytest.mark.parametrize("scale", [1e-5, 1e-4, 1e-3, 1e-2, 1e-1, 1.0])
@pytest.mark.parametrize("filtered", [False, True])
def test_scales_from_a_vanishing_dot_to_a_wall(scale: float, filtered: bool) -> None:
    """Six turned Gaussians whose axes differ by 10, through a lens that can show 10 micrometres."""
    view = camera(focal=2000.0)
    gaussians = random_gaussians(3, 6, view)
    axes = np.tile(np.array([scale, scale / 10, scale / 3], np.float32), (6, 1))
    gaussians = dataclasses.replace(gaussians, scales=axes)
    if filtered:
        gaussians = dataclasses.replace(gaussians, smoothing=np.full(6, 0.01 * scale**2, np.float32))
    planes, found = draw_and_differentiate(gaussians, view)
    true = truth(gaussians, view)
    assert_finite(planes, found)
    assert true.planes[4].max() > 0.05
    true.check(planes, found)


@pytest.mark.parametrize("filtered", [False, True])
def test_flat_as_paper_and_thin_as_a_thread(filtered: bool) -> None:
    """Axes of 1e-7 m beside a millimetre, 1 : 10,000; with and without a filter of a micrometre."""
    gaussians = random_gaussians(7, 12, VIEW)
    scales = np.tile(np.array([[1e-3, 1e-7, 2e-3], [1e-3, 1.1e-3, 1e-7]], np.float32), (6, 1))
    scales[8:] = [3e-3, 3e-4, 3e-7]
    gaussians = dataclasses.replace(gaussians, scales=scales, opacities=np.full(12, 0.97, np.float32))
    if filtered:
        gaussians = dataclasses.replace(gaussians, smoothing=np.full(12, 1e-12, np.float32))
    planes, found = draw_and_differentiate(gaussians, VIEW)
    true = truth(gaussians, VIEW)
    assert true.planes[4].max() > 0.05
    true.check(planes, found)


@pytest.mark.parametrize("opacity", [1e-6, 1 / 255, 0.0045, 0.5, 0.9985, 0.9995, 1 - 1e-6, 1.0])
def test_opacities_from_nothing_to_everything(opacity: float) -> None:
    gaussians = random_gaussians(5, 8, VIEW, spread=3.0)
    gaussians = dataclasses.replace(gaussians, opacities=np.full(8, opacity, np.float32))
    planes, found = draw_and_differentiate(gaussians, VIEW)
    assert planes[4].any() == (opacity > 1 / 255)
    truth(gaussians, VIEW).check(planes, found)


@pytest.mark.parametrize("length", [1e-11, 1e-6, 1e6, 1e15])
def test_quaternions_of_any_length_are_the_same_turn(length: float) -> None:
    unit = FULL.quats / np.linalg.norm(FULL.quats, axis=1)[:, None]
    true = truth(dataclasses.replace(FULL, quats=unit), VIEW)
    scaled = dataclasses.replace(FULL, quats=unit * np.float32(length))
    planes, found = draw_and_differentiate(scaled, VIEW)
    true.check(planes, found | {"quats": found["quats"].astype(np.float64) * length})


@pytest.mark.parametrize("length", [1e-13, 1e-30, 1e19])
def test_quaternions_without_a_direction_are_not_drawn(length: float) -> None:
    planes, found = draw_and_differentiate(changed(FULL, "quats", 13, length), VIEW)
    expected, _ = draw_and_differentiate(rows(FULL, np.arange(30) != 13), VIEW)
    np.testing.assert_array_equal(planes, expected)
    assert not any(found[name][13].any() for name in DERIVATIVES)


@pytest.mark.parametrize("height", [1.0 + 1e-6, 1.01, 2.0])  # in near planes
@pytest.mark.parametrize("scale", [1e-6, 1e-4, 1e-2])
def test_just_in_front_of_the_near_plane(height: float, scale: float) -> None:
    """One on the axis, one beside the picture, one far outside."""
    z = NEAR_PLANE * height
    gaussians = rows(random_gaussians(1, 3, VIEW), np.arange(3))
    gaussians = dataclasses.replace(
        gaussians,
        means=np.array([[0, 0, z], [0.45 * z, 0.1 * z, z], [30 * z, -20 * z, z]], np.float32),
        scales=np.full((3, 3), scale, np.float32) * np.array([1, 0.5, 0.7], np.float32),
    )
    planes, found = draw_and_differentiate(gaussians, VIEW)
    assert_finite(planes, found)
    truth(gaussians, VIEW).check(planes, found)


@pytest.mark.parametrize("z", [NEAR_PLANE, 1e-6, 0.0, -1e-6, -0.05, -1e9])
def test_at_or_behind_the_near_plane_nothing_is_drawn(z: float) -> None:
    gaussians = one_gaussian(np.array([0.001, 0.0, z]), 0.01)
    planes, found = draw_and_differentiate(with_view_dependence(gaussians, 3), VIEW)
    assert not planes.any()
    assert not any(found[name].any() for name in DERIVATIVES)


def test_a_principal_point_far_outside_and_a_telephoto_lens() -> None:
    K = np.array([[20000.0, 0, -900.0], [0, 21000, 700], [0, 0, 1]])
    view = Camera(31, 29, K, np.eye(4))
    gaussians = random_gaussians(2, 40, view)
    planes, found = draw_and_differentiate(gaussians, view)
    true = truth(gaussians, view)
    assert true.planes[4].mean() > 0.2
    true.check(planes, found)


# ---- crowds and empty places -------------------------------------------------------------------------------


@pytest.mark.parametrize(("count", "opacity"), [(100_000, 0.9), (100_000, 0.01), (300, 0.01)])
def test_a_crowd_on_one_pixel_follows_the_law_of_absorption(count: int, opacity: float) -> None:
    """n equal Gaussians behind each other, each larger than the picture: what is left is (1 - alpha)^n, down
    to 1e-4, where a tile stops."""
    view = camera(width=3, height=2, focal=30.0)
    one = one_gaussian(geometry.unproject(view, np.array([1.0, 1.0]), np.array(0.07)), 0.3, opacity)
    crowd = rows(one, np.zeros(count, int))
    planes, found = draw_and_differentiate(crowd, view)
    single, _ = draw_and_differentiate(one, view)
    assert_finite(planes, found)
    left = np.maximum((1 - single[4].astype(np.float64)) ** count, 1e-4)
    drawn = int(np.count_nonzero(found["contribution"]))  # until the tile stops
    np.testing.assert_allclose(1 - planes[4], left, atol=1e-4 + drawn * EXPONENTIAL * opacity * left.max())
    np.testing.assert_allclose(planes[0], 0.8 * planes[4], rtol=after(2 * drawn))
    weight = cotangents(view, 0)[1]
    total = found["contribution"].astype(np.float64).sum()
    assert total == pytest.approx((weight * planes[4]).sum(), rel=after(2 * drawn))
    assert (np.diff(found["contribution"]) <= 0).all()  # the nearest are the first of equals


@pytest.mark.parametrize("backend", ["numba", "reference"])
def test_nothing_to_draw(backend: str) -> None:
    """No Gaussians at all, or none that the camera sees."""
    away = dataclasses.replace(FULL, means=FULL.means + np.array([0, 50, 0], np.float32))
    for gaussians in (rows(FULL, np.zeros(30, bool)), away):
        planes, found = draw_and_differentiate(gaussians, VIEW, backend)
        assert planes.shape == (5, 40, 48)
        assert not planes.any()
        assert found["sh_rest"].shape == (len(gaussians), 8, 3)
        assert not any(found[name].any() for name in DERIVATIVES)


@pytest.mark.parametrize("size", [(1, 1), (1, 70), (33, 1), (17, 65)])
def test_pictures_of_odd_sizes(size: tuple[int, int]) -> None:
    view = camera(*size, focal=30.0, moved=True)
    gaussians = with_filter(with_view_dependence(random_gaussians(3, 25, view, spread=2.0), 1))
    planes, found = draw_and_differentiate(gaussians, view)
    true = truth(gaussians, view)
    assert true.planes[4].max() > 0.05
    true.check(planes, found)


# ---- what is not a number ----------------------------------------------------------------------------------


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("name", [*INPUTS, "sh_rest", "smoothing"])
def test_a_spoilt_value_costs_one_gaussian_and_no_other(name: str, value: float) -> None:
    """With view dependence and filter on. A negative filter is none at all."""
    spoilt = changed(FULL, name, 13, value)
    others = np.arange(30) != 13
    planes, found = draw_and_differentiate(spoilt, VIEW)
    if name == "smoothing" and value < 0:
        expected, true = draw_and_differentiate(changed(FULL, name, 13, 0.0), VIEW)
        others[:] = True
    elif name == "opacities" and value < 0:
        expected, true = draw_and_differentiate(changed(FULL, name, 13, 0.0), VIEW)
        true = {key: value[others] for key, value in true.items()}
    else:
        expected, true = draw_and_differentiate(rows(FULL, others), VIEW)
    np.testing.assert_array_equal(planes, expected)
    for key in DERIVATIVES:
        np.testing.assert_array_equal(found[key][others], true[key], err_msg=key)
        assert not found[key][~others].any(), key


@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize("what", ["v_planes", "weight"])
def test_a_spoilt_cotangent_stays_in_its_tile(what: str, value: float) -> None:
    """Gaussians that do not reach the pixel's tile keep their gradients bit by bit."""
    view = camera(width=160, height=128, focal=200.0)
    gaussians = with_filter(with_view_dependence(random_gaussians(8, 200, view), 1))
    rasterizer = make_rasterizer("numba", view.width, view.height)
    rasterizer.forward(gaussians, view)
    v_planes, weight = cotangents(view, 0)
    clean = {name: getattr(rasterizer.backward(v_planes, weight), name).copy() for name in DERIVATIVES}
    (v_planes if what == "v_planes" else weight)[..., 70, 40] = value
    found = rasterizer.backward(v_planes, weight)
    pixels, _ = geometry.project(view, gaussians.means.astype(np.float64))
    reach = 4 * gaussians.scales.max(1) / gaussians.means[:, 2] * 206 + 2
    away = np.abs(pixels - [40, 70]).max(1) > reach + 32
    assert 20 < away.sum() < 190
    for name in DERIVATIVES:
        np.testing.assert_array_equal(getattr(found, name)[away], clean[name][away], err_msg=name)
    assert not np.isfinite(found.contribution if what == "weight" else found.means).all()


def test_opacity_is_held_below_one() -> None:
    """What keeps 1 - alpha away from zero: even a wall lets a thousandth through."""
    view = camera(width=3, height=3, focal=30.0)
    planes, _ = draw_and_differentiate(one_gaussian(np.array([0, 0, 0.07]), 1.0, 1.0), view)
    assert planes[4].max() == pytest.approx(MAX_OPACITY, rel=EXPONENTIAL)
