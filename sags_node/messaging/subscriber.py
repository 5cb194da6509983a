"""The consumer's side: a receiver thread keeps the newest messages of each topic, so lag cannot build up.

with Subscriber(["left/render/depth"]) as subscriber:
    depth = subscriber.wait("left/render/depth", timeout=1.0)
    subscriber.read("left/render/depth")  # raises StaleError when it must not be shown as new

`received.TopicName` in place of a plain name makes the results typed; `async_subscriber` is for asyncio.
"""

import atexit
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, Self, overload

import zmq

from sags_node.errors import SagsError, UsageError
from sags_node.messaging import topics
from sags_node.messaging.address import Address, ClientKeys, Clock, NodeAddress, found
from sags_node.messaging.freshness import TWO_NODES, Freshness, StaleError
from sags_node.messaging.received import Frame, R, Received, ReceivedText, TopicName, interpret
from sags_node.messaging.sockets import Closes
from sags_node.messaging.stream import POLL_MS, check_topic, data_socket, receive
from sags_node.messaging.wire import WireError
from sags_node.workers import go_on

KEPT = 4  # newest messages of a topic, so that topics of one frame can be joined by stamp
SILENT_AFTER = 2.5  # s without a `status`, which comes every second
_ALWAYS = frozenset({"status"})


