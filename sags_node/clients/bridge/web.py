"""`sags bridge web`: the node's own messages by WebSocket, for browsers and whatever else has no ZeroMQ.

docs/bridges.md says what goes over it. Each peer has a thread and a relay of its own. A message is sent once
the one before has left, so a slow peer misses some, and no other waits for it.
"""

import http
import logging
import re
import socket
import struct
import threading
from collections.abc import Callable, Mapping
from contextlib import closing, suppress
from dataclasses import dataclass
from importlib import resources
from typing import Any

import msgspec
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response
from websockets.sync.server import Server, ServerConnection, serve

from sags_node.clients.bridge.relay import LOOK, Feed, Outlet, Output, Relay, ServerOptions, Source
from sags_node.clients.bridge.requests import Requests
from sags_node.errors import SagsError, UsageError
from sags_node.messaging.received import Frame
from sags_node.messaging.stream import check_topic

MOST_PEERS = 16  # connections; a page takes some for a moment while it is loaded
MOST_TOPICS = 16  # of one peer
LONGEST_MESSAGE = 1 << 14  # bytes of one message of a peer
SEND_BUFFER = 1 << 18  # bytes in the kernel, so that little waits there that gets old
STUCK = struct.pack("@ll", 3, 0)  # s and us: who takes nothing for so long is cut off
HANDSHAKE = 3.0  # s
ALIVE = 5.0  # s between two pings, and for the answer
SOCKET = "/ws"
PAGE = {"/": ("index.html", "text/html"), "/sags.js": ("sags.js", "text/javascript")}
PINNING = ("add_anchor", "remove_anchor")  # what peers may ask of the node, with --pin


@dataclass(frozen=True, slots=True)
class WebOptions(ServerOptions):
    """How `sags bridge web` runs."""

    port: int = 8766
    pin: bool = False  # let peers pin anchors
    origins: tuple[str, ...] = ()  # of pages that may connect, beside our own


class _Said(msgspec.Struct):
    """What a peer says: which topics it wants from now on, or a request as on the control socket."""

    subscribe: list[str] | None = None
    id: int | None = None
    op: str = ""
    args: dict[str, Any] = {}


log = logging.getLogger(__name__)
_unheard = logging.getLogger(f"{__name__}.peers")  # of every stranger that leaves without a word
_unheard.disabled = True
_decoder = msgspec.json.Decoder(_Said)


def run_web(options: WebOptions, ready: Callable[[str, int], None], stop: threading.Event) -> None:
    """Serve WebSocket peers until `stop` is set. The node may come later and be restarted.

    Args:
        ready: called with the host and the port once peers can connect.

    Raises:
        UsageError: wrong keys.
        SagsError: the port cannot be bound, or an endpoint is malformed.
    """
    for sender in (options.overlay, options.node):  # what is wrong is said now, not to the first peer
        Feed((), sender, options.max_age, lambda: None).close()
    with closing(Requests(options.node)) as requests:
        server, port = _served(options, requests, stop)
        serving = threading.Thread(target=server.serve_forever, name="sags-web")
        serving.start()
        try:
            ready(options.host, port)
            stop.wait()
        finally:
            stop.set()
            server.shutdown()
            serving.join()


def _served(options: WebOptions, requests: Requests, stop: threading.Event) -> tuple[Server, int]:
    """A server that is bound and does not serve yet, and its port."""
    listener = options.listen(MOST_PEERS)
    port = int(listener.getsockname()[1])
    own = ["127.0.0.1", "localhost", "[::1]", f"[{options.host}]" if ":" in options.host else options.host]
    pages = [re.compile(re.escape(f"http://{host}:{port}")) for host in own]
    pages += [re.compile(re.escape(origin)) for origin in options.origins]
    server = serve(
        lambda connection: Peer(connection, options, requests).attend(stop),
        sock=listener,
        origins=[None, *pages],  # None: a client that is no browser, so it runs no page of somebody else
        process_request=_page,
        compression=None,  # images do not become smaller by that, and it takes long
        open_timeout=HANDSHAKE,
        close_timeout=HANDSHAKE,
        ping_interval=ALIVE,
        ping_timeout=ALIVE,
        max_size=LONGEST_MESSAGE,
        logger=_unheard,
    )
    server.handler = _bounded(server.handler)
    return server, port


def _bounded(handler: Callable[[socket.socket, Any], None]) -> Callable[[socket.socket, Any], None]:
    """Limit the number of connections, including those that have not finished their handshake."""
    places = threading.Semaphore(MOST_PEERS)

    def handle(accepted: socket.socket, address: Any) -> None:
        if not places.acquire(blocking=False):
            accepted.close()
            return
        try:
            handler(accepted, address)
        finally:
            places.release()

    return handle


