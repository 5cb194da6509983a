"""Brings what the node shows to the browser, at the rate that node, machine and browser can take."""

import sys
import threading
import time
from collections.abc import Callable, Mapping
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import redirect_stdout, suppress
from typing import Self

import viser

from sags_node.clients.viewer.feed import Feed, Moment
from sags_node.clients.viewer.panel import Panel
from sags_node.clients.viewer.pictures import needs_of, overlaid_in
from sags_node.clients.viewer.saving import Exporter
from sags_node.clients.viewer.scene import Scene
from sags_node.clients.viewer.server import serving
from sags_node.messaging.address import THE_NODE, NodeAddress
from sags_node.messaging.node_clock import NodeClock

RATE = 20.0  # Hz, at first
PULLED = 5.0  # Hz of updates; below it each frame is asked for, above it the node sends all
PAGE_TIME = 2.0  # s that all pages may take to show an update
OTHERS_TIME = 0.25  # s that the others have once one has shown it: what hangs makes no other page old
MOST = 16  # pages that are asked at once
IDLE_WAIT = 0.25  # s between looks for a browser, and for whether a frozen page goes on


class Pages:
    """Waits until the pages have shown an update: else a slow one piles updates up. A block is its life."""

    def __init__(self) -> None:
        self._workers = ThreadPoolExecutor(MOST, thread_name_prefix="sags-page")
        self._asked: dict[int, Future[None]] = {}  # by the client's number

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._workers.shutdown(cancel_futures=True)  # each has a time limit

    def wait(self, clients: Mapping[int, viser.ClientHandle]) -> None:
        """Wait until one has shown all that was sent, and a moment longer for the others."""
        pending = {number: asked for number, asked in self._asked.items() if not asked.done()}
        self._asked = {
            number: pending.get(number) or self._workers.submit(_ask, client)
            for number, client in clients.items()
        }
        wait(self._asked.values(), PAGE_TIME, FIRST_COMPLETED)
        wait(self._asked.values(), OTHERS_TIME)


def _ask(client: viser.ClientHandle) -> None:
    """Return when a page has shown all that was sent: only then does it answer; viser has no other sign."""
    with suppress(TimeoutError, RuntimeError):  # too slow, gone, or without storage: it has had its time
        client.local_storage.get_item("sags-view", timeout=PAGE_TIME)


def run_viewer(
    host: str = "127.0.0.1",
    port: int = 8080,
    insecure: bool = False,
    node: NodeAddress = THE_NODE,
    ready: Callable[[str, int], None] = lambda url, port: None,
    *,
    export: Exporter,
    stop: threading.Event,
) -> None:
    """Serve the viewer until `stop` is set.

    Args:
        node: it need not run yet. With both `endpoint` and `control` its clock is asked for, too.
        export: writes the model of a moment as a file.
        ready: called with the address and the port once browsers can connect.

    Raises:
        UsageError: `host` is no loopback address and `insecure` is not given, or the node's keys do not fit.
        SagsError: the port cannot be bound, or the node's endpoint is malformed.
    """
    remote = node.endpoint is not None and node.control is not None
    feed = Feed(node, NodeClock.at(node) if remote else None)
    try:
        with serving(host, port, insecure) as (server, url):
            scene = Scene(server)
            panel = Panel(server, scene, node, export, RATE)
            server.on_client_connect(scene.look)
            server.on_client_connect(panel.fit)
            ready(url, server.get_port())
            # What viser has to say; stdout is for machines.
            with redirect_stdout(sys.stderr), Pages() as pages:
                _follow(server, pages, feed, scene, panel, stop)
    finally:
        feed.close()


def _follow(
    server: viser.ViserServer, pages: Pages, feed: Feed, scene: Scene, panel: Panel, stop: threading.Event
) -> None:
    """Update the browsers until `stop`, as fast as they can show it; without any, only `status` comes."""
    period = 0.0
    while not stop.is_set():
        if not server.get_clients():
            feed.pause()
            panel.go_on()
            scene.show(Moment())
            stop.wait(IDLE_WAIT)
            continue
        if panel.frozen:
            feed.pause()
            panel.stay()
            stop.wait(IDLE_WAIT)
            continue
        began = time.monotonic()
        moment = feed.now(needs_of(panel.view), overlaid_in(panel.view), steady=period < 1 / PULLED)
        if panel.frozen:  # meanwhile
            continue
        with server.atomic():
            scene.show(moment)
            panel.show(moment)
        server.flush()
        sent = time.monotonic()
        pages.wait(server.get_clients())
        answered = time.monotonic()
        # Half of the browser's time at most is for taking in updates; the rest is the user's.
        stop.wait(max(began + 1 / panel.rate - answered, answered - sent))
        period = time.monotonic() - began
