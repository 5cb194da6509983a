"""The gsplat backend against the CPU engine and the float64 twin. On the CPU gsplat runs with the torch
versions of its own stages (`gsplat_on_cpu`), so this shows what is handed to it and what is made of its
results; its kernels themselves need a GPU."""

from __future__ import annotations

import dataclasses
import importlib.util
import sys
from collections.abc import Iterator
from functools import partial
from types import ModuleType
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from engine_scenes import (
    DERIVATIVES,
    EXPONENTIAL,
    as_bytes,
    camera,
    cotangents,
    draw_and_differentiate,
    one_gaussian,
    random_gaussians,
    relative_error,
    with_filter,
    with_view_dependence,
)
from following import Following

from sags_node.config.launch_file import load_launch
from sags_node.doctor import examine
from sags_node.engine.device import choose_device
from sags_node.engine.interface import MAX_OPACITY, MIN_ALPHA
from sags_node.engine.losses.pieces import LEVEL
from sags_node.engine.rasterizer.rasterize import make_rasterizer
from sags_node.errors import SagsError, UsageError
from sags_node.evaluation.metrics import as_float
from sags_node.mapping import mapper
from sags_node.mapping.budget import StepBudget
from sags_node.mapping.refiner import CpuRefiner
from sags_node.mapping.tissue_map import TissueMap
from sags_node.types import Observation

pytest.importorskip("gsplat", reason="the optional backend is not installed: pip install 'sags-node[gsplat]'")
pytest.importorskip("triton", reason="Triton comes with torch's CUDA builds, or by `pip install triton`")

from gsplat_on_cpu import use_gsplat_on_cpu

from sags_node.engine.cuda import gsplat as gsplat_backend

VIEW = camera(width=50, height=44, focal=60.0, moved=True)
pytestmark = pytest.mark.beside


@pytest.fixture(autouse=True)
def on_cpu(request: pytest.FixtureRequest) -> Iterator[None]:
    if "machine" in request.fixturenames:  # the true choice, on a machine that is made up
        yield
        return
    with pytest.MonkeyPatch.context() as patch:
        use_gsplat_on_cpu(patch)
        yield


# ---- where they differ: what docs/gpu.md says of it --------------------------------------------------------


def test_opacities_above_the_largest_of_ours() -> None:
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


def test_where_hardly_anything_shines_through_any_more() -> None:
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


# ---- tiles, parts, limits ----------------------------------------------------------------------------------


def test_limits_are_said(monkeypatch: pytest.MonkeyPatch) -> None:
    drawing = make_rasterizer("gsplat", 50, 44)
    gaussians = random_gaussians(2, 8, VIEW)
    drawing.forward(gaussians, VIEW)
    with pytest.raises(UsageError, match=r"gsplat gives no median depth; choose the numba"):
        drawing.median()

    def full(*_: Any, **__: Any) -> None:
        raise torch.OutOfMemoryError("CUDA out of memory")

    monkeypatch.setattr("gsplat.rasterization", full)
    with pytest.raises(SagsError, match="not enough free memory for gsplat to draw 8 Gaussians at 50x44 px"):
        drawing.forward(gaussians, VIEW)
    with pytest.raises(UsageError, match="last drawing failed"):
        drawing.backward(*cotangents(VIEW, 0))


