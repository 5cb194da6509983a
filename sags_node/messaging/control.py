"""Requests to the node: msgpack `{v, id, op, args}` -> `{v, id, ok, result | error}`."""

import logging
import time
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import CancelledError, Future
from dataclasses import dataclass
from functools import partial
from math import inf
from pathlib import Path
from typing import Annotated, Any, Self

import msgspec
import zmq

from sags_node.errors import SagsError, UsageError, brief
from sags_node.messaging.address import Address, ClientKeys, NodeAddress, connect, found
from sags_node.messaging.roles import Client, needed
from sags_node.messaging.security import Gate, RateLimitedLog
from sags_node.messaging.sockets import Closes, waiting
from sags_node.messaging.wire import PROTOCOL

# The most views there may be, each moved as often as it is drawn, make 480 requests a second.
RATE = 500.0  # requests/s
BURST = 300  # at once: all anchors and views there may be, and some more
FORGET_ABOVE = 1000  # clients remembered, before those with a full bucket are forgotten

MAX_REQUEST_BYTES = 65536  # per part
MAX_UNANSWERED_BYTES = 4 << 20  # of one peer that may wait; more than its high-water mark can hold
MAX_REPLY_BYTES = 1 << 20
MAX_REQUEST_PARTS = 4  # identity, the empty delimiter of REQ, the request
MAX_REQUESTS_AT_ONCE = 32  # so that a flood cannot keep the publishing thread from its frames
MAX_PENDING = 64
MAX_PENDING_OF_ONE = MAX_PENDING // 2  # of one client, so that the others are still answered
RECEIVE_HIGH_WATER = 8  # requests one peer may have waiting
SEND_HIGH_WATER = 2 * MAX_REQUESTS_AT_ONCE  # answers, before a peer that does not read loses some
HERE = ("ipc:", "tcp://127.", "tcp://localhost", "tcp://[::1]")  # endpoints of this machine
LOOK_MS = 100  # after which a client notices that its node was restarted
TOO_LATE = "it was not begun in the time that its sender waits, and is not done"
ANONYMOUS = "anonymous"  # what ZeroMQ's authenticator calls a peer without a key
PLAIN = Client("a client without a key")  # it was let in without one, so it may do everything

Handler = Callable[[dict[str, Any]], Any]
Identifier = int | Annotated[str, msgspec.Meta(max_length=128)] | None

log = logging.getLogger(__name__)


class Request(msgspec.Struct, frozen=True):
    v: Annotated[str, msgspec.Meta(pattern=r"^1\.[0-9]{1,4}\Z")]
    id: Identifier
    op: Annotated[str, msgspec.Meta(max_length=64)]
    args: dict[str, Any] = msgspec.field(default_factory=dict)
    # How long its sender waits. A request that has not begun by then is not carried out. On the same machine
    # also by the wall clock: a node whose process was stopped does not know for how long.
    within_s: Annotated[float, msgspec.Meta(ge=-1e308)] | None = None  # which NaN is not
    until_ns: int | None = None

    @property
    def left(self) -> float:
        """The time in which it must begin, s from now."""
        left = inf if self.until_ns is None else (self.until_ns - time.time_ns()) * 1e-9
        return left if self.within_s is None else min(left, self.within_s)


class Reply(msgspec.Struct, frozen=True, omit_defaults=True):
    v: str
    id: Identifier
    ok: bool
    result: Any = None
    error: str | None = None
    code: str | None = None  # of some errors: "not_allowed", "too_often"
    retry_after_s: float | None = None  # of "too_often"


def refused(
    identifier: Identifier, error: str, code: str | None = None, retry_after_s: float | None = None
) -> Reply:
    """Make the reply that says why a request is not carried out."""
    return Reply(PROTOCOL, identifier, False, None, error, code, retry_after_s)


# What msgspec raises for bytes of a stranger: too deep, not hashable as a key, bad UTF-8 or a bad value.
_BAD_BYTES = (msgspec.MsgspecError, UnicodeError, RecursionError, TypeError, ValueError)


@dataclass(frozen=True, slots=True)
class _Sender:
    """The sender of a request.

    Attributes:
        envelope: the frames that route an answer back to it.
        id: its key, or its connection if it has no key.
        client: None: its key was taken off the list a moment ago.
    """

    envelope: list[bytes]
    id: bytes
    client: Client | None


