"""Writes a rosbag2 folder: one MCAP file of profile `ros2`, and at the end `metadata.yaml` (version 9).

A message is in the file at the latest after the next `flush`: the file of a process that is killed can be
recovered up to there.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import yaml
from mcap.records import Schema
from mcap.writer import CompressionType, Writer

from sags_node import __version__
from sags_node.errors import SagsError, UsageError
from sags_node.recording.bag import METADATA

CHUNK_BYTES = 1 << 20  # what is lost at most when the process is killed between two flushes
_NEVER = {"sec": 9223372036, "nsec": 854775807}


@dataclass(slots=True)
class _Topic:
    name: str
    type: str
    type_hash: str
    latched: bool
    count: int = 0


class BagWriter:
    """A bag that is being written.

    Raises:
        UsageError: something is at `folder` already.
        SagsError: it cannot be written.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.bytes = 0  # of messages
        self._topics: dict[int, _Topic] = {}
        self._schemas: dict[tuple[str, str, bytes], int] = {}
        self._first_ns, self._last_ns = 2**63 - 1, 0
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise UsageError(f"{folder} exists already; name a new folder")
        try:
            folder.mkdir(parents=True, exist_ok=True)
            self._file = (folder / f"{folder.resolve().name}_0.mcap").open("xb")
        except OSError as error:
            raise SagsError(f"cannot write {folder}: {error.strerror}; name another place") from None
        # Chunks are small and not compressed: pictures hardly shrink, and time is short.
        self._writer = Writer(self._file, chunk_size=CHUNK_BYTES, compression=CompressionType.NONE)
        self._writer.start(profile="ros2", library=f"sags-node {__version__}")

    def add_topic(
        self, name: str, kind: str, schema: Schema, type_hash: str = "", latched: bool = False
    ) -> int:
        """Announce a topic; its number for `write`.

        Args:
            kind: ROS 2 name of the type.
            schema: its definition; the number in it is not used.
            latched: late subscribers get the last message too (durability transient_local).
        """
        key = (schema.name, schema.encoding, schema.data)
        if key not in self._schemas:
            self._schemas[key] = self._writer.register_schema(*key)
        quality = yaml.safe_dump(_quality(latched), sort_keys=False)
        metadata = {"offered_qos_profiles": quality, "topic_type_hash": type_hash}
        channel: int = self._writer.register_channel(name, "cdr", self._schemas[key], metadata)
        self._topics[channel] = _Topic(name, kind, type_hash, latched)
        return channel

    def write(
        self, channel: int, log_ns: int, publish_ns: int, sequence: int, data: bytes | memoryview
    ) -> None:
        self._writer.add_message(channel, log_ns, data, publish_ns, sequence & 0xFFFFFFFF)
        self._topics[channel].count += 1
        self.bytes += len(data)
        self._first_ns, self._last_ns = min(self._first_ns, log_ns), max(self._last_ns, log_ns)

    def attach(self, name: str, media_type: str, data: bytes, log_ns: int) -> None:
        """Put a file into the bag."""
        self._writer.add_attachment(log_ns, log_ns, name, media_type, data)

    def note(self, name: str, values: dict[str, str]) -> None:
        """Put key-value metadata into the bag."""
        self._writer.add_metadata(name, values)

    def flush(self) -> None:
        """Hand everything over to the operating system."""
        self._writer.flush()

    @property
    def messages(self) -> int:
        return sum(topic.count for topic in self._topics.values())

    def close(self) -> None:
        """Finish the file and describe the bag."""
        information = self._information()
        self.note("rosbag2", {"serialized_metadata": yaml.safe_dump(information, sort_keys=False)})
        self._writer.finish()
        self._file.close()
        text = yaml.safe_dump({"rosbag2_bagfile_information": information}, sort_keys=False)
        (self.folder / METADATA).write_text(text, encoding="utf-8")

    def _information(self) -> dict[str, Any]:
        """The content of `metadata.yaml`, as `rosbag2_storage` defines it."""
        span: dict[str, Any] = {
            "starting_time": {"nanoseconds_since_epoch": self._first_ns if self.messages else 0},
            "duration": {"nanoseconds": max(0, self._last_ns - self._first_ns)},
            "message_count": self.messages,
        }
        name = Path(self._file.name).name
        topics = [
            {
                "topic_metadata": {
                    "name": topic.name,
                    "type": topic.type,
                    "serialization_format": "cdr",
                    "offered_qos_profiles": _quality(topic.latched),
                    "type_description_hash": topic.type_hash,
                },
                "message_count": topic.count,
            }
            for topic in self._topics.values()
        ]
        return {
            "version": 9,
            "storage_identifier": "mcap",
            "relative_file_paths": [name],
            **span,
            "topics_with_message_count": topics,
            "compression_format": "",
            "compression_mode": "",
            "files": [{"path": name, **span}],
            "custom_data": None,
            "ros_distro": "jazzy",
        }

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is None:
            self.close()
        else:
            self._file.close()  # what has been written stays, for `recover`


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
