"""A socket that receives messages of other programs in the format of `wire`, and tells them what is wrong.

A sender connects with DEALER, and sends messages as the node itself publishes them. Once a second it gets a
`wire.Receipt`. The socket waits for nobody: of messages that come too fast the newest are taken.
"""

from __future__ import annotations

import logging
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable
from contextlib import ExitStack
from dataclasses import dataclass
from math import inf
from typing import TYPE_CHECKING, NamedTuple

import msgspec
import zmq

from sags_node.errors import SagsError
from sags_node.messaging import wire
from sags_node.messaging.peers import Peers
from sags_node.messaging.security import RateLimitedLog, authenticated, check_endpoint
from sags_node.messaging.sockets import bind, limit
from sags_node.messaging.wire import Message
from sags_node.types import Finding
from sags_node.workers import go_on

if TYPE_CHECKING:
    from sags_node.config.schema import Guarded

log = logging.getLogger(__name__)

MAX_PART_BYTES = 64 << 20  # an image of 4096 x 4096 px, 4 bytes each
MAX_UNTAKEN_BYTES = 4 * MAX_PART_BYTES  # of a peer that may wait unread
RECEIVE_HIGH_WATER = 8  # messages of a sender that wait in the socket
SEND_HIGH_WATER = 4
MOST_AT_ONCE = 64  # messages read in one go
POLL_MS = 100  # after which the thread notices that it should end
RECEIPT_S = 1.0
FORGOTTEN_S = 10.0  # of silence, after which a sender is forgotten
ALONE_S = 1.0  # after a program's last message, until another one may send the same

Take = Callable[[Message, int], None]


class _Holder(NamedTuple):
    sender: _Sender
    session: str
    heard: float


@dataclass(slots=True)
class _Sender:
    heard: float
    due: float
    taken: int = 0
    refused: int = 0
    overtaken: int = 0
    problem: str | None = None
    second: float = -inf  # when it last sent what another program sends, too


