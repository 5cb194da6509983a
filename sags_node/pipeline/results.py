"""Changes to the result of a mapped frame: it is repeated for a frame that is not mapped, doubted while
frames are held, or unsure where the calibration is a guess.

Lengths of a guessed calibration, or of a declared scale, are right only up to an unknown factor. A depth's
confidence states an error in mm, which is not known then. So no confidence reaches `SURE`, and programs
that decide something by a depth, or show it as sure, use none of these.
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from sags_node.confidence import SURE, confidence_of, error_of
from sags_node.engine.rasterizer.confidence import doubted as doubted_view
from sags_node.rig import GUESSED_FOV
from sags_node.types import F32, AnchorStates, Finding, FrameResult, Observation, RectifiedPair
from sags_node.vision.depth import Measured
from sags_node.vision.observe import observe

MOST = 0.98 * SURE  # highest confidence where the scale is a guess
LEAST_ERROR = error_of(np.array(MOST, np.float32))  # m, predicted error at `MOST`
FINDING = Finding(
    "uncalibrated",
    f"no calibration: a field of view of {GUESSED_FOV:g} degrees is guessed, and depth has no unit; "
    "calibrate (docs/calibration.md), then set rig",
)


def repeated(
    mapped: FrameResult, pair: RectifiedPair, epoch: int, timings: Mapping[str, float], anchors: AnchorStates
) -> FrameResult:
    """The last mapped result, with the id and stamp of a frame that is not mapped."""
    frame_id, stamp = pair.frame_id, pair.t_capture_ns
    still = np.zeros_like(mapped.snapshot.velocities)
    views = {eye: replace(view, frame_id=frame_id, t_capture_ns=stamp) for eye, view in mapped.views.items()}
    return replace(
        mapped,
        pair=pair,
        observation=replace(mapped.observation, frame_id=frame_id, t_capture_ns=stamp),
        snapshot=replace(
            mapped.snapshot, frame_id=frame_id, t_capture_ns=stamp, velocities=still, counts={"iterations": 0}
        ),
        views=views,
        epoch=epoch,
        timings_ms=timings,
        skipped={**mapped.skipped, "frame": "equals its predecessor"},
        anchors=anchors,
        instruments=None,  # they are published only with the frame in which they were found
    )


def doubted(held: FrameResult, error: float) -> FrameResult:
    """The result with `error` (m) added to the predicted errors of its depths."""
    gaussians, anchors = held.snapshot.gaussians, held.anchors
    if gaussians.depth_errors is not None:
        gaussians = replace(gaussians, depth_errors=gaussians.depth_errors + np.float32(error))
    sure = anchors.depth_confidence * confidence_of(np.float32(error))
    return replace(
        held,
        snapshot=replace(held.snapshot, gaussians=gaussians),
        views={eye: doubted_view(view, error) for eye, view in held.views.items()},
        anchors=replace(anchors, depth_confidence=sure),
    )


def unseen(pair: RectifiedPair) -> Observation:
    """The observation of a frame without a usable pixel."""
    shape = pair.left.shape[:2]
    return observe(pair, np.zeros(shape, np.bool_), Measured.nothing(shape))


def unsure(result: FrameResult) -> FrameResult:
    """The result with no confidence above `MOST`; all else is unchanged."""
    views = {
        eye: view if view.confidence is None else replace(view, confidence=_at_most(view.confidence))
        for eye, view in result.views.items()
    }
    snapshot, anchors = result.snapshot, result.anchors
    errors = snapshot.gaussians.depth_errors
    if errors is not None:
        gaussians = replace(snapshot.gaussians, depth_errors=np.maximum(errors, LEAST_ERROR))
        snapshot = replace(snapshot, gaussians=gaussians)
    anchors = replace(anchors, depth_confidence=_at_most(anchors.depth_confidence))
    instruments = result.instruments
    if instruments is not None:
        instruments = replace(
            instruments,
            confidence=_at_most(instruments.confidence),
            distance_confidence=_at_most(instruments.distance_confidence),
            clearance_confidence=_at_most(instruments.clearance_confidence),
        )
    return replace(result, views=views, snapshot=snapshot, anchors=anchors, instruments=instruments)


def _at_most(confidence: F32) -> F32:
    """Confidences limited to the highest allowed where the scale is a guess."""
    return np.minimum(confidence, np.float32(MOST))
