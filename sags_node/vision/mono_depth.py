"""Metric depth from a monocular network: each image's relative inverse depth is fitted to known depth.

Such a network's inverse depth is right up to scale and shift.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from sags_node.config.schema import StereoConfig
from sags_node.errors import UsageError
from sags_node.types import F32, F64, Bool
from sags_node.vision.onnx_session import DepthNetworkError

MEASURE_EVERY = 5  # frames: how often the eyes are matched for the scale alone
LARGEST_ERROR = 0.15  # of the depth, median: here the confidence has fallen to its least
DECLARED_ERROR = 0.5 * LARGEST_ERROR  # taken for a declared scale, whose error is not known
LEAST_CONFIDENCE = 0.05
MOST_SAMPLES = 4000
FEWEST_SAMPLES = 200
TRIALS = 200  # of lines through two samples
KEPT = 0.7  # of the samples, in a trimmed step
STEPS = 10
OUTLIER = 2.5  # robust standard deviations
SPREAD_PER_MAD = 1.4826  # a normal distribution's
LEAST_CORRELATION = 0.5  # of the inliers

Measure = Callable[[], F32 | None]  # depth [H, W] (m, 0 unknown) that stereo or the session gives


@dataclass(frozen=True, slots=True)
class ScaleShift:
    """1 / depth = scale * relative + shift."""

    scale: float  # 1/m per unit of the network
    shift: float  # 1/m
    error: float  # median of the residuals, as a share of the median inverse depth


class MonoDepth:
    """Keeps the scale from frame to frame.

    The paper trains on the correlation of drawn and monocular depth, which is blind to scale and shift. A
    stream cannot wait for that: its Gaussians are placed at the depth of the newest frame. So both are solved
    for in closed form, and what comes out is used as any other depth is.

    Between measurements a frame is fitted to the depth of the frame before, not to the drawn model, which is
    0.07 % nearer: that would add up.

    Args:
        declared_depth: m, median of the first image, for one camera alone.
        config: depth outside its range is taken for unknown.

    Attributes:
        is_declared: the scale comes from that distance; nothing has been measured since.
    """

    def __init__(self, declared_depth: float | None, config: StereoConfig) -> None:
        self._declared = declared_depth
        self.is_declared = False
        self._nearest, self._farthest = config.nearest, config.max_depth
        self._line: ScaleShift | None = None
        self._before: F32 | None = None  # [H, W] m, depth of the frame before, 0 unknown
        self._frames_to_measure = 0

    @property
    def measures(self) -> bool:
        """True: the next frame is fitted to measured depth."""
        return self._frames_to_measure == 0

    def __call__(self, relative: F32, tissue: Bool, measure: Measure) -> tuple[F32, F32]:
        """Return depth [H, W] (m, 0 unknown) and confidence [H, W] (one number where known).

        Args:
            relative: [H, W] the network's inverse depth, any scale and shift.
            measure: gives measured depth, every fifth frame; it returns None for one camera alone.

        Raises:
            DepthNetworkError: it does not fit what is measured, or nothing is known yet.
            UsageError: one camera alone, and no depth was declared.
        """
        line = self._align(relative, tissue, measure)
        inverse = line.scale * relative + np.float32(line.shift)
        # All depths, not only those within the range: a limit would bias the next frame's fit.
        self._before = np.divide(
            np.float32(1), inverse, out=np.zeros_like(inverse), where=tissue & (inverse > 0)
        )
        self._line = line
        known = (self._before >= self._nearest) & (self._before <= self._farthest)
        confidence = max(LEAST_CONFIDENCE, 1 - line.error / LARGEST_ERROR)
        return self._before * known, known * np.float32(confidence)

    def _align(self, relative: F32, tissue: Bool, measure: Measure) -> ScaleShift:
        measured = measure() if self.measures else None
        if measured is not None:
            found = fit_scale_shift(relative, measured, tissue)
            if found is None:
                raise DepthNetworkError(
                    "the network's inverse depth does not rise with the measured one; one of depth needs "
                    "meaning: depth"
                )
            self._frames_to_measure, self.is_declared = MEASURE_EVERY - 1, False
            return found
        self._frames_to_measure = max(0, self._frames_to_measure - 1)
        if self._line is None or self._before is None:
            return self._declare(relative, tissue)
        found = fit_scale_shift(relative, self._before, tissue)
        # After a cut nothing agrees with the frame before: then the last line is all there is.
        return self._line if found is None else replace(found, error=self._line.error)

    def _declare(self, relative: F32, tissue: Bool) -> ScaleShift:
        """Nothing but a distance is known: inverse depth is taken to be 0 where the network says 0."""
        if self._declared is None:
            raise UsageError(
                "one camera alone does not tell how far things are; set vision.onnx.declared_depth to the "
                "distance to the middle of the first image, m (docs/networks.md, 'One eye')"
            )
        values = relative[tissue & np.isfinite(relative)]
        middle = float(np.median(values)) if values.size else 0.0
        if middle <= 0:
            raise DepthNetworkError("the network says nothing of the first image's depth")
        self.is_declared = True
        return ScaleShift(1 / (self._declared * middle), 0.0, DECLARED_ERROR)


def fit_scale_shift(relative: F32, depth: F32, usable: Bool) -> ScaleShift | None:
    """Fit a robust line from relative inverse depth to 1 / depth; None: too few samples, or no rising line.

    It starts at the least median of squares among lines through two samples (Rousseeuw, 1984), goes on by
    trimmed steps and ends with all inliers. So nearly half of the image may have moved, or be wrong,
    without pulling at the line. A line by least squares would be a little too flat wherever `relative` is
    noisy; fitted frame to frame, its depth would be flat after some seconds.

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
