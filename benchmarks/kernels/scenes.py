"""The scenes that kernels are timed on: tissue-like surfaces of any number of Gaussians."""

import math
from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from sags_node.geometry import invert
from sags_node.types import Camera, Gaussians


def surface(count: int, width: int, height: int) -> tuple[Gaussians, Camera]:
    """Make about `count` Gaussians on a regular grid of a wavy depth image, 40 to 90 mm away: each pixel
    sees about twenty, whatever their number."""
    rng = np.random.default_rng(0)
    stride = math.sqrt(width * height / count)
    columns = round(width / stride)
    rows = round(count / columns)
    across, down = (np.arange(columns) + 0.5) * width / columns, (np.arange(rows) + 0.5) * height / rows
    u, v = np.tile(across, rows), np.repeat(down, columns)
    n = u.size
    focal, cx, cy = 800.0 * width / 640, width / 2, height / 2
    waves = 15 * np.sin(3 * np.pi * u / width) * np.cos(2 * np.pi * v / height)
    ripples = 8 * np.sin(2 * np.pi * (3 * u / width + 2 * v / height))
    depth = np.clip(65 + waves + ripples, 40, 90) * 1e-3
    means = np.stack([(u - cx) / focal * depth, (v - cy) / focal * depth, depth], 1)
    scales = (depth * stride / focal)[:, None] * rng.uniform(0.6, 1.0, (n, 3)) * [1, 1, 0.5]
    colors = np.stack(
        [0.6 + 0.3 * np.sin(u / 40), 0.4 + 0.3 * np.sin(v / 33), 0.5 + 0.3 * np.cos((u + v) / 51)], 1
    )
    angle = 0.02
    viewmat = np.eye(4)
    viewmat[:3, :3] = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    viewmat[:3, 3] = [-1e-3, 0.3e-3, 0.5e-3]
    gaussians = Gaussians(
        means=(means + rng.normal(0, 2e-5, (n, 3))).astype(np.float32),
        quats=np.concatenate([np.ones((n, 1)), rng.normal(0, 0.15, (n, 3))], 1).astype(np.float32),
        scales=scales.astype(np.float32),
        opacities=rng.uniform(0.5, 0.99, n).astype(np.float32),
        colors=(colors + rng.normal(0, 0.03, (n, 3))).astype(np.float32),
        ids=np.arange(n),
    )
    K = np.array([[focal, 0, cx - 0.5], [0, focal, cy - 0.5], [0, 0, 1]])
    return gaussians, Camera(width, height, K, invert(viewmat))


def corner(count: int, width: int, height: int) -> tuple[Gaussians, Camera]:
    """The surface drawn into a quarter of the width and height at the top left; the rest of the image is
    empty. All work is in few tiles."""
    gaussians, camera = surface(count, width // 4, height // 4)
    return gaussians, Camera(width, height, camera.K, camera.T_world_cam)


def shuffled(count: int, width: int, height: int) -> tuple[Gaussians, Camera]:
    """The surface, stored in random order: neighbours in the image are not neighbours in memory."""
    gaussians, camera = surface(count, width, height)
    order = np.random.default_rng(0).permutation(len(gaussians))
    names = ("means", "quats", "scales", "opacities", "colors", "ids")
    return replace(gaussians, **{name: getattr(gaussians, name)[order] for name in names}), camera


SCENES: Mapping[str, Callable[[int, int, int], tuple[Gaussians, Camera]]] = {
    "surface": surface,
    "corner": corner,
    "shuffled": shuffled,
}


def with_harmonics(gaussians: Gaussians, degree: int) -> Gaussians:
    """Return the Gaussians with view-dependent colours: random spherical harmonics up to `degree`."""
    shape = (len(gaussians), (degree + 1) ** 2 - 1, 3)
    return replace(gaussians, sh_rest=np.random.default_rng(0).normal(0, 0.05, shape).astype(np.float32))