class Inbox:
    """Receives in a thread of its own, from the start to `close`.

    Args:
        endpoint: to bind.
        config: who may send.
        section: of the launch file that holds both.
        take: called with each message and its arrival (wall clock, ns). It raises `SagsError` for what it
            refuses; the sender gets the text.
        advice: returns what a sender is told if nothing was refused; None: nothing.
        newest: how many waiting messages of each topic are taken, the newest ones; 0: all.
        about: returns what in a message only one program may send at a time. A second program is refused,
            and both are told.

    Raises:
        UsageError: the endpoint is open to other machines without keys, or a key file cannot be used.
        SagsError: the endpoint is taken.
    """

    def __init__(
        self,
        endpoint: str,
        config: Guarded,
        section: str,
        take: Take,
        advice: Callable[[], str | None] = lambda: None,
        newest: int = 0,
        about: Callable[[Message], Iterable[str]] = lambda message: (),
    ) -> None:
        check_endpoint(endpoint, config, section)
        self._section = section
        self._take, self._advice, self._newest = take, advice, newest
        self._about = about
        self._senders: dict[bytes, _Sender] = {}
        self._holders: dict[str, _Holder] = {}
        self._two = "", -ALONE_S  # what is said of two equal senders, and when the second last sent
        self._refused = "", -ALONE_S  # why a message was refused, and when
        self._seldom = RateLimitedLog()
        self._stopping = threading.Event()
        self._resources = ExitStack()
        context = zmq.Context()
        self._resources.callback(context.destroy, linger=0)
        try:
            gate = self._resources.enter_context(authenticated(context, config, section))
            self._socket = context.socket(zmq.ROUTER)
            limit(self._socket, SEND_HIGH_WATER, RECEIVE_HIGH_WATER, MAX_PART_BYTES)
            self._socket.setsockopt(zmq.RCVBUF, -1)  # the system's: images are large
            self._peers = Peers(self._socket, section, MAX_UNTAKEN_BYTES, gate.revocations)
            self._resources.callback(self._peers.close)
            self.endpoint = bind(self._socket, endpoint, f"{section}.endpoint", gate.keys)
        except BaseException:
            self._resources.close()
            raise
        self._thread = threading.Thread(
            target=go_on, args=(self._receive, self._stopping, section), name="inbox", daemon=True
        )
        self._thread.start()

    @property
    def findings(self) -> tuple[Finding, ...]:
        """What is wrong with the senders, and how to fix it. May be read from any thread."""
        for code, (said, when) in (("two_senders", self._two), ("sent_refused", self._refused)):
            if time.monotonic() - when < 2 * ALONE_S:
                return (Finding(code, said),)
        return ()

    def close(self) -> None:
        """End the thread and close the socket."""
        self._stopping.set()
        self._thread.join()
        self._resources.close()

    # ---- the receiving thread --------------------------------------------------------------------------

    def _receive(self) -> None:
        if self._socket.poll(POLL_MS):
            for sender, message, arrival_ns in self._waiting():
                try:
                    things = tuple(self._about(message))
                    self._refuse_second(sender, message.meta.session, things)
                    self._take(message, arrival_ns)
                    holder = _Holder(sender, message.meta.session, time.monotonic())
                    self._holders.update(dict.fromkeys(things, holder))
                    sender.taken += 1
                except SagsError as error:
                    self._refuse(sender, str(error))
        self._tell()

    def _refuse_second(self, sender: _Sender, session: str, things: tuple[str, ...]) -> None:
        """Refuse all messages of the second of two programs that send the same: images of both must not
        become a stereo pair.

        Raises:
            SagsError: this is the second program.
        """
        now = time.monotonic()
        for thing in things:
            holder = self._holders.get(thing)
            if holder is None or now - holder.heard > ALONE_S:
                continue
            if holder.sender is not sender or holder.session != session:
                said = f"two programs send {thing}: end one of them"
                self._two, holder.sender.problem, sender.second = (said, now), said, now
        if things and now - sender.second < ALONE_S:
            raise SagsError(f"{self._two[0]}; the other's is taken")

    def _waiting(self) -> list[tuple[_Sender, Message, int]]:
        """Return the messages that have come, in order; only the newest of each sender and topic."""
        came: list[tuple[_Sender, Message, int]] = []
        for identity, *frames in self._peers.waiting(MOST_AT_ONCE, wire.MAX_PARTS + 1):
            arrival_ns = time.time_ns()
            sender = self._sender(identity.bytes)
            try:
                came.append((sender, wire.decode([frame.buffer for frame in frames]), arrival_ns))
            except wire.WireError as error:
                self._refuse(sender, str(error))
        if not self._newest:
            return came
        kept, counts = [], Counter[tuple[int, str]]()
        for one in reversed(came):
            topic = id(one[0]), one[1].topic
            counts[topic] += 1
            if counts[topic] <= self._newest:
                kept.append(one)
            else:
                one[0].overtaken += 1
        return kept[::-1]

    def _sender(self, identity: bytes) -> _Sender:
        now = time.monotonic()
        sender = self._senders.setdefault(identity, _Sender(now, now + RECEIPT_S))
        sender.heard = now
        return sender

    def _refuse(self, sender: _Sender, why: str) -> None:
        sender.refused += 1
        sender.problem = why
        said = f"{self._section} {self.endpoint}: left out: {why}"
        if self._section == "source":  # a robot may send poses that nobody asked for
            self._refused = said, time.monotonic()
        if self._seldom.due():
            log.warning("%s", said)

    def _tell(self) -> None:
        now = time.monotonic()
        for identity, sender in list(self._senders.items()):
            if now - sender.heard > FORGOTTEN_S:
                del self._senders[identity]
            elif now >= sender.due:
                sender.due = now + RECEIPT_S
                problem, sender.problem = sender.problem or self._advice(), None
                receipt = wire.Receipt(
                    taken=sender.taken, refused=sender.refused, overtaken=sender.overtaken, problem=problem
                )
                try:
                    self._socket.send_multipart([identity, msgspec.msgpack.encode(receipt)], zmq.NOBLOCK)
                except zmq.ZMQError as error:  # the sender is gone or does not read: its own loss
                    log.debug("a receipt was not sent: %s", error)
