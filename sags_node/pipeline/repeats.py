"""Results of frames that are not mapped: the last mapped frame's, under their own ids."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from sags_node.confidence import confidence_of
from sags_node.engine.rasterizer.confidence import doubted as doubted_view
from sags_node.types import AnchorStates, FrameResult, Observation, RectifiedPair
from sags_node.vision.depth import Measured
from sags_node.vision.observe import observe


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
