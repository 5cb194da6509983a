"""Joins the node's messages of one frame to what the overlay needs of it."""

from dataclasses import dataclass

import msgspec
import numpy as np

from sags_node.clients.registration.surfaces import Surface
from sags_node.confidence import SURE_OF_ANCHOR
from sags_node.messaging.received import (
    Frame,
    ReceivedCameraInfo,
    ReceivedCloud,
    ReceivedImage,
    ReceivedRos,
    TopicName,
)
from sags_node.messaging.wire import WireError
from sags_node.types import F32, F64, Bool, Camera

DEPTH = TopicName("left/render/depth", ReceivedImage)
TISSUE = TopicName("left/tissue_mask", ReceivedImage)
INFO = TopicName("left/camera_info", ReceivedCameraInfo)
POSE = TopicName("tf", ReceivedRos)
ANCHORS = TopicName("anchors", ReceivedCloud)
RIGHT_INFO = TopicName("right/camera_info", ReceivedCameraInfo)
NEEDED = (DEPTH, TISSUE, INFO, POSE, ANCHORS)
CONFIDENCE = TopicName("left/render/depth_confidence", ReceivedImage)  # older recordings have none

# Limits for the confidence of anchors, from how often such anchors were right: "Is confidence right?" in
# benchmarks/tracking.md. Confidence halves every 2 s, so each limit is a time since the tissue around one was
# recognised: `SURE_OF_ANCHOR` is 2 s.
LEAST_IN_SIGHT = 0.02  # 11 s; above it at least 2 of 3 anchors are right, below it 0 to 4 of 5
LEAST_HIDDEN = 0.1  # 6 s
TOLD = ("visibility", "confidence", "depth_confidence", "ahead")  # of an `Anchor`; older nodes lack some


@dataclass(frozen=True, slots=True)
class Anchor:
    """Where the node says that an anchor is."""

    place: F64  # [3] m, world; NaN: lost
    visibility: float  # 0..1
    confidence: float  # 0..1
    depth_confidence: float = 1.0  # 0..1; low: where it lies in depth is a guess
    ahead: float = 0.0  # s after the frame at which it is expected at `place`; 0: it was there

    @property
    def is_sure(self) -> bool:
        """Tell whether it is most likely on the tissue where it was pinned."""
        return self.confidence >= SURE_OF_ANCHOR

    @property
    def holds(self) -> bool:
        """Tell whether an object may be placed by it, if only drawn faintly. That it is visible is not
        enough: so is an anchor that has slipped to other tissue."""
        least = LEAST_IN_SIGHT if self.visibility == 1 else LEAST_HIDDEN
        return bool(np.isfinite(self.place).all()) and self.confidence >= least


@dataclass(frozen=True, slots=True)
class TissueFrame:
    """The tissue at one time, as the node knows it."""

    frame_id: int
    stamp_ns: int
    session: str  # of the node: anchors of another session are other points
    epoch: int
    camera: Camera  # left
    baseline: float | None  # m to the right eye; None: unknown
    depth: F32  # [H, W] m, NaN unknown
    tissue: Bool  # [H, W], False: instrument
    anchors: dict[int, Anchor]
    confidence: F32 | None = None  # [H, W] 0..1 of the depth; None: the node does not tell
    recorded_s: float | None = None  # its place in the recording that the node plays; None: not said
    metric: bool = True  # False: nobody has calibrated the eyes, so lengths are right up to a factor

    def surface(self, where: Bool) -> Surface:
        """Take some points of the measured surface, where a mask [H, W] is true."""
        assert self.confidence is not None
        return Surface.of_depth(self.depth, self.confidence, where, self.camera)


def tissue_frame(
    messages: Frame, right: ReceivedCameraInfo | None, confidence: ReceivedImage | None = None,
    ahead: bool = True,
) -> TissueFrame | None:  # fmt: skip
    """Join the messages `NEEDED` of one frame; None: they do not fit together.

    Args:
        confidence: of its depth; None: from a node or a recording that does not tell.
        ahead: take the predicted place of each anchor that was asked for with one; else where anchors were.
    """
    depth, tissue, info, anchors = messages[DEPTH], messages[TISSUE], messages[INFO], messages[ANCHORS]
    size = (info.height, info.width)
    fields = {*(anchors.points.dtype.names or ())} - (set() if ahead else {"ahead"})
    said = {(message.meta.session, message.meta.epoch) for message in messages.values()}
    shapes = {each.array.shape for each in (depth, tissue, confidence) if each is not None}
    if shapes != {size} or len(said) != 1 or not {"id", "visibility", "confidence"} <= fields:
        return None
    try:
        T_world_cam = messages[POSE].pose()
    except WireError:
        return None
    rows = anchors.points
    places = anchors.xyz().astype(np.float64)
    if "ahead" in fields:
        places = np.stack([rows[f"{axis}_ahead"] for axis in "xyz"], axis=-1).astype(np.float64)
    return TissueFrame(
        frame_id=depth.meta.frame_id,
        stamp_ns=depth.stamp_ns,
        session=depth.meta.session,
        epoch=depth.meta.epoch,
        camera=Camera(info.width, info.height, info.K, T_world_cam),
        baseline=None if right is None else float(-right.P[0, 3] / right.P[0, 0]),
        depth=depth.array,
        tissue=tissue.array > 0,
        anchors={
            int(row["id"]): Anchor(place, **{name: float(row[name]) for name in TOLD if name in fields})
            for row, place in zip(rows, places, strict=True)
        },
        confidence=None if confidence is None else confidence.array,
        recorded_s=None if depth.meta.recorded_s is msgspec.UNSET else depth.meta.recorded_s,
        metric=depth.metric,
    )
