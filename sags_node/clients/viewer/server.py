"""viser on this machine only: it has no keys, so nobody else may reach it."""

from __future__ import annotations

import re
import socket
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout
from functools import partial
from io import StringIO

import viser
import websockets.asyncio.server

from sags_node.errors import SagsError, UsageError
from sags_node.messaging.security import is_loopback


class _LocalServer(viser.ViserServer):
    def request_share_url(self, verbose: bool = True) -> None:
        """viser would tunnel the page through a server on the internet; any browser may ask for that."""


@contextmanager
def serving(host: str, port: int, insecure: bool) -> Iterator[tuple[viser.ViserServer, str]]:
    """The server and its address, until the end of the block.

    On loopback, only pages of this server may open its websocket: else any page that the user has open could
    read the pictures and press the buttons. With `insecure` the page may have any name, as this machine may.

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
    url = f"http://{f'[{host}]' if ':' in host else host}:{port}"
    names = "|".join(map(re.escape, (f"[{host}]" if ":" in host else host, "127.0.0.1", "localhost")))
    origin = re.compile(rf"https?://.*:{port}" if insecure else rf"http://({names}):{port}")
    with redirect_stdout(StringIO()), _only_from(origin):
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


@contextmanager
def _only_from(origin: re.Pattern[str]) -> Iterator[None]:
    """viser has no setting for the origins it accepts; websockets has, so it is set on the way there."""
    serve = websockets.asyncio.server.serve
    websockets.asyncio.server.serve = partial(serve, origins=[origin])  # type: ignore[assignment, misc]  # as above
    try:
        yield
    finally:
        websockets.asyncio.server.serve = serve  # type: ignore[misc]  # as above
