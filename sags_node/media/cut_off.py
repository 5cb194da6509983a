"""Tells whether a video file is cut off, by the units in which its container writes.

FFmpeg does not tell: streams hold neither length nor index, and the lengths in other containers may be a
second off.
"""

import struct
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO

PACKET = 188  # bytes of an MPEG transport stream's packet; 192 with a time, 204 with a checksum added
SECTOR = 2048  # bytes of a DVD's sector
HEAD = 1 << 16  # bytes at the beginning of a file; its header lies within them
TAIL = 1 << 18  # bytes at the end of a stream; at least one unit begins within them
LONGEST_NAME = 4  # bytes of a Matroska element's ID
_SEGMENT, _CLUSTER = bytes.fromhex("18538067"), bytes.fromhex("1f43b675")
_PACK, _STREAM_END = b"\0\0\1\xba", b"\xb9"  # of a program stream, ISO/IEC 13818-1
_BOXES = {b"moov", b"moof", b"mdat"}  # ISO/IEC 14496-12: what players need
_PARTITION = bytes.fromhex("060e2b34020501010d01020101")  # SMPTE 377-1
_ASF_FILE = bytes.fromhex("a1dcab8c47a9cf118ee400c00c205365")  # the File Properties Object


def ends_in_a_packet(path: Path, size: int, container: str) -> bool:
    """Tell whether a file of `size` bytes ends inside a packet or sector; False for other containers.

    Args:
        container: FFmpeg's name of the container.
    """
    if path.suffix.lower() == ".vob":
        return size % SECTOR != 0
    if container != "mpegts":
        return False
    with path.open("rb") as file:
        head = file.read(HEAD)
    for width in (PACKET, 192, 204):
        for at in range(width):
            if head[at::width][:4] == b"GGGG":  # each packet begins with a G; an added time lies before it
                return (size - at) % width not in (0, PACKET)
    return False


def lacks_its_end(path: Path, size: int, container: str) -> bool:
    """Tell whether a file of `size` bytes says that it is longer, or ends inside a unit of its container.

    False for a file that was never closed, but stops right behind a unit.
    """
    reader = next((each for name, each in _READERS.items() if name in container.split(",")), None)
    if reader is None:
        return False
    with path.open("rb") as file:
        return reader(file, size)


def _matroska(file: BinaryIO, size: int) -> bool:
    """By RFC 8794 and 9559. Elements of unknown length, as in live recordings, are read through."""
    at = 0
    while at < size:
        file.seek(at)
        head = file.read(16).ljust(16, b"\0")
        width = 9 - head[0].bit_length()  # the zeros in front of a number say how long it is
        if width > LONGEST_NAME:
            return False
        name, wide = head[:width], 9 - head[width].bit_length()
        unknown = (1 << 7 * wide) - 1
        length = int.from_bytes(head[width : width + wide]) & unknown
        at += width + wide
        if length != unknown:
            at += length
            if name == _SEGMENT:  # nothing follows
                break
        elif name not in (_SEGMENT, _CLUSTER):  # only these two may have an unknown length
            return False
    return at > size


def _flv(file: BinaryIO, size: int) -> bool:
    """By the file size in the metadata, if any, and by the last tag, whose length is written behind it."""
    said = file.read(HEAD).partition(b"\0\x08filesize\0")[2][:8]
    if len(said) == 8 and struct.unpack(">d", said)[0] > size:
        return True
    file.seek(max(0, size - 4))
    length = int.from_bytes(file.read(4))
    file.seek(max(0, size - 4 - length))
    return int.from_bytes(file.read(4)[1:]) + 11 != length


def _mxf(file: BinaryIO, size: int) -> bool:
    """By the header partition: it says where the footer partition begins. 0: that was never written."""
    head = file.read(HEAD)
    at = head.find(_PARTITION)
    if at < 0:
        return False
    width = head[at + 16]
    begins = at + 17 + (width & 0x7F if width & 0x80 else 0)
    return int.from_bytes(head[begins + 24 : begins + 32]) >= size


def _asf(file: BinaryIO, size: int) -> bool:
    """By the file size in the header, which does not hold for a broadcast (flag 1)."""
    said = file.read(HEAD).partition(_ASF_FILE)[2][24:80]
    if len(said) < 56:
        return False
    length, flags = struct.unpack_from("<Q", said, 0)[0], struct.unpack_from("<I", said, 48)[0]
    return not flags & 1 and length > size


def _mp4(file: BinaryIO, size: int) -> bool:
    """By the box that reaches past the end of the file. A box of length 0 goes up to the end."""
    at = 0
    while at + 8 <= size:
        file.seek(at)
        length, name, longer = struct.unpack(">I4sQ", file.read(16).ljust(16, b"\0"))
        length = longer if length == 1 else length
        if length < 8 or at + length > size:
            return length >= 8 and name in _BOXES
        at += length
    return False


def _program_stream(file: BinaryIO, size: int) -> bool:
    """By the packets behind a pack header near the end of the file."""
    file.seek(max(0, size - TAIL))
    tail = file.read(TAIL)
    at = tail.find(_PACK)
    while 0 <= at < len(tail) and tail[at : at + 3] in _PACK and tail[at + 3 : at + 4] != _STREAM_END:
        head = tail[at : at + 14].ljust(14, b"\0")
        if head[:4] != _PACK:
            at += 6 + int.from_bytes(head[4:6])
        elif head[4] >> 6 == 1:
            at += 14 + head[13] % 8
        else:  # MPEG-1
            at += 12
    return at > len(tail)


_READERS: dict[str, Callable[[BinaryIO, int], bool]] = {
    "matroska": _matroska,
    "flv": _flv,
    "mxf": _mxf,
    "asf": _asf,
    "mp4": _mp4,
    "mpeg": _program_stream,
}
