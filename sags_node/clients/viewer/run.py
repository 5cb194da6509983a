"""Brings what the node shows to the browser, at the rate that node, machine and browser can take."""

import sys
import threading
import time
from collections.abc import Callable
from contextlib import redirect_stdout, suppress

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
IDLE_WAIT = 0.25  # s between looks for a browser, and for whether a frozen page goes on
BROWSER_TIME = 2.0  # s that a browser may take to show an update


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
            with redirect_stdout(sys.stderr):  # what viser has to say; stdout is for machines
                _follow(server, feed, scene, panel, stop)
    finally:
        feed.close()


def _follow(server: viser.ViserServer, feed: Feed, scene: Scene, panel: Panel, stop: threading.Event) -> None:
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
        for client in server.get_clients().values():
            _await(client)
        answered = time.monotonic()
        # Half of the browser's time at most is for taking in updates; the rest is the user's.
        stop.wait(max(began + 1 / panel.rate - answered, answered - sent))
        period = time.monotonic() - began


def _await(client: viser.ClientHandle) -> None:
    """Wait until a browser has shown all that was sent: only then does it answer this request.

    Without this a slow browser piles up updates: viser has no other sign of what it has shown.
    """
    with suppress(TimeoutError, RuntimeError):  # too slow, gone, or without storage: it has had its time
        client.local_storage.get_item("sags-view", timeout=BROWSER_TIME)
