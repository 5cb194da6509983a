"""How accurate masks are that were not given, and what each source of masks is worth to the mapper."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from benchmarks import Advance
from sags_node.errors import SagsError
from sags_node.kernels.threads import configure_threads
from sags_node.mapping.budget import StepBudget
from sags_node.pipeline.pipeline import Pipeline
from sags_node.pipeline.session import Session
from sags_node.quality import metrics
from sags_node.sources.source import open_source
from sags_node.tools.evaluation.receipt import Receipt
from sags_node.types import Bool, FrameResult, Reference, StereoFrame
from sags_node.vision.tissue import TissueMask

Row = dict[str, Any]


TABLES = (
    "session frames masks iou missed tissue_lost flicker mask_ms online_psnr depth_median_mm depth_p90_mm"
    " depth_coverage",
)


def measure_masks(session: Session, advance: Advance) -> Row:
    """Play a recording that has masks of its own, with those that its launch file asks for.

    Masks are compared with the recording's own without dilation. Images and depth are measured under the
    recording's own mask, whatever the mapper was given, so figures of different sources are comparable.
    """
    configure_threads(session.config.engine.threads)
    run, method = _Run(session), session.config.vision.tissue.method
    with open_source(session.config.source) as frames:  # which reads the truth too
        for number, frame in enumerate(frames):
            run.take(frame)
            advance(number + 1, frames.frame_count, f"masks: {method}")
    return {"session": session.name, "frames": run.frames, "masks": method, **run.figures()}


class _Run:
    """One pass through the recording."""

    def __init__(self, session: Session) -> None:
        config = session.config.vision.tissue
        self._pipeline = Pipeline(session.config, session.rig)
        self._budget = StepBudget(1)
        self._given, self._given_bare, self._found_bare, self._everything = (
            TissueMask(config.model_copy(update=changed), self._pipeline.rectifier)
            for changed in (
                *({"method": "session"}, {"method": "session", "dilate": 0}),
                *({"dilate": 0}, {"method": "none"}),
            )
        )
        self._before: tuple[Bool, Bool] | None = None  # instruments given and found
        self._pixels = np.zeros(5)  # usable, given, found, both, flickering
        self._mask_ms: list[float] = []
        self._psnr: list[float] = []
        self._depth: list[metrics.DepthErrors] = []
        self._receipt = Receipt(session.rig, session.working_size, None)
        self.frames = 0

    def take(self, frame: StereoFrame) -> None:
        """Map one frame and measure it."""
        if frame.tissue is None:
            raise SagsError(f"frame {frame.frame_id} has no mask to compare with; choose another recording")
        before = self._pipeline.newest
        result = self._pipeline.process(frame, self._budget)
        self.frames += 1
        self._mask_ms.append(result.timings_ms.get("mask", 0.0))
        self._compare(frame, result, before)
        given = self._given(frame, result.pair)
        self._measure(result, given, frame.reference)
        self._receipt.add(frame, given)

    def _compare(self, frame: StereoFrame, result: FrameResult, before: FrameResult | None) -> None:
        usable = self._everything(frame, result.pair)
        drawn = None if before is None else before.views["left"]
        given = usable & ~self._given_bare(frame, result.pair)
        found = usable & ~self._found_bare(frame, result.pair, drawn)
        flickering = np.zeros_like(found)
        if self._before is not None:
            flickering = (found != self._before[1]) & (given == self._before[0])
        self._before = given, found
        self._pixels += [np.count_nonzero(mask) for mask in (usable, given, found, given & found, flickering)]

    def _measure(self, result: FrameResult, tissue: Bool, reference: Reference | None) -> None:
        view = result.views["left"]
        self._psnr.append(
            metrics.psnr(metrics.as_float(view.rgb), metrics.as_float(result.pair.left), tissue)
        )
        if reference is not None and reference.depth is not None:
            truth = metrics.resample_nearest(reference.depth, view.camera.width, view.camera.height)
            self._depth.append(metrics.depth_errors(view.depth, truth, tissue))

    def figures(self) -> Row:
        """Return the figures of the whole pass; shares are 0..1."""
        usable, given, found, both, flickering = self._pixels.tolist()
        return {
            "iou": _ratio(both, given + found - both),
            "missed": _ratio(given - both, given),
            "tissue_lost": _ratio(found - both, usable - given),
            "flicker": _ratio(flickering, usable),
            "mask_ms": round(float(np.median(self._mask_ms)), 2),
            "online_psnr": round(float(np.mean(self._psnr)), 2),
            "depth_median_mm": _mean([errors.median_mm for errors in self._depth]),
            "depth_p90_mm": _mean([errors.p90_mm for errors in self._depth]),
            "depth_coverage": _mean([errors.coverage for errors in self._depth]),
            "receipt": self._receipt.as_json(),
        }


def _ratio(part: float, whole: float) -> float:
    return round(part / max(1.0, whole), 4)


def _mean(values: Sequence[float]) -> float | None:
    return round(float(np.nanmean(values)), 3) if values else None
