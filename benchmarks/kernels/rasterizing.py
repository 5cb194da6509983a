"""Times of the rasteriser, stage by stage."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from benchmarks.kernels.reference import ReferenceRasterizer
from benchmarks.kernels.scenes import SCENES, with_harmonics
from benchmarks.kernels.timing import (
    Stages,
    StageTimes,
    Work,
    median_ms,
    share_of_peak,
    stage_clock,
    stage_rows,
)
from sags_node.engine.rasterizer import (
    binning,
    compositing,
    projection,
    projection_backward,
    spherical_harmonics,
)
from sags_node.engine.rasterizer.compositing import TILE_HEIGHT, TILE_WIDTH
from sags_node.engine.rasterizer.rasterize import Rasterizer, make_rasterizer
from sags_node.kernels.peak import Peak
from sags_node.kernels.vectors import BLOCK_WIDTH, RECORD
from sags_node.types import F32, Bool, Camera, Gaussians

STAGES: Stages = {
    (projection, "project"): "project",
    (spherical_harmonics, "color"): "color",
    (binning, "sort_by_depth"): "sort",
    (binning, "emit_pairs"): "bin",
    (binning, "sort_into_tiles"): "bin",
    (compositing, "composite"): "composite",
    (compositing, "composite_backward"): "composite backward",
    (projection_backward, "project_backward"): "project backward",
    (spherical_harmonics, "color_backward"): "color backward",
}
# Operations on one pixel of one pair; what is the same along a row of pixels is out of the loop. A
# multiply-add, a rounding, a shift and a division count as one each. The innermost loops have as many vector
# instructions in AVX-512 machine code, besides loads and stores.
OPERATIONS_PER_PAIR = {"composite": 18, "composite backward": 36}


@dataclass(frozen=True, slots=True)
class RasterCase:
    """What is drawn, and with how many threads."""

    count: int
    width: int
    height: int
    threads: int
    scene: str = "surface"
    active_tiles: float = 1.0  # share of the tiles
    sh_degree: int = 0


def measure_rasterizer(case: RasterCase, runs: int, peak: Peak, twin_runs: int = 0) -> dict[str, Any]:
    """Measure one row of the table. The calling thread must be set to `case.threads`, the threads of `peak`.

    Args:
        twin_runs: how often to draw with the slow torch twin, too; 0: not at all.
    """
    drawing = Drawing(case)
    forward_ms = median_ms(drawing.forward, runs)
    both_ms = median_ms(drawing.forward_backward, runs)
    with stage_clock(STAGES) as times:
        stages_ms = times.medians_ms(drawing.forward_backward, runs)
    work = {stage: _work(stage, times) for stage in stages_ms}
    row: dict[str, Any] = {
        "n": len(drawing.gaussians),
        "width": case.width,
        "height": case.height,
        "scene": case.scene,
        "active_tiles": case.active_tiles,
        "sh_degree": case.sh_degree,
        "threads": case.threads,
        "forward_ms": forward_ms,
        "forward_backward_ms": both_ms,
        "pixel_pairs": work["composite"].pairs,
        "share_of_peak": share_of_peak(both_ms, work, peak),
        "stages": stage_rows(stages_ms, work, peak),
        "between_stages_ms": max(0.0, both_ms - sum(stages_ms.values())),
    }
    if twin_runs > 0:
        row["twin_forward_backward_ms"] = _time_twin(case, twin_runs)
        row["speedup_over_twin"] = row["twin_forward_backward_ms"] / row["forward_backward_ms"]
    return row


def _time_twin(case: RasterCase, runs: int) -> float:
    import torch

    torch.set_num_threads(case.threads)
    small = replace(case, count=100, width=32, height=32)
    Drawing(small, ReferenceRasterizer()).forward_backward()  # torch starts up
    return median_ms(Drawing(case, ReferenceRasterizer()).forward_backward, runs, warm_up=0)


class Drawing:
    """Draws one case with arrays of the host."""

    def __init__(self, case: RasterCase, rasterizer: Rasterizer | None = None) -> None:
        self.gaussians, self._camera = make_scene(case)
        self._tiles = _active_tiles(case)
        self._v_planes, self._weight = make_cotangents(case)
        self._rasterizer = rasterizer or make_rasterizer("numba", case.width, case.height)

    def forward(self) -> F32:
        return self._rasterizer.forward(self.gaussians, self._camera, self._tiles)

    def forward_backward(self) -> None:
        self.forward()
        self._rasterizer.backward(self._v_planes, self._weight)


def make_scene(case: RasterCase) -> tuple[Gaussians, Camera]:
    """Return the Gaussians and the camera of a case."""
    gaussians, camera = SCENES[case.scene](case.count, case.width, case.height)
    if case.sh_degree > 0:
        gaussians = with_harmonics(gaussians, case.sh_degree)
    return gaussians, camera


def make_cotangents(case: RasterCase) -> tuple[F32, F32]:
    """Return random cotangents of the planes [5, H, W], and the pixels' weights [H, W]."""
    size = (case.height, case.width)
    v_planes = np.random.default_rng(0).normal(size=(5, *size))
    return v_planes.astype(np.float32), np.ones(size, np.float32)


