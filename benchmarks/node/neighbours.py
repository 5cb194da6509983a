"""What runs beside a node: the overlay, the viewer, and readers. Each is a process of its own.

A reader stands for another machine, and takes only what the node leaves of the cores.
"""

import json
import os
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from subprocess import DEVNULL, PIPE, Popen
from urllib.request import urlopen

import websockets.sync.client as websockets
import zmq

from benchmarks.node.processes import (
    STARTING,
    STOPPING,
    first_said,
    parent_lives,
    program,
    sags,
    wait_until,
)
from sags_node.messaging.address import NodeAddress, connect
from sags_node.messaging.rundir import connection_path
from sags_node.messaging.stream import MAX_MESSAGE_BYTES
from sags_node.processes import end

NS = "sags"
OWN_PORTS = "publish.data:=[tcp://127.0.0.1:*]", "publish.control:=tcp://127.0.0.1:*"
BROWSERS = "chromium", "chromium-browser", "google-chrome"


@contextmanager
def everything(folder: Path) -> Iterator[zmq.Socket[bytes]]:
    """Open a socket that gets all topics."""
    context = zmq.Context()
    socket = context.socket(zmq.SUB)
    socket.subscribe("")
    connect(socket, NodeAddress(NS, run_dir=folder).data(), MAX_MESSAGE_BYTES)
    try:
        yield socket
    finally:
        context.destroy(linger=0)


@contextmanager
def overlay(run_dir: Path) -> Iterator[int]:
    """Run the overlay with its mark; gives its process id."""
    with sags("overlay", "--run-dir", str(run_dir), "--repin", lasts=True) as process:
        failed = "the overlay did not start; see sags overlay --help"
        wait_until(connection_path(run_dir, "overlay").exists, process, failed)
        yield process.pid


@contextmanager
def viewer(run_dir: Path) -> Iterator[int]:
    """Run the viewer, and a browser on its page as if on another machine; gives the viewer's process id."""
    browser = find_browser()
    assert browser is not None
    environment = os.environ | {"XDG_RUNTIME_DIR": str(run_dir.parent)}
    with sags("view", "--port", "0", "--json", lasts=True, env=environment, stdout=PIPE) as process:
        url = first_said(process, "the viewer did not start; see sags view --help")["url"]
        profile = f"--user-data-dir={run_dir.parent}/browser"
        asked = "--remote-debugging-port=0"  # see `updates_per_s`
        page = [browser, "--headless=new", "--no-sandbox", "--disable-gpu", asked, profile, url]
        # Not `nice`: the process of Chromium that draws takes a high priority again, where it may.
        shown = Popen(["chrt", "--idle", "0", *page], stdout=DEVNULL, stderr=DEVNULL)
        try:
            yield process.pid
        finally:
            end(shown, grace=STOPPING)


def updates_per_s(run_dir: Path) -> float:
    """Ask the browser of `viewer` how many frames a second came to its page, by the page's own stamps; 0 if
    there are no two."""
    port = Path(run_dir.parent, "browser", "DevToolsActivePort").read_text().split()[0]
    with urlopen(f"http://127.0.0.1:{port}/json/list", timeout=STARTING) as answer:
        (page,) = (each for each in json.load(answer) if each["type"] == "page")
    rate = "1000 * (sagsFrames.count - 1) / (sagsFrames.last - sagsFrames.first)"
    ask = {"expression": f"window.sagsFrames?.count > 1 ? {rate} : 0"}
    with websockets.connect(page["webSocketDebuggerUrl"], proxy=None) as browser:
        browser.send(json.dumps({"id": 1, "method": "Runtime.evaluate", "params": ask}))
        return float(json.loads(browser.recv(timeout=STARTING))["result"]["result"]["value"])


def reader(run_dir: Path) -> AbstractContextManager[None]:
    """Run a reader that takes everything, as fast as it comes."""
    return program(_read, run_dir)


def _read(run_dir: Path) -> None:
    """Take everything that the node of this run directory sends; the node may start later."""
    give_way()
    while parent_lives() and not connection_path(run_dir, NS).exists():
        time.sleep(0.05)
    read_everything(run_dir, parent_lives)


def read_everything(run_dir: Path, goes_on: Callable[[], bool]) -> int:
    """Take all that a node sends, as fast as it comes; return the number of messages."""
    taken = 0
    with everything(run_dir) as socket:
        while goes_on():
            if socket.poll(100):
                socket.recv_multipart(copy=False)
                taken += 1
    return taken


def give_way() -> None:
    """Let this process have only what others leave of the cores, as if it ran on another machine."""
    os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))


def find_browser() -> str | None:
    return next((found for name in BROWSERS if (found := shutil.which(name))), None)
