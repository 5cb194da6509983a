"""Writes a rosbag2 folder: MCAP files of profile `ros2`, and at the end `metadata.yaml`.

A message is in the file at the latest after the next `flush`: the file of a process that is killed can be
recovered up to there.
"""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Self, TypeVar

import yaml
from mcap.records import Schema
from mcap.writer import CompressionType, Writer

from sags_node import __version__
from sags_node.bags.bag import METADATA
from sags_node.errors import UsageError
from sags_node.files import writing

CHUNK_BYTES = 1 << 20  # what is lost at most when the process is killed between two flushes
MESSAGE_HEAD_BYTES = 31  # of an MCAP message record
_NEVER = {"sec": 9223372036, "nsec": 854775807}  # an infinite duration of ROS 2

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Limits:
    """Where a file of the bag ends and the next one begins; 0: never.

    Attributes:
        bytes: of messages in one file; its index comes on top. A larger message has its own file.
        seconds: between the first and the last message of one file.
    """

    bytes: int = 0
    seconds: float = 0.0


NO_LIMITS = Limits()


@dataclass(frozen=True, slots=True)
class _Topic:
    name: str
    type: str  # ROS 2 name
    type_hash: str
    latched: bool  # late subscribers get the last message too
    encoding: str


@dataclass(slots=True)
class _Part:
    """What one file of a bag holds."""

    file: str  # name
    counts: Counter[int] = field(default_factory=Counter)  # messages of each topic, by its number
    first_ns: int = 2**63 - 1
    last_ns: int = 0

    def add(self, topic: int, log_ns: int) -> None:
        self.counts[topic] += 1
        self.first_ns, self.last_ns = min(self.first_ns, log_ns), max(self.last_ns, log_ns)


class BagWriter:
    """A bag that is being written: `<folder>_0.mcap` and so on, each of which can be read alone.

    Raises:
        UsageError: something is at `folder` already.
        SagsError: it cannot be written.
    """

    def __init__(self, folder: Path, limits: Limits = NO_LIMITS) -> None:
        self.folder = folder
        self.bytes = 0  # of messages
        self._limits = limits
        self._topics: dict[int, _Topic] = {}  # by channel, the same number in every file
        self._beginning: list[Callable[[Writer], object]] = []  # writes what every file begins with
        self._notes: dict[str, dict[str, str]] = {}
        self._schemas: dict[tuple[str, str, bytes], int] = {}
        self._parts: list[_Part] = []
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise UsageError(f"{folder} exists already; name a new folder")
        self._is_new = not folder.exists()
        with writing(folder):
            folder.mkdir(parents=True, exist_ok=True)
            self._begin_file()

    def add_topic(
        self,
        name: str,
        kind: str,
        schema: Schema,
        type_hash: str = "",
        latched: bool = False,
        marks: Mapping[str, str] | None = None,
        encoding: str = "cdr",
    ) -> int:
        """Announce a topic; return its number for `write`.

        Args:
            kind: ROS 2 name of the type.
            schema: its definition; the number in it is not used.
            latched: late subscribers get the last message too (durability transient_local).
            marks: more metadata of its channel, see `bag.marks_of`.
            encoding: of its messages.
        """
        key = (schema.name, schema.encoding, schema.data)
        if key not in self._schemas:
            self._schemas[key] = self._say_first(lambda writer: writer.register_schema(*key))
        metadata = {
            "offered_qos_profiles": yaml.safe_dump(_quality(latched), sort_keys=False),
            "topic_type_hash": type_hash,
            **(marks or {}),
        }
        schema_id = self._schemas[key]
        channel: int = self._say_first(
            lambda writer: writer.register_channel(name, encoding, schema_id, metadata)
        )
        self._topics[channel] = _Topic(name, kind, type_hash, latched, encoding)
        return channel

    def write(
        self, channel: int, log_ns: int, publish_ns: int, sequence: int, data: bytes | memoryview
    ) -> None:
        """Write one message, into the next file if this one is full.

        Raises:
            OSError: the disk is full.
        """
        if self._is_full(log_ns, len(data)):
            self._end_file()
            self._begin_file()
        self._writer.add_message(channel, log_ns, data, publish_ns, sequence & 0xFFFFFFFF)
        self._parts[-1].add(channel, log_ns)
        self._file_bytes += MESSAGE_HEAD_BYTES + len(data)
        self.bytes += len(data)

    def attach(self, name: str, media_type: str, data: bytes, log_ns: int) -> None:
        """Put a file into the bag."""
        self._say_first(lambda writer: writer.add_attachment(log_ns, log_ns, name, media_type, data))

    def note(self, name: str, values: dict[str, str]) -> None:
        """Put key-value metadata into the bag: it holds for the messages that follow, until the next one."""
        self._notes[name] = values
        self._writer.flush()  # else it would stand before messages that were written before it
        self._writer.add_metadata(name, values)

    def flush(self) -> None:
        """Hand everything over to the operating system."""
        self._writer.flush()

    @property
    def messages(self) -> int:
        return sum(part.counts.total() for part in self._parts)

    def close(self) -> None:
        """Finish the file and describe the bag.

        Raises:
            OSError: the disk is full.
        """
        self._end_file()
        text = yaml.safe_dump(
            {"rosbag2_bagfile_information": _described(self._parts, self._topics)}, sort_keys=False
        )
        metadata = self.folder / METADATA
        try:
            metadata.write_text(text, encoding="utf-8")
        except OSError:
            metadata.unlink(missing_ok=True)  # half of it would hide a bag that is whole
            raise

    def discard(self) -> None:
        """Remove what was written, and the folder if it was made for it."""
        self._file.close()
        for name in (*(part.file for part in self._parts), METADATA):
            (self.folder / name).unlink(missing_ok=True)
        if self._is_new:
            self.folder.rmdir()

    # ---- its files -------------------------------------------------------------------------------------

    def _say_first(self, say: Callable[[Writer], T]) -> T:
        """Write it into this file, and at the beginning of later ones."""
        if self._limits != NO_LIMITS:
            self._beginning.append(say)
        return say(self._writer)  # numbers are given in order: they are the same in every file

    def _is_full(self, log_ns: int, size: int) -> bool:
        part, limits = self._parts[-1], self._limits
        if not part.counts:
            return False
        too_large = 0 < limits.bytes < self._file_bytes + MESSAGE_HEAD_BYTES + size
        too_long = 0 < limits.seconds < (log_ns - part.first_ns) * 1e-9
        return too_large or too_long

    def _begin_file(self) -> None:
        self._parts.append(_Part(f"{self.folder.resolve().name}_{len(self._parts)}.mcap"))
        self._file = (self.folder / self._parts[-1].file).open("xb")
        self._file_bytes = 0
        # Chunks are small and not compressed: images hardly shrink, and time is short.
        self._writer = Writer(self._file, chunk_size=CHUNK_BYTES, compression=CompressionType.NONE)
        self._writer.start(profile="ros2", library=f"sags-node {__version__}")
        for say in self._beginning:
            say(self._writer)
        for name, values in self._notes.items():
            self._writer.add_metadata(name, values)

    def _end_file(self) -> None:
        description = _described(self._parts[-1:], self._topics)
        serialized = yaml.safe_dump(description, sort_keys=False)
        self._writer.add_metadata("rosbag2", {"serialized_metadata": serialized})
        self._writer.finish()
        self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *error: object) -> None:
        if kind is None:
            self.close()
        else:
            self._file.close()  # what has been written stays, for `recover`


