"""Reads messages from any bag: rosbag2 folders (MCAP, db3), single .mcap and .db3 files, ROS 1 .bag files.

Whatever the file, a message is ROS 2 CDR. MCAP is read by `mcap_file`, record by record, so that no false
length or index can make it take too much memory. db3 and ROS 1 files are read by `rosbags`.
"""

import logging
import shlex
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any, BinaryIO

from mcap.opcode import Opcode
from mcap.records import Channel, Schema

from sags_node.bags import mcap_file, rosbag1_check
from sags_node.bags.mcap_file import MAGIC, MAX_RECORD_BYTES, DamagedError, Entry, Head, Inner
from sags_node.config.launch_file import BAG_SUFFIXES as SUFFIXES
from sags_node.config.launch_file import UNFINISHED
from sags_node.config.yaml_reader import read_yaml
from sags_node.errors import SagsError, UsageError
from sags_node.files import SHOWN, open_file
from sags_node.messaging import cdr

_warn = cache(logging.getLogger(__name__).warning)  # once: a bag is looked at several times

MAX_METADATA_BYTES = 4 << 20
METADATA = "metadata.yaml"
DATE = 6  # digits: a number in a file's name with as many or more is a date, not a count of files
RECORDED = "sags"  # name of the metadata record that tells which node is recorded from there on
RELATIVE = {"sags_units": "relative"}  # metadata of a channel whose lengths have no unit
AHEAD = "sags_ahead_ms"  # metadata of a channel with predicted content: ms ahead of the stamp

Wanted = Callable[[str, str], bool]  # by topic and type


@dataclass(frozen=True, slots=True)
class BagMessage:
    topic: str  # as written, usually with a leading slash
    type: str  # ROS 2 name, e.g. sensor_msgs/msg/Image; ROS 1 name for types in `cdr.OTHER_IN_ROS1`
    log_ns: int  # when it was recorded
    publish_ns: int
    sequence: int  # 0 where the format has none
    data: bytes | memoryview  # CDR
    relative: bool = False  # its lengths have no unit: it is of a node without calibration
    ahead_ns: int = 0  # how far its content is predicted ahead of its stamp
    session: str = ""  # of the node that was recorded; empty: not in the bag
    epoch: int = 0  # of that node


def read_messages(
    path: Path,
    topics: Collection[str] | None = None,
    start_ns: int = 0,
    wanted: Wanted | None = None,
) -> Iterator[BagMessage]:
    """Yield the messages of a bag in the order of the file.

    Args:
        topics: only these; None: all.
        start_ns: leave out what was recorded before.
        wanted: tells by topic and type whose data is used; None: all. Other data is not converted, and its
            encoding is not checked (it may be JSON).

    Raises:
        UsageError: there is no bag at `path`, or its format is not supported.
        SagsError: it is damaged; the message says where and how to fix it.
    """
    files, unpack = storage_files(path)
    for file in files:
        with _explained(file):
            if file.suffix == ".mcap":
                found = _read_mcap(file, topics, start_ns, wanted)
            else:
                found = _read_with_rosbags(file, topics, start_ns, wanted)
            for message in found:
                yield _unpacked(message) if unpack else message


def recorded_namespace(path: Path) -> str | None:
    """Return the namespace of the recorded node; None if the bag does not hold it: another program recorded
    it, or it is not MCAP.

    Raises:
        UsageError, SagsError: as `read_messages`.
    """
    for file in (file for file in storage_files(path)[0] if file.suffix == ".mcap"):
        with _explained(file), open_file(file) as opened:
            for head in mcap_file.heads(opened, file.stat().st_size, len(MAGIC)):
                if head.opcode in (Opcode.CHUNK, Opcode.MESSAGE):
                    break  # that record comes before the first message
                if (said := _recorded_node(opened, head)) is not None:
                    return said.get("ns")
    return None


def recorded_topics(path: Path) -> set[str]:
    """Return the topics in the summaries of a bag's files; empty if one has none (cut off, or not MCAP).

    Raises:
        UsageError, SagsError: as `read_messages`.
    """
    there = set[str]()
    for file in storage_files(path)[0]:
        if file.suffix != ".mcap":
            return set()
        with _explained(file), open_file(file) as opened:
            said = {each.topic for each in summary(opened, file.stat().st_size) if isinstance(each, Channel)}
        if not said:
            return set()
        there |= said
    return there


