"""A server for OpenIGTLink peers that keeps, for each peer, the newest message of each device.

pyigtl's own holds a hundred messages, serves one peer and takes over the signals of its process.
"""

import asyncio
import logging
import socket
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field

from sags_node.clients.bridge import igtl
from sags_node.messaging.security import RateLimitedLog

MOST_PEERS = 8
SEND_BUFFER = 1 << 18  # bytes in the kernel: less than an image, so that nothing old waits there
STUCK_MS = 15_000  # a peer that takes nothing for so long is cut off, or such peers would keep others out
LOOK = 0.05  # s between calls of `idle`

log = logging.getLogger(__name__)

Hear = Callable[[igtl.Said], None]


@dataclass(slots=True, eq=False)
class _Peer:
    writer: asyncio.StreamWriter
    waiting: dict[str, tuple[bytes, float]] = field(default_factory=dict)  # device: message, monotonic limit
    owed: asyncio.Event = field(default_factory=asyncio.Event)

    def give(self, device: str, message: bytes, limit: float) -> None:
        self.waiting[device] = (message, limit)
        self.owed.set()


class Peers:
    """Listens from its own thread, from `start` until it is closed.

    Args:
        listener: bound; closed at the end.
        hear: called with what peers send, from that thread.
        idle: called there every `LOOK` s.
    """

    def __init__(self, listener: socket.socket, hear: Hear, idle: Callable[[], None]) -> None:
        self._hear, self._idle = hear, idle
        self._peers: set[_Peer] = set()
        self._greeting: tuple[str, bytes] | None = None
        self._seldom = RateLimitedLog()
        self._listener = listener
        self._loop = asyncio.new_event_loop()
        self._stop = asyncio.Event()
        self._thread = threading.Thread(target=self._run, name="sags-igtl-peers", daemon=True)

    def start(self) -> None:
        """Let peers in."""
        self._thread.start()

    def __len__(self) -> int:
        """The number of peers that are connected."""
        return len(self._peers)

    def send(self, device: str, message: bytes, valid: float = float("inf")) -> None:
        """Give the newest message of a device to all peers, in place of one that still waits.

        Args:
            valid: s from now on, after which sending it is not begun any more.
        """
        limit = time.monotonic() + valid

        def give() -> None:
            for peer in self._peers:
                peer.give(device, message, limit)

        self._call(give)

    def greet(self, device: str, message: bytes) -> None:
        """Give a message to all peers, and to each who comes later."""
        self._greeting = (device, message)
        self.send(device, message)

    def close(self) -> None:
        """Cut all connections. What is sent from now on goes nowhere."""
        self._call(self._stop.set)
        self._thread.join()

    # ---- the thread ----------------------------------------------------------------------------------------

    def _call(self, what: Callable[[], object]) -> None:
        with suppress(RuntimeError):  # the loop has ended
            self._loop.call_soon_threadsafe(what)

    def _run(self) -> None:
        with asyncio.Runner(loop_factory=lambda: self._loop) as runner:
            runner.run(self._serve())

    async def _serve(self) -> None:
        server = await asyncio.start_server(self._attend, sock=self._listener)
        while not self._stop.is_set():
            self._idle()
            with suppress(TimeoutError):
                await asyncio.wait_for(self._stop.wait(), LOOK)
        server.close()
        while self._peers:  # each ends by itself once its connection is gone
            for peer in self._peers:
                peer.writer.transport.abort()
            await asyncio.sleep(0)

    async def _attend(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        name = (writer.get_extra_info("peername") or ["one that has gone"])[0]
        if len(self._peers) >= MOST_PEERS:
            self._warn("refused %s: %d are connected already", name, MOST_PEERS)
            writer.close()
            return
        accepted: socket.socket = writer.get_extra_info("socket")
        accepted.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER)
        accepted.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        accepted.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, STUCK_MS)
        writer.transport.set_write_buffer_limits(0)  # the next message begins when one is in the kernel
        peer = _Peer(writer)
        if self._greeting is not None:
            peer.give(*self._greeting, float("inf"))
        self._peers.add(peer)
        writing = asyncio.ensure_future(self._write(peer))
        try:
            if not await self._read(reader):
                self._warn("%s was cut off: it sent no OpenIGTLink, or a large message", name)
        finally:
            self._peers.discard(peer)
            writing.cancel()
            writer.transport.abort()

    async def _read(self, reader: asyncio.StreamReader) -> bool:
        """Take in what a peer says until it has gone; False when it speaks another language."""
        with suppress(asyncio.IncompleteReadError, OSError):
            while (head := igtl.header(await reader.readexactly(igtl.HEADER_BYTES))) is not None:
                heard = igtl.said(head, await reader.readexactly(head["body_size"]))
                if heard is not None:
                    self._hear(heard)
            return False
        return True

    async def _write(self, peer: _Peer) -> None:
        """Send one message after another, the one that waits longest first; skip those that are too old."""
        with suppress(OSError):  # it has gone: `_read` sees it, too
            while await peer.owed.wait():
                if not peer.waiting:
                    peer.owed.clear()
                    continue
                message, limit = peer.waiting.pop(next(iter(peer.waiting)))
                if time.monotonic() < limit:
                    peer.writer.write(message)
                    await peer.writer.drain()

    def _warn(self, words: str, *args: object) -> None:
        if self._seldom.due():
            log.warning(words, *args)
