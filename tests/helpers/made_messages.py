"""Headers of messages that no node has sent."""

from __future__ import annotations

from typing import Any

from sags_node.messaging.wire import Meta

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
