"""Saves what is whole of damaged MCAP files: everything up to the damage, and every intact chunk after it."""

import mmap
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import asdict, dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any, BinaryIO

from mcap.opcode import Opcode
from mcap.records import Channel, Schema

from sags_node.bags import mcap_file
from sags_node.bags.bag import (
    RECORDED,
    Channels,
    check_one,
    files_in,
    marks_of,
    missing_files,
    read_messages,
    records_of,
    storage_files,
    summary,
)
from sags_node.bags.mcap_file import HEAD, MAGIC, MAX_RECORD_BYTES, DamagedError, Entry, Head
from sags_node.clients.recording.bag_writer import BagWriter
from sags_node.errors import SagsError, UsageError
from sags_node.files import open_file


@dataclass(slots=True)
class Recovery:
    """What became of the files. `lost` is False only where nothing can be missing."""

    messages: int = 0
    chunks: int = 0  # whole ones
    chunks_damaged: int = 0
    messages_lost: int = 0  # whole, but of an unknown topic; how many a damaged chunk held is not known
    bytes_skipped: int = 0
    unclosed_files: int = 0
    files_missing: int = 0  # by the numbers of those that are there

    @property
    def lost(self) -> bool:
        parts = self.chunks_damaged, self.messages_lost, self.bytes_skipped, self.unclosed_files
        return any(parts) or self.files_missing > 0


def recover(path: Path, out: Path) -> dict[str, Any]:
    """Write what is whole of the MCAP file or folder at `path` as a new bag, and read it back.

    Nothing stays at `out` where nothing could be saved or something went wrong: the damaged files are still
    there to begin anew.

    Returns:
        The fields of `Recovery`, `lost` and the new folder.

    Raises:
        UsageError: there is no MCAP file, the folder holds several recordings, or something is at `out`
            already.
        SagsError: nothing can be saved, or the new bag cannot be written.
    """
    files = _files(path)
    if not files or files[0].suffix != ".mcap":
        raise UsageError(
            f"{path}: only MCAP is recovered; for ROS 1 use rosbag reindex, for db3 sqlite3 .recover"
        )
    done = Recovery(files_missing=missing_files(files) if path.is_dir() else 0)
    bag = BagWriter(out)
    try:
        with bag:
            writer = _Writer(bag, done)
            for file in files:
                _recover_file(file, writer)
            if done.messages == 0:
                raise SagsError(f"{path} holds no whole message; nothing can be saved")
    except OSError as error:
        bag.discard()
        raise SagsError(f"cannot recover {path} to {out}: {error.strerror}") from None
    except BaseException:
        bag.discard()
        raise
    read_back = sum(1 for _ in read_messages(out, wanted=lambda topic, kind: False))
    if read_back != done.messages:
        raise SagsError(f"{out} holds {read_back} of {done.messages} messages; is the disk sound?")
    return {"folder": str(out), **asdict(done), "lost": done.lost}


def _files(path: Path) -> list[Path]:
    """The files of one recording: their names are alike, unless metadata.yaml names just those."""
    if not path.is_dir():
        return storage_files(path)[0]
    files, named = files_in(path, ".mcap"), list[Path]()
    with suppress(SagsError):
        named = storage_files(path)[0]
    if set(named) != set(files):
        check_one(path)
    return files


