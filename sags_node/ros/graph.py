"""A ROS 2 graph, joined by DDS with the `cyclonedds` package. Messages are raw CDR, which it does not parse.

ROS 2 is DDS with conventions: a topic `/a` is called `rt/a`, a type `pkg/msg/Name` is called
`pkg::msg::dds_::Name_`, and the type's hash is in the user data. So no message type needs to be defined here.
"""

import logging
import os
import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from sags_node.config.schema import RosGraph
from sags_node.errors import SagsError, UsageError, install
from sags_node.messaging import cdr

log = logging.getLogger(__name__)

MOST_AT_ONCE = 16  # messages taken in one go
BLOCKED = 100_000_000  # ns that a write may block; it never does, as the history keeps the newest only
RECEIVE_BUFFER = 16 << 20  # bytes asked for; the kernel gives no more than net.core.rmem_max
ANNOUNCED = 0.5  # s between announcements of this process, so that new nodes find it soon
PARTICIPANTS = 32  # DDS processes on this machine that are looked for
ALIVE = 16  # DDS' instance state
NODES = "ros_discovery_info"  # the topic on which processes tell their nodes
_CONFIG = """<CycloneDDS><Domain Id="any">
<General><Interfaces><NetworkInterface name="{interface}"/></Interfaces>{general}</General>
<Discovery><ParticipantIndex>auto</ParticipantIndex>
<MaxAutoParticipantIndex>{participants}</MaxAutoParticipantIndex>
<SPDPInterval>{announced} s</SPDPInterval>{discovery}</Discovery>
<Internal><SocketReceiveBufferSize max="{buffer} B"/></Internal>
<Compatibility><IgnoreTypeInformation>1.1,1.3,1.15,1.16</IgnoreTypeInformation></Compatibility>
</Domain></CycloneDDS>"""  # Compatibility: else newer Fast DDS lists our readers, but never matches them
_LOCAL = "<AllowMulticast>false</AllowMulticast>", '<Peers><Peer Address="127.0.0.1"/></Peers>'


@dataclass(frozen=True, slots=True)
class Delivery:
    """The quality of service (QoS) of a topic, as in ROS.

    Attributes:
        reliable: lost messages are sent again. Else best effort, which only readers that ask for best effort
            can read.
        kept: late readers get the last messages, too ("transient local"); needs `reliable`.
        depth: number of newest messages kept: by a reader until taken, by a reliable writer to send again.
        lifespan: s after its stamp during which a message is delivered; None: without limit.
    """

    reliable: bool = False
    kept: bool = False
    depth: int = 4
    lifespan: float | None = None


BEST_EFFORT = Delivery()


class Reader:
    """Receives the raw messages of one topic."""

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
        """Take up to `MOST_AT_ONCE` of the messages that have come, oldest first, as CDR."""
        from cyclonedds._clayer import ddspy_take  # the only way to bytes; so the package's version is pinned

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
        """The number of readers that are connected now."""
        return int(self._writer.get_publication_matched_status().current_count)

    @property
    def refused(self) -> int:
        """The number of readers so far that asked for a stricter QoS, and so get nothing."""
        return int(self._writer.get_offered_incompatible_qos_status().total_count)

    def write(self, data: bytes, stamp_ns: int) -> None:
        """Send a message (CDR) without waiting for readers.

        Raises:
            SagsError: DDS cannot send it.
        """
        from cyclonedds._clayer import ddspy_write_ts  # see `Reader.take`

        whole = data + bytes(-len(data) % 4)  # DDS sends words of 4 bytes, and would pad with arbitrary ones
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
        Policy.Userdata(f"typehash={cdr.type_hash(kind)};".encode()),
    ]
    if delivery.lifespan is not None:
        policies = [*policies, Policy.Lifespan(duration(milliseconds=round(1e3 * delivery.lifespan)))]
    return Qos(*policies)


_types: dict[str, Any] = {}


def raw_type(kind: str) -> Any:
    """Make a DDS type without fields that has the name of a ROS type: CDR passes through it unchanged."""
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
    """Return the ROS name of a DDS type: `pkg/msg/Name` for `pkg::msg::dds_::Name_`."""
    package, _, last = name.partition("::")
    return f"{package}/msg/{last.rpartition('::')[2].removesuffix('_')}"


