"""Slopes, for who knows none."""

from dataclasses import replace

import numpy as np
from engine_scenes import camera, round_gaussians
from flat_scene import flat_means

from sags_node.engine.rasterizer.rasterize import make_rasterizer
from sags_node.model.constant_colours import with_constant_colours
from sags_node.types import F32, Gaussians

VIEW = camera(width=96, height=80, focal=120.0)


def drawn(gaussians: Gaussians) -> F32:
    """[3, H, W] RGB, normalised."""
    planes = make_rasterizer("numba", VIEW.width, VIEW.height).forward(gaussians, VIEW)
    return planes[:3] / np.maximum(planes[4], np.float32(1e-3))


def scene() -> Gaussians:
    """Flat Gaussians side by side, 7 cm away, as those of tissue."""
    rng, means = np.random.default_rng(2), flat_means(VIEW, 0.07, 6.0)
    pixel, shape = 0.07 / VIEW.K[0, 0], means.shape
    return replace(
        round_gaussians(means, pixel, rng.uniform(0.3, 0.7, shape)),
        scales=(pixel * rng.uniform([2, 2, 0.5], [3.5, 3.5, 1], shape)).astype(np.float32),
        opacities=rng.uniform(0.2, 0.5, len(means)).astype(np.float32),
        depth_errors=np.ones(len(means), np.float32),
        slopes=(rng.normal(0, 0.06, shape) * [1, 0, 0]).astype(np.float32),
    )


def test_splitting_in_two_keeps_most_of_what_slopes_show() -> None:
    gaussians = scene()
    given = replace(gaussians, slopes=gaussians.slopes.copy())
    baked = with_constant_colours(gaussians)
    assert baked.slopes is None and len(gaussians) < len(baked) <= 2 * len(gaussians)
    middle = np.s_[:, 6:-6, 6:-6]  # covered everywhere
    whole = drawn(gaussians)[middle]
    lost = [np.mean((drawn(one)[middle] - whole) ** 2) for one in (baked, replace(gaussians, slopes=None))]
    assert lost[0] < 0.6 * lost[1]
    for name in ("means", "scales", "colors", "opacities", "slopes"):  # what was given is not written to
        np.testing.assert_array_equal(getattr(gaussians, name), getattr(given, name))


def test_two_halves_are_as_wide_and_as_opaque_as_the_whole() -> None:
    """The variance of two Gaussians +-d apart is theirs and d^2; 1 - (1 - o)^2 is the whole's opacity."""
    gaussians = scene()
    baked = with_constant_colours(gaussians)
    ids, counts = np.unique(baked.ids, return_counts=True)
    assert set(counts) == {1, 2}
    for number in ids[counts == 2][:20]:
        (row,), halves = np.flatnonzero(gaussians.ids == number), np.flatnonzero(baked.ids == number)
        np.testing.assert_allclose(baked.means[halves].mean(0), gaussians.means[row], atol=1e-7)
        np.testing.assert_allclose(baked.colors[halves].mean(0), gaussians.colors[row], atol=1e-6)
        axis = np.abs(gaussians.slopes[row]).argmax()
        apart = np.linalg.norm(np.diff(baked.means[halves], axis=0)) / 2
        wide, whole = baked.scales[halves[0], axis], gaussians.scales[row, axis]
        assert np.isclose(wide**2 + apart**2, whole**2, rtol=1e-4)
        assert np.isclose(1 - (1 - baked.opacities[halves[0]]) ** 2, gaussians.opacities[row], rtol=1e-4)


def test_without_slopes_nothing_changes() -> None:
    gaussians = replace(scene(), slopes=None)
    assert with_constant_colours(gaussians) is gaussians
