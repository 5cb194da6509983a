"""A ROS 2 graph, joined by DDS with the `cyclonedds` package."""

from __future__ import annotations

import logging
import os
import threading
import time
from pathlib import Path
from typing import Any, Literal

from sags_node.config.schema import RosGraph
from sags_node.errors import SagsError, UsageError, install
from sags_node.messaging import cdr
from sags_node.ros.endpoints import BEST_EFFORT, Delivery, Reader, Writer, ros_type

log = logging.getLogger(__name__)

RECEIVE_BUFFER = 16 << 20  # bytes asked for; the kernel gives no more than net.core.rmem_max
ANNOUNCED = 0.5  # s between announcements of this process: so soon a node that comes up is found
PARTICIPANTS = 32  # DDS processes on this machine that are looked for
ALIVE = 16  # DDS' instance state
NODES = "ros_discovery_info"  # the topic on which processes say which nodes are theirs
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
        self._said: Writer | None = None  # that says which node this is
        self._announced: Any = None  # what others publish; nobody may ever ask
        self._publications: dict[Any, tuple[str, str]] = {}  # by writer: topic and type, in ROS' words

    def publications(self) -> dict[str, set[str]]:
        """The topics that somebody else publishes now, and their types."""
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
        """A reader of a topic, named as in ROS, e.g. `/a/image_raw`. Best effort fits every writer."""
        reader = Reader(self.participant, topic, kind, delivery)
        self._waiting.attach(reader.condition)
        self._read.append(reader.guid)
        return reader

    def writer(self, topic: str, kind: str, delivery: Delivery = BEST_EFFORT) -> Writer:
        """A writer of a topic, named as in ROS."""
        writer = Writer(self.participant, topic, kind, delivery)
        self._written.append(writer.guid)
        return writer

    def call_it(self, node: str) -> None:
        """Let the graph show what is read and written so far as a node of this name, e.g. `/sags`."""
        if self._said is None:
            newest = Delivery(reliable=True, kept=True, depth=1)
            self._said = Writer(self.participant, NODES, cdr.NODES, newest)
        guid = self.participant.guid.bytes
        namespace, _, name = node.rpartition("/")
        body = cdr.node_entities(guid, namespace or "/", name, self._read, self._written)
        self._said.write(body, time.time_ns())

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
    return min(RECEIVE_BUFFER, kernel_buffer("max") or RECEIVE_BUFFER)


def kernel_buffer(which: Literal["default", "max"]) -> int | None:
    """The receive buffer, in bytes, of a process of this machine that asks for none, or the largest that it
    may ask for; None: the kernel does not say."""
    said = Path(f"/proc/sys/net/core/rmem_{which}")
    return int(said.read_text()) if said.exists() else None


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
