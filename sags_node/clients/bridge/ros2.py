"""`sags bridge ros2`: every topic of a node in a ROS 2 graph, as ROS users expect it. No ROS is needed.

The messages are the node's own, byte for byte. Small ones are sent, too, for receivers with ROS 2's default
settings: compressed images, and fewer points. What has stopped is not sent again; `/diagnostics` says why.
"""

import logging
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import chain

import numpy as np

from sags_node.clients.bridge.compressed import LARGEST, Compressor, suffix
from sags_node.clients.bridge.relay import BridgeOptions, Outlet, Output, Relay, Source, silent
from sags_node.clients.bridge.requests import Requests
from sags_node.clients.bridge.ros2_requests import ANSWER, Inbox
from sags_node.config.schema import RosGraph
from sags_node.errors import UsageError
from sags_node.messaging import cdr, content, topics
from sags_node.messaging.received import Frame, Received, ReceivedCameraInfo, ReceivedCloud, ReceivedRos
from sags_node.messaging.topics import VIEW_NAME
from sags_node.ros.graph import Delivery, Graph, kernel_buffer

ALL_POINTS = "/all"
GLOBAL = {"tf": "/tf", "diagnostics": "/diagnostics"}  # the names by which all of ROS knows them
STATIC = "/tf_static"
SHARED = (*GLOBAL.values(), STATIC)
BEAT = 1.0  # s between two messages about the bridge itself
ATTEND = 0.1  # s between looks at who reads
STALE = 3  # the level of a diagnostic status
TWO = "two nodes publish in this graph under one name; stop one of them, or give it another ns"
PACE = 50e6  # bytes/s at which a stock receiver on a loaded machine empties its buffer
ENOUGH = 4 << 20  # bytes of a receive buffer: with that much a raw image and depth get through

Make = Callable[[Received], bytes]

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Ros2Options(BridgeOptions):
    """How `sags bridge ros2` runs."""

    graph: RosGraph = field(default_factory=RosGraph)
    views: tuple[str, ...] = ("ros",)  # that consumers may open
    points: int = 8000  # of a cloud, at most; 20 bytes each


@dataclass(frozen=True, slots=True)
class Offer:
    """One topic of the graph.

    Attributes:
        make: makes its CDR from a message of the node.
    """

    output: Output
    kind: str
    delivery: Delivery
    make: Make


def offers(options: Ros2Options) -> list[Offer]:
    """List all topics of the node, of an overlay and of `options.views`, as they are and in small versions.

    Raises:
        UsageError: a view's name is not valid.
    """
    node, overlay = options.node.ns, options.overlay.ns
    found: list[Offer] = []
    for topic in topics.TOPICS:
        found += _of_topic(node, topic, options)
    for view in options.views:
        if VIEW_NAME.fullmatch(view) is None:
            raise UsageError(f"--view {view!r}: a view is named with up to 64 letters, digits and _")
        names = (content.view_topics(view, stereo, depth=True) for stereo in (False, True))
        for topic in filter(None, map(topics.find, chain.from_iterable(names))):
            found += _of_topic(node, topic, options, optional=True)
    for topic in topics.OVERLAY_TOPICS:
        found += _of_topic(overlay, topic, options, optional=True)
    return found


def _of_topic(ns: str, topic: topics.Topic, options: Ros2Options, optional: bool = False) -> list[Offer]:
    name = GLOBAL.get(topic.name, f"/{topics.full_name(ns, topic.name)}")
    delivery = _delivery(topic, options.max_age)

    def offer(added: str, kind: str, make: Make) -> Offer:
        sources = (Source(ns, topic.name),)
        output = Output(f"{name}{added}", sources, optional=optional, lengths=topic.in_metres)
        return Offer(output, kind, delivery, make)

    if topic.type == topics.IMAGE:
        packed = offer(suffix(topic), cdr.COMPRESSED, Compressor(topic))
        return [offer("", topic.type, Received.cdr), packed]
    if topic.name == "points":
        thinned = offer("", topic.type, partial(_thinned, most=options.points))
        return [thinned, offer(ALL_POINTS, topic.type, Received.cdr)]
    if topic.type == topics.DIAGNOSTICS:
        return [offer("", topic.type, partial(_named, ns=ns))]
    found = [offer("", topic.type, Received.ros)]
    if (ns, topic.name) == (options.node.ns, "right/camera_info"):
        output = Output(STATIC, (Source(ns, topic.name),), BEAT, optional=True, lengths=True)
        kept = Delivery(reliable=True, kept=True, lifespan=options.max_age)
        found.append(Offer(output, topics.TF, kept, _eyes))
    return found


