"""A ROS 2 graph without ROS: raw messages by DDS, with the `cyclonedds` package.

ROS 2 is DDS with conventions: a topic `/a` is called `rt/a`, a type `pkg/msg/Name` is called
`pkg::msg::dds_::Name_`, and what travels is CDR. So no message is defined here: bytes come out as they came.
"""

from __future__ import annotations

import logging
import os
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sags_node.config import RosGraph
from sags_node.errors import SagsError, UsageError
from sags_node.messaging.cdr import Content, type_hash

log = logging.getLogger(__name__)

MOST_AT_ONCE = 16  # messages or announcements taken in one go
RECEIVE_BUFFER = 16 << 20  # bytes asked for; the kernel gives no more than net.core.rmem_max
ANNOUNCED = 0.5  # s between announcements of this process: so soon a node that comes up is found
PARTICIPANTS = 32  # DDS processes on this machine that are looked for
ALIVE = 16  # DDS' instance state
_CONFIG = """<CycloneDDS><Domain Id="any">
<General><Interfaces><NetworkInterface name="{interface}"/></Interfaces>{general}</General>
<Discovery><ParticipantIndex>auto</ParticipantIndex>
<MaxAutoParticipantIndex>{participants}</MaxAutoParticipantIndex>
<SPDPInterval>{announced} s</SPDPInterval>{discovery}</Discovery>
<Internal><SocketReceiveBufferSize max="{buffer} B"/></Internal>
<Compatibility><IgnoreTypeInformation>1.1,1.3,1.15,1.16</IgnoreTypeInformation></Compatibility>
</Domain></CycloneDDS>"""  # the last one: newer Fast DDS would list our readers and never match them
_LOCAL = "<AllowMulticast>false</AllowMulticast>", '<Peers><Peer Address="127.0.0.1"/></Peers>'


class Graph:
    """A process of its own in a ROS 2 graph. What it reads is used by one thread.

    Raises:
        UsageError: `cyclonedds` is not installed, or there is no such network interface.
        SagsError: DDS cannot be started, or this process is in another graph of this domain already.
    """

    def __init__(self, config: RosGraph) -> None:
        try:
            from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsPublication
            from cyclonedds.core import DDSException, WaitSet
            from cyclonedds.domain import DomainParticipant
        except ImportError:
            raise UsageError("ROS 2 needs one more package: pip install 'sags-node[ros2]'") from None
        self.domain = domain_of(config)
        self.interface = config.interface
        self._domain = _domain(self.domain, config.interface)
        try:
            self.participant = DomainParticipant(self.domain)
            self._announced = BuiltinDataReader(self.participant, BuiltinTopicDcpsPublication)
            self._waiting = WaitSet(self.participant)
        except DDSException as error:
            raise SagsError(f"cannot join ROS 2 domain {self.domain}: {error.msg}") from None
        self._publications: dict[Any, tuple[str, str]] = {}  # by writer: topic and type, in ROS' words

    def publications(self) -> dict[str, set[str]]:
        """The topics that somebody publishes now, and their types."""
        for said in self._announced.take(4096):
            alive = said.sample_info.instance_state == ALIVE
            if alive and said.topic_name is not None and said.topic_name.startswith("rt/"):
                self._publications[said.key] = said.topic_name[2:], _ros_type(said.type_name)
            elif not alive:
                self._publications.pop(said.key, None)
        found: dict[str, set[str]] = {}
        for topic, kind in self._publications.values():
            found.setdefault(topic, set()).add(kind)
        return found

    def reader(self, topic: str, kind: str, depth: int = 4, kept: bool = False) -> Reader:
        """A reader of a topic, told as ROS tells it, e.g. `/a/image_raw`.

        Args:
            depth: the newest messages that wait to be taken.
            kept: also what was sent before, by writers that keep it (`tf_static`).
        """
        reader = Reader(self.participant, topic, kind, depth, kept)
        self._waiting.attach(reader.condition)
        return reader

    def writer(self, topic: str, kind: str) -> Writer:
        """A writer to a topic, told as ROS tells it: what stands in for cameras."""
        return Writer(self.participant, topic, kind)

    def wait(self, seconds: float) -> None:
        """Until something can be taken from one of the readers, or the time is over."""
        from cyclonedds.util import duration

        self._waiting.wait(duration(milliseconds=round(seconds * 1e3)))

    def where(self) -> str:
        """Which graph this is, for messages."""
        return where(self.domain, self.interface)


def where(domain: int, interface: str) -> str:
    """A graph, for messages."""
    return f"ROS 2 domain {domain}, interface {interface}"


