"""Our GPU rasteriser beyond what all must do (`test_rasterizer.py`): tensors, and machines without it."""

from __future__ import annotations

import dataclasses
import importlib
import sys
from typing import Any

import pytest
import torch
from engine_scenes import camera, cotangents, random_gaussians, rows

from sags_node.engine.rasterizer.rasterize import TILE_HEIGHT, TILE_WIDTH, as_pinhole, make_rasterizer
from sags_node.errors import SagsError, UsageError

pytest.importorskip("triton", reason="Triton comes with torch's CUDA builds, or by `pip install triton`")
pytestmark = pytest.mark.usefixtures("quick_interpreter")

from sags_node.engine import cuda  # noqa: E402  (needs triton)
from sags_node.engine.cuda import layout, rasterizer  # noqa: E402  (needs triton)
from sags_node.engine.cuda.backend import default_device  # noqa: E402
from sags_node.engine.cuda.scene import DeviceGaussians  # noqa: E402

VIEW = camera(width=35, height=21, focal=42.0)  # no whole number of tiles


def test_a_machine_without_triton_is_told_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "triton", None)
    with pytest.raises(UsageError, match=r"needs Triton.*choose the numba backend"):
        importlib.reload(cuda)


def test_a_machine_without_a_gpu_is_told_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("TRITON_INTERPRET", raising=False)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(UsageError, match=r"found no GPU.*choose the numba backend"):
        make_rasterizer("cuda", 8, 8)


def test_too_little_memory_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: Any) -> None:
        raise torch.OutOfMemoryError("CUDA out of memory")

    gaussians = random_gaussians(1, 20, VIEW)
    drawing = make_rasterizer("cuda", VIEW.width, VIEW.height)
    drawing.forward(rows(gaussians, slice(2)), VIEW)
    monkeypatch.setattr(rasterizer, "bin_splats", full)
    with pytest.raises(SagsError, match="not enough free memory to draw 20 Gaussians at 35x21 px"):
        drawing.forward(gaussians, VIEW)
    for use in (drawing.median, lambda: drawing.backward(*cotangents(VIEW, 0))):
        with pytest.raises(UsageError, match="last drawing was refused"):  # not the lists of the one before
            use()


def test_wrong_tensors_are_explained() -> None:
    device = default_device()
    inside = rasterizer.CudaRasterizer(VIEW.width, VIEW.height, True, device)
    drawn = DeviceGaussians.from_host(random_gaussians(2, 5, VIEW), device)
    inside.draw(drawn, as_pinhole(VIEW))
    v_planes, weight = (torch.tensor(array, device=device) for array in cotangents(VIEW, 0))
    with pytest.raises(UsageError, match=r"quats is torch.float32 \[5, 3\], expected torch.float32 \[5, 4\]"):
        dataclasses.replace(drawn, quats=drawn.means)
    with pytest.raises(UsageError, match=r"scales is torch.float64"):
        dataclasses.replace(drawn, scales=drawn.scales.double())
    with pytest.raises(UsageError, match=r"means is on .* must be contiguous"):
        dataclasses.replace(drawn, means=drawn.means.T.contiguous().T)
    with pytest.raises(UsageError, match="sh_rest has 4 terms, expected 0, 3, 8 or 15"):
        dataclasses.replace(drawn, sh_rest=drawn.means.new_zeros((5, 4, 3)))
    with pytest.raises(UsageError, match="v_planes is"):
        inside.backward_pass(v_planes[:4], weight)
    with pytest.raises(UsageError, match=r"tiles is torch.bool \[2, 3\], expected bool \[1, 3\]"):
        inside.draw(drawn, as_pinhole(VIEW), torch.ones((2, 3), dtype=torch.bool))


def test_tiles_of_the_kernels_fill_those_of_the_callers() -> None:
    assert layout.TILE_WIDTH.value == TILE_WIDTH
    assert TILE_HEIGHT % layout.TILE_HEIGHT.value == 0
    assert 1 << layout.TILE_WIDTH_BITS.value == layout.TILE_WIDTH.value
    assert 1 << layout.TILE_HEIGHT_BITS.value == layout.TILE_HEIGHT.value
    assert layout.TILE_PIXELS.value == layout.TILE_WIDTH.value * layout.TILE_HEIGHT.value
