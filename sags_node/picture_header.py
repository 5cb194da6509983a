"""What picture files say of themselves before they are decoded: their size, and whether their end is there.

Decoders take the memory that a header asks for, and fill what is missing of a cut-off picture with grey and
say nothing.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Callable
from typing import NamedTuple

KINDS = "JPEG, PNG, TIFF, BMP, WebP or binary PGM/PPM"
SUFFIXES = frozenset((".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp", ".pgm", ".ppm", ".pnm"))
_NO_FRAMES = (0xC4, 0xC8, 0xCC)  # JPEG markers among those of frames that are none
_LONGEST_PADDING = 512  # bytes some cameras write after the end of a picture
_TIFF_ORDERS = {b"II": "<", b"MM": ">"}
_TIFF_WIDTH, _TIFF_HEIGHT = 256, 257  # tags
_TIFF_PLACES = ((273, 279), (324, 325))  # tags: where strips or tiles begin, and their lengths
_TIFF_FORMATS = {3: "H", 4: "I"}
_BMP_HEADER = 40  # bytes of the header that everything after OS/2 1.x has, at least
_BMP_PLAIN = (0, 3)  # kinds of compression that are none
_PNM = re.compile(
    rb"P([56])\s+(?:#[^\n]*\n\s*)*(\d{1,6})\s+(?:#[^\n]*\n\s*)*(\d{1,6})\s+(?:#[^\n]*\n\s*)*(\d{1,5})\s"
)
_PNM_LOOK = 4096  # bytes: a header with comments


class _Kind(NamedTuple):
    size: Callable[[memoryview], tuple[int, int] | None]
    length: Callable[[memoryview], int]  # bytes until the picture's end


def claimed_size(data: memoryview) -> tuple[int, int] | None:
    """Width and height that a file claims; None where it is of no kind that is read, or claims nothing."""
    kind = _kind(data)
    try:
        return None if kind is None else kind.size(data)
    except struct.error:  # it ends before
        return None


def is_whole(data: memoryview) -> bool:
    """Whether the end of a picture is there, as far as its header says where that is."""
    kind = _kind(data)
    try:
        return kind is not None and kind.length(data) <= len(data)
    except struct.error:
        return False


def _kind(data: memoryview) -> _Kind | None:
    start = bytes(data[:12])
    if start[:4] == b"RIFF":
        return _Kind(_webp_size, _webp_length) if start[8:] == b"WEBP" else None
    return next((kind for begins, kind in _KINDS.items() if start.startswith(begins)), None)


def _until(end: bytes) -> Callable[[memoryview], int]:
    """For kinds that end in a mark: nothing is missing where it is among the last bytes."""
    return lambda data: 0 if end in bytes(data[-_LONGEST_PADDING:]) else len(data) + 1


def _png_size(data: memoryview) -> tuple[int, int]:
    width, height = struct.unpack_from(">II", data, 16)
    return width, height


def _jpeg_size(data: memoryview) -> tuple[int, int] | None:
    at = 2
    while at + 9 <= len(data) and data[at] == 0xFF:
        marker, length = struct.unpack_from(">BH", data, at + 1)
        if 0xC0 <= marker <= 0xCF and marker not in _NO_FRAMES:
            height, width = struct.unpack_from(">HH", data, at + 5)
            return width, height
        at += 2 + length
    return None


def _pnm_size(data: memoryview) -> tuple[int, int] | None:
    found = _PNM.match(bytes(data[:_PNM_LOOK]))
    return None if found is None else (int(found[2]), int(found[3]))


def _pnm_length(data: memoryview) -> int:
    found = _PNM.match(bytes(data[:_PNM_LOOK]))
    if found is None:
        return len(data) + 1
    channels, wide = (3 if found[1] == b"6" else 1), (2 if int(found[4]) > 255 else 1)
    return found.end() + int(found[2]) * int(found[3]) * channels * wide


def _tiff_tags(data: memoryview) -> tuple[str, dict[int, tuple[str, int, int]]]:
    """The order of bytes, and of the first picture by tag: format, number of values, and where these are."""
    order = _TIFF_ORDERS[bytes(data[:2])]
    (at,) = struct.unpack_from(f"{order}I", data, 4)
    (entries,) = struct.unpack_from(f"{order}H", data, at)
    found = {}
    for entry in range(at + 2, at + 2 + 12 * entries, 12):
        tag, kind, count = struct.unpack_from(f"{order}HHI", data, entry)
        if kind in _TIFF_FORMATS:
            form = _TIFF_FORMATS[kind]
            inside = count * struct.calcsize(form) <= 4
            place = entry + 8 if inside else struct.unpack_from(f"{order}I", data, entry + 8)[0]
            found[tag] = form, count, place
    return order, found


def _tiff_values(data: memoryview, order: str, tag: tuple[str, int, int]) -> tuple[int, ...]:
    form, count, place = tag
    if place + count * struct.calcsize(form) > len(data):  # before memory is taken for so many
        raise struct.error
    return struct.unpack_from(f"{order}{count}{form}", data, place)


def _tiff_size(data: memoryview) -> tuple[int, int] | None:
    order, tags = _tiff_tags(data)
    if _TIFF_WIDTH not in tags or _TIFF_HEIGHT not in tags:
        return None
    width, height = (_tiff_values(data, order, tags[tag])[0] for tag in (_TIFF_WIDTH, _TIFF_HEIGHT))
    return width, height


def _tiff_length(data: memoryview) -> int:
    order, tags = _tiff_tags(data)
    ends = [0]
    for begin, length in _TIFF_PLACES:
        if begin in tags and length in tags:
            both = (_tiff_values(data, order, tags[tag]) for tag in (begin, length))
            ends += [sum(part) for part in zip(*both, strict=False)]
    return max(ends)


def _bmp_size(data: memoryview) -> tuple[int, int] | None:
    header, width, height = struct.unpack_from("<Iii", data, 14)
    return (width, abs(height)) if header >= _BMP_HEADER else None  # a negative height: from the top down


def _bmp_length(data: memoryview) -> int:
    claimed, begin = struct.unpack_from("<I4xI", data, 2)
    width, height, bits, compression = struct.unpack_from("<ii2xHI", data, 18)
    if compression not in _BMP_PLAIN:
        return int(claimed)
    return int(begin + (width * bits + 31) // 32 * 4 * abs(height))


def _webp_size(data: memoryview) -> tuple[int, int] | None:
    kind = bytes(data[12:16])
    if kind == b"VP8 ":
        width, height = struct.unpack_from("<HH", data, 26)
        return width & 0x3FFF, height & 0x3FFF
    if kind == b"VP8L":
        (bits,) = struct.unpack_from("<I", data, 21)
        return (bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1
    if kind == b"VP8X":
        width, wide, height, high = struct.unpack_from("<HBHB", data, 24)
        return width + (wide << 16) + 1, height + (high << 16) + 1
    return None


def _webp_length(data: memoryview) -> int:
    (length,) = struct.unpack_from("<I", data, 4)
    return int(length) + 8


_KINDS = {
    b"\xff\xd8": _Kind(_jpeg_size, _until(b"\xff\xd9")),
    b"\x89PNG\r\n\x1a\n": _Kind(_png_size, _until(b"IEND\xaeB`\x82")),
    b"II*\0": _Kind(_tiff_size, _tiff_length),
    b"MM\0*": _Kind(_tiff_size, _tiff_length),
    b"BM": _Kind(_bmp_size, _bmp_length),
    b"P5": _Kind(_pnm_size, _pnm_length),
    b"P6": _Kind(_pnm_size, _pnm_length),
}