class _Writer:
    """Copies messages of the old files into the new bag."""

    def __init__(self, bag: BagWriter, done: Recovery) -> None:
        self._bag = bag
        self.done = done
        self._known: dict[tuple[object, ...], int] = {}  # topic, type, schema, marks: channel
        self._attached: set[tuple[str, bytes]] = set()  # name and digest: each file of a bag has them all

    def write(self, entry: Entry, channel: Channel, schema: Schema) -> None:
        metadata, marks = channel.metadata, marks_of(channel)
        encoding = channel.message_encoding
        key = (channel.topic, encoding, schema.name, schema.data, *marks.items())
        if key not in self._known:
            latched = "transient_local" in metadata.get("offered_qos_profiles", "")
            self._known[key] = self._bag.add_topic(
                channel.topic,
                schema.name,
                schema,
                metadata.get("topic_type_hash", ""),
                latched,
                marks,
                encoding,
            )
        self._bag.write(self._known[key], entry.log_ns, entry.publish_ns, entry.sequence, entry.data)
        self.done.messages += 1

    def attach(self, content: bytes) -> None:
        """Copy an attachment whose checksum is right, once."""
        attachment = mcap_file.read_attachment(content)
        if attachment is None:
            return
        key = attachment.name, sha256(attachment.data).digest()
        if key not in self._attached:
            self._attached.add(key)
            self._bag.attach(attachment.name, attachment.media_type, attachment.data, attachment.log_time)

    def note(self, content: bytes) -> None:
        """Copy what says which node was recorded."""
        metadata = mcap_file.read_metadata(content)
        if metadata is not None and metadata.name == RECORDED:
            self._bag.note(RECORDED, metadata.metadata)


def _recover_file(path: Path, writer: _Writer) -> None:
    size, done = path.stat().st_size, writer.done
    if size == 0:
        done.unclosed_files += 1
        return
    with open_file(path) as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as mapped:
        channels = Channels()
        for record in summary(file, size):  # the first chunk of a channel may be damaged
            channels.add(record)
        position, in_data = len(MAGIC), True
        while True:
            try:
                for head in mcap_file.heads(file, size, position):
                    position = head.end
                    if head.opcode == Opcode.DATA_END:
                        in_data = False
                    if in_data:
                        _copy(file, head, channels, writer)
                return
            except DamagedError as error:
                if not in_data:  # all messages lie before: only the index is damaged
                    return
                position = error.position
            following = _next_chunk(mapped, position + 1)
            if following is None:
                done.unclosed_files += 1
                _copy_cut_off(mapped, position, channels, writer)
                return
            done.bytes_skipped += following - position
            position = following


def _copy(file: BinaryIO, head: Head, channels: Channels, writer: _Writer) -> None:
    """One record of the old file; what is damaged inside it is counted and left out."""
    if head.opcode in (Opcode.ATTACHMENT, Opcode.METADATA):
        say = writer.attach if head.opcode == Opcode.ATTACHMENT else writer.note
        say(mcap_file.read_content(file, head))
        return
    try:
        records = list(records_of(file, head))
    except DamagedError:
        writer.done.chunks_damaged += 1
        return
    writer.done.chunks += head.opcode == Opcode.CHUNK
    _copy_records(records, head.position, channels, writer)


def _copy_records(records: Iterable[Any], position: int, channels: Channels, writer: _Writer) -> None:
    for record in records:
        if not isinstance(record, Entry):
            channels.add(record)
            continue
        try:
            channel, schema = channels.of(record, position)
        except DamagedError:
            writer.done.messages_lost += 1
            continue
        writer.write(record, channel, schema)


def _next_chunk(mapped: mmap.mmap, position: int) -> int | None:
    """Find where the next record begins that can only be a chunk: its inner lengths add up."""
    opcode = bytes([Opcode.CHUNK])
    while (position := mapped.find(opcode, position)) >= 0:
        if position + HEAD.size > len(mapped):
            return None
        length = HEAD.unpack_from(mapped, position)[1]
        start = position + HEAD.size
        if 40 <= length <= min(MAX_RECORD_BYTES, len(mapped) - start):
            if mcap_file.chunk_is_consistent(memoryview(mapped)[start : start + length]):
                return position
        position += 1
    return None


def _copy_cut_off(mapped: mmap.mmap, position: int, channels: Channels, writer: _Writer) -> None:
    """The messages at the beginning of a chunk that the end of the file cuts off."""
    if mapped[position : position + 1] != bytes([Opcode.CHUNK]):
        writer.done.bytes_skipped += len(mapped) - position
        return
    content = mapped[position + HEAD.size : position + HEAD.size + MAX_RECORD_BYTES]
    writer.done.chunks_damaged += 1
    try:
        data = mcap_file.unpack_chunk(content, position, whole=False)
        _copy_records(mcap_file.inner_records(data, position), position, channels, writer)
    except DamagedError:
        return  # here the file ends
