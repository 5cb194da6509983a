"""Whether the predicted errors of published depth cover the real ones."""

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from sags_node.confidence import error_of
from sags_node.types import F32, F64, I64, Bool

# mm: edges of the groups of predicted errors; 3 mm is confidence 0.5.
PREDICTED_MM = (0.0, 0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0, 12.0, 18.1)
STEP_MM, MOST_MM = 0.05, 40.0  # bin width and end of the histogram of real errors
LEAST_SHARE = 5e-3  # of all pixels: the percentiles of a smaller group say nothing
SURE_GROUPS = PREDICTED_MM.index(3.0)  # the groups below this index have a confidence of at least `SURE`


def tally(depth: F32, confidence: F32, truth: F32, tissue: Bool) -> I64:
    """Count the pixels of one frame by predicted and by real error, [groups, steps + 1].

    Args:
        depth, truth: [H, W] m, 0 unknown.
        confidence: [H, W] 0..1.
    """
    given = tissue & (truth > 0) & (depth > 0)
    real = np.abs(depth[given].astype(np.float64) - truth[given]) * 1e3
    predicted = error_of(confidence[given]) * 1e3
    steps = round(MOST_MM / STEP_MM)
    group = np.clip(np.searchsorted(PREDICTED_MM, predicted, side="left") - 1, 0, len(PREDICTED_MM) - 2)
    step = np.minimum(real / STEP_MM, steps).astype(np.int64)
    counts = np.bincount(group * (steps + 1) + step, minlength=(len(PREDICTED_MM) - 1) * (steps + 1))
    return counts.reshape(-1, steps + 1).astype(np.int64)


def figures(tallies: Sequence[I64]) -> dict[str, Any]:
    """The figures of all frames: the share that is sure (confidence of at least 0.5, so 3 mm) and its error;
    for each group of predicted errors its share and the real errors. A group below `LEAST_SHARE` counts as
    empty."""
    counts = np.sum(tallies, axis=0)
    total = max(int(counts.sum()), 1)
    sure = counts[:SURE_GROUPS].sum(0)
    counts[counts.sum(1) < LEAST_SHARE * total] = 0
    return {
        "sure_share": float(sure.sum() / total),
        "sure_p90_mm": _percentile(sure, 0.9),
        "by_predicted_mm": {
            f"{low:g} to {high:g}": {
                "share": float(row.sum() / total),
                "p50_mm": _percentile(row, 0.5),
                "p90_mm": _percentile(row, 0.9),
            }
            for (low, high), row in zip(pairwise(PREDICTED_MM), counts, strict=True)
        },
    }


def points(tallies: Sequence[I64], share: float) -> list[tuple[float, float]]:
    """The points of a plot: for each group the middle of its predicted errors, and the quantile `share` of
    its real ones, mm."""
    if not tallies:
        return []
    middles = [(low + high) / 2 for low, high in pairwise(PREDICTED_MM)]
    real = [_percentile(row, share) for row in np.sum(tallies, axis=0)]
    return [(middle, each) for middle, each in zip(middles, real, strict=True) if each is not None]


def _percentile(counts: I64, share: float) -> float | None:
    """The quantile `share` of the real errors, mm: its step's upper edge; None where nothing was counted."""
    if counts.sum() == 0:
        return None
    running: F64 = np.cumsum(counts) / counts.sum()
    return float(STEP_MM * (np.searchsorted(running, share) + 1))
