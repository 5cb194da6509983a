"""Times of the space-time field."""

from __future__ import annotations

from typing import Any

import numpy as np

from benchmarks.kernels.scenes import surface
from benchmarks.kernels.timing import median_ms
from benchmarks.kernels.work import Work, bytes_of, share_of_peak, stage_rows
from sags_node.engine.field.hexplane import Grid, HexPlane, Moment
from sags_node.kernels.peak import Peak
from sags_node.kernels.threads import thread_count
from sags_node.types import F32

NODES = ((64, 64, 64), (128, 128, 128))
SLOTS, CHANNELS = 50, 32
MOMENT = Moment(20, 21, 0.3)
# Per point, level and channel: three planes of three linear steps, three lines of one, and their product;
# backward the same again, the products of all but one, and the sums over cells.
FORWARD_OPERATIONS, BACKWARD_OPERATIONS = 29, 75


def make_grid(points: F32) -> Grid:
    """As the deformation uses it: around the points [N, 3], with room to move."""
    margin = 5e-3
    low, high = (points.min(0) - margin).tolist(), (points.max(0) + margin).tolist()
    return Grid(((low[0], low[1], low[2]), (high[0], high[1], high[2])), NODES, SLOTS, CHANNELS)


def make_cells(grid: Grid) -> F32:
    return np.random.default_rng(0).normal(1, 0.3, (grid.rows, grid.channels)).astype(np.float32)


def measure_hexplane(count: int, threads: int, runs: int, peak: Peak, twin_runs: int = 0) -> dict[str, Any]:
    """One row of the table. The calling thread must be set to `threads`, and `peak` be that of them."""
    points = surface(count, 640, 512)[0].means
    grid = make_grid(points)
    cells = make_cells(grid)
    v_features = np.random.default_rng(1).normal(size=(len(points), grid.features)).astype(np.float32)
    field = HexPlane(grid)
    features = field.forward(cells, points, MOMENT)
    touched = field.backward(v_features).rows.size * grid.channels * 4
    each = len(points) * grid.features
    work = {
        "forward": Work(touched + bytes_of(points, features), FORWARD_OPERATIONS * each),
        "backward": Work(2 * touched + bytes_of(points, points, v_features), BACKWARD_OPERATIONS * each),
    }
    times = {
        "forward": median_ms(lambda: field.forward(cells, points, MOMENT), runs),
        "backward": median_ms(lambda: field.backward(v_features), runs),
    }
    both_ms = times["forward"] + times["backward"]
    row: dict[str, Any] = {
        "n": len(points),
        "threads": threads,
        "forward_ms": times["forward"],
        "forward_backward_ms": both_ms,
        "share_of_peak": share_of_peak(both_ms, work, peak),
        "stages": stage_rows(times, work, peak),
    }
    if twin_runs > 0:
        row["twin_forward_backward_ms"] = median_ms(
            lambda: _twin(grid, cells, points, v_features), twin_runs, warm_up=1
        )
        row["speedup_over_twin"] = row["twin_forward_backward_ms"] / both_ms
    return row


def _twin(grid: Grid, cells: F32, points: F32, v_features: F32) -> None:
    import torch

    from sags_node.engine.reference import hexplane as hexplane_reference

    torch.set_num_threads(thread_count())
    all_cells, places = torch.tensor(cells, requires_grad=True), torch.tensor(points, requires_grad=True)
    features = hexplane_reference.sample(grid, all_cells, places, MOMENT)
    torch.autograd.grad(features, [all_cells, places], torch.tensor(v_features))
