"""Metric depth from a monocular network: each picture's relative inverse depth is laid onto known depth."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from sags_node.config.schema import StereoConfig
from sags_node.errors import UsageError
from sags_node.types import F32, Bool
from sags_node.vision.mono_scale import ScaleShift, fit_scale_shift
from sags_node.vision.onnx_session import DepthNetworkError

MEASURE_EVERY = 5  # frames: so rarely depth is matched for its scale alone
LARGEST_ERROR = 0.15  # of the depth, median: here the confidence is 0
DECLARED_ERROR = 0.5 * LARGEST_ERROR  # nothing tells how wrong it is
LEAST_CONFIDENCE = 0.05

Measure = Callable[[], F32 | None]  # depth [H, W] (m, 0 unknown) that stereo or the session gives


class MonoDepth:
    """Keeps the scale from frame to frame.

    The paper trains on the correlation of drawn and monocular depth, which is blind to scale and shift. A
    stream cannot wait for that: its Gaussians are placed at the depth of the newest frame. So both are solved
    for in closed form, and what comes out is used as any other depth is.

    Between measurements a frame is laid onto the depth of the frame before, not onto the drawn model: that
    stands 0.07 % nearer, which adds up.

    Args:
        declared_depth: m, median of the first picture, for one camera alone.
        config: its depth range is the one that is believed.
    """

    def __init__(self, declared_depth: float | None, config: StereoConfig) -> None:
        self._declared = declared_depth
        self._nearest, self._farthest = config.nearest, config.max_depth
        self._line: ScaleShift | None = None
        self._before: F32 | None = None  # [H, W] m, depth of the frame before, 0 unknown
        self._frames_to_measure = 0

    def __call__(self, relative: F32, tissue: Bool, measure: Measure) -> tuple[F32, F32]:
        """Depth [H, W] (m, 0 unknown) and confidence [H, W] (one number where known).

        Args:
            relative: [H, W] the network's inverse depth, any scale and shift.
            measure: asked in every fifth frame; None where only one camera is.

        Raises:
            DepthNetworkError: it does not fit what is measured, or nothing is known yet.
            UsageError: one camera alone, and no depth was declared.
        """
        line = self._align(relative, tissue, measure)
        inverse = line.scale * relative + np.float32(line.shift)
        # All of it, not only what is believed: a limit would pull at the next frame's line.
        self._before = np.divide(
            np.float32(1), inverse, out=np.zeros_like(inverse), where=tissue & (inverse > 0)
        )
        self._line = line
        known = (self._before >= self._nearest) & (self._before <= self._farthest)
        confidence = max(LEAST_CONFIDENCE, 1 - line.error / LARGEST_ERROR)
        return self._before * known, known * np.float32(confidence)

    def _align(self, relative: F32, tissue: Bool, measure: Measure) -> ScaleShift:
        measured = measure() if self._frames_to_measure == 0 else None
        if measured is not None:
            found = fit_scale_shift(relative, measured, tissue)
            if found is None:
                raise DepthNetworkError(
                    "the network's inverse depth does not rise with the measured one; one of depth needs "
                    "meaning: depth"
                )
            self._frames_to_measure = MEASURE_EVERY - 1
            return found
        self._frames_to_measure = max(0, self._frames_to_measure - 1)
        if self._line is None or self._before is None:
            return self._declare(relative, tissue)
        found = fit_scale_shift(relative, self._before, tissue)
        # After a cut nothing agrees with the frame before: then the network's own scale is all there is.
        return self._line if found is None else replace(found, error=self._line.error)

    def _declare(self, relative: F32, tissue: Bool) -> ScaleShift:
        """Nothing but a distance is known: inverse depth is taken to be 0 where the network says 0."""
        if self._declared is None:
            raise UsageError(
                "one camera alone does not tell how far things are; set vision.onnx.declared_depth to the "
                "distance to the middle of the first picture, m (docs/networks.md, 'One eye')"
            )
        values = relative[tissue & np.isfinite(relative)]
        middle = float(np.median(values)) if values.size else 0.0
        if middle <= 0:
            raise DepthNetworkError("the network says nothing of the first picture's depth")
        return ScaleShift(1 / (self._declared * middle), 0.0, DECLARED_ERROR)
