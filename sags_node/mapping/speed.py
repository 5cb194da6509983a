"""How long this machine takes, before the first frame: from a drawing that is the same everywhere."""

from __future__ import annotations

import time

import numpy as np

from sags_node.engine.rasterizer.rasterize import Rasterizer
from sags_node.geometry import unproject
from sags_node.types import Camera, Gaussians

SAMPLE_SIZE = 320, 256  # px
SAMPLE_GAUSSIANS = 8000
SAMPLE_MS = 1.9  # of one drawing and its gradients, back to back, where live frames take their prices
TRIES = 21


def measured_speed(rasterizer: Rasterizer) -> float:
    """`Ladder.speed` of this machine: the median of some drawings of made-up Gaussians with their gradients.

    Args:
        rasterizer: for pictures of `SAMPLE_SIZE`.
    """
    width, height = SAMPLE_SIZE
    rng = np.random.default_rng(0)
    depths = rng.uniform(0.06, 0.08, SAMPLE_GAUSSIANS).astype(np.float32)
    pixels = rng.uniform(0, [width, height], (SAMPLE_GAUSSIANS, 2)).astype(np.float32)
    focal = float(width)
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    camera = Camera(width, height, K, np.eye(4))
    gaussians = Gaussians(
        means=unproject(camera, pixels, depths),
        quats=np.tile(np.array([1, 0, 0, 0], np.float32), (SAMPLE_GAUSSIANS, 1)),
        scales=np.full((SAMPLE_GAUSSIANS, 3), np.float32(3e-4)),
        opacities=np.full(SAMPLE_GAUSSIANS, np.float32(0.9)),
        colors=rng.uniform(0, 1, (SAMPLE_GAUSSIANS, 3)).astype(np.float32),
        ids=np.arange(SAMPLE_GAUSSIANS),
    )
    v_planes, weight = np.ones((5, height, width), np.float32), np.ones((height, width), np.float32)
    times = []
    for _ in range(TRIES):
        started = time.perf_counter()
        rasterizer.forward(gaussians, camera)
        rasterizer.backward(v_planes, weight)
        times.append(time.perf_counter() - started)
    return 1e3 * float(np.median(times)) / SAMPLE_MS
