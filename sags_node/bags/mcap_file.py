"""Reads MCAP records from an untrusted file: every length is checked before memory is allocated.

Format: https://mcap.dev/spec. A file is magic, records, magic; a record is an opcode (1 byte), a length
(8 bytes) and its content. Messages lie in chunks, which may be compressed and carry a checksum.
"""

import bz2
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from io import BytesIO
from typing import BinaryIO, TypeAlias

import lz4.frame
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Metadata, Schema

from sags_node.errors import SagsError

MAGIC = b"\x89MCAP0\r\n"
MAX_RECORD_BYTES = 256 << 20
MAX_CHUNK_BYTES = 256 << 20  # unpacked
HEAD = struct.Struct("<BQ")
_MESSAGE = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
_FOOTER = struct.Struct("<BQQQI")  # opcode, length, start of the summary, start of its offsets, CRC
_CHUNK = struct.Struct("<QQQII")  # first and last log time, unpacked size, CRC, length of the next string
# What the package `mcap` raises for content that it cannot read.
_BAD_BYTES = (McapError, struct.error, UnicodeError, ValueError)


class DamagedError(SagsError):
    """A file is damaged.

    Attributes:
        position: byte of the file from which on it cannot be trusted.
    """

    def __init__(self, position: int, what: str) -> None:
        super().__init__(f"damaged at byte {position}: {what}")
        self.position = position


@dataclass(frozen=True, slots=True)
class Head:
    """The opcode, position and length of one record."""

    opcode: int
    position: int  # of the head
    length: int  # of the content

    @property
    def start(self) -> int:
        """Position of the content."""
        return self.position + HEAD.size

    @property
    def end(self) -> int:
        return self.start + self.length


@dataclass(frozen=True, slots=True)
class Entry:
    """One message as the file holds it."""

    channel_id: int
    sequence: int
    log_ns: int
    publish_ns: int
    data: memoryview


Inner: TypeAlias = Schema | Channel | Entry


def heads(file: BinaryIO, size: int, position: int) -> Iterator[Head]:
    """Yield the heads of the records from `position` on, up to the footer.

    Args:
        size: of the file, bytes.

    Raises:
        DamagedError: a record is larger than what is left of the file or than `MAX_RECORD_BYTES`, or the
            file does not end with a footer and magic.
    """
    while True:
        file.seek(position)
        head = file.read(HEAD.size)
        if len(head) < HEAD.size:
            raise DamagedError(position, "the file ends without a footer; it was cut off or never closed")
        found = Head(head[0], position, HEAD.unpack(head)[1])
        if found.length > size - found.start:
            raise DamagedError(
                position, f"a record of {found.length} bytes, but only {size - found.start} follow"
            )
        if found.length > MAX_RECORD_BYTES:
            raise DamagedError(position, f"a record of {found.length} bytes is larger than any may be")
        yield found
        if found.opcode == Opcode.FOOTER:
            file.seek(found.end)
            if file.read(len(MAGIC)) != MAGIC:
                raise DamagedError(found.end, "it does not end as an MCAP file")
            return
        position = found.end


def read_content(file: BinaryIO, head: Head) -> bytes:
    file.seek(head.start)
    return file.read(head.length)


def chunk_times(file: BinaryIO, head: Head) -> tuple[int, int]:
    """Return the first and the last log time of a chunk, ns, as it claims."""
    file.seek(head.start)
    claimed = file.read(16)
    if len(claimed) < 16:
        raise DamagedError(head.position, "a chunk without times")
    first, last = struct.unpack("<QQ", claimed)
    return first, last


def summary_start(file: BinaryIO, size: int) -> int:
    """Return the position of the summary, as the footer gives it.

    Raises:
        DamagedError: there is no footer, or no summary.
    """
    position = size - len(MAGIC) - _FOOTER.size
    if position >= len(MAGIC):
        file.seek(position)
        opcode, length, start, _, _ = _FOOTER.unpack(file.read(_FOOTER.size))
        if (opcode, length) == (Opcode.FOOTER, _FOOTER.size - HEAD.size) and 0 < start < position:
            return int(start)
    raise DamagedError(max(position, 0), "there is no footer with a summary")


def read_attachment(content: bytes) -> Attachment | None:
    """Read an attachment; None if it is damaged."""
    crc = int.from_bytes(content[-4:], "little")
    if crc and zlib.crc32(content[:-4]) != crc:
        return None
    try:
        return Attachment.read(ReadDataStream(BytesIO(content)))
    except _BAD_BYTES:
        return None