def _described(parts: Sequence[_Part], topics: Mapping[int, _Topic]) -> dict[str, Any]:
    """The content of `rosbag2_bagfile_information` in `metadata.yaml` (version 9), see `rosbag2_storage`.

    Args:
        topics: by number.
    """
    counts = sum((part.counts for part in parts), Counter[int]())
    return {
        "version": 9,
        "storage_identifier": "mcap",
        "relative_file_paths": [part.file for part in parts],
        **_span(parts),
        "topics_with_message_count": [
            {
                "topic_metadata": {
                    "name": topic.name,
                    "type": topic.type,
                    "serialization_format": topic.encoding,
                    "offered_qos_profiles": _quality(topic.latched),
                    "type_description_hash": topic.type_hash,
                },
                "message_count": counts[number],
            }
            for number, topic in topics.items()
        ],
        "compression_format": "",
        "compression_mode": "",
        "files": [{"path": part.file, **_span([part])} for part in parts],
        "custom_data": None,
        "ros_distro": "jazzy",
    }


def _span(parts: Sequence[_Part]) -> dict[str, Any]:
    messages = sum(part.counts.total() for part in parts)
    first, last = min(part.first_ns for part in parts), max(part.last_ns for part in parts)
    return {
        "starting_time": {"nanoseconds_since_epoch": first if messages else 0},
        "duration": {"nanoseconds": max(0, last - first)},
        "message_count": messages,
    }


def _quality(latched: bool) -> list[dict[str, Any]]:
    """The quality of service of a publisher, as rosbag2 writes it down; a new object each time: YAML would
    else write references."""
    return [
        {
            "history": "keep_last",
            "depth": 1 if latched else 5,
            "reliability": "reliable" if latched else "best_effort",
            "durability": "transient_local" if latched else "volatile",
            "deadline": dict(_NEVER),
            "lifespan": dict(_NEVER),
            "liveliness": "automatic",
            "liveliness_lease_duration": dict(_NEVER),
            "avoid_ros_namespace_conventions": False,
        }
    ]
