"""Times of what happens to whole pictures: the mapper's loss, and the view that is shown."""

from __future__ import annotations

from typing import Any

import numpy as np

from benchmarks.kernels.scenes import surface
from benchmarks.kernels.timing import median_ms
from benchmarks.kernels.work import Work, bytes_of, share_of_peak, stage_rows
from sags_node.engine.losses import tissue as losses
from sags_node.engine.rasterizer import views
from sags_node.engine.rasterizer.rasterize import make_rasterizer
from sags_node.kernels.peak import Peak

DEPTH_WEIGHT, DEPTH_SCALE = 2e-3, 1e-3  # as the mapper's


def measure_losses(
    count: int, width: int, height: int, threads: int, runs: int, peak: Peak
) -> dict[str, Any]:
    """One row of the table: of a drawn surface against a darker picture of itself. The calling thread must be
    set to `threads`, and `peak` be that of them."""
    gaussians, camera = surface(count, width, height)
    planes = make_rasterizer("numba", width, height).forward(gaussians, camera)
    view = views.to_view(planes, camera, 0, 0)
    image = (0.9 * 255 * views.colours_of(planes)).astype(np.uint8)
    tissue = np.ones((height, width), np.bool_)
    v_planes, weight = np.empty_like(planes), np.empty_like(view.depth)

    def tissue_loss() -> None:
        losses.tissue_loss(planes, image, tissue, view.depth, v_planes, weight, DEPTH_WEIGHT, DEPTH_SCALE)

    times = {
        "tissue loss": median_ms(tissue_loss, runs),
        "view": median_ms(lambda: views.to_view(planes, camera, 0, 0), runs),
    }
    work = {
        "tissue loss": Work(bytes_of(planes, image, tissue, view.depth, v_planes, weight)),
        "view": Work(bytes_of(planes, view.rgb, view.depth, view.alpha)),
    }
    return {
        "width": width,
        "height": height,
        "threads": threads,
        "tissue_loss_ms": times["tissue loss"],
        "view_ms": times["view"],
        "share_of_peak": share_of_peak(sum(times.values()), work, peak),
        "stages": stage_rows(times, work, peak),
    }