def _recorded_node(file: BinaryIO, head: Head) -> dict[str, str] | None:
    """The metadata of the recorded node, if this record holds it; else None."""
    if head.opcode != Opcode.METADATA or head.length > MAX_METADATA_BYTES:
        return None
    said = mcap_file.read_metadata(mcap_file.read_content(file, head))
    return said.metadata if said is not None and said.name == RECORDED else None


def storage_files(path: Path) -> tuple[list[Path], bool]:
    """Return the files of a bag in order, and whether their messages are compressed one by one (zstd).

    Raises:
        UsageError: there is no bag, its metadata cannot be read, or whole files are compressed.
    """
    if not path.is_dir():
        if not path.is_file():
            raise UsageError(f"recording {path} does not exist; check the path")
        if path.name.endswith(UNFINISHED):
            named = shlex.quote(str(path))
            raise UsageError(
                f"{path} was not closed: its recorder was killed; with ROS 1: rosbag reindex {named}, "
                f"then mv {named} {shlex.quote(str(path.with_suffix('')))}"
            )
        if path.suffix not in SUFFIXES:
            raise UsageError(f"{path} is not a recording; what is read: folders, {', '.join(SUFFIXES)}")
        return [path], False
    if not (path / METADATA).is_file():
        check_one(path)
        files = files_in(path, ".mcap") or files_in(path, ".db3")
        if not files:
            raise UsageError(
                f"{path} holds neither {METADATA} nor a .mcap or .db3 file; it is not a rosbag2 folder"
            )
        if lacking := missing_files(files):
            _warn("%s lacks %d of its files, and what was in them", path, lacking)
        return files, False
    information = _metadata(path / METADATA)
    mode = str(information.get("compression_mode") or "").lower()
    if mode == "file":
        raise UsageError(f"{path} is compressed file by file; unpack it first: ros2 bag convert, or zstd -d")
    names = information.get("relative_file_paths")
    if not isinstance(names, list) or not names or not all(isinstance(name, str) for name in names):
        raise UsageError(f"{path / METADATA} names no files; remove it to read the files beside it")
    files = [path / Path(name).name for name in names]  # a name cannot lead out of the folder
    for file in files:
        if not file.is_file() or file.suffix not in (".mcap", ".db3"):
            raise UsageError(f"{path / METADATA} names {file.name}, which is not a .mcap or .db3 file there")
    return files, mode == "message"


def check_one(folder: Path) -> None:
    """Check by their names that the files in a folder are of one recording.

    Raises:
        UsageError: they are of several.
    """
    stems = {_stem(file.stem) for suffix in (".mcap", ".db3") for file in files_in(folder, suffix)}
    if len(stems) > 1:
        raise UsageError(
            f"{folder} holds {len(stems)} recordings and no {METADATA} that names one: "
            f"{', '.join(sorted(stems)[:3])}; give one of its files"
        )


def files_in(folder: Path, suffix: str) -> list[Path]:
    """Return a folder's files with this suffix, ordered by their numbers: case_2 before case_10."""
    found = folder.glob(f"{SHOWN}{suffix}")
    return sorted(found, key=lambda file: (_whole(file.stem.rpartition("_")[2]), file.name))


def missing_files(files: Sequence[Path]) -> int:
    """Count the files that are missing before the last one; they are numbered from 0: case_0, case_1."""
    parts = [file.stem.rpartition("_")[2] for file in files]
    if not all(part.isdecimal() and len(part) < DATE for part in parts):
        return 0
    return max(map(int, parts), default=-1) + 1 - len(set(parts))


def _stem(stem: str) -> str:
    """The name of a recording without the number of its file: case for case_0."""
    name, _, digits = stem.rpartition("_")
    return name if digits.isdecimal() else stem


def _whole(digits: str) -> int:
    """The number in these digits; 0 if there is none, or if it has ten digits or more."""
    return int(digits) if digits.isdecimal() and len(digits) < 10 else 0


