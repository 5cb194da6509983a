"""The rasteriser on a GPU: is it right, how fast is it, and how fast is gsplat on the same Gaussians."""

from __future__ import annotations

import importlib.util
from typing import Any

import numpy as np
import warp as wp

from benchmarks.kernels.rasterizing import RasterCase, make_cotangents
from benchmarks.kernels.scenes import surface
from benchmarks.kernels.timing import median_ms
from sags_node.engine import device
from sags_node.engine.gpu.rasterizer import DERIVED, DeviceRasterizer, sent
from sags_node.engine.interface import MIP_VARIANCE, NEAR_PLANE
from sags_node.engine.rasterizer.arguments import view_of
from sags_node.engine.rasterizer.rasterize import make_rasterizer
from sags_node.types import Camera, Gaussians

Row = dict[str, Any]


def parity(count: int, width: int, height: int) -> Row:
    """Compare the GPU's planes and gradients with the CPU's, and check that they repeat to the bit."""
    gaussians, camera = surface(count, width, height)
    v_planes, weight = make_cotangents(RasterCase(count, width, height, 1))
    drawn = []
    for backend in ("numba", "warp", "warp"):
        rasterizer = make_rasterizer(backend, width, height)
        planes = rasterizer.forward(gaussians, camera).copy()
        gradients = rasterizer.backward(v_planes, weight)
        drawn.append((planes, {name: getattr(gradients, name).copy() for name in DERIVED}))
    (true, expected), (planes, found), (again, same) = drawn
    off = np.abs(planes - true).max(0)
    return {
        "n": len(gaussians), "width": width, "height": height,
        "planes_apart": float(off.max()),
        "pixels_apart": float((off > 2e-4).mean()),
        "gradients_apart": max(
            float(np.linalg.norm(found[name] - expected[name]) / np.linalg.norm(expected[name]))
            for name in DERIVED
            if expected[name].any()
        ),
        "repeats": bool(
            np.array_equal(planes, again) and all(np.array_equal(found[name], same[name]) for name in DERIVED)
        ),
    }  # fmt: skip


def measure_drawing(count: int, width: int, height: int, runs: int) -> Row:
    """Time a drawing and its gradients (ms), with all arrays on the device: ours, and gsplat's where it is
    installed."""
    gaussians, camera = surface(count, width, height)
    chosen = device.gpu()
    rasterizer, tables = DeviceRasterizer(width, height, chosen), sent(gaussians, chosen)
    v_planes, weight = (
        wp.array(each, dtype=float, device=chosen)
        for each in make_cotangents(RasterCase(count, width, height, 1))
    )
    view = view_of(camera)

    def forward() -> None:
        rasterizer.forward(tables, view)
        wp.synchronize_device(chosen)

    def backward() -> None:
        rasterizer.backward(v_planes, weight)
        wp.synchronize_device(chosen)

    row: Row = {"n": len(gaussians), "width": width, "height": height}
    row |= {"forward_ms": median_ms(forward, runs), "backward_ms": median_ms(backward, runs)}
    if chosen.is_cuda and importlib.util.find_spec("gsplat") is not None:
        row |= _gsplat(gaussians, camera, runs)
    return row


def _gsplat(gaussians: Gaussians, camera: Camera, runs: int) -> Row:
    """The same times of gsplat (V. Ye et al., JMLR 2025), whose antialiased mode draws the same image."""
    import gsplat
    import torch

    names = ("means", "quats", "scales", "opacities", "colors")
    leaves = [torch.tensor(getattr(gaussians, name), device="cuda").requires_grad_() for name in names]
    shifted = camera.K.copy()
    shifted[:2, 2] += 0.5  # the centre of gsplat's first pixel is at 0.5
    view, K = (torch.tensor(each, dtype=torch.float32, device="cuda") for each in (camera.viewmat, shifted))
    drawn: list[Any] = []

    def forward() -> None:
        drawn[:] = gsplat.rasterization(
            *leaves, view[None], K[None], camera.width, camera.height, near_plane=NEAR_PLANE,
            eps2d=MIP_VARIANCE, rasterize_mode="antialiased", render_mode="RGB+D", packed=False,
        )[:2]  # fmt: skip
        torch.cuda.synchronize()

    def backward() -> None:
        torch.autograd.grad([each.sum() for each in drawn], leaves, retain_graph=True)
        torch.cuda.synchronize()

    forward_ms = median_ms(forward, runs)
    planes = make_rasterizer("warp", camera.width, camera.height).forward(gaussians, camera)
    theirs = drawn[0][0].detach().cpu().numpy().transpose(2, 0, 1)
    apart = float(np.median(np.abs(theirs[:3] - planes[:3])))
    backward_ms = median_ms(backward, runs)
    return {"gsplat_forward_ms": forward_ms, "gsplat_backward_ms": backward_ms, "gsplat_apart": apart}
