"""Received messages as typed values, which are views of the received memory."""

import time
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Generic, Self, TypeVar, overload

import msgspec
import numpy as np
from numpy.typing import NDArray

from sags_node.errors import UsageError
from sags_node.geometry import quat_to_matrix, rigid
from sags_node.messaging import cdr, topics
from sags_node.messaging.stream import check_topic
from sags_node.messaging.wire import Buffer, Message, Meta, WireError
from sags_node.types import F64

# States of a sender with valid content. While a node is held, images are valid, and no model is sent.
VALID_STATES = ("running", "held", "degraded")


@dataclass(frozen=True, slots=True)
class Received:
    """One message; subclasses add its content."""

    topic: str  # with the namespace
    meta: Meta
    received_ns: int
    parts: tuple[Buffer, ...] = field(repr=False, compare=False)  # as they came

    @property
    def stamp_ns(self) -> int:
        """Capture time of what it shows."""
        return self.meta.stamp_ns

    @property
    def metric(self) -> bool:
        """Tell whether lengths are metres; else the node has no calibration, and they have no unit."""
        return self.meta.units is msgspec.UNSET

    def age(self, now_ns: int | None = None) -> float:
        """Seconds since what it shows was captured."""
        return ((time.time_ns() if now_ns is None else now_ns) - self.meta.stamp_ns) * 1e-9

    def cdr(self) -> bytes:
        """The ROS 2 message that came, byte for byte."""
        return b"".join(self.parts)

    def ros(self) -> bytes:
        """The message for readers without `meta`: the CameraInfo of an uncalibrated camera says so itself."""
        return told_in_ros(self.meta, self.cdr())


@dataclass(frozen=True, slots=True)
class ReceivedImage(Received):
    array: NDArray[Any]  # [H, W] or [H, W, C], read-only; uint8, or float32 metres with NaN unknown


@dataclass(frozen=True)
class ReceivedCompressed(Received):
    """A thin image; it is decoded when its `array` is asked for."""

    @cached_property
    def array(self) -> NDArray[Any]:
        """[H, W] or [H, W, 3], read-only; uint8, or float32 with NaN unknown: metres, or a confidence.

        Raises:
            WireError: the file is damaged.
        """
        from sags_node.messaging.thin import decode  # brings OpenCV along, which few clients need

        return decode(self.topic, self.meta.scale or 0.0, self.parts[1])

    @property
    def window(self) -> tuple[int, int, int]:
        """The x and y of its first pixel in the whole image, and px of that per px of this one."""
        x, y, every = self.meta.window or (0, 0, 1)
        return x, y, every


@dataclass(frozen=True, slots=True)
class ReceivedCloud(Received):
    points: NDArray[Any]  # [N] records, read-only; fields by name, e.g. points["x"]

    def xyz(self) -> NDArray[np.float32]:
        """Positions [N, 3], m, world."""
        return np.stack([self.points["x"], self.points["y"], self.points["z"]], axis=1)


@dataclass(frozen=True, slots=True)
class ReceivedCameraInfo(Received):
    width: int  # px
    height: int
    K: F64  # [3, 3] px
    P: F64  # [3, 4]


@dataclass(frozen=True, slots=True)
class ReceivedText(Received):
    text: str

    def warnings(self) -> dict[str, str]:
        """The warnings of a `status`: code -> what is wrong and how to fix it."""
        return self._said().warning_codes

    def invalid(self) -> str | None:
        """Why nothing that the sender of this `status` sends is valid now; None: it may be."""
        state = self._said().state
        if state in VALID_STATES:
            return None
        return f"the sender says it is {state!r}" if state else "the sender's status cannot be read"

    def why_silent(self) -> str | None:
        """Why the sender of this `status` sends no frames, or nothing of the model; None: not known."""
        said = self._said()
        if said.state in ("", "running", "degraded"):
            return None
        why = ["sags resume goes on"] if said.state == "paused" else said.warning_codes.values()
        return "; ".join((f"the sender says it is {said.state!r}", *filter(None, (said.reason, *why))))

    def _said(self) -> "_Status":
        try:
            return msgspec.json.decode(self.text, type=_Status)
        except (msgspec.MsgspecError, RecursionError):
            return _Status()


class _Status(msgspec.Struct):
    state: str = ""
    reason: str | None = None  # of an overlay that is blank
    warning_codes: dict[str, str] = {}