class Receiver:
    """What `Subscriber` and `AsyncSubscriber` have in common: everything but the waiting.

    `status` is always received too: a sender that says it is not running makes every topic stale. A node
    that is restarted is followed, also to another port if it was found by its connection file.

    Args:
        names: topics without the namespace.
        endpoint: of the XPUB socket; default: from the connection file of `ns`.
        rates: Hz a topic must keep; default: every message that its sender sends.
        clock_ns: the wall clock that capture stamps are compared with.
        keys: for a node that wants them.
        clock: of the node's machine if it is another one, instead of `clock_ns`. While its offset is not
            known, every topic is stale.
        paused: begin as after `pause`.
        patience: s to wait for a node that does not run yet; default: 10, and 0 for asyncio, whose loop must
            not be blocked. With an `endpoint` none need run.
        may_be_absent: do not wait for a node; connect as soon as there is one.
        kept: number of newest messages of each topic, in which `aligned` and `nearest` search.

    Attributes:
        refusal: why the node does not let this client in.
        absent: why no node can be found; None: one was found.
        refused: topics that the node does not make, and why; changed by another thread.
        rejected: malformed messages.

    Raises:
        UsageError: an unknown topic, or the node wants keys that are not given.
        SagsError: no node named `ns` runs here and no endpoint is given.
    """

    _patience = 0.0

    def __init__(
        self,
        names: Iterable[str],
        endpoint: str | None = None,
        ns: str = "sags",
        run_dir: Path | None = None,
        rates: Mapping[str, float] | None = None,
        clock_ns: Callable[[], int] = time.time_ns,
        keys: ClientKeys | None = None,
        clock: Clock | None = None,
        paused: bool = False,
        patience: float | None = None,
        may_be_absent: bool = False,
        kept: int = KEPT,
    ) -> None:
        wanted = [check_topic(name) for name in dict.fromkeys([*names, "status"])]
        rates = rates or {}
        self.refusal: str | None = None
        self.absent: str | None = None
        self.rejected = 0
        node = NodeAddress(ns, endpoint, None, run_dir, keys)
        ns = self._ns = node.ns
        self._clock = clock
        self._clock_ns = clock_ns if clock is None else clock.latest_ns
        self._fresh = {topic.name: Freshness(rates.get(topic.name), topic.periodic) for topic in wanted}
        self._types = {topic.name: topic.type for topic in wanted}
        self.refused: dict[str, str] = {}
        self._kept: dict[str, deque[Received]] = {topic.name: deque(maxlen=kept) for topic in wanted}
        self._arrived = threading.Condition()
        self._wakes: list[Callable[[], None]] = []
        self._stopping = threading.Event()
        self._names = {topics.full_name(ns, name): name for name in self._kept}
        self._asked = _ALWAYS if paused else frozenset(self._kept)
        self._find = node.data
        self._resources = ExitStack()  # holds the socket; only the receiver thread uses it once it runs
        self._socket: zmq.Socket[bytes] | None = None  # before there is a node
        self._address: Address | None = None
        if may_be_absent and endpoint is None:
            self._look_for_node()
            if self.refusal is not None:
                raise UsageError(self.refusal)
        else:
            patience = self._patience if patience is None else patience
            self._connect(found(self._find, time.monotonic() + patience))
        turn = self._receive_next, self._stopping, "sags-subscriber"
        self._thread = threading.Thread(target=go_on, args=turn, name="sags-subscriber", daemon=True)
        self._thread.start()
        atexit.register(self.close)  # the thread must not outlive the interpreter

    @classmethod
    def at(cls, node: NodeAddress, names: Iterable[str], **options: Any) -> Self:
        """Subscribe to this node, which must be running; see the class."""
        usual = {"keys": node.keys, "clock": node.clock, "patience": 0.0}
        return cls(names, node.endpoint, node.ns, node.run_dir, **usual | options)

    @property
    def endpoint(self) -> str:
        """The endpoint of the node, as last known; empty before it was found."""
        return "" if self._address is None else self._address.endpoint

    # ---- what has come ---------------------------------------------------------------------------------

    @overload
    def latest(self, name: TopicName[R]) -> R | None: ...
    @overload
    def latest(self, name: str) -> Received | None: ...
    def latest(self, name: str) -> Received | None:
        """The newest message of a topic, however old it is."""
        with self._arrived:
            return self._newest(name)

    @overload
    def nearest(self, name: TopicName[R], stamp_ns: int) -> R | None: ...
    @overload
    def nearest(self, name: str, stamp_ns: int) -> Received | None: ...
    def nearest(self, name: str, stamp_ns: int) -> Received | None:
        """The one of the newest messages of a topic whose stamp is nearest; None before the first."""
        with self._arrived:
            return min(self._kept[name], key=lambda kept: abs(kept.stamp_ns - stamp_ns), default=None)

    @overload
    def read(self, name: TopicName[R], max_age: float | None = None) -> R: ...
    @overload
    def read(self, name: str, max_age: float | None = None) -> Received: ...
    def read(self, name: str, max_age: float | None = None) -> Received:
        """The newest message of a topic, if it may be shown as new.

        Raises:
            StaleError: it is older than ten periods or `max_age` (s; default 0.5 for what shows a frame),
                fewer than 90 % of the messages arrive, the sender says it is not running, or nothing came.
        """
        with self._arrived:
            problem = self._problem(name, max_age)
            newest = self._newest(name)
        if problem is not None or newest is None:
            raise StaleError(f"{topics.full_name(self._ns, name)} is stale: {problem}")
        return newest

    def problem(self, name: str, max_age: float | None = None) -> str | None:
        """Why `read` of this topic would raise; None when it would not."""
        with self._arrived:
            return self._problem(name, max_age)

    def ok(self, name: str) -> bool:
        """True while the newest message of a topic may be shown as new."""
        return self.problem(name) is None

    def lost(self, name: str) -> int:
        """Messages of a topic that were sent and never came, seen as gaps in `seq`."""
        with self._arrived:
            return self._fresh[name].lost

    def period(self, name: str) -> float:
        """Seconds between two messages of a topic."""
        with self._arrived:
            return self._fresh[name].period

    def now_ns(self) -> int:
        """Return the latest time (ns) that the node's clock may show now, for `Received.age`."""
        return self._clock_ns()

    @contextmanager
    def notified(self, wake: Callable[[], None]) -> Iterator[None]:
        """Let the receiver thread call `wake` for every message during the block; it must return quickly."""
        with self._arrived:
            self._wakes.append(wake)
        try:
            yield
        finally:
            with self._arrived:
                self._wakes.remove(wake)

    def ask(self, names: Iterable[str]) -> None:
        """Receive only these of the topics, and `status`; the node then makes and sends nothing else for this
        client. Takes effect within `POLL_MS`. What is not received meanwhile is not counted as `lost`."""
        self._asked = _ALWAYS | frozenset(names)

    def pause(self) -> None:
        """Receive nothing but `status`, until `resume` or `ask`."""
        self.ask(())

    def resume(self) -> None:
        """Receive all topics again, subscribed in the order in which they were given."""
        self.ask(self._kept)

    def _newest(self, name: str) -> Received | None:
        kept = self._kept[name]
        return kept[-1] if kept else None

    def _newer(self, name: str, after: Received | None) -> Received | None:
        newest = self._newest(name)
        return None if newest is None or (after is not None and newest.meta == after.meta) else newest

    def _frame(self, names: list[str], stamp_ns: int) -> Frame | None:
        kept = ((name, message) for name in names for message in self._kept[name])
        matches = Frame((name, message) for name, message in kept if message.stamp_ns == stamp_ns)
        return matches if len(matches) == len(names) else None

    def _problem(self, name: str, max_age: float | None) -> str | None:
        if (refused := self.refused.get(name)) is not None:  # another thread may take it out
            return refused
        problem = self._fresh[name].problem(self._clock_ns(), max_age)
        if problem is not None:
            status = self._newest("status")
            said = None
            if isinstance(status, ReceivedText) and status.age(self._clock_ns()) <= SILENT_AFTER:
                said = status.why_silent()
            return self.refusal or self.absent or (said if problem != TWO_NODES else None) or problem
        unknown = None if self._clock is None else self._clock.problem
        return unknown or self._sender_problem(name)

    def _sender_problem(self, name: str) -> str | None:
        """Return what the newest `status` says against the newest message of a topic."""
        status, newest = self._newest("status"), self._newest(name)
        if not isinstance(status, ReceivedText) or newest is None or newest.meta.frame_id < 0:
            return None  # nothing is said against what shows no frame
        if newest.meta.session != status.meta.session and newest.received_ns < status.received_ns:
            return "the node was started anew since"
        if newest.meta.epoch < status.meta.epoch:
            return "the recording or the model started anew since"
        return status.invalid()

    # ---- the receiver thread ---------------------------------------------------------------------------

    def _connect(self, address: Address) -> None:
        resources, asked = ExitStack(), self._asked
        prefixes = [full for full, name in self._names.items() if name in asked]
        self._socket, self._watch = resources.enter_context(data_socket(address, prefixes))
        self._resources.close()
        self._resources, self._address, self._subscribed = resources, address, asked
        self.refusal = None  # it was of the node before

    def _receive_next(self) -> None:
        if self._socket is None:
            self._stopping.wait(POLL_MS * 1e-3)
            self._look_for_node()
            return
        self._subscribe(self._socket)
        if self._socket.poll(POLL_MS):
            self._receive_one(self._socket)
        else:
            self.refusal = self._watch.refusal()
            self._look_for_node()

    def _subscribe(self, socket: zmq.Socket[bytes]) -> None:
        """Apply the last `ask` to the socket, on the receiver thread: only that one may use it."""
        asked = self._asked
        if asked == self._subscribed:
            return
        for full, name in self._names.items():
            if (name in asked) != (name in self._subscribed):
                option = zmq.SUBSCRIBE if name in asked else zmq.UNSUBSCRIBE
                socket.setsockopt_string(option, full)
                self._fresh[name].ask_anew()
        self._subscribed = asked

    def _look_for_node(self) -> None:
        """Look for a node that has started, or was restarted elsewhere; called while nothing comes."""
        try:
            address = self._find()
            self.absent = None
            if address != self._address:
                self._connect(address)
        except UsageError as error:  # the new one wants keys, or wants none any more
            self.refusal = str(error)
        except SagsError as error:  # there is none; ZeroMQ goes on trying where the last one was
            self.absent = str(error)

    def _receive_one(self, socket: zmq.Socket[bytes]) -> None:
        self.absent = None
        try:
            message = receive(socket)
            name = self._names.get(message.topic)
            if name is None:  # a subscription is a prefix: that to `depth` also brings `depth_confidence`
                return
            received = interpret(message, self._clock_ns())
            if self._types[name] == topics.COMPRESSED_IMAGE and isinstance(received, ReceivedText):
                self.refused[name] = received.text
                return
            if message.meta.type != self._types[name]:
                raise WireError(f"{message.topic}: not what was subscribed to")
            self.refused.pop(name, None)
        except WireError:
            with self._arrived:
                self.rejected += 1
            return
        with self._arrived:
            if self._fresh[name].accept(received.meta):
                self._kept[name].append(received)
                self._arrived.notify_all()
                for wake in self._wakes:
                    wake()

    def close(self) -> None:
        """End the receiver thread; what has come stays readable."""
        atexit.unregister(self.close)
        self._stopping.set()
        self._thread.join()
        self._resources.close()


class Subscriber(Receiver, Closes):
    """Receives topics in the background; `latest`, `read`, `wait` and `aligned` give what has come.

    Arguments and errors: see `Receiver`. Any number of threads may ask.
    """

    _patience = 10.0

    @overload
    def wait(self, name: TopicName[R], timeout: float, after: Received | None = None) -> R | None: ...
    @overload
    def wait(self, name: str, timeout: float, after: Received | None = None) -> Received | None: ...
    def wait(self, name: str, timeout: float, after: Received | None = None) -> Received | None:
        """Wait for a message newer than `after`, and return the newest one; None after `timeout` s."""
        with self._arrived:
            return self._arrived.wait_for(lambda: self._newer(name, after), timeout)

    def aligned(self, names: Iterable[str], stamp_ns: int, timeout: float = 0.0) -> Frame | None:
        """The messages of several topics that show the frame captured at `stamp_ns`.

        None when one of them has not come within `timeout` seconds.
        """
        wanted = list(names)
        with self._arrived:
            return self._arrived.wait_for(lambda: self._frame(wanted, stamp_ns), timeout)
