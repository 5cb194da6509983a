"""Messages of OpenIGTLink (http://openigtlink.org/protocols/v2), version 1 of the header.

pyigtl packs and reads them. Here is what it lacks: STATUS, and a check of what strangers send.
"""

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pyigtl.messages import (
    CRC64,
    ImageMessage,
    MessageBase,
    PointMessage,
    PolyDataMessage,
    StringMessage,
    TransformMessage,
)

from sags_node.types import F64, U8

HEADER_BYTES = 58
MAX_BODY_BYTES = 65536  # of what peers send: requests and points
OK, NOT_READY = 1, 13  # codes of STATUS
NONE = "none"  # the name of the point that stands for none
_BAD_BYTES = (struct.error, ValueError, TypeError, IndexError)  # what pyigtl raises for a stranger's body


class Status(MessageBase):  # type: ignore[misc]  # pyigtl has no types
    """STATUS: a code, and the words for it."""

    def __init__(self, code: int, words: str) -> None:
        super().__init__()
        self._message_type, self._valid_message = "STATUS", True
        self._code, self._words = code, words

    def _pack_content(self) -> bytes:
        name = b"" if self._code == OK else b"not ready"
        return struct.pack(">Hq20s", self._code, 0, name) + _ascii(self._words).encode() + b"\0"


def image(picture: U8, T_ras_pixel: F64) -> MessageBase:
    """IMAGE of an image [H, W, C] uint8; `T_ras_pixel` [4, 4] takes (column, row, 0, 1) to mm."""
    return ImageMessage(picture[None], T_ras_pixel, "ras")


def transform(T: F64) -> MessageBase:
    """TRANSFORM of a pose [4, 4], mm."""
    return TransformMessage(T)


def points(places: F64, names: Sequence[str] = (), colors: Sequence[Sequence[int]] = ()) -> MessageBase:
    """POINT: named places [N, 3] (mm) with colours RGBA; for an empty list, one invisible point.

    A list without points has no body, and receivers pass over it: what they showed would stand.
    """
    if len(places) == 0:
        places, names, colors = np.zeros((1, 3)), (NONE,), ((0, 0, 0, 0),)
    message = PointMessage(places, list(names), colors)
    message.groups = "SAGS"
    return message


def surface(places: F64, triangles: NDArray[np.int64]) -> MessageBase:
    """POLYDATA: corners [N, 3] (mm) and triangles [M, 3]; both may be empty."""
    return PolyDataMessage(
        points=places, polygons=np.insert(triangles, 0, 3, axis=1).ravel().astype(np.uint32)
    )


def string(words: str) -> MessageBase:
    """STRING of these words, in ASCII."""
    return StringMessage(_ascii(words))


def packed(message: MessageBase, device: str, seconds: float) -> bytes:
    """Pack a message with its device and its time (s since the epoch)."""
    message.device_name, message.timestamp = device, seconds
    return bytes(message.pack())


@dataclass(frozen=True, slots=True)
class Said:
    """What a peer sent."""

    kind: str
    device: str
    text: str = ""  # of STRING
    points: tuple[tuple[str, F64], ...] = ()  # of POINT: name, place [3] mm


def header(raw: bytes) -> dict[str, Any] | None:
    """Read a header of 58 bytes from anybody: the fields of `MessageBase.parse_header`, and `crc`. None: it
    is no header, or announces too long a body."""
    try:
        fields: dict[str, Any] = MessageBase.parse_header(raw)
    except UnicodeDecodeError:
        return None
    if not 1 <= fields["header_version"] <= 3 or fields["body_size"] > MAX_BODY_BYTES:
        return None
    return fields | {"crc": int.from_bytes(raw[-8:])}


def said(head: dict[str, Any], body: bytes) -> Said | None:
    """Return what a message says, if it is a STRING or a POINT; None for other kinds and for damaged ones."""
    kind, device = head["message_type"], head["device_name"]
    if kind not in ("STRING", "POINT") or CRC64(body) != head["crc"]:
        return None
    message: Any = MessageBase.create_message(kind)
    try:
        message.unpack(head, body)
    except _BAD_BYTES:
        return None
    if kind == "STRING":
        return Said(kind, device, text=message.string)
    places = [np.array(place, np.float64) for place in message.positions]
    named = zip(message.names, places, strict=True)
    return Said(kind, device, points=tuple((n, p) for n, p in named if np.isfinite(p).all()))


def _ascii(words: str) -> str:
    """The words in ASCII: pyigtl can pack no other characters, and Slicer shows these."""
    return words.encode("ascii", "replace").decode()
