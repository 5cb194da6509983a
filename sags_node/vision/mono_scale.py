"""What a single picture's network says is right but for scale and shift of the inverse depth: find both."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sags_node.types import F32, F64, Bool

MOST_SAMPLES = 4000
FEWEST_SAMPLES = 200
TRIALS = 200  # of lines through two samples
KEPT = 0.7  # of the samples, in a trimmed step
STEPS = 10
OUTLIER = 2.5  # robust standard deviations
SPREAD_PER_MAD = 1.4826  # a normal distribution's
LEAST_CORRELATION = 0.5  # of what is no outlier


@dataclass(frozen=True, slots=True)
class ScaleShift:
    """1 / depth = scale * relative + shift."""

    scale: float  # 1/m per unit of the network
    shift: float  # 1/m
    error: float  # median of the residuals, as a share of the median inverse depth


def fit_scale_shift(relative: F32, depth: F32, usable: Bool) -> ScaleShift | None:
    """Robust line from relative inverse depth to 1 / depth; None: too little to go by, or no rising line.

    It starts at the least median of squares among lines through two samples (Rousseeuw, 1984), goes on by
    trimmed steps and ends with all that is no outlier to that. So nearly half of the picture may have moved,
    or be wrong, without pulling at the line. A line by least squares would be a little too flat wherever
    `relative` is noisy; laid frame onto frame, its depth would be flat after some seconds.

    Args:
        relative: [H, W] any unit.
        depth: [H, W] m, 0 unknown.
        usable: [H, W] where to look.
    """
    places = np.flatnonzero(usable & (depth > 0) & np.isfinite(relative))
    if len(places) < FEWEST_SAMPLES:
        return None
    places = places[:: -(-len(places) // MOST_SAMPLES)]
    x = relative.ravel()[places].astype(np.float64)
    y = 1.0 / depth.ravel()[places].astype(np.float64)
    line = _least_median(x, y)
    if line is None or line[0] <= 0:
        return None
    for _ in range(STEPS):
        residuals = np.abs(y - line[0] * x - line[1])
        kept = residuals <= np.quantile(residuals, KEPT)
        line = _of_equal_spreads(x[kept], y[kept])
    residuals = np.abs(y - line[0] * x - line[1])
    kept = residuals <= OUTLIER * SPREAD_PER_MAD * np.median(residuals)
    scale, shift = _of_equal_spreads(x[kept], y[kept])
    if not np.corrcoef(x[kept], y[kept])[0, 1] > LEAST_CORRELATION:
        return None
    error = np.median(np.abs(y - scale * x - shift)) / np.median(y)
    return ScaleShift(scale, shift, float(error))


def _least_median(x: F64, y: F64) -> tuple[float, float] | None:
    """The line through two samples with the least median residual; None where all x are equal."""
    rng = np.random.default_rng(0)
    one, other = rng.integers(0, len(x), (2, TRIALS))
    apart = np.abs(x[one] - x[other]) > 0.1 * np.std(x)
    one, other = one[apart], other[apart]
    if not len(one):
        return None
    slopes = (y[one] - y[other]) / (x[one] - x[other])
    shifts = y[one] - slopes * x[one]
    seen = slice(None, None, max(1, len(x) // 500))
    medians = np.median(np.abs(y[seen] - slopes[:, None] * x[seen] - shifts[:, None]), axis=1)
    best = int(np.argmin(medians))
    return float(slopes[best]), float(shifts[best])


def _of_equal_spreads(x: F64, y: F64) -> tuple[float, float]:
    """The rising line that treats both sides alike (reduced major axis)."""
    scale = float(y.std() / max(x.std(), np.finfo(float).tiny))
    return scale, float(y.mean() - scale * x.mean())
