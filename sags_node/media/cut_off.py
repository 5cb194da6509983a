"""Whether a video file must have been longer, by the units in which its container writes.

FFmpeg does not say it: streams hold neither length nor index, and the lengths that other containers hold may
be a second off.
"""

import struct
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO

PACKET = 188  # bytes of MPEG's transport streams, to which recorders add times or check sums: 192 or 204
SECTOR = 2048  # bytes of a DVD
HEAD = 1 << 16  # bytes of a file, within which its header is
TAIL = 1 << 18  # bytes of a stream, within which a unit begins and ends
LONGEST_NAME = 4  # bytes, of Matroska
_SEGMENT, _CLUSTER = bytes.fromhex("18538067"), bytes.fromhex("1f43b675")
_PACK, _STREAM_END = b"\0\0\1\xba", b"\xb9"  # of a program stream, ISO/IEC 13818-1
_BOXES = {b"moov", b"moof", b"mdat"}  # ISO/IEC 14496-12: what players need
_PARTITION = bytes.fromhex("060e2b34020501010d01020101")  # SMPTE 377-1
_ASF_FILE = bytes.fromhex("a1dcab8c47a9cf118ee400c00c205365")  # the File Properties Object


def ends_in_a_packet(path: Path, size: int, container: str) -> bool:
    """Tell whether the last packet or sector is not whole, of files of `size` bytes that have such.

    Args:
        container: FFmpeg's name of it.
    """
    if path.suffix.lower() == ".vob":
        return size % SECTOR != 0
    if container != "mpegts":
        return False
    with path.open("rb") as file:
        head = file.read(HEAD)
    for width in (PACKET, 192, 204):
        for at in range(width):
            if head[at::width][:4] == b"GGGG":  # each packet begins with a G; the time lies before it
                return (size - at) % width not in (0, PACKET)
    return False


def lacks_its_end(path: Path, size: int, container: str) -> bool:
    """Tell whether a file of `size` bytes says that it is longer, or ends within a unit of its container.

    One that was never ended, and stops behind a unit, does not.
    """
    reader = next((each for name, each in _READERS.items() if name in container.split(",")), None)
    if reader is None:
        return False
    with path.open("rb") as file:
        return reader(file, size)


def _matroska(file: BinaryIO, size: int) -> bool:
    """RFC 8794 and 9559. Elements of unknown length, as live ones have, are told by those inside."""
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
        elif name not in (_SEGMENT, _CLUSTER):  # nothing that is known
            return False
    return at > size


def _flv(file: BinaryIO, size: int) -> bool:
    """Its size, where it is said, and the last tag, whose length follows it."""
    said = file.read(HEAD).partition(b"\0\x08filesize\0")[2][:8]
    if len(said) == 8 and struct.unpack(">d", said)[0] > size:
        return True
    file.seek(max(0, size - 4))
    length = int.from_bytes(file.read(4))
    file.seek(max(0, size - 4 - length))
    return int.from_bytes(file.read(4)[1:]) + 11 != length


def _mxf(file: BinaryIO, size: int) -> bool:
    """A partition at its head says where that of its foot begins; 0: it was never written."""
    head = file.read(HEAD)
    at = head.find(_PARTITION)
    if at < 0:
        return False
    width = head[at + 16]
    begins = at + 17 + (width & 0x7F if width & 0x80 else 0)
    return int.from_bytes(head[begins + 24 : begins + 32]) >= size


def _asf(file: BinaryIO, size: int) -> bool:
    """Its size, unless it was sent as it was made."""
    said = file.read(HEAD).partition(_ASF_FILE)[2][24:80]
    if len(said) < 56:
        return False
    length, flags = struct.unpack_from("<Q", said, 0)[0], struct.unpack_from("<I", said, 48)[0]
    return not flags & 1 and length > size


def _mp4(file: BinaryIO, size: int) -> bool:
    """The box that leads over its end; a length of 0 goes to the end."""
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
    """The packets from a pack near its end on."""
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
