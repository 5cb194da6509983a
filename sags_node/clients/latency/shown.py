"""ArUco codes that cameras can read, shown in images that are pushed to a node, or on a web page."""

import http
import json
import math
import sys
import threading
import time
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib import resources
from pathlib import Path
from typing import Annotated, Any

import cv2
import msgspec
import numpy as np

from sags_node.clients.latency.ledger import Ledger, Moment
from sags_node.errors import SagsError
from sags_node.messaging.sender import FrameSender
from sags_node.messaging.sockets import Closes
from sags_node.types import U8

NUMBERS = 1000  # after the last one the first comes again
CELLS = 7  # cells across a code, its black border included
EVERY_MS = 100  # ms that the page shows a code: several exposures, so that one has this code alone
LONGEST = 1024  # bytes of one message of a page
SILENT = 2.0  # s without data, after which a connection is closed

_DICTIONARY = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_1000)  # Garrido-Jurado et al., 2014
Milliseconds = Annotated[float, msgspec.Meta(ge=0, le=1e13)]


def cells(number: int) -> U8:
    """The code of a number as an image [CELLS, CELLS], 0 or 255."""
    return np.asarray(cv2.aruco.generateImageMarker(_DICTIONARY, number % NUMBERS, CELLS), np.uint8)


def paint(picture: U8, number: int) -> None:
    """Paint a number into the upper left corner of an image [H, W, 3], over half of its height."""
    cell = picture.shape[0] // 2 // (CELLS + 2)
    whole = np.pad(cells(number), 1, constant_values=255).repeat(cell, 0).repeat(cell, 1)
    picture[: len(whole), : len(whole)] = whole[..., None]


class Reader:
    """Reads the number of an image."""

    def __init__(self) -> None:
        exact = cv2.aruco.DetectorParameters()
        exact.errorCorrectionRate = 0.0  # two codes in one exposure must not be taken for a third one
        self._detector = cv2.aruco.ArucoDetector(_DICTIONARY, exact)

    def read(self, picture: U8) -> int | None:
        """The number that an image [H, W, 3] shows; None: none, or several."""
        _, ids, _ = self._detector.detectMarkers(cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY))
        return int(ids.ravel()[0]) if ids is not None and len(ids) == 1 else None


class Codes(Closes):
    """Shows one code after the other, and writes down when.

    Attributes:
        ledger: where it is written.
        hint: what to do where none is seen.
        problem: what is known to be wrong.
    """

    ledger: Ledger
    hint: str
    problem: str | None = None

    def step(self, goes_on: bool) -> float:
        """Show the next code if it is due and `goes_on`; return the seconds until the one after it."""
        return math.inf


class Pushed(Codes):
    """Pushes the images of a session to a node, both eyes with a code in the upper left corner.

    Args:
        endpoint: of a node with `source.kind: push`.
        session: folder with `left` and `right`, which are played in turn.
        rate: Hz.
    """

    hint = "does the node take images (source.kind: push), of this size and at this endpoint?"

    def __init__(self, endpoint: str, session: Path, rate: float) -> None:
        self.ledger = Ledger("sent")
        folders = (session / "left", session / "right")
        self._pairs = [
            [_picture(folder / file.name) for folder in folders] for file in sorted(folders[0].iterdir())
        ]
        self._period, self._number, self._due = 1 / rate, 0, time.monotonic()
        self._sender = FrameSender(endpoint)

    def step(self, goes_on: bool) -> float:
        now = time.monotonic()
        if goes_on and now >= self._due:
            pair = [eye.copy() for eye in self._pairs[self._number % len(self._pairs)]]
            for eye in pair:
                paint(eye, self._number)
            at = Moment.now()
            self._sender.send(pair[0], pair[1], at.wall)
            self.ledger.shown(self._number % NUMBERS, at)
            self._number += 1
            self._due = max(self._due + self._period, now)
            self.problem = self._sender.problem
        return max(0.0, self._due - time.monotonic()) if goes_on else math.inf

    def close(self) -> None:
        self._sender.close()


class _Said(msgspec.Struct):
    page: Milliseconds  # since the epoch, when it was loaded
    number: Annotated[int, msgspec.Meta(ge=0, lt=NUMBERS)]
    shown_ms: Milliseconds  # by its own clock, which begins when it is loaded
    now_ms: Milliseconds


