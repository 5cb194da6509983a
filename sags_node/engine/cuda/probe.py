"""Whether the GPU here does what it should: a small drawing, compared with the CPU engine's."""

from __future__ import annotations

import numpy as np
import torch
import triton

from sags_node.engine.failures import UnusableError
from sags_node.engine.interface import Gradients
from sags_node.engine.rasterizer.rasterize import make_rasterizer
from sags_node.types import F32, Camera, Gaussians

TOLERANCE = 1e-3  # of the largest value: a hundred times what rounding makes of it
COUNT, WIDTH, HEIGHT = 12, 32, 24


def probe() -> str:
    """The name of the GPU that will be used.

    Raises:
        UnusableError: there is none, or it does not work, or it draws something else.
    """
    interpreted = triton.knobs.runtime.interpret
    if not interpreted and torch.version.cuda is None:
        raise UnusableError(
            f"torch {torch.__version__} is a build without CUDA",
            "install one with CUDA: pip install --force-reinstall torch",
        )
    if not interpreted and not torch.cuda.is_available():
        raise UnusableError(
            f"torch (CUDA {torch.version.cuda}) finds no GPU that its driver can use",
            "look at nvidia-smi and install a newer driver",
        )
    try:
        apart = largest_difference()
        name = "CPU (Triton's interpreter)" if interpreted else torch.cuda.get_device_name()
    except Exception as error:  # the driver, Triton and the C compiler that it calls fail in many ways
        first = (str(error).strip() or type(error).__name__).splitlines()[0]
        raise UnusableError(
            f"the GPU's test drawing failed: {first}", "fix that (Triton needs a C compiler: gcc)"
        ) from error
    if not apart < TOLERANCE:
        raise UnusableError(
            f"the GPU draws something else than the CPU (apart by {apart:.2g}, allowed {TOLERANCE:.0e})",
            "update its driver, torch and triton, and report this",
        )
    return name


def largest_difference() -> float:
    """Of planes and gradients, relative to the largest value of each."""
    rng = np.random.default_rng(0)
    scene = Gaussians(
        means=rng.uniform([-0.01, -0.008, 0.04], [0.01, 0.008, 0.06], (COUNT, 3)).astype(np.float32),
        quats=rng.normal(size=(COUNT, 4)).astype(np.float32),
        scales=rng.uniform(1e-3, 3e-3, (COUNT, 3)).astype(np.float32),
        opacities=rng.uniform(0.3, 0.9, COUNT).astype(np.float32),
        colors=rng.uniform(0, 1, (COUNT, 3)).astype(np.float32),
        ids=np.arange(COUNT),
    )
    K = np.array([[60.0, 0.0, (WIDTH - 1) / 2], [0.0, 60.0, (HEIGHT - 1) / 2], [0.0, 0.0, 1.0]])
    camera = Camera(WIDTH, HEIGHT, K, np.eye(4))
    v_planes = rng.normal(size=(5, HEIGHT, WIDTH)).astype(np.float32)
    (planes, found), (true_planes, true) = (
        _draw(backend, scene, camera, v_planes) for backend in ("cuda", "numba")
    )
    names = ("means", "quats", "scales", "opacities", "colors", "contribution")
    pairs = [(planes, true_planes), *((getattr(found, name), getattr(true, name)) for name in names)]
    return max(float(np.abs(a - b).max() / np.abs(b).max()) for a, b in pairs)


def _draw(backend: str, scene: Gaussians, camera: Camera, v_planes: F32) -> tuple[F32, Gradients]:
    rasterizer = make_rasterizer(backend, camera.width, camera.height)
    planes = rasterizer.forward(scene, camera)
    return planes, rasterizer.backward(v_planes, np.ones_like(v_planes[0]))
