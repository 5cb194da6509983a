"""What a node publishes, for `sags topic`, in the terms of `ros2 topic`.

Each function gives plain dictionaries that JSON can hold.
"""

import dataclasses
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from sags_node.errors import SagsError
from sags_node.messaging import topics
from sags_node.messaging.address import THE_NODE, NodeAddress
from sags_node.messaging.freezes import freezes_of
from sags_node.messaging.node_clock import NodeClock
from sags_node.messaging.received import (
    Received,
    ReceivedCameraInfo,
    ReceivedCloud,
    ReceivedCompressed,
    ReceivedImage,
    ReceivedRos,
    ReceivedText,
    interpret,
)
from sags_node.messaging.stream import check_topic, listen_to

Record = dict[str, Any]

STATUS_WAIT = 1.5  # s for a `status`, which comes every second
PATIENCE = 5.0  # s that `topic_echo` waits for the first message


@dataclasses.dataclass(frozen=True, slots=True)
class _Sample:
    arrival_ns: int
    stamp_ns: int
    size: int  # bytes


def topic_list(node: NodeAddress = THE_NODE, seconds: float = 3.0) -> list[Record]:
    """List all topics that a node (or an overlay) may publish, and others heard within `seconds`.

    `messages` and `mean_bytes` are 0 where nothing came; `rate_hz` is None where too little came to tell.

    Raises:
        SagsError: no node is known, or nothing at all came.
    """
    heard = _heard([], node, seconds)
    if not heard:
        raise _silence("*", node, seconds)
    rows = []
    for topic in _listed({full.removeprefix(f"{node.ns}/") for full in heard}):
        full = topics.full_name(node.ns, topic.name)
        samples = heard.get(full, [])
        mean_size = sum(sample.size for sample in samples) / len(samples) if samples else 0.0
        steps = np.diff([sample.arrival_ns for sample in _without_resent(topic.name, samples)]) * 1e-9
        row: Record = {"topic": full, "type": topic.type, "messages": len(samples)}
        row["rate_hz"] = round(float(1 / steps.mean()), 1) if len(steps) else None
        rows.append({**row, "mean_bytes": round(mean_size)})
    return rows


def _listed(heard: set[str]) -> list[topics.Topic]:
    """Return the topics that the sender of `heard` may send. It is an overlay if all of them are an
    overlay's."""
    of_overlay = heard <= {topic.name for topic in topics.OVERLAY_TOPICS}
    listed = {topic.name: topic for topic in (topics.OVERLAY_TOPICS if of_overlay else topics.TOPICS)}
    for name in sorted(heard - set(listed)):  # views and a clock; unknown topics are left out
        if (topic := topics.find(name)) is not None:
            listed[name] = topic
    return list(listed.values())


def topic_echo(
    names: str | Sequence[str],
    node: NodeAddress = THE_NODE,
    seconds: float | None = None,
    count: int | None = None,
    warned: Callable[[Mapping[str, str]], object] = lambda warnings: None,
    silent: Callable[[str], object] = lambda why: None,
) -> Iterator[Record]:
    """Yield each message of one or more topics: its stamps, and its content (arrays as their range).

    Args:
        warned: called with the warnings (code -> text) of each `status` of the sender.
        silent: called with the reason when the sender says that it stops sending frames.

    Raises:
        UsageError: there is no such topic.
        SagsError: no node is known, or nothing came within `seconds` or `PATIENCE`.
    """
    asked = [names] if isinstance(names, str) else names
    shown, quiet = 0, None
    began = time.monotonic()
    status = topics.full_name(node.ns, "status")
    for arrived in listen_to(node, [*asked, "status"], seconds):
        received = None if arrived is None else interpret(*arrived)
        if received is not None and received.topic == status:
            assert isinstance(received, ReceivedText)
            warned(received.warnings())
            before, quiet = quiet, received.why_silent()
            if quiet is not None and before is None:
                silent(quiet)
            if "status" not in (topics.plain_name(node.ns, name) for name in asked):
                received = None
        if received is None:
            if not shown and time.monotonic() - began > PATIENCE:
                raise _silence(asked[0], node, PATIENCE)
            continue
        yield _echo(received)
        shown += 1
        if shown == count:
            return
    if not shown and seconds is not None:
        raise _silence(asked[0], node, seconds)


def topic_info(name: str, node: NodeAddress = THE_NODE, seconds: float = 1.0) -> Record:
    """Return the definition of a topic, and what was heard of it within `seconds`.

    Raises:
        UsageError: there is no such topic.
        SagsError: no node is known.
    """
    topic = check_topic(topics.plain_name(node.ns, name))
    heard = [arrived[0].meta.session for arrived in listen_to(node, [topic.name], seconds) if arrived]
    said = {"topic": topics.full_name(node.ns, topic.name), "type": topic.type, "content": topic.content}
    return said | {"publishers": len(set(heard)), "messages": len(heard), "kept_for_newcomers": topic.cached}


