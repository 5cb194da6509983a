"""What a bag holds: topics, types, counts, rates, and what is missing from them."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from sags_node.bags.bag import read_messages, storage_files


@dataclass(slots=True)
class _Seen:
    bytes: int = 0
    times_ns: list[int] = field(default_factory=list)
    sequences: list[int] = field(default_factory=list)


def bag_info(path: Path) -> dict[str, Any]:
    """Read a bag through and count; this also checks every checksum.

    Per topic: `messages`, `bytes`, `rate_hz` (None for fewer than two), `lost` (gaps in the sequence numbers;
    None where the file has none) and `longest_gap_s` between two messages.

    Raises:
        UsageError: there is no bag.
        SagsError: it is damaged.
    """
    seen: dict[tuple[str, str], _Seen] = {}
    for message in read_messages(path, wanted=lambda topic, kind: False):  # they are counted
        topic = seen.setdefault((message.topic, message.type), _Seen())
        topic.bytes += len(message.data)
        topic.times_ns.append(message.log_ns)
        topic.sequences.append(message.sequence)
    times = [time for topic in seen.values() for time in (min(topic.times_ns), max(topic.times_ns))]
    rows = [_row(name, kind, topic) for (name, kind), topic in sorted(seen.items())]
    files = storage_files(path)[0]
    return {
        "path": str(path),
        "files": [file.name for file in files],
        "size": sum(file.stat().st_size for file in files),
        "start_ns": min(times, default=0),
        "duration_s": round((max(times, default=0) - min(times, default=0)) * 1e-9, 3),
        "messages": sum(row["messages"] for row in rows),
        "topics": rows,
    }


def _row(name: str, kind: str, topic: _Seen) -> dict[str, Any]:
    steps = np.diff(np.sort(np.array(topic.times_ns, np.int64))) * 1e-9
    span = float(steps.sum())
    return {
        "topic": name,
        "type": kind,
        "messages": len(topic.times_ns),
        "bytes": topic.bytes,
        "rate_hz": round(len(steps) / span, 2) if span > 0 else None,
        "lost": _lost(np.array(topic.sequences, np.int64)),
        "longest_gap_s": round(float(steps.max()), 3) if len(steps) else None,
    }


def _lost(sequences: np.ndarray[Any, np.dtype[np.int64]]) -> int | None:
    """How many numbers are missing; None: there are none. Where they fall, the sender was started anew."""
    if not sequences.any():
        return None
    steps = np.diff(sequences)
    return int((steps[steps > 0] - 1).sum())
