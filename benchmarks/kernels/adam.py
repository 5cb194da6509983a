"""Times of the optimiser."""

from __future__ import annotations

from typing import Any

import numpy as np

from benchmarks.kernels.timing import median_ms
from benchmarks.kernels.work import Work, share_of_peak, stage_rows
from sags_node.engine.adam import AdamState, adam_step
from sags_node.kernels.peak import Peak

# per value: it and its two momenta are read and written, its gradient is read
ADAM_FLOATS, ADAM_OPERATIONS = 7, 14


def measure_adam(count: int, of: int, columns: int, threads: int, runs: int, peak: Peak) -> dict[str, Any]:
    """One row of the table: Adam on `count` rows, spread at random, of a table [of, columns]. The calling
    thread must be set to `threads`, and `peak` be that of them."""
    rng = np.random.default_rng(0)
    values, gradients = (rng.normal(size=(of, columns)).astype(np.float32) for _ in range(2))
    state, rates = AdamState.new(of, columns), np.full(columns, 1e-3, np.float32)
    rows = None if count == of else np.sort(rng.permutation(of)[:count])
    ms = median_ms(lambda: adam_step(values, gradients, state, rates, rows=rows), runs)
    work = {"step": Work(4 * ADAM_FLOATS * count * columns, ADAM_OPERATIONS * count * columns)}
    return {
        "n": count,
        "of": of,
        "columns": columns,
        "threads": threads,
        "step_ms": ms,
        "share_of_peak": share_of_peak(ms, work, peak),
        "stages": stage_rows({"step": ms}, work, peak),
    }
