"""What is made with a guessed calibration, or at a declared scale, says so: its lengths are right up to a
factor that nobody knows.

How sure a depth is, is an error in mm, and there is none to state. So no confidence reaches `SURE`: programs
that decide something by a depth, or show it as sure, take none of these, also those that know no more.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sags_node.confidence import SURE, error_of
from sags_node.rig import GUESSED_FOV
from sags_node.types import F32, Finding, FrameResult

MOST = 0.98 * SURE
LEAST_ERROR = error_of(np.array(MOST, np.float32))  # m
FINDING = Finding(
    "uncalibrated",
    f"no calibration: a field of view of {GUESSED_FOV:g} degrees is guessed, and depth has no unit; "
    "calibrate (docs/calibration.md), then set rig",
)


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
