"""The peers of a bound socket, from ZeroMQ's socket monitor: counted, limited in number, and expelled."""

import ctypes
import logging
import os
import socket as sockets
import struct
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import zmq
from zmq.utils.monitor import recv_monitor_message

from sags_node.messaging.security import RateLimitedLog
from sags_node.messaging.sockets import HANDSHAKES, waiting
from sags_node.workers import go_on

MAX_PEERS = 64  # of one socket; ZeroMQ has no such limit of its own
SMALL_TALK = 1024  # bytes per second that a peer may send besides its messages: heartbeats
QUARANTINE = 2.0  # s without new tcp peers after a flood; its sender would be back at once
CHECK_MS = 20  # between checks for a flood
MAX_EVENTS_AT_ONCE = 1000

_ADDRESS_BYTES = 16  # of sockaddr_in
_BYTES_RECEIVED = 128  # where tcpi_bytes_received lies in Linux's struct tcp_info
_libc = ctypes.CDLL(None)

log = logging.getLogger(__name__)


@dataclass(slots=True)
class _Peer:
    connection: sockets.socket  # a duplicate, so that its descriptor is not reused for another peer
    since: float
    taken: int = 0  # bytes of its messages that the node has read
    expelled: bool = False

    @property
    def is_local(self) -> bool:
        """Tell whether it is connected by ipc, and so is a process of the same user."""
        return self.connection.family == sockets.AF_UNIX

    @property
    def sent(self) -> int:
        """Bytes that a tcp peer has sent so far; 0 for ipc."""
        if self.is_local:
            return 0
        info = self.connection.getsockopt(sockets.IPPROTO_TCP, sockets.TCP_INFO, _BYTES_RECEIVED + 8)
        return int(struct.unpack_from("=Q", info, _BYTES_RECEIVED)[0])


class Peers:
    """Follows the connections of one bound socket, from a thread of its own.

    libzmq reads subscriptions on the thread that uses the socket, and does not return while they keep coming.
    So that thread could not stop a flood.

    Args:
        socket: not yet bound.
        name: of the socket, for the log.
        max_untaken: bytes a tcp peer may have sent beyond what `waiting` has read. This bounds what ZeroMQ
            itself does not: the number of parts of a message, and of subscriptions.
        revocations: how often keys were revoked. When it grows, all tcp peers must connect anew.
    """

    def __init__(
        self,
        socket: zmq.Socket[bytes],
        name: str,
        max_untaken: int,
        revocations: Callable[[], int] = lambda: 0,
    ) -> None:
        self._socket = socket
        self._monitor = socket.get_monitor_socket(zmq.EVENT_ACCEPTED | zmq.EVENT_DISCONNECTED | HANDSHAKES)
        self._name = name
        self._max_untaken = max_untaken
        self._revocations, self._revoked = revocations, revocations()
        self._open: dict[int, _Peer] = {}  # by the file descriptor that libzmq has
        self._count: Counter[str] = Counter()
        self._closed_until = 0.0
        self._seldom = RateLimitedLog()
        self._stopping = threading.Event()
        self._thread = threading.Thread(
            target=go_on, args=(self._follow, self._stopping, name), name=f"sags-{name}-peers", daemon=True
        )
        self._thread.start()

    def counts(self) -> dict[str, int]:
        """The numbers of open connections, and of those refused since the start, some by reason.

        `refused` also holds a connection that is in the middle of its handshake; `flooding` counts peers that
        were expelled for sending too much, `too_many` those expelled for want of room or just after a flood.
        """
        return {
            "open": len(self._open),
            "refused": self._count["accepted"] - self._count["admitted"],
            "unlisted_key": self._count["unlisted_key"],
            "too_many": self._count["too_many"],
            "flooding": self._count["flooding"],
        }

    def waiting(self, most: int, most_parts: int) -> Iterator[list[zmq.Frame]]:
        """Read the messages that have arrived, as `sockets.waiting`, and count the bytes of each peer."""
        for frames in waiting(self._socket, most, most_parts):
            if (peer := self._open.get(int(frames[-1].get(zmq.SRCFD)))) is not None:
                peer.taken += sum(len(frame) for frame in frames)
            yield frames

    def close(self) -> None:
        """End the thread. To be called before the socket is closed, on the socket's thread."""
        self._socket.disable_monitor()  # first: libzmq waits for a reader when many events have gathered
        self._stopping.set()
        self._thread.join()
        for peer in self._open.values():
            peer.connection.close()

    def _follow(self) -> None:
        self._monitor.poll(CHECK_MS)
        for _ in range(MAX_EVENTS_AT_ONCE):
            try:
                said = recv_monitor_message(self._monitor, zmq.NOBLOCK)
            except zmq.Again:
                break
            self._note(said["event"], int(said["value"]))
        self._expel_floods()
        before, self._revoked = self._revoked, self._revocations()
        if self._revoked != before:
            self._expel_all()

    def _expel_floods(self) -> None:
        now = time.monotonic()
        for peer in self._open.values():
            allowed = self._max_untaken + peer.taken + SMALL_TALK * (now - peer.since)
            if not peer.expelled and peer.sent > allowed:
                self._expel(peer, "flooding")
                self._closed_until = now + QUARANTINE

    def _expel_all(self) -> None:
        """Cut off all tcp peers. Nothing tells which key each one used, so all must authenticate again."""
        for peer in self._open.values():
            if not peer.expelled and not peer.is_local:
                self._expel(peer, "renewed")

    def _note(self, event: int, value: int) -> None:
        """`value` is the descriptor of a connection that begins or ends."""
        if event == zmq.EVENT_ACCEPTED:
            self._count["accepted"] += 1
            try:
                copy = os.dup(value)
            except OSError:
                return  # it has gone already
            try:
                peer = _Peer(sockets.socket(fileno=copy), time.monotonic())
            except OSError:
                os.close(copy)  # it has gone, and its number is that of another file
                return
            self._open[value] = peer
            closed = peer.since < self._closed_until and not peer.is_local
            if closed or len(self._open) > MAX_PEERS:
                self._expel(peer, "too_many")
        elif event == zmq.EVENT_DISCONNECTED:
            ended = self._open.pop(value, None)
            if ended is not None:
                ended.connection.close()
        elif event == zmq.EVENT_HANDSHAKE_SUCCEEDED:
            self._count["admitted"] += 1
        else:
            self._count["unlisted_key"] += event == zmq.EVENT_HANDSHAKE_FAILED_AUTH
            self._log()

    def _expel(self, peer: _Peer, why: str) -> None:
        """Cut the connection off under libzmq, which then closes its end of it."""
        peer.expelled = True
        self._count[why] += 1
        self._log()
        try:
            peer.connection.shutdown(sockets.SHUT_RDWR)
        except OSError:
            return  # it has gone by itself
        if not peer.is_local:
            # After a shutdown Linux still reads what a tcp peer goes on sending. To connect to no address
            # (AF_UNSPEC) resets the connection.
            _libc.connect(peer.connection.fileno(), bytes(_ADDRESS_BYTES), _ADDRESS_BYTES)

    def _log(self) -> None:
        if self._seldom.due():
            log.warning("%s socket: connections refused since the start: %s", self._name, self.counts())