def _delivery(topic: topics.Topic, max_age: float) -> Delivery:
    """The QoS that ROS users expect: best effort for images and clouds, reliable for small messages."""
    if topic.type == topics.TF:
        return Delivery(reliable=True, depth=100, lifespan=max_age)
    if topic.type == topics.DIAGNOSTICS:
        return Delivery(reliable=True, depth=10)
    if topic.type == topics.STRING:
        return Delivery(reliable=True, kept=True, depth=1)
    if topic.type == topics.CAMERA_INFO:
        return Delivery(reliable=True, kept=topic.cached, depth=5, lifespan=max_age)
    return Delivery(reliable=topic.name == "anchors", depth=5, lifespan=max_age)


def run_ros2(options: Ros2Options, ready: Callable[[int, str], None], stop: threading.Event) -> None:
    """Publish into a ROS 2 graph until `stop` is set. The node may come later and be restarted.

    Args:
        ready: called with the domain and the interface once peers can see the topics.

    Raises:
        UsageError: wrong keys, `cyclonedds` is not installed, or there is no such network interface.
        SagsError: DDS cannot be started, or an endpoint is malformed.
    """
    offered = offers(options)
    outputs, senders = [offer.output for offer in offered], (options.node, options.overlay)
    with (
        closing(Ros2(options, offered)) as bridge,
        closing(Relay(senders, outputs, bridge, options.max_age)) as relay,
    ):
        _tell_of_buffers()
        ready(bridge.graph.domain, bridge.graph.interface)
        relay.run(stop)


def _tell_of_buffers() -> None:
    default, most = kernel_buffer("default"), kernel_buffer("max")
    if default is not None and default < ENOUGH:
        log.warning(
            "receivers of ROS 2 have a buffer of %d kB on this machine (net.core.rmem_default; rmem_max: %d "
            "kB) and lose raw images: let them read .../compressed, or: sudo sysctl -w "
            "net.core.rmem_default=16777216, and start them anew",
            default // 1000,
            (most or default) // 1000,
        )


