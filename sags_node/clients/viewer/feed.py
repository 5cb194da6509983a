"""What a running node shows at this moment, and why nothing is shown when there is nothing.

The node may come, go and come back: the feed connects by itself and drops what is old. Images come thin, as
small JPEG and PNG files, and only those that somebody looks at.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from sags_node.clients.viewer.overlay import LEAST_HZ, Overlay, OverlayFeed
from sags_node.messaging.address import NodeAddress
from sags_node.messaging.node_clock import NodeClock
from sags_node.messaging.received import (
    Received,
    ReceivedCameraInfo,
    ReceivedCloud,
    ReceivedCompressed,
    ReceivedRos,
    ReceivedText,
)
from sags_node.messaging.subscriber import SILENT_AFTER, Subscriber
from sags_node.messaging.wire import WireError
from sags_node.types import U8, Camera

# Numbers are subsampled, not averaged: taking every fourth pixel costs a fifth of every second one.
LEFT = "thin/half/left/image_rect_color/jpeg"
SHOWN = "thin/half/left/render/image/jpeg"
RIGHT = "thin/half/right/image_rect_color/jpeg"
RIGHT_SHOWN = "thin/half/right/render/image/jpeg"
DEPTH = "thin/quarter/left/render/depth/png"
CONFIDENCE = "thin/quarter/left/render/depth_confidence/png"
TISSUE = "thin/quarter/left/tissue_mask/png"
PICTURES = (LEFT, SHOWN, RIGHT, RIGHT_SHOWN, DEPTH, CONFIDENCE, TISSUE)
SPLATS, ANCHORS, INFO, POSE = "splats", "anchors", "left/camera_info", "tf"
WHOLE = (SPLATS, ANCHORS, INFO, POSE)  # always asked for, with LEFT
SPLAT_FIELDS = {"scale_0", "rot_w", "f_dc_0", "opacity", "id"}
ANCHOR_FIELDS = {"id", "visibility", "confidence", "depth_confidence", "age"}

MAX_AGE = 1.0  # s; older content is not shown
WAIT_FOR_PICTURE = MAX_AGE  # s; an image that comes later is old
WAIT_FOR_REST = 0.3  # s for what belongs to an image

_STATES = {
    "starting": "the node is starting: waiting for the first frame",
    "waiting": "waiting for the left camera: the source gives no frames",
    "paused": "the node is paused; Resume goes on",
    "stopping": "the node is stopping",
}


class Rung(msgspec.Struct, frozen=True):
    """The rung of the ladder of quality."""

    number: int
    of: int


class Status(msgspec.Struct, frozen=True):
    """What the node says of itself, as far as it is shown."""

    state: str = ""  # "" before it has said anything
    rate_hz: float = 0.0
    latency_ms: dict[str, float | None] = {}
    gaussians: int = 0
    rung: Rung | None = None
    last_error: str | None = None
    warning_codes: dict[str, str] = {}  # code -> what is wrong and how to fix it
    session: str = ""  # of the node that says so


SILENT = Status()


@dataclass(frozen=True, slots=True)
class Moment:
    """All that is new enough to be shown; the rest is missing. All but the status is of one frame."""

    problem: str | None = None  # why nothing is shown; None while all is well
    status: Status = SILENT
    pictures: Mapping[str, NDArray[Any]] = field(default_factory=dict)  # by topic, see `PICTURES`
    camera: Camera | None = None
    splats: NDArray[Any] | None = None  # [N] records, see docs/wire.md
    anchors: NDArray[Any] | None = None
    t_capture_ns: int = 0
    overlay: Overlay | None = None  # None: none runs
    drawn: Mapping[str, U8] = field(default_factory=dict)  # by eye, [H, W, 4] of the overlay


class Feed:
    """Follows a node; used from one thread.

    Raises:
        UsageError: the node wants keys that are not given, or the other way round.
        SagsError: its endpoint is malformed. That no node runs yet is no error.
    """

    def __init__(self, node: NodeAddress, clock: NodeClock | None = None) -> None:
        self._clock = clock
        self._frame: dict[str, Received] | None = None  # the newest that came as a whole
        self._shown: Received | None = None  # the image of the last moment
        names = (*WHOLE, *PICTURES)
        rates = dict.fromkeys(names, LEAST_HZ)
        self._subscriber = Subscriber.at(
            node, names, rates=rates, clock=clock, paused=True, may_be_absent=True
        )
        self._overlay = OverlayFeed(node.run_dir)

    def now(self, pictures: Iterable[str], overlaid: Iterable[str] = (), steady: bool = False) -> Moment:
        """Return what may be shown now. Wait up to `WAIT_FOR_PICTURE` for an image newer than the last one.

        Args:
            pictures: those of `PICTURES` that are looked at. The node makes no others.
            overlaid: eyes whose overlay is looked at.
            steady: let the node go on sending until the next call, which follows at once; else it sends one
                frame for each call, and nothing in between.
        """
        subscriber, overlaid = self._subscriber, tuple(overlaid)
        names = (*WHOLE, *dict.fromkeys((*pictures, LEFT)))
        subscriber.ask(names)
        self._overlay.ask(overlaid)
        try:
            sends = subscriber.absent is None and _status_of(subscriber).state not in _STATES
            picture = subscriber.wait(LEFT, WAIT_FOR_PICTURE, after=self._shown) if sends else None
            if picture is not None:
                self._shown = picture
                made = {LEFT} | (set(names) - subscriber.refused.copy().keys())
                whole = subscriber.aligned(made, picture.stamp_ns, WAIT_FOR_REST)
                self._frame = whole or self._frame
            return self._seen(subscriber, set(names), overlaid)
        finally:
            if not steady:  # not the overlay: one that only begins to draw would miss this frame
                subscriber.pause()

    def pause(self) -> None:
        """Let nothing but `status` come until the next `now`."""
        self._subscriber.pause()
        self._overlay.ask(())

    def _seen(self, subscriber: Subscriber, names: set[str], overlaid: tuple[str, ...]) -> Moment:
        status, overlay = _status_of(subscriber), self._overlay.says()
        if overlay is not None and overlay.session not in (None, status.session):
            overlay = None  # of another node on this machine: its anchors are other points
        problem = self._problem(subscriber, status)
        if problem is not None:
            return Moment(problem, status, overlay=overlay)
        newest = subscriber.latest(LEFT)
        assert newest is not None  # else there was a problem
        refused, frame = subscriber.refused.copy(), self._frame
        if (
            frame is None
            or not names <= frame.keys() | refused.keys()
            or not self._is_fresh(frame[LEFT], newest)
        ):
            frame = {LEFT: newest}
        try:
            shown = {name: part.array for name, part in frame.items() if isinstance(part, ReceivedCompressed)}
            camera = _camera(frame)
        except WireError as error:  # a damaged file, or no pose
            return Moment(f"the node sends what cannot be read: {error}", status, overlay=overlay)
        lacks = next((why for name, why in refused.items() if name in names), None)
        return Moment(
            problem="waiting for the model of this image" if camera is None else lacks,
            status=status,
            pictures=shown,
            camera=camera,
            splats=_records(frame.get(SPLATS), SPLAT_FIELDS),
            anchors=_records(frame.get(ANCHORS), ANCHOR_FIELDS),
            t_capture_ns=frame[LEFT].stamp_ns,
            overlay=overlay,
            drawn=self._overlay.pictures(overlaid, frame[LEFT].stamp_ns),
        )

    def close(self) -> None:
        """Stop following the node."""
        self._subscriber.close()
        self._overlay.close()
        if self._clock is not None:
            self._clock.close()

    def _problem(self, subscriber: Subscriber, status: Status) -> str | None:
        """Why nothing may be shown: first by the node's state, then by the age of its images."""
        why = subscriber.refusal or subscriber.absent
        if not status.state:
            return why or f"waiting for a node at {subscriber.endpoint}"
        if (silence := _silence(subscriber)) > SILENT_AFTER:
            return why or f"stale for {silence:.1f} s: the node is silent"
        if status.state in _STATES:
            return _STATES[status.state]
        newest = subscriber.latest(LEFT)
        if newest is None:
            return "waiting for the left camera"
        if (age := newest.age(subscriber.now_ns())) > MAX_AGE:
            return f"stale for {age:.1f} s: no image comes"
        return subscriber.problem(LEFT, MAX_AGE)

    def _is_fresh(self, shown: Received, newest: Received) -> bool:
        """Tell whether an older whole frame may be shown, as not all of the newest one has come."""
        same = (shown.meta.session, shown.meta.epoch) == (newest.meta.session, newest.meta.epoch)
        return same and shown.age(self._subscriber.now_ns()) <= MAX_AGE


