"""One message on the wire: `[topic, meta, part0, part1, ...]`, and the check of what arrives.

`meta` is a msgpack map that says what the parts are; the parts joined are one ROS 2 CDR message.
Decoding looks only at bytes that have arrived: a claimed size is compared with them, never allocated.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from sags_node.errors import SagsError

PROTOCOL = "1.0"
MAX_PARTS = 8
MAX_TOPIC_BYTES = 255
MAX_META_BYTES = 4096

Buffer = bytes | memoryview
DType = Literal["", "uint8", "float32"]
Stamp = Annotated[int, msgspec.Meta(ge=0, le=2**63 - 1)]
Count = Annotated[int, msgspec.Meta(ge=0, le=2**63 - 1)]
Text = Annotated[str, msgspec.Meta(max_length=512)]
Scale = Annotated[float, msgspec.Meta(gt=0, le=1)]
Seconds = Annotated[float, msgspec.Meta(ge=0)]
Window = Annotated[
    list[Annotated[int, msgspec.Meta(ge=0, lt=2**31)]], msgspec.Meta(min_length=3, max_length=3)
]


class WireError(SagsError):
    """Bytes that are no message of this protocol."""


class Meta(msgspec.Struct, frozen=True, kw_only=True):
    """The second part of every message; unknown keys are ignored."""

    v: Annotated[str, msgspec.Meta(pattern=r"^1\.[0-9]{1,4}\Z")] = PROTOCOL
    type: Text  # ROS 2 type of the joined parts
    type_hash: Text  # RIHS01
    seq: Count  # per topic and session; a gap is a lost message
    frame_id: Annotated[int, msgspec.Meta(ge=-1, le=2**63 - 1)]  # captured frame shown; -1: none
    stamp_ns: Stamp  # capture time of that frame
    publish_ns: Stamp
    session: Text  # changes when the node is started anew
    epoch: Count  # grows when the clock jumps back, a recording loops or the model is reset
    step: Count  # optimiser steps of the model
    encoding: Text  # of an image, or the comma-separated field names of a point cloud
    shape: Annotated[list[Annotated[int, msgspec.Meta(ge=0, lt=2**31)]], msgspec.Meta(max_length=4)]
    dtype: DType  # of part 1, little-endian; empty: no bulk part
    dropped: Count  # frames the node dropped so far
    ahead_ns: Count | msgspec.UnsetType = msgspec.UNSET  # what is shown is expected so long after `stamp_ns`
    detail_age_ns: Count | msgspec.UnsetType = (
        msgspec.UNSET
    )  # how long before `stamp_ns` the oldest image in a view was captured
    scale: Scale | msgspec.UnsetType = msgspec.UNSET  # size of one step of a thin image of integers
    window: Window | msgspec.UnsetType = msgspec.UNSET  # of a thin image: x, y, px of the whole per px
    recorded_s: Seconds | msgspec.UnsetType = msgspec.UNSET  # time of the frame in the recording played
    units: Text | msgspec.UnsetType = msgspec.UNSET  # of lengths: "relative", of a guessed rig; unset: metres


class Receipt(msgspec.Struct, frozen=True, kw_only=True):
    """The node's answer, once a second, to a program that sends it images or poses."""

    v: str = PROTOCOL
    taken: int  # messages since it connected
    refused: int
    overtaken: int  # messages left out because newer ones came before they were read
    problem: str | None = None  # what is wrong and how to fix it


@dataclass(frozen=True, slots=True)
class Message:
    topic: str
    meta: Meta
    parts: tuple[Buffer, ...]

    def array(self) -> NDArray[Any]:
        """The bulk part as a read-only array of `meta.shape`, without a copy when its memory is aligned.

        Raises:
            WireError: the message has no bulk part, or its size is not what `meta` claims.
        """
        meta = self.meta
        if not meta.dtype or len(self.parts) < 2:
            raise WireError(f"{self.topic}: a {meta.type} message has no array part")
        dtype = np.dtype(meta.dtype)
        claimed = math.prod(meta.shape) * dtype.itemsize
        arrived = memoryview(self.parts[1]).nbytes
        if claimed != arrived:
            raise WireError(f"{self.topic}: meta claims {claimed} bytes of data, {arrived} arrived")
        array = np.frombuffer(self.parts[1], dtype).reshape(meta.shape)
        if not array.flags.aligned:
            array = array.copy()
        array.flags.writeable = False
        return array

    def cdr(self) -> bytes:
        """The parts joined: one ROS 2 CDR message."""
        return b"".join(self.parts)


_encoder = msgspec.msgpack.Encoder()
_decoder = msgspec.msgpack.Decoder(Meta)


def encode(message: Message) -> list[Buffer]:
    """The ZeroMQ parts of a message."""
    return [message.topic.encode(), _encoder.encode(message.meta), *message.parts]


def decode(frames: Sequence[Buffer]) -> Message:
    """Decode the ZeroMQ parts that any sender sent into a message.

    Raises:
        WireError: too few, too many or too large parts, or a `meta` that does not follow the protocol.
    """
    if not 3 <= len(frames) <= MAX_PARTS:
        raise WireError(f"a message has 3 to {MAX_PARTS} parts, {len(frames)} arrived")
    topic, meta, *parts = frames
    if len(topic) > MAX_TOPIC_BYTES or len(meta) > MAX_META_BYTES:
        raise WireError(f"topic of {len(topic)} and meta of {len(meta)} bytes: too long")
    try:
        name = bytes(topic).decode()
        decoded = _decoder.decode(bytes(meta))
    except (msgspec.MsgspecError, UnicodeError, RecursionError) as error:
        raise WireError(f"not a message of protocol {PROTOCOL}: {error}") from None
    if not name.isprintable():  # the name appears in error messages and in the log
        raise WireError(f"no topic has the name {name!r}")
    return Message(name, decoded, tuple(parts))
