"""A server for OpenIGTLink peers that keeps the newest of each device for each of them.

pyigtl's own holds a hundred messages, serves one peer and takes over the signals of its process.
"""

from __future__ import annotations

import logging
import selectors
import socket
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field

from sags_node.bridge import igtl
from sags_node.errors import SagsError
from sags_node.messaging.security import RateLimitedLog

MOST_PEERS = 8
SEND_BUFFER = 1 << 18  # bytes in the kernel: less than a picture, so that nothing old waits there
READ_AT_ONCE = 1 << 16
LOOK = 0.05  # s between calls of `idle`

log = logging.getLogger(__name__)

Hear = Callable[[igtl.Said], None]


@dataclass(slots=True)
class _Peer:
    socket: socket.socket
    name: str
    waiting: dict[str, tuple[bytes, float]] = field(default_factory=dict)  # device: message, monotonic limit
    sending: bytes | memoryview = b""  # the rest of the message that has begun
    came: bytearray = field(default_factory=bytearray)


class Peers:
    """Listens from its own thread, from `start` until it is closed.

    Args:
        port: 0 for any free one.
        hear: called with what peers send, from that thread.
        idle: called there every `LOOK` s.

    Raises:
        SagsError: the address cannot be bound.
    """

    def __init__(self, host: str, port: int, hear: Hear, idle: Callable[[], None]) -> None:
        self._hear, self._idle = hear, idle
        self._lock = threading.Lock()
        self._peers: dict[socket.socket, _Peer] = {}
        self._greeting: tuple[str, bytes] | None = None
        self._seldom = RateLimitedLog()
        try:
            family = socket.AF_INET6 if ":" in host else socket.AF_INET
            self._listener = socket.create_server((host, port), family=family, backlog=MOST_PEERS)
        except OSError as error:
            raise SagsError(
                f"cannot listen on {host} port {port}: {error.strerror}; choose another --port (0: any)"
            ) from None
        self._listener.setblocking(False)
        self.port = int(self._listener.getsockname()[1])
        self._bell, self._ring = socket.socketpair()  # a byte in it wakes the thread
        self._bell.setblocking(False)
        self._ring.setblocking(False)
        self._selector = selectors.DefaultSelector()
        for readable in (self._listener, self._bell):
            self._selector.register(readable, selectors.EVENT_READ)
        self._stopping = False
        self._thread = threading.Thread(target=self._serve, name="sags-igtl-peers", daemon=True)

    def start(self) -> None:
        """Let peers in."""
        self._thread.start()

    def __len__(self) -> int:
        """How many are connected."""
        return len(self._peers)

    def send(self, device: str, message: bytes, valid: float = float("inf")) -> None:
        """Give the newest message of a device to all peers, in place of one that still waits.

        Args:
            valid: s from now on, after which it is not begun any more.
        """
        limit = time.monotonic() + valid
        with self._lock:
            for peer in self._peers.values():
                peer.waiting[device] = (message, limit)
            self._wake()

    def greet(self, device: str, message: bytes) -> None:
        """Give a message to all peers, and to each who comes later."""
        self._greeting = (device, message)
        self.send(device, message)

    def close(self) -> None:
        """Cut all connections. What is sent from now on goes nowhere."""
        with self._lock:
            self._stopping = True
        self._thread.join()  # it looks every `LOOK` s
        self._bell.close()
        self._ring.close()

    # ---- the thread ----------------------------------------------------------------------------------------

    def _wake(self) -> None:
        """Under the lock: after `_stopping` the bell may be gone."""
        if self._stopping:
            return
        try:
            self._ring.send(b"\0")
        except BlockingIOError:
            pass  # it is awake

    def _serve(self) -> None:
        next_idle = 0.0
        while not self._stopping:
            for key, events in self._selector.select(LOOK):
                found = key.fileobj
                assert isinstance(found, socket.socket)
                if found is self._bell:
                    self._bell.recv(4096)
                elif found is self._listener:
                    self._accept()
                else:
                    self._attend(self._peers[found], events)
            if time.monotonic() >= next_idle:
                next_idle = time.monotonic() + LOOK
                self._idle()
            self._watch_writable()
        for peer in list(self._peers.values()):
            self._drop(peer)
        self._listener.close()
        self._selector.close()

    def _accept(self) -> None:
        try:
            accepted, address = self._listener.accept()
        except OSError:  # it has gone again
            return
        if len(self._peers) >= MOST_PEERS:
            accepted.close()
            if self._seldom.due():
                log.warning("refused %s: %d are connected already", address[0], MOST_PEERS)
            return
        accepted.setblocking(False)
        accepted.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER)
        accepted.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        accepted.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        peer = _Peer(accepted, f"{address[0]}:{address[1]}")
        with self._lock:
            if self._greeting is not None:
                device, message = self._greeting
                peer.waiting[device] = (message, float("inf"))
            self._peers[accepted] = peer
        self._selector.register(accepted, selectors.EVENT_READ)

    def _attend(self, peer: _Peer, events: int) -> None:
        try:
            if events & selectors.EVENT_READ and not self._read(peer):
                self._drop(peer)
                return
            if events & selectors.EVENT_WRITE:
                self._write(peer)
        except BlockingIOError:
            return
        except OSError:  # it is gone
            self._drop(peer)

    def _read(self, peer: _Peer) -> bool:
        """Take in what a peer says; False when it has gone, or speaks another language."""
        came = peer.socket.recv(READ_AT_ONCE)
        peer.came += came
        while len(peer.came) >= igtl.HEADER_BYTES:
            head = igtl.header(bytes(peer.came[: igtl.HEADER_BYTES]))
            if head is None:
                if self._seldom.due():
                    log.warning("%s was cut off: it sent no OpenIGTLink, or a large message", peer.name)
                return False
            end = igtl.HEADER_BYTES + head.body_bytes
            if len(peer.came) < end:
                break
            heard = igtl.said(head, bytes(peer.came[igtl.HEADER_BYTES : end]))
            del peer.came[:end]
            if heard is not None:
                self._hear(heard)
        return bool(came)

    def _write(self, peer: _Peer) -> None:
        """Go on with the message that has begun; else begin the one that waits longest and is still new."""
        if not peer.sending:
            with self._lock:
                for device in list(peer.waiting):
                    message, limit = peer.waiting.pop(device)
                    if time.monotonic() < limit:
                        peer.sending = memoryview(message)
                        break
        if peer.sending:
            peer.sending = memoryview(peer.sending)[peer.socket.send(peer.sending) :]

    def _watch_writable(self) -> None:
        """Be woken by the peers that have something to get."""
        for peer in self._peers.values():
            owed = bool(peer.sending) or bool(peer.waiting)
            events = selectors.EVENT_READ | (selectors.EVENT_WRITE if owed else 0)
            if self._selector.get_key(peer.socket).events != events:
                self._selector.modify(peer.socket, events)

    def _drop(self, peer: _Peer) -> None:
        self._selector.unregister(peer.socket)
        with self._lock:
            del self._peers[peer.socket]
        peer.socket.close()