class ControlServer:
    """Answers requests on a ROUTER socket; used from one thread.

    A handler gets `args` and returns the result, or a `Future` of it when another thread must do the work.
    A `SagsError` it raises is the answer; anything else is answered as an internal error and logged.

    Args:
        read: returns what has arrived, given the most messages and parts of each; default: `sockets.waiting`.
        gate: tells which client has a key.

    Attributes:
        refused: number of refused requests, by reason.
    """

    def __init__(
        self,
        socket: zmq.Socket[bytes],
        handlers: Mapping[str, Handler],
        read: Callable[[int, int], Iterable[list[zmq.Frame]]] | None = None,
        gate: Gate = Gate(),  # noqa: B008  it is frozen
    ) -> None:
        self._socket = socket
        self._handlers = handlers
        self._read = read or partial(waiting, socket)
        self._gate = gate
        self._rate = RequestRate()
        self.refused = Counter[str](requests_not_allowed=0, requests_too_often=0)
        self._seldom = RateLimitedLog()
        self._pending: list[tuple[_Sender, Identifier, Future[Any], float]] = []  # and until when, monotonic
        self._request = msgspec.msgpack.Decoder(Request)

    @property
    def pending(self) -> bool:
        """Tell whether the answer of a future is still to be sent."""
        return bool(self._pending)

    def serve(self) -> None:
        """Answer what has arrived and what has been finished, without waiting."""
        for frames in self._read(MAX_REQUESTS_AT_ONCE, MAX_REQUEST_PARTS):
            *envelope, body = (frame.bytes for frame in frames)
            if len(envelope) in (1, 2):
                self._handle(self._sender(frames[-1], envelope), body)
        now = time.monotonic()
        finished = [
            entry for entry in self._pending if entry[2].done() or (entry[3] < now and entry[2].cancel())
        ]
        for sender, identifier, future, _ in finished:
            self._answer(sender, identifier, future.result)
        self._pending = [entry for entry in self._pending if entry not in finished]

    def _sender(self, frame: zmq.Frame, envelope: list[bytes]) -> _Sender:
        try:
            key = str(frame.get("User-Id"))  # as the authenticator said it of this connection
        except zmq.ZMQError:
            key = ANONYMOUS
        if key == ANONYMOUS:
            return _Sender(envelope, envelope[0], PLAIN)
        return _Sender(envelope, key.encode(), self._gate.client(key.encode()))

    def _handle(self, sender: _Sender, body: bytes) -> None:
        try:
            request = self._request.decode(body)
        except _BAD_BYTES as error:
            self._send(sender, refused(None, f"not a request: {error}"))
            return
        too_late = refused(request.id, TOO_LATE) if request.left <= 0 else None
        refusal = too_late or self._refusal(sender, request)
        if refusal is not None:
            self._send(sender, refusal)
            return
        handler = self._handlers[request.op]
        self._answer(sender, request.id, lambda: handler(request.args), time.monotonic() + request.left)

    def _refusal(self, sender: _Sender, request: Request) -> Reply | None:
        """Return the reply to a request that must not be carried out; None: it may be."""
        wait = self._rate.wait(sender.id)
        if wait:
            self._count("requests_too_often", sender, request.op)
            text = f"{RATE:g} requests a second of one client are answered; ask again in {wait:.3f} s"
            return refused(request.id, text, "too_often", wait)
        if request.op not in self._handlers:
            known = ", ".join(sorted(self._handlers))
            return refused(request.id, f"unknown op '{request.op}'; this node knows: {known}")
        client = sender.client
        if client is None:
            return refused(request.id, "this key is no longer in publish.allow", "not_allowed")
        if not client.may(request.op):
            self._count("requests_not_allowed", sender, request.op)
            role = needed(request.op)
            text = (
                f"{request.op} takes the role '{role}', and {client.name} has '{client.role}'; "
                f"move {client.name}.pub into the folder '{role}' of the node's publish.allow"
            )
            return refused(request.id, text, "not_allowed")
        of_sender = sum(waiting.id == sender.id for waiting, *_ in self._pending)
        if len(self._pending) >= MAX_PENDING or of_sender >= MAX_PENDING_OF_ONE:
            return refused(request.id, "too many requests are waiting for an answer; try again later")
        return None

    def _count(self, why: str, sender: _Sender, op: str) -> None:
        self.refused[why] += 1
        if self._seldom.due():
            log.warning("refused %s of %s; since the start: %s", brief(op), sender.client, dict(self.refused))

    def _answer(
        self, sender: _Sender, identifier: Identifier, work: Callable[[], Any], until: float = inf
    ) -> None:
        try:
            result = work()
            if isinstance(result, Future):
                self._pending.append((sender, identifier, result, until))
            else:
                self._send(sender, Reply(PROTOCOL, identifier, True, result=result))
        except SagsError as error:
            self._send(sender, refused(identifier, str(error)))
        except CancelledError:
            self._send(sender, refused(identifier, TOO_LATE))
        except Exception as error:  # a request must not end the node
            log.exception("a control request failed")
            self._send(sender, refused(identifier, f"internal error: {type(error).__name__}: {error}"))

    def _send(self, sender: _Sender, reply: Reply) -> None:
        body = msgspec.msgpack.encode(reply)
        try:
            self._socket.send_multipart([*sender.envelope, body], zmq.NOBLOCK)
        except zmq.ZMQError as error:  # the peer is gone or does not read: its own loss
            log.debug("a reply was not sent: %s", error)


