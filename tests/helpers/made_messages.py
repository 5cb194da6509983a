"""Messages that no node has sent."""

from __future__ import annotations

from typing import Any

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
