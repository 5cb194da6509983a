"""The gsplat backend against the CPU engine and the float64 twin. On the CPU gsplat runs with the torch
versions of its own stages (`gsplat_on_cpu`), so this shows what is handed to it and what is made of its
results; its kernels themselves need a GPU."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from engine_scenes import (
    DERIVATIVES,
    EXPONENTIAL,
    camera,
    cotangents,
    draw_and_differentiate,
    one_gaussian,
    random_gaussians,
    relative_error,
    with_filter,
    with_view_dependence,
)
from rounding import after

from sags_node.engine.device import find_gpu
from sags_node.engine.interface import MAX_OPACITY, MIN_ALPHA
from sags_node.engine.rasterizer.rasterize import make_rasterizer
from sags_node.errors import UsageError

pytest.importorskip("gsplat", reason="the optional backend is not installed: pip install 'sags-node[gsplat]'")

from gsplat_on_cpu import use_gsplat_on_cpu

VIEW = camera(width=50, height=44, focal=60.0, moved=True)
pytestmark = pytest.mark.beside


@pytest.fixture
def on_cpu(monkeypatch: pytest.MonkeyPatch) -> None:
    use_gsplat_on_cpu(monkeypatch)


def test_opacities_above_the_largest_of_ours(on_cpu: None) -> None:
    """Ours holds the opacity at 0.999, gsplat alpha at every pixel: apart by 0.001, and at the rim of each
    Gaussian, where only one of them is cut off, by the smallest alpha."""
    gaussians = dataclasses.replace(random_gaussians(4, 40, VIEW), opacities=np.ones(40, np.float32))
    planes, _ = draw_and_differentiate(gaussians, VIEW, "gsplat")
    true_planes, _ = draw_and_differentiate(gaussians, VIEW, "numba")
    apart = np.abs(planes - true_planes)[4]
    assert 2e-4 < apart.max() < 3 * MIN_ALPHA
    assert np.median(apart) < 2e-4
    wall = one_gaussian(np.array([0, 0, 0.07]), 0.5, 1.0)
    for backend in ("gsplat", "numba"):
        drawn, _ = draw_and_differentiate(wall, camera(), backend)
        assert drawn[4].max() == pytest.approx(MAX_OPACITY, rel=EXPONENTIAL)


def test_where_hardly_anything_shines_through_any_more(on_cpu: None) -> None:
    """gsplat leaves out the Gaussian that would darken a pixel to 1e-4, and all behind it; ours finishes the
    tile. What gsplat lets shine through is less than 1e-4 / (1 - alpha) of that Gaussian."""
    opacity = 0.95
    gaussians = dataclasses.replace(
        random_gaussians(6, 400, VIEW, spread=4.0), opacities=np.full(400, opacity, np.float32)
    )
    planes, found = draw_and_differentiate(gaussians, VIEW, "gsplat")
    true_planes, true = draw_and_differentiate(gaussians, VIEW, "numba")
    assert true_planes[4].min() > 0.9999
    apart = (true_planes - planes)[4]
    assert -EXPONENTIAL < apart.min() and 1e-3 < apart.max() < 1e-4 / (1 - opacity)
    for name in DERIVATIVES[:5]:
        assert 1e-4 < relative_error(found[name], true[name]) < 2e-2, name


def test_a_drawing_may_be_differentiated_twice(on_cpu: None) -> None:
    rasterizer = make_rasterizer("gsplat", 50, 44)
    rasterizer.forward(random_gaussians(2, 8, VIEW), VIEW)
    first, again = (rasterizer.backward(*cotangents(VIEW, 0)) for _ in range(2))
    assert relative_error(again.means, first.means) < after(50 * 44)  # sums in another order


def test_it_gives_no_median_depth(on_cpu: None) -> None:
    drawing = make_rasterizer("gsplat", 50, 44)
    gaussians = random_gaussians(2, 8, VIEW)
    drawing.forward(gaussians, VIEW)
    with pytest.raises(UsageError, match=r"gsplat gives no median depth; choose the numba"):
        drawing.median()


@pytest.mark.skipif(find_gpu().kind == "cpu", reason=f"gsplat's kernels need a GPU: {find_gpu().reason}")
def test_its_kernels_draw_what_the_cpu_engine_draws() -> None:
    """They are compiled with fast, inexact arithmetic."""
    gaussians = with_filter(with_view_dependence(random_gaussians(3, 200, VIEW), 3))
    planes, found = draw_and_differentiate(gaussians, VIEW, "gsplat")
    true_planes, true = draw_and_differentiate(gaussians, VIEW, "numba")
    np.testing.assert_allclose(planes, true_planes, atol=2e-4)
    for name in true:
        assert relative_error(found[name], true[name]) < 2e-3, name
