"""`sags topic list | echo | hz | bw | delay`: look at what a node publishes, in the words of `ros2 topic`.

Each function gives plain dictionaries that JSON can hold.
"""

from __future__ import annotations

import dataclasses
from collections import defaultdict
from collections.abc import Iterator
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from sags_node.errors import SagsError
from sags_node.messaging import topics, wire
from sags_node.messaging.received import (
    Received,
    ReceivedCameraInfo,
    ReceivedCloud,
    ReceivedImage,
    ReceivedRos,
    ReceivedText,
    interpret,
)
from sags_node.messaging.stream import data_endpoint, listen

Record = dict[str, Any]


@dataclasses.dataclass(frozen=True, slots=True)
class _Sample:
    arrival_ns: int
    stamp_ns: int
    size: int  # bytes


def topic_list(endpoint: str | None = None, ns: str = "sags", seconds: float = 2.0) -> list[Record]:
    """Every topic of the contract with the rate and the size heard in `seconds`; 0 where nothing came.

    Raises:
        SagsError: no node is known, or nothing at all came.
    """
    heard: dict[str, list[int]] = defaultdict(list)
    for arrived in listen([], endpoint, ns, seconds):
        if arrived is not None:
            heard[arrived[0].topic].append(_size(arrived[0]))
    if not heard:
        raise _silence(f"{ns}/*", endpoint, ns, seconds)
    rows = []
    for topic in topics.TOPICS:
        full = topics.full_name(ns, topic.name)
        sizes = heard[full]
        mean_size = sum(sizes) / len(sizes) if sizes else 0.0
        row: Record = {"topic": full, "type": topic.type, "messages": len(sizes)}
        rows.append({**row, "rate_hz": round(len(sizes) / seconds, 1), "mean_bytes": round(mean_size)})
    return rows


def topic_echo(
    topic: str,
    endpoint: str | None = None,
    ns: str = "sags",
    seconds: float | None = None,
    count: int | None = None,
) -> Iterator[Record]:
    """Each message of a topic: who, when, and its content (arrays as their range).

    Raises:
        UsageError: there is no such topic.
        SagsError: no node is known, or nothing came within `seconds`.
    """
    shown = 0
    for arrived in listen([topic], endpoint, ns, seconds):
        if arrived is None:
            continue
        message, arrival_ns = arrived
        yield _echo(interpret(message, arrival_ns))
        shown += 1
        if shown == count:
            return
    if not shown:
        raise _silence(topics.full_name(ns, topic), endpoint, ns, seconds)


def topic_hz(topic: str, endpoint: str | None = None, ns: str = "sags", seconds: float = 5.0) -> Record:
    """Average rate over `seconds`, and the shortest, longest and standard deviation of the intervals.

    Raises:
        UsageError: there is no such topic.
        SagsError: no node is known, or fewer than two messages came.
    """
    samples = _listen_to(topic, endpoint, ns, seconds)
    steps = np.diff([sample.arrival_ns for sample in samples]) * 1e-9
    return {
        "average_rate": float(1 / steps.mean()),
        "min_s": float(steps.min()),
        "max_s": float(steps.max()),
        "std_dev_s": float(steps.std()),
        "window": len(samples),
    }


def topic_bw(topic: str, endpoint: str | None = None, ns: str = "sags", seconds: float = 5.0) -> Record:
    """Bytes per second over `seconds`, and the mean, smallest and largest message.

    Raises:
        UsageError: there is no such topic.
        SagsError: no node is known, or fewer than two messages came.
    """
    samples = _listen_to(topic, endpoint, ns, seconds)
    sizes = np.array([sample.size for sample in samples])
    span = (samples[-1].arrival_ns - samples[0].arrival_ns) * 1e-9
    return {
        "bytes_per_s": float(sizes[1:].sum() / span),  # the first message only starts the clock
        "mean_bytes": float(sizes.mean()),
        "min_bytes": int(sizes.min()),
        "max_bytes": int(sizes.max()),
        "window": len(samples),
    }


def topic_delay(topic: str, endpoint: str | None = None, ns: str = "sags", seconds: float = 5.0) -> Record:
    """How long after their frame's capture the messages of `seconds` arrived.

    Raises:
        UsageError: there is no such topic.
        SagsError: no node is known, or fewer than two messages came.
    """
    samples = _listen_to(topic, endpoint, ns, seconds)
    delays = np.array([sample.arrival_ns - sample.stamp_ns for sample in samples]) * 1e-9
    return {
        "average_delay_s": float(delays.mean()),
        "min_s": float(delays.min()),
        "max_s": float(delays.max()),
        "std_dev_s": float(delays.std()),
        "window": len(samples),
    }


def _listen_to(topic: str, endpoint: str | None, ns: str, seconds: float) -> list[_Sample]:
    """What came on one topic, each message once: a last value may be sent again for another peer."""
    samples: dict[tuple[str, int], _Sample] = {}
    for arrived in listen([topic], endpoint, ns, seconds):
        if arrived is not None:
            message, arrival_ns = arrived
            key = (message.meta.session, message.meta.seq)
            samples.setdefault(key, _Sample(arrival_ns, message.meta.stamp_ns, _size(message)))
    if len(samples) < 2:
        raise _silence(topics.full_name(ns, topic), endpoint, ns, seconds)
    return list(samples.values())


def _size(message: wire.Message) -> int:
    return sum(memoryview(part).nbytes for part in message.parts)


def _silence(full: str, endpoint: str | None, ns: str, seconds: float | None) -> SagsError:
    where = data_endpoint(endpoint, ns)
    during = "" if seconds is None else f" in {seconds:g} s"
    return SagsError(f"no messages on {full} from {where}{during}; is the node running and not waiting?")


def _echo(received: Received) -> Record:
    meta: Record = msgspec.to_builtins(received.meta)
    kept = ("type", "seq", "frame_id", "stamp_ns", "epoch", "step", "dropped")
    return {
        "topic": received.topic,
        **{key: meta[key] for key in kept},
        "delay_s": received.age(received.received_ns),
        "content": _content(received),
    }


def _content(received: Received) -> Any:
    if isinstance(received, ReceivedImage):
        shape = list(received.array.shape)
        return {"encoding": received.meta.encoding, "shape": shape, **_range(received.array)}
    if isinstance(received, ReceivedCloud):
        fields = received.points.dtype.names or ()
        return {"points": len(received.points), **{name: _range(received.points[name]) for name in fields}}
    if isinstance(received, ReceivedCameraInfo):
        size = {"width": received.width, "height": received.height}
        return {**size, "K": received.K.tolist(), "P": received.P.tolist()}
    if isinstance(received, ReceivedText):
        try:
            return msgspec.json.decode(received.text)
        except (msgspec.MsgspecError, RecursionError):
            return received.text
    assert isinstance(received, ReceivedRos)
    return dataclasses.asdict(received.message)


def _range(array: NDArray[Any]) -> Record:
    """Smallest, mean and largest known value and the share that is unknown (NaN)."""
    known = array[np.isfinite(array)]
    if known.size == 0:
        return {"unknown": 1.0}
    return {
        "min": float(known.min()),
        "mean": float(known.mean(dtype=np.float64)),
        "max": float(known.max()),
        "unknown": 1 - known.size / array.size,
    }
