"""Time the rasteriser's kernels: python benchmarks/kernels.py [--out FILE] [--no-twin]

Prints medians, ms, for a wavy tissue-like surface at 640x512. `--out` also writes them as JSON.
"""

from __future__ import annotations

import argparse
import json
import platform
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from sags_node.engine.losses import tissue_loss
from sags_node.engine.rasterize import make_rasterizer, to_view
from sags_node.engine.threads import configure_threads
from sags_node.geometry import invert
from sags_node.types import Camera, Gaussians

WIDTH, HEIGHT = 640, 512
COUNTS = (10_000, 30_000, 100_000)
TWIN_COUNT = 10_000
RUNS = 31


def surface(count: int, width: int, height: int, seed: int = 0) -> tuple[Gaussians, Camera]:
    """About `count` Gaussians on a regular pixel grid of a wavy depth picture, 40 to 90 mm away."""
    rng = np.random.default_rng(seed)
    stride = np.sqrt(width * height / count)
    columns = round(width / stride)
    rows = round(count / columns)
    u, v = np.meshgrid((np.arange(columns) + 0.5) * width / columns, (np.arange(rows) + 0.5) * height / rows)
    u, v = u.ravel(), v.ravel()
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


def median_ms(function: Callable[[], object], runs: int = RUNS) -> float:
    for _ in range(min(3, runs)):
        function()
    times = []
    for _ in range(runs):
        start = time.perf_counter()
        function()
        times.append(time.perf_counter() - start)
    return statistics.median(times) * 1e3


def time_rasterizer(count: int, backend: str = "numba", runs: int = RUNS) -> dict[str, Any]:
    gaussians, camera = surface(count, WIDTH, HEIGHT)
    rasterizer = make_rasterizer(backend, WIDTH, HEIGHT)
    rng = np.random.default_rng(0)
    v_planes = rng.normal(size=(5, HEIGHT, WIDTH)).astype(np.float32)
    weight = np.ones((HEIGHT, WIDTH), np.float32)

    def forward_backward() -> None:
        rasterizer.forward(gaussians, camera)
        rasterizer.backward(v_planes, weight)

    return {
        "n": len(gaussians),
        "width": WIDTH,
        "height": HEIGHT,
        "forward_ms": median_ms(lambda: rasterizer.forward(gaussians, camera), runs),
        "forward_backward_ms": median_ms(forward_backward, runs),
    }


def time_losses() -> dict[str, Any]:
    gaussians, camera = surface(COUNTS[0], WIDTH, HEIGHT)
    planes = make_rasterizer("numba", WIDTH, HEIGHT).forward(gaussians, camera)
    view = to_view(planes, camera, 0, 0)
    tissue = np.ones((HEIGHT, WIDTH), np.bool_)
    v_planes, weight = np.empty_like(planes), np.empty_like(view.depth)

    def loss() -> float:
        return tissue_loss(planes, view.rgb, tissue, view.depth, v_planes, weight, 2e-3, 1e-3)

    return {
        "width": WIDTH,
        "height": HEIGHT,
        "tissue_loss_ms": median_ms(loss),
        "to_view_ms": median_ms(lambda: to_view(planes, camera, 0, 0)),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--out", type=Path, help="write the table as JSON, e.g. benchmarks/results/kernels.json"
    )
    parser.add_argument("--no-twin", action="store_true", help="leave out the slow torch twin")
    options = parser.parse_args()
    threads = configure_threads(None)
    rows = [time_rasterizer(count) for count in COUNTS]
    if not options.no_twin:
        row = rows[COUNTS.index(TWIN_COUNT)]
        twin = time_rasterizer(TWIN_COUNT, "reference", runs=1)
        row["twin_forward_backward_ms"] = twin["forward_backward_ms"]
        row["speedup_over_twin"] = twin["forward_backward_ms"] / row["forward_backward_ms"]
    losses = time_losses()
    print(f"{WIDTH}x{HEIGHT}, {threads} threads, medians of {RUNS}; {platform.machine()}")
    for row in rows:
        twin_text = f"   {row['speedup_over_twin']:.0f}x the torch twin" if "speedup_over_twin" in row else ""
        print(
            f"{row['n']:7d} Gaussians: forward {row['forward_ms']:6.2f} ms, "
            f"forward + backward {row['forward_backward_ms']:6.2f} ms{twin_text}"
        )
    print(f"loss {losses['tissue_loss_ms']:.2f} ms, view {losses['to_view_ms']:.2f} ms")
    if options.out is not None:
        command = f"python benchmarks/kernels.py --out {options.out}"
        table = {"command": command, "threads": threads, "rasterize": rows, "losses": [losses]}
        options.out.parent.mkdir(parents=True, exist_ok=True)
        options.out.write_text(json.dumps(table, indent=2) + "\n")


if __name__ == "__main__":
    main()