@dataclass(frozen=True, slots=True)
class ReceivedRos(Received):
    message: Any  # a ROS message object of a type without a class of its own here: tf, diagnostics

    def pose(self) -> F64:
        """The only transform of a `tf` message, child to parent frame, [4, 4], m.

        Raises:
            WireError: it has none, or several.
        """
        transforms: Any = getattr(self.message, "transforms", ())
        if len(transforms) != 1:
            raise WireError(f"{self.topic}: {len(transforms)} transforms, expected one")
        moved = transforms[0].transform
        R = quat_to_matrix(np.array([getattr(moved.rotation, axis) for axis in "wxyz"]))
        return rigid(R, [getattr(moved.translation, axis) for axis in "xyz"])


R = TypeVar("R", bound=Received)
_KINDS: dict[str, type[Received]] = {
    topics.IMAGE: ReceivedImage,
    topics.COMPRESSED_IMAGE: ReceivedCompressed,
    topics.POINT_CLOUD: ReceivedCloud,
    topics.CAMERA_INFO: ReceivedCameraInfo,
    topics.STRING: ReceivedText,
}


def told_in_ros(meta: Meta, data: bytes) -> bytes:
    """The CDR of a message for readers that do not get `meta`, see `Received.ros`."""
    guessed = meta.type == topics.CAMERA_INFO and meta.units is not msgspec.UNSET
    return cdr.uncalibrated(data) if guessed else data


class TopicName(str, Generic[R]):
    """A topic's name that tells type checkers what comes on it: `depth.array` then needs no cast.

    depth = subscriber.read(TopicName("left/render/depth", ReceivedImage))

    Raises:
        UsageError: there is no such topic, or something else comes on it.
    """

    __slots__ = ()

    def __new__(cls, name: str, kind: type[R]) -> Self:
        comes = _KINDS.get(check_topic(name).type, ReceivedRos)
        if comes is not kind:
            raise UsageError(f"'{name}' brings {comes.__name__}, not {kind.__name__}")
        return super().__new__(cls, name)


class Frame(dict[str, Received]):
    """Messages that show the same captured frame, by topic."""

    @overload
    def __getitem__(self, name: TopicName[R]) -> R: ...
    @overload
    def __getitem__(self, name: str) -> Received: ...
    def __getitem__(self, name: str) -> Received:
        return super().__getitem__(name)


def interpret(message: Message, received_ns: int) -> Received:
    """Convert a message from any sender to its typed value.

    Raises:
        WireError: content and description do not fit, or the type is not one of this protocol.
    """
    head = (message.topic, message.meta, received_ns, message.parts)
    kind = message.meta.type
    if kind == topics.IMAGE:
        return ReceivedImage(*head, array=_image(message))
    if kind == topics.COMPRESSED_IMAGE:
        message.array()  # raises unless it is there, and as long as `meta` claims
        return ReceivedCompressed(*head)
    if kind == topics.POINT_CLOUD:
        return ReceivedCloud(*head, points=_records(message))
    ros = cdr.parse(message)
    if kind == topics.CAMERA_INFO:
        return ReceivedCameraInfo(*head, ros.width, ros.height, ros.k.reshape(3, 3), ros.p.reshape(3, 4))
    if kind == topics.STRING:
        return ReceivedText(*head, text=ros.data)
    return ReceivedRos(*head, message=ros)


def _image(message: Message) -> NDArray[Any]:
    meta = message.meta
    dtype, channels = cdr.IMAGE_ENCODINGS.get(meta.encoding, ("", 0))
    shape = meta.shape[2:] if channels > 1 else [1, *meta.shape[2:]]
    if dtype != meta.dtype or shape != [channels] or len(meta.shape) < 2:
        raise WireError(f"{message.topic}: {meta.encoding!r} does not fit {meta.dtype} {meta.shape}")
    return message.array()


def _records(message: Message) -> NDArray[Any]:
    meta = message.meta
    names = meta.encoding.split(",")
    well_named = len(set(names)) == len(names) and all(name.isidentifier() for name in names)
    if meta.dtype != "float32" or len(meta.shape) != 2 or meta.shape[1] != len(names) or not well_named:
        raise WireError(f"{message.topic}: fields {meta.encoding!r} do not fit {meta.dtype} {meta.shape}")
    if not {"x", "y", "z"} <= set(names):
        raise WireError(f"{message.topic}: a point cloud needs x, y and z")
    record = np.dtype([(name, "<u4" if name in cdr.PACKED_FIELDS else "<f4") for name in names])
    return message.array().reshape(-1).view(record)
