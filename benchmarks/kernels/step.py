"""Time of one whole optimisation step of the paper's method: all kernels together."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from benchmarks.kernels.decoding import make_decoder
from benchmarks.kernels.fields import MOMENT, make_cells, make_grid
from benchmarks.kernels.pictures import WITH_SSIM, WITHOUT_SSIM
from benchmarks.kernels.rasterizing import RasterCase
from benchmarks.kernels.scenes import surface
from benchmarks.kernels.timing import StageTimes, median_ms
from sags_node.engine.adam import AdamState, adam_step
from sags_node.engine.field.hexplane import HexPlane
from sags_node.engine.losses.photometric import PhotometricLoss
from sags_node.engine.rasterizer.rasterize import make_rasterizer
from sags_node.engine.rasterizer.views import colours_of, to_view
from sags_node.model import columns
from sags_node.model.activation import activate, activate_backward, deactivate
from sags_node.types import F32, I64

RATE = 1e-7  # so small that every step sees the same scene
DELTA_SCALE = np.float32(1e-4)  # untrained deltas must not tear the surface apart


def measure_step(case: RasterCase, structural: bool, runs: int) -> dict[str, Any]:
    """One row of the table. `structural`: with SSIM in the loss. The calling thread must be set to
    `case.threads`."""
    times = StageTimes()
    step = _Step(case, structural, times)
    return {
        "n": step.count,
        "width": case.width,
        "height": case.height,
        "threads": case.threads,
        "ssim": structural,
        "step_ms": median_ms(step, runs),
        "stage_ms": times.medians_ms(step, runs),
    }


class _Trained:
    """A table of parameters with its optimiser."""

    def __init__(self, values: F32) -> None:
        self.values = values
        self._state = AdamState.new(*values.shape)
        self._rates = np.full(values.shape[1], RATE, np.float32)

    def descend(self, gradients: F32, rows: I64 | None = None) -> None:
        adam_step(self.values, gradients, self._state, self._rates, rows=rows)


class _Step:
    """Field, drawing and loss, all of them backwards, and Adam on Gaussians, field and decoder."""

    def __init__(self, case: RasterCase, structural: bool, times: StageTimes) -> None:
        gaussians, self._camera = surface(case.count, case.width, case.height)
        self.count, self._ids = len(gaussians), gaussians.ids
        self._rows = _Trained(deactivate(gaussians))
        grid = make_grid(gaussians.means)
        self._field = HexPlane(grid)
        self._cells = _Trained(make_cells(grid))
        self._decoder = make_decoder("self")
        self._weights = _Trained(self._decoder.values[None])
        self._rasterizer = make_rasterizer("numba", case.width, case.height)
        self._loss = PhotometricLoss(case.width, case.height, WITH_SSIM if structural else WITHOUT_SSIM)
        planes = self._rasterizer.forward(gaussians, self._camera)
        view = to_view(planes, self._camera, 0, 0)
        self._image = (0.9 * 255 * colours_of(planes)).astype(np.uint8)
        self._depth = view.depth
        self._tissue = np.ones(view.depth.shape, np.bool_)
        self._v_planes, self._weight = np.empty_like(planes), np.empty_like(view.depth)
        functions: dict[str, Callable[..., Any]] = {
            "HexPlane": self._field.forward,
            "decoder": self._decoder.forward,
            "activate": activate,
            "draw": self._rasterizer.forward,
            "loss": self._loss.evaluate,
            "draw backward": self._rasterizer.backward,
            "activate backward": activate_backward,
            "decoder backward": self._decoder.backward,
            "HexPlane backward": self._field.backward,
            "Adam": self._descend,
        }
        self._stages = {name: times.watched(function, name, name) for name, function in functions.items()}

    def __call__(self) -> None:
        stages, rows = self._stages, self._rows.values
        features = stages["HexPlane"](self._cells.values, rows[:, columns.MEAN], MOMENT)
        deltas = stages["decoder"](features)
        gaussians = stages["activate"](rows + DELTA_SCALE * deltas, self._ids, None)
        planes = stages["draw"](gaussians, self._camera)
        stages["loss"](planes, self._image, self._tissue, self._depth, self._v_planes, self._weight)
        gradients = stages["draw backward"](self._v_planes, self._weight)
        v_rows = stages["activate backward"](gaussians, gradients)
        v_features = stages["decoder backward"](DELTA_SCALE * v_rows)
        by_field = stages["HexPlane backward"](v_features)
        v_rows[:, columns.MEAN] += by_field.v_points
        stages["Adam"](v_rows, by_field.v_cells, by_field.rows)

    def _descend(self, v_rows: F32, v_cells: F32, cells: I64) -> None:
        self._rows.descend(v_rows)
        self._cells.descend(v_cells, cells)
        self._weights.descend(self._decoder.gradients[None])
