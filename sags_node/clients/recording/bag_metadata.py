"""What `metadata.yaml` says of a rosbag2 folder (version 9), as `rosbag2_storage` defines it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

_NEVER = {"sec": 9223372036, "nsec": 854775807}


@dataclass(frozen=True, slots=True)
class Topic:
    name: str
    type: str  # ROS 2 name
    type_hash: str
    latched: bool  # late subscribers get the last message too


@dataclass(slots=True)
class Part:
    """What one file of a bag holds."""

    file: str  # name
    counts: Counter[int] = field(default_factory=Counter)  # messages of each topic, by its number
    first_ns: int = 2**63 - 1
    last_ns: int = 0

    def add(self, topic: int, log_ns: int) -> None:
        self.counts[topic] += 1
        self.first_ns, self.last_ns = min(self.first_ns, log_ns), max(self.last_ns, log_ns)


def describe(parts: Sequence[Part], topics: Mapping[int, Topic]) -> dict[str, Any]:
    """The content of `rosbag2_bagfile_information`.

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
                    "serialization_format": "cdr",
                    "offered_qos_profiles": quality(topic.latched),
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


def _span(parts: Sequence[Part]) -> dict[str, Any]:
    messages = sum(part.counts.total() for part in parts)
    first, last = min(part.first_ns for part in parts), max(part.last_ns for part in parts)
    return {
        "starting_time": {"nanoseconds_since_epoch": first if messages else 0},
        "duration": {"nanoseconds": max(0, last - first)},
        "message_count": messages,
    }


def quality(latched: bool) -> list[dict[str, Any]]:
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
