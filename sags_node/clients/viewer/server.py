"""viser on this machine only: it has no keys, so nobody else may reach it."""

import http
import re
import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stdout
from functools import partial
from io import StringIO
from typing import Any

import viser
import websockets.asyncio.server
from websockets.http11 import Request, Response

from sags_node.clients.viewer import cursor, still
from sags_node.errors import SagsError, UsageError
from sags_node.messaging.security import is_loopback

HTTP = 80  # the port that a browser leaves out
# viser 1.1.1 gives two numbers for each corner of a splat's quad, and three.js reads three: it reports a
# bounding sphere of radius NaN, and culls nothing. A large third number is not drawn, and culls nothing, too.
MEND = """<script>
(() => {
  const { head } = document, append = head.appendChild;
  head.appendChild = (node) => {
    if (node.type === "module") node.textContent = node.textContent.replace(
      "Float32Array([-2,-2,2,-2,2,2,-2,2]),2)", "Float32Array([-2,-2,-1e9,2,-2,1e9,2,2,-1e9,-2,2,1e9]),3)");
    return append.call(head, node);
  };
})();
</script>"""


class _LocalServer(viser.ViserServer):
    def request_share_url(self, verbose: bool = True) -> None:
        """Do nothing: viser would tunnel the page through a server on the internet if any browser asks."""


@contextmanager
def serving(host: str, port: int, insecure: bool) -> Iterator[tuple[viser.ViserServer, str]]:
    """The server and its address, until the end of the block.

    Only pages of this server may open its websocket: else any page that the user has open could read the
    images and press the buttons. It answers by its own addresses only: a name that somebody else gave this
    machine would make his page one of ours (DNS rebinding). With `insecure` those are all numbers and the
    machine's name.

    Args:
        port: 0 for any free one.

    Raises:
        UsageError: `host` is not loopback and `insecure` is not given.
        SagsError: the address cannot be bound.
    """
    if not is_loopback(host) and not insecure:
        raise UsageError(
            f"--host {host} would show the video to all who reach it and obey their clicks, without keys; "
            "leave it out and look from elsewhere through ssh -L, or give --insecure"
        )
    port = _bindable(host, port)
    own = f"[{host}]" if ":" in host else host
    url = f"http://{own}:{port}"
    names = [own, "127.0.0.1", "localhost", "[::1]"]
    names += [socket.gethostname(), socket.getfqdn()] if insecure else []
    any_number = [r"[\d.]+", r"\[[\da-f:.]+\]"] if insecure else []  # which nobody can give to this machine
    hosts = rf"({'|'.join([*map(re.escape, names), *any_number])})(:{port}{'|' if port == HTTP else ''})"
    with redirect_stdout(StringIO()), _answering(hosts, url):
        server = _LocalServer(host=host, port=port, verbose=False)
    try:
        if server.get_port() != port:
            raise SagsError(f"port {port} on {host} has just been taken; try again, or another --port")
        yield server, url
    finally:
        with redirect_stdout(StringIO()):
            server.stop()


def _bindable(host: str, port: int) -> int:
    """The port if it can be bound: viser would take another one in silence."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with socket.socket(family, socket.SOCK_STREAM) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except OSError as error:
            raise SagsError(
                f"cannot serve on {host} port {port}: {error.strerror}; choose another --port (0: any)"
            ) from None
        return int(probe.getsockname()[1])


def _answer(
    answer: Callable[[Any, Request], Response | None],
    own: re.Pattern[str],
    url: str,
    connection: Any,
    request: Request,
) -> Response | None:
    """viser's answer, to who asks by an address of our `own`; its page gets our scripts."""
    asked = request.headers.get_all("Host")
    if len(asked) != 1 or own.fullmatch(asked[0]) is None:
        said = f"sags view does not answer by this address. Open {url}; use the same port with ssh -L\n"
        refusal: Response = connection.respond(http.HTTPStatus.FORBIDDEN, said)
        return refusal
    if "Accept-Encoding" in request.headers:
        del request.headers["Accept-Encoding"]  # so that the page can be read here
    response = answer(connection, request)
    if response is not None and b"</head>" in response.body:
        response.body = response.body.replace(
            b"</head>", f"{cursor.SCRIPT}{still.SCRIPT}{MEND}</head>".encode(), 1
        )
        del response.headers["Content-Length"]  # else there are two
        response.headers["Content-Length"] = str(len(response.body))
    return response


@contextmanager
def _answering(hosts: str, url: str) -> Iterator[None]:
    """Patch websockets' `serve`: viser has no setting for whom it answers, nor for its page."""
    serve = websockets.asyncio.server.serve
    own, origin = (re.compile(scheme + hosts, re.IGNORECASE) for scheme in ("", "https?://"))

    def served(*args: Any, process_request: Any, **options: Any) -> Any:
        answer = partial(_answer, process_request, own, url)
        return serve(*args, process_request=answer, origins=[origin], **options)

    websockets.asyncio.server.serve = served  # type: ignore[assignment, misc]  # as above
    try:
        yield
    finally:
        websockets.asyncio.server.serve = serve  # type: ignore[misc]  # as above