class Graph:
    """This process as a participant in a ROS 2 graph. Only one thread may read from it.

    Raises:
        UsageError: `cyclonedds` is not installed, or there is no such network interface.
        SagsError: DDS cannot be started, or this process has joined this domain on another interface.
    """

    def __init__(self, config: RosGraph) -> None:
        try:
            from cyclonedds.core import DDSException, Policy, Qos, WaitSet
            from cyclonedds.domain import DomainParticipant
        except ImportError:
            raise UsageError(f"ROS 2 needs one more package: {install('ros2')}") from None
        self.domain = domain_of(config)
        self.interface = config.interface
        self._domain = _domain(self.domain, config.interface)
        try:
            self.participant = DomainParticipant(self.domain, Qos(Policy.Userdata(b"enclave=/;")))
            self._waiting = WaitSet(self.participant)
        except DDSException as error:
            raise SagsError(f"cannot join ROS 2 domain {self.domain}: {error.msg}") from None
        self._read: list[bytes] = []  # by GUID
        self._written: list[bytes] = []
        self._said: Writer | None = None  # tells the graph which node this is
        self._announced: Any = None  # reads what others publish; opened when first asked
        self._publications: dict[Any, tuple[str, str]] = {}  # by writer: topic and type, as ROS names them

    def publications(self) -> dict[str, set[str]]:
        """Return the topics that others publish now, and their types."""
        if self._announced is None:
            from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsPublication

            self._announced = BuiltinDataReader(self.participant, BuiltinTopicDcpsPublication)
        for said in self._announced.take(4096):
            alive = said.sample_info.instance_state == ALIVE
            if said.key.bytes in self._written:
                continue
            if alive and said.topic_name is not None and said.topic_name.startswith("rt/"):
                self._publications[said.key] = said.topic_name[2:], ros_type(said.type_name)
            elif not alive:
                self._publications.pop(said.key, None)
        found: dict[str, set[str]] = {}
        for topic, kind in self._publications.values():
            found.setdefault(topic, set()).add(kind)
        return found

    def reader(self, topic: str, kind: str, delivery: Delivery = BEST_EFFORT) -> Reader:
        """Open a reader of a topic, named as in ROS: `/a/image_raw`. Best effort matches every writer."""
        reader = Reader(self.participant, topic, kind, delivery)
        self._waiting.attach(reader.condition)
        self._read.append(reader.guid)
        return reader

    def writer(self, topic: str, kind: str, delivery: Delivery = BEST_EFFORT) -> Writer:
        """Open a writer of a topic, named as in ROS."""
        writer = Writer(self.participant, topic, kind, delivery)
        self._written.append(writer.guid)
        return writer

    def call_it(self, node: str) -> None:
        """Announce the readers and writers so far as a node of this name, e.g. `/sags`."""
        if self._said is None:
            newest = Delivery(reliable=True, kept=True, depth=1)
            self._said = Writer(self.participant, NODES, cdr.NODES, newest)
        guid = self.participant.guid.bytes
        namespace, _, name = node.rpartition("/")
        body = cdr.node_entities(guid, namespace or "/", name, self._read, self._written)
        self._said.write(body, time.time_ns())

    def wait(self, seconds: float) -> None:
        """Wait until a reader has a message, at most `seconds`."""
        from cyclonedds.util import duration

        self._waiting.wait(duration(milliseconds=round(seconds * 1e3)))

    def where(self) -> str:
        """Name this graph, for messages."""
        return where(self.domain, self.interface)


def where(domain: int, interface: str) -> str:
    """Name a graph, for messages."""
    return f"ROS 2 domain {domain}, interface {interface}"


def domain_of(config: RosGraph) -> int:
    """Return the domain that the launch file names, or else `ROS_DOMAIN_ID`, or 0.

    Raises:
        UsageError: the variable is not a number from 0 to 232.
    """
    if config.domain is not None:
        return config.domain
    said = os.environ.get("ROS_DOMAIN_ID") or "0"
    if not said.isdecimal() or int(said) > 232:
        raise UsageError(f"ROS_DOMAIN_ID is {said!r}, not a number from 0 to 232")
    return int(said)


def receive_buffer() -> int:
    """Return the receive buffer that the kernel grants us, bytes."""
    return min(RECEIVE_BUFFER, kernel_buffer("max") or RECEIVE_BUFFER)


def kernel_buffer(which: Literal["default", "max"]) -> int | None:
    """Return the kernel's default or largest receive buffer of a socket, bytes; None: it does not tell."""
    said = Path(f"/proc/sys/net/core/rmem_{which}")
    return int(said.read_text()) if said.exists() else None


_lock = threading.Lock()
_domains: dict[int, tuple[str, Any]] = {}  # DDS configures a domain only once in a process


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