def read_metadata(content: bytes) -> Metadata | None:
    """Read a metadata record (name, keys and values); None if it is damaged."""
    try:
        return Metadata.read(ReadDataStream(BytesIO(content)))
    except _BAD_BYTES:
        return None


def chunk_is_consistent(content: bytes | memoryview) -> bool:
    """Tell whether the lengths inside a chunk's content add up to its own."""
    if len(content) < _CHUNK.size:
        return False
    first, last, _, _, named = _CHUNK.unpack_from(content)
    data = _CHUNK.size + named
    if first > last or named > 4 or len(content) < data + 8:
        return False
    return bool(struct.unpack_from("<Q", content, data)[0] == len(content) - data - 8)


def unpack(packed: bytes | memoryview, compression: bytes, size: int, position: int) -> bytes:
    """Decompress the data of a chunk: at most one byte more than the `size` that it claims.

    Args:
        compression: lz4, zstd, bz2 (of ROS 1), or nothing.
        position: of the chunk in the file, for messages.

    Raises:
        DamagedError: it claims more than a chunk may hold, or cannot be decompressed.
    """
    if size > MAX_CHUNK_BYTES:
        raise DamagedError(position, f"a chunk says that it unpacks to {size} bytes; at most 256 MB is read")
    try:
        match compression:
            case b"":
                return bytes(packed)
            case b"zstd":
                return bytes(zstandard.ZstdDecompressor().stream_reader(packed).read(size + 1))
            case b"lz4":
                return bytes(lz4.frame.LZ4FrameDecompressor().decompress(packed, max_length=size + 1))
            case b"bz2":
                return bz2.BZ2Decompressor().decompress(packed, max_length=size + 1)
    except (zstandard.ZstdError, RuntimeError, OSError, EOFError) as error:
        raise DamagedError(position, f"a chunk cannot be unpacked: {error}") from None
    raise DamagedError(position, f"a chunk of unknown compression {compression!r}")


def unpack_chunk(content: bytes, position: int, whole: bool = True) -> bytes:
    """Decompress and check the records of a chunk.

    Args:
        position: of the chunk in the file, for messages.
        whole: False for a chunk that is cut off: what is there is decompressed, and not checked.

    Raises:
        DamagedError: lengths or checksum are wrong, or it decompresses to more than it claims or may hold.
    """
    if (whole and not chunk_is_consistent(content)) or len(content) < _CHUNK.size + 12:
        raise DamagedError(position, "the lengths in a chunk do not add up")
    _, _, size, crc, named = _CHUNK.unpack_from(content)
    compression = content[_CHUNK.size : _CHUNK.size + named]
    packed = memoryview(content)[_CHUNK.size + named + 8 :]
    data = unpack(packed, bytes(compression), size, position)
    if whole and len(data) != size:
        raise DamagedError(position, f"a chunk does not unpack to the {size} bytes it says")
    if whole and crc and zlib.crc32(data) != crc:
        raise DamagedError(position, "the checksum of a chunk is wrong")
    return data


def inner_records(data: bytes, position: int) -> Iterator[Inner]:
    """Yield the schemas, channels and messages of a decompressed chunk; other records are skipped.

    Raises:
        DamagedError: a record reaches past the end of the chunk.
    """
    view, at = memoryview(data), 0
    while at < len(data):
        if len(data) - at < HEAD.size:
            raise DamagedError(position, "a chunk ends inside a record")
        opcode, length = HEAD.unpack_from(data, at)
        at += HEAD.size
        if length > len(data) - at:
            raise DamagedError(position, "a record leaves its chunk")
        record = parse(opcode, view[at : at + length], position)
        if record is not None:
            yield record
        at += length


def parse(opcode: int, content: memoryview, position: int) -> Inner | None:
    """Parse a schema, channel or message; None for any other record.

    Raises:
        DamagedError: the content does not follow the format.
    """
    if opcode == Opcode.MESSAGE:
        if len(content) < _MESSAGE.size:
            raise DamagedError(position, "a message shorter than its own head")
        channel_id, sequence, log_ns, publish_ns = _MESSAGE.unpack_from(content)
        return Entry(channel_id, sequence, log_ns, publish_ns, content[_MESSAGE.size :])
    if opcode not in (Opcode.SCHEMA, Opcode.CHANNEL):
        return None
    stream = ReadDataStream(BytesIO(content))
    try:
        record: Schema | Channel = (Schema if opcode == Opcode.SCHEMA else Channel).read(stream)
    except _BAD_BYTES as error:
        raise DamagedError(position, f"a schema or channel cannot be read: {error}") from None
    return record