def _active_tiles(case: RasterCase) -> Bool | None:
    """The tiles that are drawn, spread at random; None: all."""
    if case.active_tiles == 1.0:
        return None
    shape = (-(-case.height // TILE_HEIGHT), -(-case.width // TILE_WIDTH))
    order = np.random.default_rng(0).permutation(int(np.prod(shape)))
    return (order < case.active_tiles * order.size).reshape(shape)


def evaluated_pairs(arguments: Mapping[str, Any]) -> int:
    """Count the pixel-Gaussian pairs that `composite` evaluated: all pixels in the rows that a splat touches
    of a tile's columns, until the tile was finished.

    Args:
        arguments: `pairs`, `tile_starts`, `tile_ends` and `drawn` as `composite` left them.
    """
    pairs, starts, drawn = arguments["pairs"], arguments["tile_starts"], arguments["drawn"]
    begin, end = (pairs[name][: starts[-1]].astype(np.int64) for name in ("begin", "end"))
    rows_before = np.concatenate([[0], np.maximum(end - begin, 0).sum(1).cumsum()])
    ends = arguments["tile_ends"][drawn]
    return int((rows_before[ends] - rows_before[starts[drawn]]).sum()) * BLOCK_WIDTH


_PER_PAIR = {"emitted": 1, "pairs": 1, "v_pairs": RECORD}  # items; these buffers are larger than needed
_PICTURES = {"planes", "v_planes", "weight"}  # only read and written where drawn
_IN_CACHE = {"scratch"}


def _work(stage: str, times: StageTimes) -> Work:
    drawing = times.arguments["composite"]
    tile_pairs, tiles = int(drawing["tile_starts"][-1]), drawing["tile_ends"].size
    drawn_share = drawing["drawn"].size / tiles
    touched = 0.0
    for name, value in _arrays_of(stage, times):
        if name not in _IN_CACHE:
            items = tile_pairs * _PER_PAIR[name] if name in _PER_PAIR else value.size
            used = items * value.itemsize
            touched += used * drawn_share if name in _PICTURES else used
    if stage in OPERATIONS_PER_PAIR:
        pairs = evaluated_pairs(drawing)
        return Work(touched, OPERATIONS_PER_PAIR[stage] * pairs, pairs)
    return Work(touched)


def _arrays_of(stage: str, times: StageTimes) -> Iterator[tuple[str, Any]]:
    """Arrays, by their names, that the functions of a stage were given in their last calls."""
    for function in (name for (_, name), each in STAGES.items() if each == stage):
        for name, value in times.arguments[function].items():
            if hasattr(value, "nbytes"):
                yield name, value
