"""OpenIGTLink (http://openigtlink.org/protocols/v2), version 1 of the header: its messages, and a server.

pyigtl packs and reads them. Here is what it has not: STATUS, a check of what strangers send, and a server
that keeps the newest of each device for each peer. pyigtl's own holds a hundred messages, serves one peer and
takes over the signals of its process.
"""

from __future__ import annotations

import asyncio
import logging
import socket
import struct
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pyigtl.messages import (
    CRC64,
    ImageMessage,
    MessageBase,
    PointMessage,
    PolyDataMessage,
    StringMessage,
    TransformMessage,
)

from sags_node.messaging.security import RateLimitedLog
from sags_node.types import F64, U8

HEADER_BYTES = 58
MAX_BODY_BYTES = 65536  # of what peers send: requests and points
OK, NOT_READY = 1, 13  # codes of STATUS
NONE = "none"  # the name of the point that stands for none
MOST_PEERS = 8
SEND_BUFFER = 1 << 18  # bytes in the kernel: less than a picture, so that nothing old waits there
LOOK = 0.05  # s between calls of `idle`
_BAD_BYTES = (struct.error, ValueError, TypeError, IndexError)  # what pyigtl raises for a stranger's body

log = logging.getLogger(__name__)


class Status(MessageBase):  # type: ignore[misc]  # pyigtl has no types
    """STATUS: a code, and the words for it."""

    def __init__(self, code: int, words: str) -> None:
        super().__init__()
        self._message_type, self._valid_message = "STATUS", True
        self._code, self._words = code, words

    def _pack_content(self) -> bytes:
        name = b"" if self._code == OK else b"not ready"
        return struct.pack(">Hq20s", self._code, 0, name) + _ascii(self._words).encode() + b"\0"


def image(picture: U8, T_ras_pixel: F64) -> MessageBase:
    """IMAGE of a picture [H, W, C] uint8; `T_ras_pixel` [4, 4] takes (column, row, 0, 1) to mm."""
    return ImageMessage(picture[None], T_ras_pixel, "ras")


def transform(T: F64) -> MessageBase:
    """TRANSFORM of a pose [4, 4], mm."""
    return TransformMessage(T)


def points(places: F64, names: Sequence[str] = (), colors: Sequence[Sequence[int]] = ()) -> MessageBase:
    """POINT: named places [N, 3] (mm) with colours RGBA; of none, one that cannot be seen.

    A list without points has no body, and receivers pass over it: what they showed would stand.
    """
    if len(places) == 0:
        places, names, colors = np.zeros((1, 3)), (NONE,), ((0, 0, 0, 0),)
    message = PointMessage(places, list(names), colors)
    message.groups = "SAGS"
    return message


def surface(places: F64, triangles: NDArray[np.int64]) -> MessageBase:
    """POLYDATA: corners [N, 3] (mm) and triangles [M, 3]; both may be empty."""
    return PolyDataMessage(
        points=places, polygons=np.insert(triangles, 0, 3, axis=1).ravel().astype(np.uint32)
    )


def string(words: str) -> MessageBase:
    """STRING."""
    return StringMessage(_ascii(words))


def packed(message: MessageBase, device: str, seconds: float) -> bytes:
    """A message of this device and time."""
    message.device_name, message.timestamp = device, seconds
    return bytes(message.pack())


@dataclass(frozen=True, slots=True)
class Said:
    """What a peer sent."""

    kind: str
    device: str
    text: str = ""  # of STRING
    points: tuple[tuple[str, F64], ...] = ()  # of POINT: name, place [3] mm


def header(raw: bytes) -> dict[str, Any] | None:
    """The fields of the header in 58 bytes from anybody, see `MessageBase.parse_header`, and its `crc`; None
    when it is none, or announces too much."""
    try:
        fields: dict[str, Any] = MessageBase.parse_header(raw)
    except UnicodeDecodeError:
        return None
    if not 1 <= fields["header_version"] <= 3 or fields["body_size"] > MAX_BODY_BYTES:
        return None
    return fields | {"crc": int.from_bytes(raw[-8:])}


def said(head: dict[str, Any], body: bytes) -> Said | None:
    """Return what a message says, if it is a STRING or a POINT; None for other kinds and for damaged ones."""
    kind, device = head["message_type"], head["device_name"]
    if kind not in ("STRING", "POINT") or CRC64(body) != head["crc"]:
        return None
    message: Any = MessageBase.create_message(kind)
    try:
        message.unpack(head, body)
    except _BAD_BYTES:
        return None
    if kind == "STRING":
        return Said(kind, device, text=message.string)
    places = [np.array(place, np.float64) for place in message.positions]
    named = zip(message.names, places, strict=True)
    return Said(kind, device, points=tuple((n, p) for n, p in named if np.isfinite(p).all()))


def _ascii(words: str) -> str:
    """pyigtl cannot pack others, and Slicer shows these."""
    return words.encode("ascii", "replace").decode()


# ---- a server for them -----------------------------------------------------------------------------------


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

    def __init__(
        self, listener: socket.socket, hear: Callable[[Said], None], idle: Callable[[], None]
    ) -> None:
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
        """How many are connected."""
        return len(self._peers)

    def send(self, device: str, message: bytes, valid: float = float("inf")) -> None:
        """Give the newest message of a device to all peers, in place of one that still waits.

        Args:
            valid: s from now on, after which it is not begun any more.
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
            while (head := header(await reader.readexactly(HEADER_BYTES))) is not None:
                heard = said(head, await reader.readexactly(head["body_size"]))
                if heard is not None:
                    self._hear(heard)
            return False
        return True

    async def _write(self, peer: _Peer) -> None:
        """Send the one that waits longest, of those that are still new, one after the other."""
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
