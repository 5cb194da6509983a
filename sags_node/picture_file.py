"""JPEG, PNG and TIFF files of others, decoded: their size is looked at before memory is taken for it."""

from __future__ import annotations

import logging
import re
import struct
import threading
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from sags_node.errors import SagsError
from sags_node.native_output import native_output

log = logging.getLogger(__name__)

MAX_PIXELS = 64 << 20
_PNG = b"\x89PNG\r\n\x1a\n"
_JPEG = b"\xff\xd8"
_NO_FRAMES = (0xC4, 0xC8, 0xCC)  # JPEG markers among those of frames that are none
_TIFF = {b"II*\0": "<", b"MM\0*": ">"}  # and the order of its bytes
_TIFF_WIDTH, _TIFF_HEIGHT = 256, 257  # tags
_MOST_KINDS = 32


def decode(data: bytes | NDArray[np.uint8], flags: int, where: str, mend: str) -> NDArray[Any]:
    """A picture as OpenCV decodes it.

    What the decoder says of a picture that it could read goes to the log, with `where`.

    Args:
        flags: of `cv2.imdecode`.
        where: what to call it in messages.
        mend: what to do where it is damaged.

    Raises:
        SagsError: it is of another kind, damaged, or says that it is larger than `MAX_PIXELS`.
    """
    array = np.frombuffer(data, np.uint8)
    size = claimed_size(array.data)
    if size is None:
        raise SagsError(f"{where} is no JPEG, PNG or TIFF, or is damaged ({array.size} bytes); {mend}")
    width, height = size
    if not 0 < width * height <= MAX_PIXELS:
        raise SagsError(
            f"{where} says that it is {width}x{height} px; at most {MAX_PIXELS >> 20} Mpx are read; {mend}"
        )
    with native_output() as said:
        try:
            picture: NDArray[Any] | None = cv2.imdecode(array, flags)
        except cv2.error:
            picture = None
    if picture is None:
        reason = f": {said[-1]}" if said else ""
        raise SagsError(f"{where} is damaged or cut off ({array.size} bytes){reason}; {mend}")
    _complaints.tell(where, said)
    return picture


def claimed_size(data: memoryview) -> tuple[int, int] | None:
    """Width and height that a file claims; None where it is no JPEG, PNG or TIFF, or claims nothing."""
    try:
        if data[:8] == _PNG:
            width, height = struct.unpack_from(">II", data, 16)
            return width, height
        order = _TIFF.get(bytes(data[:4]))
        return _tiff_size(data, order) if order is not None else _jpeg_size(data)
    except struct.error:  # it ends before
        return None


def _jpeg_size(data: memoryview) -> tuple[int, int] | None:
    at = 2 if data[:2] == _JPEG else len(data)
    while at + 9 <= len(data) and data[at] == 0xFF:
        marker, length = struct.unpack_from(">BH", data, at + 1)
        if 0xC0 <= marker <= 0xCF and marker not in _NO_FRAMES:
            height, width = struct.unpack_from(">HH", data, at + 5)
            return width, height
        at += 2 + length
    return None


def _tiff_size(data: memoryview, order: str) -> tuple[int, int] | None:
    (at,) = struct.unpack_from(f"{order}I", data, 4)
    (entries,) = struct.unpack_from(f"{order}H", data, at)
    found: dict[int, int] = {}
    for entry in range(at + 2, at + 2 + 12 * entries, 12):
        tag, kind = struct.unpack_from(f"{order}HH", data, entry)
        (found[tag],) = struct.unpack_from(f"{order}{'H' if kind == 3 else 'I'}", data, entry + 8)
    if _TIFF_WIDTH not in found or _TIFF_HEIGHT not in found:
        return None
    return found[_TIFF_WIDTH], found[_TIFF_HEIGHT]


class _Complaints:
    """What decoders say, once of each kind: all pictures of a recording often have the same flaw."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._kinds: set[str] = set()

    def tell(self, where: str, said: list[str]) -> None:
        for line in said:
            kind = re.sub(r"\d+|0x[0-9a-f]+", "", line)
            with self._lock:
                is_new = kind not in self._kinds and len(self._kinds) < _MOST_KINDS
                if is_new:
                    self._kinds.add(kind)
            if is_new:
                log.warning("%s: %s (said once, of the first such picture)", where, line)


_complaints = _Complaints()