class Reader:
    """The raw messages of one topic. Best effort fits every writer; nobody waits for us."""

    def __init__(self, participant: Any, topic: str, kind: str, depth: int, kept: bool) -> None:
        from cyclonedds.core import InstanceState, Policy, Qos, ReadCondition, SampleState, ViewState
        from cyclonedds.sub import DataReader
        from cyclonedds.topic import Topic
        from cyclonedds.util import duration

        self.kind = kind
        policies = [
            Policy.Reliability.Reliable(duration(milliseconds=100))
            if kept
            else Policy.Reliability.BestEffort,
            Policy.Durability.TransientLocal if kept else Policy.Durability.Volatile,
            Policy.History.KeepLast(depth),
            Policy.DataRepresentation(use_cdrv0_representation=True, use_xcdrv2_representation=False),
            Policy.Userdata(f"typehash={type_hash(kind)};".encode()),
        ]
        self._any = SampleState.Any | ViewState.Any | InstanceState.Any
        self._topic = Topic(participant, f"rt{topic}", raw_type(kind))
        self._reader = DataReader(participant, self._topic, Qos(*policies))
        self.condition = ReadCondition(self._reader, self._any)

    def take(self) -> Iterator[bytes]:
        """The messages that have come, oldest first, as CDR."""
        from cyclonedds._clayer import ddspy_take  # the only way to bytes; so the package's version is fixed

        for data, info in ddspy_take(self._reader._ref, self._any, MOST_AT_ONCE):
            if info.valid_data:
                yield data


class Writer:
    """Sends what is CDR already. Best effort: what a reader has no room for is lost."""

    def __init__(self, participant: Any, topic: str, kind: str) -> None:
        from cyclonedds.core import Policy, Qos
        from cyclonedds.pub import DataWriter
        from cyclonedds.topic import Topic

        form = Policy.DataRepresentation(use_cdrv0_representation=True, use_xcdrv2_representation=False)
        qos = Qos(Policy.Reliability.BestEffort, Policy.History.KeepLast(2), form)
        self._topic = Topic(participant, f"rt{topic}", raw_type(kind))
        self._writer = DataWriter(participant, self._topic, qos)

    def write(self, body: Content, stamp_ns: int) -> None:
        from cyclonedds._clayer import ddspy_write_ts  # see `Reader.take`

        ddspy_write_ts(self._writer._ref, b"".join(bytes(part) for part in body.parts), stamp_ns)


def domain_of(config: RosGraph) -> int:
    """The domain that was asked for, by the launch file or by ROS' own variable.

    Raises:
        UsageError: the variable holds no number.
    """
    if config.domain is not None:
        return config.domain
    said = os.environ.get("ROS_DOMAIN_ID") or "0"
    if not said.isdecimal() or int(said) > 232:
        raise UsageError(f"ROS_DOMAIN_ID is {said!r}, not a number from 0 to 232")
    return int(said)


def receive_buffer() -> int:
    """The receive buffer that the kernel grants us, bytes."""
    limit = Path("/proc/sys/net/core/rmem_max")
    return min(RECEIVE_BUFFER, int(limit.read_text())) if limit.exists() else RECEIVE_BUFFER


_lock = threading.Lock()
_domains: dict[int, tuple[str, Any]] = {}  # DDS configures a domain once in a process


def _domain(number: int, interface: str) -> Any:
    from cyclonedds.core import DDSException
    from cyclonedds.domain import Domain

    with _lock:
        if number in _domains:
            if _domains[number][0] != interface:
                raise SagsError(
                    f"ROS 2 domain {number} is on interface {_domains[number][0]} already; name one interface"
                )
            return _domains[number][1]
        general, discovery = _LOCAL if interface == "lo" else ("", "")
        said = _CONFIG.format(
            interface=interface, general=general, discovery=discovery, buffer=RECEIVE_BUFFER,
            participants=PARTICIPANTS, announced=ANNOUNCED,
        )  # fmt: skip
        try:
            domain = Domain(number, said)
        except DDSException as error:
            there = ", ".join(sorted(path.name for path in Path("/sys/class/net").iterdir()))
            raise UsageError(
                f"ROS 2 cannot use network interface {interface} ({error.msg}); there are: {there}"
            ) from None
        if interface != "lo":
            log.warning("ROS 2 on interface %s is not authenticated: who reaches it is believed", interface)
        _domains[number] = interface, domain
        return domain


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


def _ros_type(name: str) -> str:
    """`pkg::msg::dds_::Name_` as ROS says it."""
    package, _, last = name.partition("::")
    return f"{package}/msg/{last.rpartition('::')[2].removesuffix('_')}"
