"""What a running node shows at this moment, and why nothing is shown when there is nothing.

The node may come, go and come back: the feed connects by itself and lets go of what is old.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from sags_node.messaging.address import NodeAddress
from sags_node.messaging.node_clock import NodeClock
from sags_node.messaging.received import (
    Received,
    ReceivedCameraInfo,
    ReceivedCloud,
    ReceivedImage,
    ReceivedRos,
    ReceivedText,
)
from sags_node.messaging.subscriber import Subscriber
from sags_node.messaging.wire import WireError
from sags_node.quality.gallery import Picture
from sags_node.types import U8, Camera

PICTURE = "left/image_rect_color"
FRAME = ("left/render/image", "left/render/depth", "left/tissue_mask", "left/camera_info", "tf", PICTURE)
SPLATS, ANCHORS = "splats", "anchors"
TOPICS = (SPLATS, ANCHORS, *FRAME)  # the picture is asked for last: where it comes, all comes
SPLAT_FIELDS = {"scale_0", "rot_w", "f_dc_0", "opacity", "id"}
ANCHOR_FIELDS = {"id", "visibility", "confidence", "age"}

MAX_AGE = 1.0  # s; older content is not shown
LEAST_HZ = 0.5  # the viewer shows a few frames of many, so losing some of them is no fault; age is
WAIT_FOR_PICTURE = MAX_AGE  # s: later none is new
WAIT_FOR_REST = 0.3  # s for what belongs to a picture
SILENT_AFTER = 2.5  # s without a `status`, which comes every second

_STATES = {
    "starting": "the node is starting: waiting for the first frame",
    "waiting": "waiting for the left camera: the source gives no frames",
    "paused": "the node is paused; Resume goes on",
    "stopping": "the node is stopping",
}


class Rung(msgspec.Struct, frozen=True):
    """Of the ladder of quality."""

    number: int
    of: int


class Status(msgspec.Struct, frozen=True):
    """What the node says of itself, as far as it is shown."""

    state: str = ""  # "" before it has said anything
    rate_hz: float = 0.0
    latency_ms: dict[str, float] = {}
    gaussians: int = 0
    rung: Rung | None = None
    last_error: str | None = None
    warning_codes: dict[str, str] = {}  # code -> what is wrong and how to fix it


SILENT = Status()


@dataclass(frozen=True, slots=True)
class Moment:
    """All that may be shown as new; what may not is None."""

    problem: str | None = None  # why nothing is shown; None while all is well
    status: Status = SILENT
    picture: U8 | None = None  # [H, W, 3] left input
    model: Picture | None = None  # input, render, depth and tissue of one frame
    camera: Camera | None = None  # of that frame
    splats: NDArray[Any] | None = None  # [N] records, see docs/wire.md
    anchors: NDArray[Any] | None = None


class Feed:
    """Follows a node; used from one thread.

    Raises:
        UsageError: the node wants keys that are not given, or the other way round.
        SagsError: its endpoint is malformed. That no node runs yet is no error.
    """

    def __init__(self, node: NodeAddress, clock: NodeClock | None = None) -> None:
        self._clock = clock
        self._frame: dict[str, Received] | None = None  # the newest that came as a whole
        rates = dict.fromkeys(TOPICS, LEAST_HZ)
        self._subscriber = Subscriber.at(
            node, TOPICS, rates=rates, clock=clock, paused=True, may_be_absent=True
        )

    def now(self) -> Moment:
        """What may be shown now. The node sends one frame for it, and nothing until the next `now`; it is
        waited for up to `WAIT_FOR_PICTURE` and `WAIT_FOR_REST`."""
        subscriber = self._subscriber
        subscriber.resume()
        try:
            sends = subscriber.absent is None and _status_of(subscriber).state not in _STATES
            before = subscriber.latest(PICTURE)
            picture = subscriber.wait(PICTURE, WAIT_FOR_PICTURE, after=before) if sends else None
            if picture is not None:
                subscriber.aligned(TOPICS, picture.stamp_ns, WAIT_FOR_REST)
            return self._seen(subscriber)
        finally:
            subscriber.pause()

    def _seen(self, subscriber: Subscriber) -> Moment:
        status = _status_of(subscriber)
        problem = self._problem(subscriber, status)
        if problem is not None:
            return Moment(problem, status)
        picture = subscriber.latest(PICTURE)
        assert isinstance(picture, ReceivedImage)  # else there was a problem
        model, camera = self._whole_frame(subscriber, picture)
        return Moment(
            problem=None if model is not None else "waiting for the model of this picture",
            status=status,
            picture=picture.array,
            model=model,
            camera=camera,
            splats=_records(subscriber, SPLATS, SPLAT_FIELDS),
            anchors=_records(subscriber, ANCHORS, ANCHOR_FIELDS),
        )

    def close(self) -> None:
        """Follow no node any more."""
        self._subscriber.close()
        if self._clock is not None:
            self._clock.close()

    def _problem(self, subscriber: Subscriber, status: Status) -> str | None:
        """Why nothing may be shown: what the node is, and else what its pictures are."""
        why = subscriber.refusal or subscriber.absent
        if not status.state:
            return why or f"waiting for a node at {subscriber.endpoint}"
        if (silence := _silence(subscriber)) > SILENT_AFTER:
            return why or f"stale for {silence:.1f} s: the node is silent"
        if status.state in _STATES:
            return _STATES[status.state]
        newest = subscriber.latest(PICTURE)
        if newest is None:
            return "waiting for the left camera"
        if (age := newest.age(subscriber.now_ns())) > MAX_AGE:
            return f"stale for {age:.1f} s: no picture comes"
        return subscriber.problem(PICTURE, MAX_AGE)

    def _whole_frame(
        self, subscriber: Subscriber, picture: ReceivedImage
    ) -> tuple[Picture | None, Camera | None]:
        """The newest frame of which everything came, while it is not too old."""
        self._frame = subscriber.aligned(FRAME, picture.stamp_ns) or self._frame
        if self._frame is None:
            return None, None
        shown = self._frame[PICTURE]
        is_old = shown.age(subscriber.now_ns()) > MAX_AGE
        if is_old or (shown.meta.session, shown.meta.epoch) != (picture.meta.session, picture.meta.epoch):
            return None, None
        return _unpack(self._frame)


def _silence(subscriber: Subscriber) -> float:
    """Seconds since the node last spoke of itself; 0 where it has not spoken yet."""
    status = subscriber.latest("status")
    return 0.0 if status is None else (subscriber.now_ns() - status.meta.publish_ns) * 1e-9


def _status_of(subscriber: Subscriber) -> Status:
    status = subscriber.latest("status")
    if not isinstance(status, ReceivedText):
        return SILENT
    try:
        return msgspec.json.decode(status.text, type=Status)
    except (msgspec.MsgspecError, RecursionError):
        return SILENT


def _records(subscriber: Subscriber, name: str, fields: set[str]) -> NDArray[Any] | None:
    """The rows of a cloud that may be shown as new and has these fields."""
    cloud = subscriber.latest(name)
    if subscriber.problem(name, MAX_AGE) is not None or not isinstance(cloud, ReceivedCloud):
        return None
    return cloud.points if fields <= set(cloud.points.dtype.names or ()) else None


def _unpack(frame: Mapping[str, Received]) -> tuple[Picture | None, Camera | None]:
    """The messages of one frame as pictures and camera; None when they do not fit together."""
    render, depth, tissue, info, pose, picture = (frame[name] for name in FRAME)
    assert isinstance(picture, ReceivedImage) and isinstance(render, ReceivedImage)
    assert isinstance(depth, ReceivedImage) and isinstance(tissue, ReceivedImage)
    assert isinstance(info, ReceivedCameraInfo) and isinstance(pose, ReceivedRos)
    size = (info.height, info.width)
    pictures = (picture, render, depth, tissue)
    if any(image.array.shape[:2] != size for image in pictures) or depth.array.ndim != 2:
        return None, None
    try:
        T_world_cam = pose.pose()
    except WireError:
        return None, None
    model = Picture(
        frame_id=picture.meta.frame_id,
        psnr=np.nan,  # not of every frame: it costs more than all the rest here
        truth=picture.array,
        render=render.array[..., :3],
        depth=np.nan_to_num(depth.array, nan=0.0),
        tissue=tissue.array > 0,
    )
    return model, Camera(info.width, info.height, info.K, T_world_cam)
