"""From a bag's message back to what goes over the wire: bulk data as a part of its own, with a new stamp."""

from __future__ import annotations

import struct
from typing import Any

import numpy as np

from sags_node.bags.bag import BagMessage
from sags_node.bags.pictures import decompressed, header_stamp
from sags_node.messaging import cdr, topics
from sags_node.messaging.cdr import Content
from sags_node.messaging.wire import Buffer

STAMPED = (topics.IMAGE, cdr.COMPRESSED, topics.POINT_CLOUD, topics.CAMERA_INFO, topics.DIAGNOSTICS)
COMPRESSED_SUFFIX = "/compressed"
_HEADER_AT = 4  # after the four bytes that say how a CDR message is encoded
_FIRST_TRANSFORM_AT = 8  # after the length of the sequence too
_STAMP = struct.Struct("<iI")


def original_stamp(message: BagMessage) -> int:
    """Return what the message itself says of its time, ns; when it was published where it says nothing, or 0.

    Raises:
        SagsError: it is too short.
    """
    stamp_ns = header_stamp(message.data) if message.type in STAMPED else 0
    return stamp_ns or message.publish_ns


def outgoing(message: BagMessage, stamp_ns: int) -> tuple[str, Content]:
    """Topic (without leading slash) and content to send, stamped `stamp_ns`.

    A compressed picture becomes a raw one on the topic it was made of, as consumers of a node know it.

    Raises:
        SagsError: the message is damaged.
    """
    name = message.topic.lstrip("/")
    if message.type == cdr.COMPRESSED and name.endswith(COMPRESSED_SUFFIX):
        return name.removesuffix(COMPRESSED_SUFFIX), _raw_picture(message, stamp_ns)
    if message.type == topics.IMAGE:
        return name, _picture(message, stamp_ns)
    if message.type == topics.POINT_CLOUD:
        return name, _cloud(message, stamp_ns)
    stamped = bytearray(message.data)
    if message.type in STAMPED:
        _restamp(stamped, _HEADER_AT, stamp_ns)
    elif message.type == topics.TF and len(stamped) > _FIRST_TRANSFORM_AT:
        _restamp(stamped, _FIRST_TRANSFORM_AT, stamp_ns)
    return name, Content(message.type, (bytes(stamped),))


def _restamp(data: bytearray, at: int, stamp_ns: int) -> None:
    little_endian = data[1] & 1
    if little_endian and len(data) >= at + _STAMP.size:
        _STAMP.pack_into(data, at, *divmod(stamp_ns, 1_000_000_000))


def _parts(message: BagMessage, bulk: int, after: int, stamp_ns: int) -> tuple[Buffer, ...]:
    """The CDR cut around its bulk data, which stays where it is."""
    data = memoryview(message.data)
    start = bytearray(data[: len(data) - bulk - after])
    _restamp(start, _HEADER_AT, stamp_ns)
    parts: tuple[Buffer, ...] = (bytes(start), data[len(start) : len(start) + bulk])
    return (*parts, bytes(data[len(data) - after :])) if after else parts


def _picture(message: BagMessage, stamp_ns: int) -> Content:
    ros = cdr.decode(message.data, topics.IMAGE)
    dtype, channels = cdr.IMAGE_ENCODINGS.get(ros.encoding, ("uint8", 0))
    row_bytes = ros.width * channels * np.dtype(dtype).itemsize
    if not row_bytes or ros.step != row_bytes or ros.data.size != row_bytes * ros.height or ros.is_bigendian:
        data = bytearray(message.data)  # valid, but not in the words of this protocol: sent as it is
        _restamp(data, _HEADER_AT, stamp_ns)
        return Content(topics.IMAGE, (bytes(data),))
    shape = (ros.height, ros.width, channels) if channels > 1 else (ros.height, ros.width)
    return Content(topics.IMAGE, _parts(message, ros.data.size, 0, stamp_ns), ros.encoding, shape, dtype)


def _cloud(message: BagMessage, stamp_ns: int) -> Content:
    ros = cdr.decode(message.data, topics.POINT_CLOUD)
    parts = _parts(message, ros.data.size, 1, stamp_ns)  # one byte follows: is_dense
    words = ros.point_step // 4
    if ros.point_step % 4 or len(ros.fields) != words or ros.data.size != ros.width * ros.height * 4 * words:
        return Content(topics.POINT_CLOUD, (b"".join(parts),))
    names = ",".join(field.name for field in ros.fields)
    return Content(topics.POINT_CLOUD, parts, names, (ros.width * ros.height, words), "float32")


def _raw_picture(message: BagMessage, stamp_ns: int) -> Content:
    ros: Any = cdr.decode(message.data, cdr.COMPRESSED)
    picture, encoding = decompressed(ros, message.topic)
    return cdr.image(picture, encoding, stamp_ns, ros.header.frame_id)
