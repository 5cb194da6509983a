"""Messages that no node has sent."""

from typing import Any

import msgpack

from sags_node.messaging.cdr import Content, type_hash
from sags_node.messaging.wire import Message, Meta

MS = 1_000_000


def meta(seq: int, stamp_ms: float, **changes: Any) -> Meta:
    fields: dict[str, Any] = {
        "type": "sensor_msgs/msg/Image",
        "type_hash": "",
        "seq": seq,
        "frame_id": seq,
        "stamp_ns": int(stamp_ms * MS),
        "publish_ns": int(stamp_ms * MS),
        "session": "s",
        "epoch": 0,
        "step": 0,
        "encoding": "",
        "shape": [],
        "dtype": "",
        "dropped": 0,
    }
    return Meta(**{**fields, **changes})


def message_of(topic: str, said: Content, seq: int = 1, stamp_ms: float = 0, **changes: Any) -> Message:
    """Content with the header that fits it."""
    form: dict[str, Any] = {
        "type": said.type,
        "type_hash": type_hash(said.type),
        "encoding": said.encoding,
        "shape": list(said.shape),
        "dtype": said.dtype,
    }
    return Message(f"sags/{topic}", meta(seq, stamp_ms, **{**form, **changes}), said.parts)


def changed(header: bytes, **fields: object) -> bytes:
    """A header that says something else."""
    return msgpack.packb(msgpack.unpackb(header) | fields)


def damaged(depth: list[bytes], other: bytes) -> list[list[bytes]]:
    """What is no message, of the parts of a depth image and the header of another one."""
    topic, header, head, pixels = depth
    return [
        [topic],
        [topic, header],
        [topic, header, head, pixels[:-4]],
        *([topic, bad, head, pixels] for bad in (
            b"\xc1",
            b"\xdd\xff\xff\xff\xff",  # an array of four thousand million
            b"\x91" * 4000,
            changed(header, shape=[2**31 - 1, 2**31 - 1]),
            changed(header, shape=[2**31, 2**31]),
            changed(header, shape=[-64, -96]),
            changed(header, seq="one"),
            other,
        )),
    ]  # fmt: skip