class _Server(ThreadingHTTPServer):
    daemon_threads = False  # closing waits for what is being answered, at most `SILENT`

    def handle_error(self, *whose: Any) -> None:
        """Ignore a browser that has gone: that is no error."""
        if not isinstance(sys.exc_info()[1], OSError):
            super().handle_error(*whose)


class Page(Codes):
    """Serves a page on this machine, which shows codes and says when.

    Its message with the least delay gives the offset between its clock and ours, both on this machine.

    Args:
        port: 0: any free one.

    Raises:
        SagsError: the port cannot be bound.
    """

    hint = "open the page on a display, and point the camera at it"

    def __init__(self, port: int) -> None:
        self.ledger = Ledger("displayed")
        self._loaded, self._ahead_ms = 0.0, math.inf  # of the page that shows the codes
        self._lock = threading.Lock()
        page = self

        class Handler(BaseHTTPRequestHandler):
            timeout = SILENT

            def do_GET(self) -> None:
                _answer(self, *page.asked(self.headers.get("Host"), self.path))

            def do_POST(self) -> None:
                came, size = Moment.now(), self.headers.get("Content-Length", "")
                body = self.rfile.read(int(size)) if size.isdecimal() and int(size) <= LONGEST else b""
                own = self.headers.get("Origin") == f"http://{self.headers.get('Host')}"
                _answer(self, *page.told(self.headers.get("Host") if own else None, body, came))

            def log_message(self, *_: Any) -> None: ...

        try:
            self._server = _Server(("127.0.0.1", port), Handler)
        except OSError as error:
            raise SagsError(
                f"cannot listen on port {port}: {error.strerror}; choose another --port"
            ) from None
        self._hosts = [f"{name}:{self._server.server_address[1]}" for name in ("127.0.0.1", "localhost")]
        self.address = f"http://{self._hosts[0]}/"
        self._thread = threading.Thread(
            target=self._server.serve_forever, args=(0.1,), name="sags-latency-page"
        )
        self._thread.start()

    def asked(self, host: str | None, path: str) -> tuple[http.HTTPStatus, str]:
        """Return the page, or why there is none for this host or path."""
        if host not in self._hosts or path != "/":
            return http.HTTPStatus.NOT_FOUND, f"there is {self.address} alone"
        bits = [
            ["".join(str(bit // 255) for bit in row) for row in cells(number)] for number in range(NUMBERS)
        ]
        text = resources.files("sags_node.clients.latency").joinpath("page.html").read_text(encoding="utf-8")
        text = text.replace("/*CODES*/[]", json.dumps(bits)).replace("/*EVERY*/100", str(EVERY_MS))
        return http.HTTPStatus.OK, text

    def told(self, host: str | None, body: bytes, came: Moment) -> tuple[http.HTTPStatus, str]:
        """Note which code a page shows, and since when; a page of another host or an older one is refused."""
        try:
            said = msgspec.json.decode(body, type=_Said)
        except msgspec.MsgspecError:
            return http.HTTPStatus.BAD_REQUEST, "not what the page says"
        with self._lock:
            if host not in self._hosts or said.page < self._loaded:
                return http.HTTPStatus.CONFLICT, "Another page shows the codes."
            if said.page > self._loaded:
                self._loaded, self._ahead_ms = said.page, math.inf
            self._ahead_ms = min(self._ahead_ms, 1e-6 * came.monotonic - said.now_ms)
            ago_s = 1e-9 * came.monotonic - 1e-3 * (said.shown_ms + self._ahead_ms)
            self.ledger.shown(said.number, came.later(-max(0.0, ago_s)))
        return http.HTTPStatus.OK, ""

    def close(self) -> None:
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()


def _answer(request: BaseHTTPRequestHandler, status: http.HTTPStatus, text: str) -> None:
    body = text.encode()
    request.send_response(status)
    request.send_header("Content-Type", f"text/{'html' if text[:1] == '<' else 'plain'}; charset=utf-8")
    request.send_header("Content-Length", str(len(body)))
    request.send_header("Cache-Control", "no-store")
    request.end_headers()
    request.wfile.write(body)


def _picture(file: Path) -> U8:
    picture = cv2.imread(str(file))
    if picture is None:
        raise SagsError(f"{file} is no image that can be read")
    return np.asarray(picture[..., ::-1], np.uint8)