class ControlClient(Closes):
    """Asks the node; one request at a time, from one thread.

    It follows a node that is restarted, also to another port if it was found by its connection file.

    Args:
        endpoint: of the ROUTER socket; default: from the connection file of `ns`.
        keys: for a node that wants them.

    Raises:
        SagsError: no endpoint is known, or it is malformed.
        UsageError: the node wants keys that are not given, or the other way round.
    """

    def __init__(
        self,
        endpoint: str | None = None,
        ns: str = "sags",
        run_dir: Path | None = None,
        keys: ClientKeys | None = None,
    ) -> None:
        self._find = NodeAddress(ns, None, endpoint, run_dir, keys).control_socket
        self._last_id = 0
        self._connect(self._find())

    @classmethod
    def at(cls, node: NodeAddress) -> Self:
        """Make a client of this node; see the class."""
        return cls(node.control, node.ns, node.run_dir, node.keys)

    @property
    def endpoint(self) -> str:
        """The endpoint of the node, as of the last request."""
        return self._address.endpoint

    def request(self, op: str, args: Mapping[str, Any] | None = None, timeout: float = 2.0) -> Any:
        """Request an operation and return its result. A request that may have been carried out is not
        repeated. The node does not begin it after `timeout` s.

        Raises:
            SagsError: the node refused the request (in its words) or this client, was restarted before it
                answered, or did not answer within `timeout` seconds.
            UsageError: it cannot be sent, or the node wants keys that are not given, or the other way round.
        """
        deadline, until_ns = time.monotonic() + timeout, time.time_ns() + round(timeout * 1e9)
        silence = f"no answer from {self.endpoint} in {timeout:g} s; is the node running?"
        self._follow(deadline)
        while not self._socket.poll(LOOK_MS, zmq.POLLOUT):  # queue none for an absent node
            if (refusal := self._watch.refusal()) is not None or time.monotonic() > deadline:
                raise SagsError(refusal or silence)
            self._follow(deadline)
        self._last_id += 1
        is_here = self.endpoint.startswith(HERE)
        asked = Request(PROTOCOL, self._last_id, op, dict(args or {}), timeout, until_ns if is_here else None)
        try:
            request = msgspec.msgpack.encode(asked)
        except (OverflowError, TypeError, UnicodeError) as error:  # more than 64 bits, a lone surrogate
            raise UsageError(f"{op}: what is asked cannot be sent: {error}") from None
        self._socket.send(request, zmq.NOBLOCK)
        while (left := deadline - time.monotonic()) > 0:
            if not self._socket.poll(min(int(left * 1000) + 1, LOOK_MS)):
                if self._has_moved():
                    raise SagsError(f"{op}: the node was started anew before it answered; ask again")
                continue
            try:
                reply = msgspec.msgpack.decode(self._socket.recv(), type=Reply)
            except _BAD_BYTES:
                continue
            if reply.id == self._last_id:  # else: of an earlier one
                wait = reply.retry_after_s
                if wait is not None and time.monotonic() + wait < deadline:  # it was not carried out
                    time.sleep(max(0.0, wait))
                    self._socket.send(request, zmq.NOBLOCK)
                    continue
                if not reply.ok:
                    raise SagsError(f"{op}: {reply.error}")
                return reply.result
        raise SagsError(self._watch.refusal() or silence)

    def _follow(self, deadline: float) -> None:
        """Connect to the node that runs now; wait for one while there is none.

        Raises:
            SagsError: none came in time.
        """
        address = found(self._find, deadline)
        if address != self._address:
            self._context.destroy(linger=0)
            self._connect(address)

    def _has_moved(self) -> bool:
        """Tell whether another node has taken the place of the one that was asked."""
        try:
            return self._find() != self._address
        except SagsError:  # there is none, or it cannot be asked: the next request will say so
            return False

    def _connect(self, address: Address) -> None:
        self._context, self._address = zmq.Context(), address
        self._socket = self._context.socket(zmq.DEALER)
        self._socket.setsockopt(zmq.IMMEDIATE, 1)
        try:
            self._watch = connect(self._socket, address, MAX_REPLY_BYTES)
        except SagsError:
            self.close()
            raise

    def close(self) -> None:
        self._context.destroy(linger=0)


class RequestRate:
    """Limits the requests of each client by a token bucket that fills again at a steady rate.

    Each bucket is full at first. Only the time when it will be full again is kept (GCRA, ITU-T I.371).

    Args:
        clock: s.
    """

    def __init__(
        self, rate: float = RATE, burst: int = BURST, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._rate, self._burst, self._clock = rate, burst, clock
        self._full: dict[bytes, float] = {}  # by client: when its bucket is full again

    def wait(self, client: bytes) -> float:
        """Take a token and return 0. If there is none, return the time until there is one, s."""
        now = self._clock()
        full = max(now, self._full.get(client, now)) + 1 / self._rate
        wait = full - now - self._burst / self._rate
        if wait > 1e-9:  # more than rounding
            return wait
        if len(self._full) >= FORGET_ABOVE:
            self._full = {one: when for one, when in self._full.items() if when > now}
        self._full[client] = full
        return 0.0