def _metadata(file: Path) -> dict[str, Any]:
    tree = read_yaml(file, "description of a bag", MAX_METADATA_BYTES)
    information = tree.get("rosbag2_bagfile_information") if isinstance(tree, dict) else None
    if not isinstance(information, dict):
        raise UsageError(f"{file} has no rosbag2_bagfile_information; it does not describe a bag")
    return information


@contextmanager
def _explained(file: Path) -> Iterator[None]:
    """Turn errors about a file into a `SagsError` that names it and says how to fix it."""
    try:
        yield
    except OSError as error:
        raise SagsError(f"cannot read {file}: {error.strerror}") from None
    except DamagedError as error:
        fix = f"save what is whole with: sags bag recover {shlex.quote(str(file))} -o OUT"
        if file.suffix != ".mcap":
            fix = "copy it again, or fix it with its own tools (rosbag reindex, sqlite3 .recover)"
        raise SagsError(f"{file} is {error}; {fix}") from None


# ---- MCAP ------------------------------------------------------------------------------------------------


def _read_mcap(
    file: Path, topics: Collection[str] | None, start_ns: int, wanted: Wanted | None
) -> Iterator[BagMessage]:
    size = file.stat().st_size
    channels, session, epoch = Channels(), "", 0
    with open_file(file) as opened:
        if opened.read(len(MAGIC)) != MAGIC:
            raise DamagedError(0, "it does not begin as an MCAP file")
        for head in mcap_file.heads(opened, size, len(MAGIC)):
            if head.opcode == Opcode.CHUNK and mcap_file.chunk_times(opened, head)[1] < start_ns:
                # Its channels may be needed later: a channel is described only before its first message.
                channels.missed.append(head)
                continue
            if (said := _recorded_node(opened, head)) is not None:
                session, epoch = said.get("session", ""), _whole(said.get("epoch", ""))
            for record in records_of(opened, head):
                if not isinstance(record, Entry):
                    channels.add(record)
                    continue
                if not channels.describe(record.channel_id):
                    channels.read_missed(opened)
                channel, schema = channels.of(record, head.position)
                if record.log_ns >= start_ns and (topics is None or channel.topic in topics):
                    used = wanted is None or wanted(channel.topic, schema.name)
                    if used and channel.message_encoding != "cdr":
                        raise UsageError(
                            f"{file}: topic {channel.topic} is encoded as {channel.message_encoding!r}; only "
                            "ROS 2 messages (cdr) are read"
                        )
                    yield BagMessage(
                        channel.topic,
                        schema.name,
                        record.log_ns,
                        record.publish_ns,
                        record.sequence,
                        record.data,
                        RELATIVE.items() <= channel.metadata.items(),
                        _whole(channel.metadata.get(AHEAD, "")) * 1_000_000,
                        session,
                        epoch,
                    )


def marks_of(channel: Channel) -> dict[str, str]:
    """Return the metadata of a channel that ROS messages cannot hold: `RELATIVE` and `AHEAD`."""
    return {key: said for key, said in channel.metadata.items() if key in (*RELATIVE, AHEAD)}


def records_of(file: BinaryIO, head: Head) -> Iterator[Inner]:
    """Yield the schemas, channels and messages in a record of the file. It may be a chunk, which holds many.

    Raises:
        DamagedError: the record is damaged.
    """
    if head.opcode == Opcode.CHUNK:
        data = mcap_file.unpack_chunk(mcap_file.read_content(file, head), head.position)
        yield from mcap_file.inner_records(data, head.position)
    elif head.opcode in (Opcode.MESSAGE, Opcode.SCHEMA, Opcode.CHANNEL):
        record = mcap_file.parse(head.opcode, memoryview(mcap_file.read_content(file, head)), head.position)
        assert record is not None
        yield record


def summary(file: BinaryIO, size: int) -> Iterator[Schema | Channel]:
    """Yield the schemas and channels in the summary of an MCAP file; none if it is damaged or missing."""
    try:
        for head in mcap_file.heads(file, size, mcap_file.summary_start(file, size)):
            if head.opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                for record in records_of(file, head):
                    if not isinstance(record, Entry):
                        yield record
    except DamagedError:
        return


