"""Checks a ROS 1 bag before it is opened: all lengths fit, and no chunk decompresses to too much.

Format: http://wiki.ros.org/Bags/Format/2.0. A record is header length, header fields, data length, data.
"""

import struct
from functools import lru_cache
from pathlib import Path
from typing import BinaryIO

from sags_node.bags.mcap_file import MAX_RECORD_BYTES, DamagedError, unpack
from sags_node.files import open_file

MAGIC = b"#ROSBAG V2.0\n"
MAX_HEADER_BYTES = 1 << 20
CHUNK_OP = b"\x05"
_LENGTH = struct.Struct("<I")


@lru_cache(maxsize=1)  # a bag is opened again for every loop, and unpacking all of it takes seconds
def chunk_positions(file: Path, size: int, mtime_ns: int) -> frozenset[int]:
    """Find the positions of a bag's chunks. Size (bytes) and time tell the cache that the file changed.

    Raises:
        DamagedError: it is no ROS 1 bag, a length does not fit, or a chunk decompresses to too much.
    """
    positions = set()
    with open_file(file) as bag:
        if bag.read(len(MAGIC)) != MAGIC:
            raise DamagedError(0, "it does not begin as a ROS 1 bag of version 2.0")
        while (position := bag.tell()) < size:
            header = bag.read(_length(bag, size, MAX_HEADER_BYTES))
            length = _length(bag, size, MAX_RECORD_BYTES)
            fields = _fields(header, position)
            if fields.get(b"op") == CHUNK_OP:
                positions.add(position)
                check_chunk(bag, length, fields, position)
            bag.seek(position + 8 + len(header) + length)
    return frozenset(positions)


def _length(bag: BinaryIO, size: int, most: int) -> int:
    position = bag.tell()
    read = bag.read(_LENGTH.size)
    if len(read) < _LENGTH.size:
        raise DamagedError(position, "the file ends inside a record")
    length = int(_LENGTH.unpack(read)[0])
    if length > min(most, size - bag.tell()):
        raise DamagedError(
            position, f"a part of {length} bytes is larger than the file's rest or than any may be"
        )
    return length


def _fields(header: bytes, position: int) -> dict[bytes, bytes]:
    fields, at = {}, 0
    while at + _LENGTH.size <= len(header):
        (length,) = _LENGTH.unpack_from(header, at)
        at += _LENGTH.size
        name, equals, value = header[at : at + length].partition(b"=")
        if not equals or at + length > len(header):
            raise DamagedError(position, "the header of a record cannot be read")
        fields[name] = value
        at += length
    return fields


def check_chunk(bag: BinaryIO, length: int, fields: dict[bytes, bytes], position: int) -> None:
    """Decompress a chunk once with a limit on its size, which `rosbags` does not have."""
    said, compression = fields.get(b"size", b""), fields.get(b"compression", b"")
    if len(said) != _LENGTH.size:
        raise DamagedError(position, "a chunk does not say its size")
    (size,) = _LENGTH.unpack(said)
    packed = bag.read(0 if compression == b"none" else length)
    data = unpack(packed, compression.replace(b"none", b""), size, position)
    if compression != b"none" and len(data) != size:
        raise DamagedError(position, f"a chunk does not unpack to the {size} bytes it says")