def topic_figures(
    kind: Literal["hz", "bw", "delay"], topic: str, node: NodeAddress = THE_NODE, seconds: float = 5.0
) -> Record:
    """Measure what comes on a topic in `seconds`.

    Args:
        kind: hz: rate, spread of the intervals, freezes. bw: bytes per second, and the mean, smallest and
            largest message. delay: how long after capture messages arrived, by the node's clock.
        node: without `control`, its clock is taken to be this machine's.

    Raises:
        UsageError: there is no such topic.
        SagsError: no node is known, fewer than two messages came, or the node's clock is not known.
    """
    offset = None
    if kind == "delay" and node.control is not None:
        with NodeClock.at(node) as clock:
            samples = _listen_to(topic, node, seconds)
            offset, problem = clock.offset, clock.problem
        if offset is None:
            raise SagsError(f"{node.control}: {problem}")
    else:
        samples = _listen_to(topic, node, seconds)
    window = {"window": len(samples)}
    if kind == "bw":
        sizes = np.array([sample.size for sample in samples])
        span = (samples[-1].arrival_ns - samples[0].arrival_ns) * 1e-9
        return {
            "bytes_per_s": float(sizes[1:].sum() / span),  # the first message only starts the clock
            "mean_bytes": float(sizes.mean()),
            "min_bytes": int(sizes.min()),
            "max_bytes": int(sizes.max()),
            **window,
        }
    if kind == "hz":
        moments = [*(sample.arrival_ns for sample in samples), time.time_ns()]
        *arrivals, now = ((moment - moments[0]) * 1e-9 for moment in moments)
        steps, freezes = np.diff(arrivals), freezes_of([*arrivals, now])  # one may last until now
        still = freezes.count > freezes_of(arrivals).count
        frozen: Record = {"freezes": freezes.count, "frozen_s": freezes.seconds}
        frozen |= {"silent": _why_silent(node) or "nothing comes any more"} if still else {}
        return {"average_rate": float(1 / steps.mean()), **_spread(steps), **frozen, **window}
    ahead, bound = (None, None) if offset is None else (offset.seconds, offset.bound)
    delays = np.array([sample.arrival_ns - sample.stamp_ns for sample in samples]) * 1e-9 + (ahead or 0.0)
    clock_said = {"clock_offset_s": ahead, "clock_bound_s": bound}
    return {**clock_said, "average_delay_s": float(delays.mean()), **_spread(delays), **window}


def _spread(values: NDArray[np.float64]) -> Record:
    """The spread of intervals or delays, s."""
    return {"min_s": float(values.min()), "max_s": float(values.max()), "std_dev_s": float(values.std())}


def _listen_to(topic: str, node: NodeAddress, seconds: float) -> list[_Sample]:
    """At least two messages of one topic."""
    heard = _heard([topic], node, seconds)
    if not heard:
        raise _silence(topic, node, seconds)
    ((full, samples),) = heard.items()
    fresh = _without_resent(full.removeprefix(f"{node.ns}/"), samples)
    if len(fresh) < 2:
        raise SagsError(
            f"too few messages came on {full} in {seconds:g} s to measure; set --seconds to listen longer"
        )
    return fresh


def _heard(names: Sequence[str], node: NodeAddress, seconds: float) -> dict[str, list[_Sample]]:
    """Return what came on some topics, each message once: a last value may be sent again for another peer."""
    heard: dict[str, dict[tuple[str, int], _Sample]] = defaultdict(dict)
    for arrived in listen_to(node, names, seconds):
        if arrived is not None:
            message, arrival_ns = arrived
            key = (message.meta.session, message.meta.seq)
            size = sum(memoryview(part).nbytes for part in message.parts)
            sample = _Sample(arrival_ns, message.meta.stamp_ns, size)
            heard[message.topic].setdefault(key, sample)
    return {topic: list(samples.values()) for topic, samples in heard.items()}


def _without_resent(name: str, samples: list[_Sample]) -> list[_Sample]:
    """Leave out the value that a cached topic sends to each new subscriber: it says nothing of the rate."""
    topic = topics.find(name)
    return samples[1:] if topic is not None and topic.cached else samples


def _silence(topic: str, node: NodeAddress, seconds: float) -> SagsError:
    full = topics.full_name(node.ns, topics.plain_name(node.ns, topic))
    hint = _why_silent(node) or "is the node running and not waiting?"
    if "/right/" in full:
        hint += f" ({topics.NO_RIGHT_EYE})"
    where = node.data().endpoint
    return SagsError(f"no messages on {full} from {where} in {seconds:g} s; {hint}")


def _why_silent(node: NodeAddress) -> str | None:
    """Why a sender sends no frames, as it says itself; None: it says nothing."""
    for arrived in listen_to(node, ["status"], STATUS_WAIT):
        status = None if arrived is None else interpret(*arrived)
        if isinstance(status, ReceivedText):
            return status.why_silent()
    return None


def _echo(received: Received) -> Record:
    meta: Record = msgspec.to_builtins(received.meta)
    kept = ("type", "seq", "frame_id", "stamp_ns", "epoch", "step", "dropped")
    where_present = ("ahead_ns", "detail_age_ns", "recorded_s", "units")  # else: seen by a camera, in m
    return {
        "topic": received.topic,
        **{key: meta[key] for key in (*kept, *where_present) if key in meta},
        "delay_s": received.age(received.received_ns),
        "content": _content(received),
    }


def _content(received: Received) -> Any:
    if isinstance(received, ReceivedImage | ReceivedCompressed):
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
    return dataclasses.asdict(received.message, dict_factory=_fields)


def _fields(pairs: list[tuple[str, Any]]) -> Record:
    """The fields of a ROS message, which are in lower case, without its type and constants."""
    return {key: value for key, value in pairs if key[0].islower()}


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