class Channels:
    """The channels and schemas of an MCAP file, as far as it was read."""

    def __init__(self) -> None:
        self.missed: list[Head] = []  # chunks that were passed over unread
        self._channels: dict[int, Channel] = {}
        self._schemas = {0: Schema(0, b"", "", "")}  # 0: a channel without schema, e.g. JSON

    def add(self, record: Schema | Channel) -> None:
        if isinstance(record, Schema):
            self._schemas[record.id] = record
        else:
            self._channels[record.id] = record

    def read_missed(self, file: BinaryIO) -> None:
        for head in self.missed:
            for record in records_of(file, head):
                if not isinstance(record, Entry):
                    self.add(record)
        self.missed.clear()

    def describe(self, channel_id: int) -> bool:
        """Tell whether a channel and its schema are known. A schema is written only once, before the first
        of its channels."""
        channel = self._channels.get(channel_id)
        return channel is not None and channel.schema_id in self._schemas

    def of(self, entry: Entry, position: int) -> tuple[Channel, Schema]:
        """Return the channel and the schema of a message.

        Raises:
            DamagedError: the file does not describe them.
        """
        channel = self._channels.get(entry.channel_id)
        schema = None if channel is None else self._schemas.get(channel.schema_id)
        if channel is None or schema is None:
            raise DamagedError(position, f"a message of channel {entry.channel_id}, which nothing describes")
        return channel, schema


# ---- db3 and ROS 1 ---------------------------------------------------------------------------------------


def _read_with_rosbags(
    file: Path, topics: Collection[str] | None, start_ns: int, wanted: Wanted | None
) -> Iterator[BagMessage]:
    from rosbags import rosbag1, rosbag2

    ros1, log = file.suffix == ".bag", Path(f"{file}-wal")
    if log.is_file() and log.stat().st_size:  # `rosbags` would pass over it
        raise SagsError(
            f"{log} holds messages that {file.name} lacks: its recorder was killed or still runs; "
            f'then: sqlite3 {shlex.quote(str(file))} "PRAGMA wal_checkpoint(TRUNCATE)"'
        )
    seen = file.stat()
    positions = rosbag1_check.chunk_positions(file, seen.st_size, seen.st_mtime_ns) if ros1 else frozenset()
    reader: Any = rosbag1.Reader(file) if ros1 else rosbag2.Reader(file)
    with _damage_as_one_error(), reader:
        if ros1 and not {info.pos for info in reader.chunk_infos} <= positions:
            raise DamagedError(0, "its index points to places where no chunk is")
        read = [c for c in reader.connections if topics is None or c.topic in topics]
        if not read:
            return
        for connection, log_ns, raw in reader.messages(connections=read, start=start_ns):
            if len(raw) > MAX_RECORD_BYTES:
                raise DamagedError(0, f"a message of {len(raw)} bytes on {connection.topic}")
            turned = ros1 and (wanted is None or wanted(connection.topic, connection.msgtype))
            data, kind = cdr.from_ros1(raw, connection.msgtype) if turned else raw, connection.msgtype
            if ros1 and kind in cdr.OTHER_IN_ROS1:
                kind = kind.replace("/msg/", "/")  # the ROS 1 name: in ROS 2 this type has other fields
            yield BagMessage(connection.topic, kind, log_ns, log_ns, 0, data)


@contextmanager
def _damage_as_one_error() -> Iterator[None]:
    """Turn any exception of `rosbags` into a `DamagedError`: damaged bytes make it raise many kinds."""
    try:
        yield
    except (SagsError, OSError):
        raise
    except (Exception, MemoryError) as error:
        said = " ".join(str(error).split())[:200]
        raise DamagedError(0, said or type(error).__name__) from None


def _unpacked(message: BagMessage) -> BagMessage:
    """The message, decompressed."""
    data = mcap_file.unpack(message.data, b"zstd", MAX_RECORD_BYTES, 0)
    if len(data) > MAX_RECORD_BYTES:
        raise DamagedError(0, f"a message on {message.topic} unpacks to more than 256 MB")
    return replace(message, data=data)
