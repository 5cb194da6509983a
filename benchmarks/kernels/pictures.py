"""Times of what happens to whole pictures: the losses, and the view that is shown."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import numpy as np

from benchmarks.kernels.scenes import surface
from benchmarks.kernels.timing import Stages, median_ms, stage_clock
from benchmarks.kernels.work import Work, bytes_of, share_of_peak, stage_rows, touched_bytes
from sags_node.engine.losses import photometric, photometric_kernels
from sags_node.engine.losses import tissue as losses
from sags_node.engine.losses.photometric import LossWeights, PhotometricLoss
from sags_node.engine.losses.ssim import Dissimilarity
from sags_node.engine.rasterizer import views
from sags_node.engine.rasterizer.rasterize import make_rasterizer
from sags_node.kernels.peak import Peak
from sags_node.kernels.threads import thread_count
from sags_node.types import F32, U8, Bool

STAGES: Stages = {
    (photometric_kernels, "compare"): "compare",
    (Dissimilarity, "forward"): "SSIM",
    (Dissimilarity, "backward"): "SSIM backward",
    (photometric, "add_total_variation"): "total variation",
    (photometric_kernels, "backward_pass"): "pull back",
}
WITH_SSIM = LossWeights(color=0.8, similarity=0.2)
WITHOUT_SSIM = LossWeights()
# Per pixel: floats in memory, and operations, halos left out. Forward: four blurs of 22 operations and 42
# others in three channels; backward: three blurs and 8.
SSIM_FLOATS, SSIM_OPERATIONS = 16, 3 * (4 * 22 + 42)
SSIM_BACKWARD_FLOATS, SSIM_BACKWARD_OPERATIONS = 19, 3 * (3 * 22 + 8)
TOTAL_VARIATIONS = 4  # colours and depth
DEPTH_WEIGHT, DEPTH_SCALE = 2e-3, 1e-3  # as the mapper's


def measure_losses(
    count: int, width: int, height: int, threads: int, runs: int, peak: Peak, twin_runs: int = 0
) -> dict[str, Any]:
    """One row of the table: of a drawn surface against a darker picture of itself. The calling thread must be
    set to `threads`, and `peak` be that of them."""
    gaussians, camera = surface(count, width, height)
    planes = make_rasterizer("numba", width, height).forward(gaussians, camera)
    view = views.to_view(planes, camera, 0, 0)
    image = (0.9 * 255 * views.colours_of(planes)).astype(np.uint8)
    tissue = np.ones((height, width), np.bool_)
    v_planes, weight = np.empty_like(planes), np.empty_like(view.depth)
    structural = PhotometricLoss(width, height, WITH_SSIM)
    plain = PhotometricLoss(width, height, WITHOUT_SSIM)

    def tissue_loss() -> None:
        losses.tissue_loss(planes, image, tissue, view.depth, v_planes, weight, DEPTH_WEIGHT, DEPTH_SCALE)

    def photometric_loss(loss: PhotometricLoss) -> None:
        loss.evaluate(planes, image, tissue, view.depth, v_planes, weight)

    with stage_clock(STAGES) as clock:
        times = clock.medians_ms(lambda: photometric_loss(structural), runs)
    pixels = width * height
    arguments = clock.arguments
    work = {
        "compare": Work(touched_bytes(arguments["compare"])),
        "SSIM": Work(4 * SSIM_FLOATS * pixels, SSIM_OPERATIONS * pixels),
        "SSIM backward": Work(4 * SSIM_BACKWARD_FLOATS * pixels, SSIM_BACKWARD_OPERATIONS * pixels),
        "total variation": Work(TOTAL_VARIATIONS * touched_bytes(arguments["add_total_variation"])),
        "pull back": Work(touched_bytes(arguments["backward_pass"])),
    }
    photometric_ms = median_ms(lambda: photometric_loss(structural), runs)
    share = share_of_peak(photometric_ms, work, peak)
    frame = bytes_of(planes, image, tissue, view.depth, v_planes, weight)
    times |= {
        "tissue loss": median_ms(tissue_loss, runs),
        "view": median_ms(lambda: views.to_view(planes, camera, 0, 0), runs),
    }
    work |= {
        "tissue loss": Work(frame),
        "view": Work(bytes_of(planes, view.rgb, view.depth, view.alpha)),
    }
    row: dict[str, Any] = {
        "width": width,
        "height": height,
        "threads": threads,
        "photometric_ms": median_ms(lambda: photometric_loss(plain), runs),
        "photometric_ssim_ms": photometric_ms,
        "tissue_loss_ms": times["tissue loss"],
        "view_ms": times["view"],
        "share_of_peak": share,
        "stages": stage_rows(times, work, peak),
    }
    if twin_runs > 0:
        twin_ms = median_ms(lambda: _twin(planes, image, tissue, view.depth), twin_runs, warm_up=1)
        row |= {"twin_forward_backward_ms": twin_ms, "speedup_over_twin": twin_ms / photometric_ms}
    return row


def _twin(planes: F32, image: U8, tissue: Bool, depth: F32) -> None:
    """The loss with SSIM, and its gradient."""
    import torch

    from sags_node.engine.reference import losses as losses_reference

    torch.set_num_threads(thread_count())
    drawn, everywhere = torch.tensor(planes, requires_grad=True), torch.tensor(tissue)
    frame = torch.tensor(image) / 255, everywhere, torch.tensor(depth), everywhere
    terms = losses_reference.photometric(drawn, *frame, normalised=True)
    total = sum(weight * terms[name] for name, weight in asdict(WITH_SSIM).items())
    torch.autograd.grad(total, drawn)
