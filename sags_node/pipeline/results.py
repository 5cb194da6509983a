"""Changes to the result of a mapped frame: it is repeated for a frame that is not mapped, doubted while
frames are held, or unsure where the calibration is a guess.

Lengths of a guessed calibration, or of a declared scale, are right up to a factor that nobody knows. The
confidence of a depth states an error in mm, and there is none to state. So no confidence reaches `SURE`:
programs that decide something by a depth, or show it as sure, take none of these.
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

MOST = 0.98 * SURE
LEAST_ERROR = error_of(np.array(MOST, np.float32))  # m
FINDING = Finding(
    "uncalibrated",
    f"no calibration: a field of view of {GUESSED_FOV:g} degrees is guessed, and depth has no unit; "
    "calibrate (docs/calibration.md), then set rig",
)


def repeated(
    mapped: FrameResult, pair: RectifiedPair, epoch: int, timings: Mapping[str, float], anchors: AnchorStates
) -> FrameResult:
    """The last mapped result under the ids of a frame that equals it."""
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
        instruments=None,  # they are told of the frame in which they were found
    )


def doubted(held: FrameResult, error: float) -> FrameResult:
    """A result whose depth may be wrong by so much more, m."""
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
    """A frame whose depths are nowhere sure; what they look like is as it was."""
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
    """Confidences as they may be stated where the scale is a guess."""
    return np.minimum(confidence, np.float32(MOST))
