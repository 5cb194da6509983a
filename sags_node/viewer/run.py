"""Brings what the node shows to the browser, at the rate that node, machine and browser can take."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable
from contextlib import redirect_stdout

import viser

from sags_node.messaging.address import ClientKeys
from sags_node.messaging.node_clock import NodeClock
from sags_node.viewer.feed import Feed, Moment
from sags_node.viewer.panel import Asker, Panel
from sags_node.viewer.scene import Scene
from sags_node.viewer.server import serving

RATE = 4.0  # Hz, at first
IDLE_WAIT = 0.25  # s between looks for a browser
BROWSER_TIME = 2.0  # s that a browser may take to show an update


def run_viewer(
    host: str = "127.0.0.1",
    port: int = 8080,
    insecure: bool = False,
    endpoint: str | None = None,
    control: str | None = None,
    ns: str = "sags",
    keys: ClientKeys | None = None,
    ready: Callable[[str, int], None] = lambda url, port: None,
    *,
    stop: threading.Event,
) -> None:
    """Serve the viewer until `stop` is set.

    Args:
        endpoint: data socket of the node; default: its connection file. No node need run yet.
        control: its control socket; default: its connection file. With `endpoint` the node's clock is
            asked for there, too.
        ready: told the address and the port once browsers can connect.

    Raises:
        UsageError: `host` is no loopback address and `insecure` is not given, or the node's keys do not fit.
        SagsError: the port cannot be bound, or `endpoint` is malformed.
    """
    remote = endpoint is not None and control is not None
    feed = Feed(endpoint, ns, keys, clock=NodeClock(control, keys=keys) if remote else None)
    try:
        with serving(host, port, insecure) as (server, url):
            scene = Scene(server)
            panel = Panel(server, scene, Asker(control, ns, keys), ns, RATE)
            server.on_client_connect(scene.look)
            ready(url, server.get_port())
            with redirect_stdout(sys.stderr):  # what viser has to say; stdout is for machines
                _follow(server, feed, scene, panel, stop)
    finally:
        feed.close()


def _follow(server: viser.ViserServer, feed: Feed, scene: Scene, panel: Panel, stop: threading.Event) -> None:
    """Nothing is taken from the node while no browser looks, and no browser gets ahead of what it shows."""
    while not stop.is_set():
        if not server.get_clients():
            feed.rest()
            scene.show(Moment())
            stop.wait(IDLE_WAIT)
            continue
        began = time.monotonic()
        moment = feed.now()
        scene.show(moment)
        panel.show(moment)
        sent = time.monotonic()
        for client in server.get_clients().values():
            _await(client)
        answered = time.monotonic()
        # Half of the browser's time at most is for taking in updates; the rest is the user's.
        stop.wait(max(began + 1 / panel.rate - answered, answered - sent))


def _await(client: viser.ClientHandle) -> None:
    """Wait until a browser has shown all that was sent: it answers what is asked behind it.

    Without this a slow browser piles up updates: viser has no other sign of life.
    """
    try:
        client.local_storage.get_item("sags-view", timeout=BROWSER_TIME)
    except (TimeoutError, RuntimeError):  # too slow, gone, or a browser without storage: it has had its time
        pass