def _page(connection: ServerConnection, request: Request) -> Response | None:
    """The example page and its client; None: go on as WebSocket."""
    path = request.path.partition("?")[0]
    if path == SOCKET:
        return None
    if path not in PAGE:
        return connection.respond(http.HTTPStatus.NOT_FOUND, f"there are {', '.join(PAGE)} and {SOCKET}\n")
    name, kind = PAGE[path]
    body = resources.files("sags_node.clients.bridge").joinpath("web_page", name).read_bytes()
    headers = {
        "Content-Type": f"{kind}; charset=utf-8",
        "Content-Length": str(len(body)),
        "Cache-Control": "no-store",
        "Connection": "close",
    }
    return Response(http.HTTPStatus.OK, "OK", Headers(headers), body)


class Peer(Outlet):
    """The outlet to one peer, on its thread."""

    def __init__(self, connection: ServerConnection, options: WebOptions, requests: Requests) -> None:
        self._connection, self._options, self._requests = connection, options, requests
        self._missing: frozenset[str] = frozenset()
        self._relay: Relay | None = None
        connection.socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER)
        connection.socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, STUCK)
        connection.socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def attend(self, stop: threading.Event) -> None:
        """Hear what it wants and send it, until it goes or `stop` is set."""
        try:
            while not stop.is_set():
                with suppress(TimeoutError):
                    self._hear(self._connection.recv(timeout=LOOK if self._relay is None else 0))
                if self._relay is not None:
                    self._relay.step()
                    self._relay.wait()
        except ConnectionClosed:
            return
        except SagsError as error:  # the node wants keys, or has been replaced by one that does
            log.warning("%s", error)
            self._connection.close(1011, "the gateway's log says why")
        finally:
            if self._relay is not None:
                self._relay.close()

    # ---- in ------------------------------------------------------------------------------------------------

    def _hear(self, message: str | bytes) -> None:
        try:
            said = _decoder.decode(message)
        except (msgspec.MsgspecError, UnicodeError, RecursionError) as error:
            self._say({"error": f"neither a subscription nor a request: {error}"})
            return
        if said.subscribe is not None:
            self._subscribe(said.subscribe)
        if said.op:
            self._request(said)

    def _subscribe(self, names: list[str]) -> None:
        """Send these topics from now on, and no others."""
        try:
            if len(names) > MOST_TOPICS:
                raise UsageError(f"{len(names)} topics; at most {MOST_TOPICS} come over one connection")
            outputs = [Output(name, (self._source(name),)) for name in dict.fromkeys(names)]
        except UsageError as error:
            self._say({"error": str(error)})
            return
        if self._relay is not None:
            self._relay.close()
        self._missing = frozenset()
        senders = (self._options.node, self._options.overlay)
        self._relay = Relay(senders, outputs, self, self._options.max_age)

    def _source(self, name: str) -> Source:
        """Raises: UsageError: there is no such topic."""
        for ns in (self._options.node.ns, self._options.overlay.ns):
            if name.startswith(f"{ns}/"):
                return Source(ns, check_topic(name.removeprefix(f"{ns}/")).name)
        raise UsageError(f"'{name}' must begin with {self._options.node.ns}/ or {self._options.overlay.ns}/")

    def _request(self, said: _Said) -> None:
        def answer(result: dict[str, Any] | None, words: str) -> None:
            try:
                right = {"ok": True, "result": result}
                self._say({"id": said.id, **(right if result is not None else {"ok": False, "error": words})})
            except ConnectionClosed:
                pass  # it asked and went

        if said.op == "get_clock":  # the node's, as far as it is known here: never behind it
            now_ns = self._options.node.now_ns()
            answer({"received_ns": now_ns, "answered_ns": now_ns}, "")
        elif said.op in PINNING and self._options.pin:
            self._requests.ask(said.op, said.args, answer)
        else:
            there = "get_clock, and with sags bridge web --pin " + " and ".join(PINNING)
            answer(None, f"'{said.op[:64]}' is not passed on; what is: {there}")

    # ---- out -----------------------------------------------------------------------------------------------

    def send(self, output: Output, frame: Frame) -> bool:
        received = frame[output.sources[0].topic]
        head = {
            "topic": received.topic,
            **msgspec.to_builtins(received.meta),
            "parts": [memoryview(part).nbytes for part in received.parts],
        }
        text = msgspec.json.encode(head)
        text += b" " * (-len(text) % 4)  # so that what follows is aligned to 4 bytes
        self._connection.send(b"".join((struct.pack("<I", len(text)), text, *received.parts)))
        return True

    def report(self, missing: Mapping[str, str], shows: bool) -> None:
        for name in missing.keys() - self._missing:
            self._say({"topic": name, "stale": missing[name]})
        self._missing = frozenset(missing)

    def _say(self, words: dict[str, Any]) -> None:
        self._connection.send(msgspec.json.encode(words).decode())