def _silence(subscriber: Subscriber) -> float:
    """Seconds since the node last spoke of itself; 0 where it has not spoken yet."""
    status = subscriber.latest("status")
    return 0.0 if status is None else (subscriber.now_ns() - status.meta.publish_ns) * 1e-9


def _status_of(subscriber: Subscriber) -> Status:
    status = subscriber.latest("status")
    if not isinstance(status, ReceivedText):
        return SILENT
    try:
        said = msgspec.json.decode(status.text, type=Status)
    except (msgspec.MsgspecError, RecursionError):
        return SILENT
    return msgspec.structs.replace(said, session=status.meta.session)


def _records(cloud: Received | None, fields: set[str]) -> NDArray[Any] | None:
    """The rows of a cloud that has these fields."""
    if not isinstance(cloud, ReceivedCloud) or not fields <= set(cloud.points.dtype.names or ()):
        return None
    return cloud.points


def _camera(frame: Mapping[str, Received]) -> Camera | None:
    """The left camera of a whole frame; None where only its image came."""
    info, pose = frame.get(INFO), frame.get(POSE)
    if not isinstance(info, ReceivedCameraInfo) or not isinstance(pose, ReceivedRos):
        return None
    return Camera(info.width, info.height, info.K, pose.pose())


def known_depth(pictures: Mapping[str, NDArray[Any]]) -> NDArray[np.float32]:
    """The depths (m) that the model knows, [k]."""
    depth = pictures.get(DEPTH, np.zeros(0, np.float32))
    return np.asarray(depth[np.isfinite(depth)])