class Ros2(Outlet):
    """The outlet: one writer for each output.

    Raises:
        UsageError, SagsError: see `Graph`.
    """

    def __init__(self, options: Ros2Options, offered: Sequence[Offer]) -> None:
        self.graph = Graph(options.graph)
        self._ns = ns = options.node.ns
        self._senders = {each.ns: each for each in (options.node, options.overlay)}
        self._offers = {offer.output.name: offer for offer in offered}
        self._writers = {
            name: self.graph.writer(name, offer.kind, offer.delivery) for name, offer in self._offers.items()
        }
        self._diagnostics = self._writers[GLOBAL["diagnostics"]]
        self._pace = Pace()
        self._read: frozenset[str] = frozenset()  # by somebody
        self._missing: dict[str, str] = {}
        self._stages: list[str] = []  # of the node's last diagnostics
        self._silent = False
        self._namesake = False
        self._refused: dict[str, int] = {}
        answers = self.graph.writer(f"/{ns}/{ANSWER}", topics.STRING, Delivery(reliable=True, depth=10))
        self._requests = Requests(options.node)
        self._inbox = Inbox(self.graph, ns, options.views, self._requests, answers)
        self.graph.call_it(f"/{ns}")
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._attend, name="sags-bridge-ros2")
        self._thread.start()

    def close(self) -> None:
        self._stopping.set()
        self._thread.join()
        self._requests.close()

    # ---- out -----------------------------------------------------------------------------------------------

    def wants(self, output: Output) -> bool:
        """Tell whether it is wanted: somebody reads it, or it is kept for late readers and must be new."""
        offer = self._offers[output.name]
        lasts = offer.delivery.kept and offer.delivery.lifespan is None
        return lasts or output.name in self._read

    def send(self, output: Output, frame: Frame) -> bool:
        source = output.sources[0]
        received = frame[source.topic]
        if source.topic == "diagnostics" and isinstance(received, ReceivedRos):
            self._stages = [status.name for status in received.message.status]
        age_ns = self._senders[source.ns].now_ns() - received.stamp_ns  # readers compare it with our clock
        data = self._offers[output.name].make(received)
        self._pace.wait(len(data))
        self._writers[output.name].write(data, time.time_ns() - age_ns)
        return True

    def blank(self, output: Output, reason: str) -> None:
        """Replace a text, which the graph keeps for late readers. Anything else is just not sent again."""
        if self._offers[output.name].kind == topics.STRING:
            self._writers[output.name].write(cdr.string(silent(reason)).cdr(), time.time_ns())

    def report(self, missing: Mapping[str, str], shows: bool) -> None:
        self._missing = dict(missing)

    # ---- on a thread of its own ----------------------------------------------------------------------------

    def _attend(self) -> None:
        due = time.monotonic()
        while not self._stopping.is_set():
            self.graph.wait(ATTEND)
            self._inbox.take()
            self._read = frozenset(name for name, writer in self._writers.items() if writer.readers > 0)
            if time.monotonic() >= due:
                due = time.monotonic() + BEAT
                self._beat()
                self._warn_of_refused()

    def _beat(self) -> None:
        """Publish the state of the bridge and, while the node is silent, that it is."""
        words = "; ".join(dict.fromkeys([*self._missing.values(), *self._namesakes()]))
        statuses = [
            cdr.Status(
                "bridge", 1 if words else 0, words or "all is new", {"topics_read": str(len(self._read))}
            )
        ]
        reason = self._missing.get(GLOBAL["diagnostics"])
        if reason is not None and (self._stages or self._silent):  # the first one takes up to a second
            statuses += [cdr.Status(stage, STALE, reason, {}) for stage in self._stages or ["node"]]
        self._silent = reason is not None
        now_ns = time.time_ns()
        self._diagnostics.write(_array(statuses, self._ns, now_ns), now_ns)

    def _namesakes(self) -> list[str]:
        """Warn of others that publish what only this node should: readers would get both in turn."""
        own = [name for name in self.graph.publications() if name in self._writers and name not in SHARED]
        if own and not self._namesake:
            log.warning("%s: %s", ", ".join(own[:3]), TWO)
        self._namesake = bool(own)
        return [TWO] if own else []

    def _warn_of_refused(self) -> None:
        for name, writer in self._writers.items():
            if writer.refused > self._refused.get(name, 0):
                self._refused[name] = writer.refused
                log.warning(
                    "%s: somebody reads it with stricter settings than it has, and gets nothing; "
                    "subscribe with qos_profile_sensor_data (best effort, volatile)",
                    name,
                )


class Pace:
    """Keeps small messages apart: all those of a frame at once do not fit into a stock receive buffer."""

    def __init__(self) -> None:
        self._free = 0.0  # monotonic s

    def wait(self, size: int) -> None:
        """Wait until a message of `size` bytes may go; one above `LARGEST` does not wait: it cannot fit."""
        if size <= LARGEST:
            time.sleep(max(0.0, self._free - time.monotonic()))
            self._free = time.monotonic() + size / PACE


# ---- what is sent ----------------------------------------------------------------------------------------


def _thinned(received: Received, most: int) -> bytes:
    """Every n-th point, so that no more than `most` are left."""
    assert isinstance(received, ReceivedCloud)
    every = max(1, -(-len(received.points) // most))
    fields = received.meta.encoding.split(",")
    kept = np.ascontiguousarray(received.points[::every]).view(np.float32).reshape(-1, len(fields))
    return cdr.point_cloud(kept, fields, received.stamp_ns).cdr()


def _eyes(received: Received) -> bytes:
    """The pose of the right eye in the left eye's frame: its images are in a frame of their own."""
    assert isinstance(received, ReceivedCameraInfo)
    T = np.eye(4)
    T[0, 3] = -received.P[0, 3] / received.P[0, 0]
    return cdr.transform(T, received.stamp_ns, cdr.LEFT_FRAME, cdr.RIGHT_FRAME).cdr()


def _named(received: Received, ns: str) -> bytes:
    """The node's diagnostics, named for a topic that all of ROS shares."""
    assert isinstance(received, ReceivedRos)
    statuses = [
        cdr.Status(said.name, said.level, said.message, {each.key: each.value for each in said.values})
        for said in received.message.status
    ]
    return _array(statuses, ns, received.stamp_ns)


def _array(statuses: Sequence[cdr.Status], ns: str, stamp_ns: int) -> bytes:
    """All of ROS shares one topic, so each name begins with the node's."""
    named = [replace(status, name=f"{ns}: {status.name}") for status in statuses]
    return cdr.diagnostics(named, stamp_ns).cdr()
