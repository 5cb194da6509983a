"""What this process reads and writes in a ROS 2 graph: raw messages (CDR), which are not looked into.

ROS 2 is DDS with conventions: a topic `/a` is called `rt/a`, a type `pkg/msg/Name` is called
`pkg::msg::dds_::Name_`, and the type's hash stands in the user data. So no message is defined here.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from sags_node.errors import SagsError
from sags_node.messaging.cdr import type_hash

MOST_AT_ONCE = 16  # messages taken in one go
BLOCKED = 100_000_000  # ns, at most; a history that keeps the newest few is never full


@dataclass(frozen=True, slots=True)
class Delivery:
    """How messages of a topic reach their readers: ROS' quality of service.

    Attributes:
        reliable: what is lost on the way is sent again. Else best effort: only readers that ask for no more
            can read.
        kept: who comes later gets what was sent last ("transient local"); for reliable ones.
        depth: newest messages that wait: of a reader to be taken, of a reliable writer to be sent again.
        lifespan: s from the stamp of a message on, after which nobody gets it any more.
    """

    reliable: bool = False
    kept: bool = False
    depth: int = 4
    lifespan: float | None = None


BEST_EFFORT = Delivery()


class Reader:
    """The raw messages of one topic."""

    def __init__(self, participant: Any, topic: str, kind: str, delivery: Delivery) -> None:
        from cyclonedds.core import InstanceState, ReadCondition, SampleState, ViewState
        from cyclonedds.sub import DataReader

        self.kind = kind
        self._any = SampleState.Any | ViewState.Any | InstanceState.Any
        self._topic = _topic(participant, topic, kind)
        self._reader = DataReader(participant, self._topic, _quality(kind, delivery))
        self.condition = ReadCondition(self._reader, self._any)

    @property
    def guid(self) -> bytes:
        return bytes(self._reader.guid.bytes)

    def take(self) -> Iterator[bytes]:
        """The messages that have come, oldest first, as CDR."""
        from cyclonedds._clayer import ddspy_take  # the only way to bytes; so the package's version is fixed

        for data, info in ddspy_take(self._reader._ref, self._any, MOST_AT_ONCE):
            if info.valid_data:
                yield data


class Writer:
    """Sends raw messages on one topic."""

    def __init__(self, participant: Any, topic: str, kind: str, delivery: Delivery) -> None:
        from cyclonedds.pub import DataWriter

        self.kind = kind
        self._topic = _topic(participant, topic, kind)
        self._writer = DataWriter(participant, self._topic, _quality(kind, delivery))

    @property
    def guid(self) -> bytes:
        return bytes(self._writer.guid.bytes)

    @property
    def readers(self) -> int:
        """How many read it now."""
        return int(self._writer.get_publication_matched_status().current_count)

    @property
    def refused(self) -> int:
        """How many have asked for more than is delivered, and get nothing."""
        return int(self._writer.get_offered_incompatible_qos_status().total_count)

    def write(self, data: bytes, stamp_ns: int) -> None:
        """Send a message (CDR) without waiting for anybody.

        Raises:
            SagsError: DDS cannot send it.
        """
        from cyclonedds._clayer import ddspy_write_ts  # see `Reader.take`

        whole = data + bytes(-len(data) % 4)  # DDS sends words, and would fill the last one from elsewhere
        code = ddspy_write_ts(self._writer._ref, whole, stamp_ns)
        if code < 0:
            raise SagsError(f"cannot send {self._topic.name} into the ROS 2 graph: DDS error {code}")


def _topic(participant: Any, topic: str, kind: str) -> Any:
    from cyclonedds.topic import Topic

    return Topic(participant, f"rt{topic}" if topic.startswith("/") else topic, raw_type(kind))


def _quality(kind: str, delivery: Delivery) -> Any:
    from cyclonedds.core import Policy, Qos
    from cyclonedds.util import duration

    policies: Sequence[Any] = [
        Policy.Reliability.Reliable(BLOCKED) if delivery.reliable else Policy.Reliability.BestEffort,
        Policy.Durability.TransientLocal if delivery.kept else Policy.Durability.Volatile,
        Policy.History.KeepLast(delivery.depth),
        Policy.DataRepresentation(use_cdrv0_representation=True, use_xcdrv2_representation=False),
        Policy.Userdata(f"typehash={type_hash(kind)};".encode()),
    ]
    if delivery.lifespan is not None:
        policies = [*policies, Policy.Lifespan(duration(milliseconds=round(1e3 * delivery.lifespan)))]
    return Qos(*policies)


_types: dict[str, Any] = {}


def raw_type(kind: str) -> Any:
    """A DDS type without fields under the name of a ROS type: CDR goes in and out as it is."""
    if kind not in _types:
        from cyclonedds.idl import IdlStruct
        from cyclonedds.idl.annotations import final

        package, _, name = kind.split("/")

        @dataclass
        @final
        class Raw(IdlStruct, typename=f"{package}.msg.dds_.{name}_"):  # type: ignore[misc, call-arg]
            pass

        Raw.__idl__.populate()
        _types[kind] = Raw
    return _types[kind]


def ros_type(name: str) -> str:
    """`pkg::msg::dds_::Name_` as ROS says it."""
    package, _, last = name.partition("::")
    return f"{package}/msg/{last.rpartition('::')[2].removesuffix('_')}"