def test_a_mapper_learns_the_same_with_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """A tilted, moving sheet, frame by frame: what is drawn, back-propagated, refined in the worst tiles, and
    shown, is as with the CPU engine."""
    monkeypatch.setattr(mapper, "FIRST_STEPS", 2)
    pictures = np.random.default_rng(0).uniform(0.2, 0.8, (24, 60, 3)).astype(np.float32)
    pictures = cv2.GaussianBlur(pictures, None, 3)
    y, x = np.mgrid[:24, :48].astype(np.float32)
    learnt = []
    for backend in ("gsplat", "numba"):
        learning = Following(mapper.Mapper(CpuRefiner(partial(make_rasterizer, backend)), TissueMap(60)))
        for i in range(3):
            image = as_bytes(pictures[:, i : i + 48])
            observation = Observation(
                i, i * 33_000_000, camera(48, 24), image, image.mean(2).astype(np.uint8),
                np.ones((24, 48), np.bool_), 0.056 + 1e-4 * x + 1.3e-4 * y, np.ones((24, 48), np.float32),
            )  # fmt: skip
            mapped = learning.take(observation, StepBudget(1))
        view = mapped.view
        error = float(np.square(as_float(view.rgb) - image * LEVEL).mean())
        learnt.append((mapped.snapshot.gaussians, view, error))
    (found, view, error), (expected, true_view, true_error) = learnt
    np.testing.assert_array_equal(found.ids, expected.ids)
    assert len(found) > 40 and true_error < 0.01
    assert error == pytest.approx(true_error, rel=0.01)
    assert relative_error(found.means, expected.means) < 1e-4  # Adam divides what is nearly 0 by its own size
    assert np.abs(view.rgb.astype(int) - true_view.rgb).max() < 0.02 * 255


# ---- whether it can be used --------------------------------------------------------------------------------


@pytest.fixture
def machine(monkeypatch: pytest.MonkeyPatch) -> pytest.MonkeyPatch:
    """As far as torch says, with a GPU."""
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "current_device", lambda: 0)
    return monkeypatch


def test_where_gsplat_is_not_installed(machine: pytest.MonkeyPatch) -> None:
    machine.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(UsageError, match=r"not installed: pip install 'sags-node\[gsplat\]'"):
        make_rasterizer("gsplat", 8, 8)


def test_where_there_is_no_gpu(machine: pytest.MonkeyPatch) -> None:
    machine.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(UsageError, match=r"gsplat backend found no GPU.*choose the numba backend"):
        make_rasterizer("gsplat", 8, 8)


def test_where_its_kernels_are_missing_or_cannot_be_built(machine: pytest.MonkeyPatch) -> None:
    built = ModuleType("gsplat.cuda._backend")
    built._C = None  # type: ignore[attr-defined]
    machine.setitem(sys.modules, built.__name__, built)
    machine.setattr("gsplat.cuda._backend", built, raising=False)
    with pytest.raises(UsageError, match=r"without kernels and found no CUDA compiler.*nvcc"):
        make_rasterizer("gsplat", 8, 8)
    machine.delattr("gsplat.cuda._backend")
    machine.setitem(sys.modules, built.__name__, None)
    with pytest.raises(UsageError, match=r"gsplat's kernels could not be built: .*_backend"):
        make_rasterizer("gsplat", 8, 8)


def test_it_is_a_launch_key_and_the_doctor_looks_at_it(machine: pytest.MonkeyPatch) -> None:
    config = load_launch(None, ["device:=gsplat"])
    assert config.backend == "gsplat" and choose_device(config.device).kind == "cpu"
    machine.setattr(torch.cuda, "is_available", lambda: False)
    (found,) = (check for check in examine(config) if check.name == "gsplat")
    assert found.level == "error" and "found no GPU" in found.fix
    machine.setattr(gsplat_backend, "usable_device", lambda: torch.device("cuda"))
    (found,) = (check for check in examine(config) if check.name == "gsplat")
    assert found.level == "ok"
    assert not [check for check in examine(load_launch()) if check.name == "gsplat"]


# ---- on a GPU ----------------------------------------------------------------------------------------------


@pytest.mark.skipif(not torch.cuda.is_available(), reason="gsplat's kernels need a GPU")
def test_its_kernels_draw_what_the_cpu_engine_draws(machine: pytest.MonkeyPatch) -> None:
    """They are compiled with fast, inexact arithmetic."""
    machine.undo()
    try:
        gsplat_backend.usable_device()
    except UsageError as error:
        pytest.skip(str(error))
    gaussians = with_filter(with_view_dependence(random_gaussians(3, 200, VIEW), 3))
    planes, found = draw_and_differentiate(gaussians, VIEW, "gsplat")
    true_planes, true = draw_and_differentiate(gaussians, VIEW, "numba")
    np.testing.assert_allclose(planes, true_planes, atol=2e-4)
    for name in true:
        assert relative_error(found[name], true[name]) < 2e-3, name
