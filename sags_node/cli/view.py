"""`sags view`: the running node in a web browser."""

from __future__ import annotations

import importlib.util
import os
import threading
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

import click
from rich.markup import escape

from sags_node.cli.launching import as_json, shown
from sags_node.cli.node_options import NICENESS, both_options, knock
from sags_node.errors import UsageError, install
from sags_node.terminal.console import console, on_stop_signals, show

if TYPE_CHECKING:
    from sags_node.messaging.address import NodeAddress
    from sags_node.types import Camera, Gaussians


@click.command()
@both_options
@shown("--port", type=click.IntRange(0, 65535), default=8080, help="0: any free one.")
@shown("--host", default="127.0.0.1", help="Address to serve on.")
@click.option("--insecure", is_flag=True, help="Serve also to other machines: there are no keys.")
@as_json
def view(port: int, host: str, insecure: bool, json_out: bool, node: NodeAddress) -> None:
    """Show a running node in a web browser on this machine.

    A page with the live model in 3D (drag turns, wheel zooms, right drag moves), the left camera and its
    image; beside it images of your choice (input, what is shown, depth, the right eye, stereo, the overlay),
    rates and latencies; buttons to freeze a moment, to keep a screenshot or the model as a file, and to
    pause, reset and record. A click on the tissue pins an anchor, which follows it; a click on an anchor
    chooses it, and the distance to the one before is told.

    Nothing old is shown as new: what stops coming disappears within a second, and the line at the top right
    says why. A page that hears nothing from here for 6 s, as when the link to it is cut, covers itself. The
    node may be started later and restarted.

    It is a process of its own. While no browser is open it takes nothing from the node.

    \b
    sags run launch/d4d_pull.yaml &
    sags view                           # then open the printed address
    ssh -L 8080:127.0.0.1:8080 HOST     # to look from another machine: the same port on both

    Needs the extra `viewer`: pip install '.[viewer]' in a clone.
    """
    if importlib.util.find_spec("viser") is None:
        raise UsageError(f"sags view needs viser; install it with: {install('viewer')}")
    from sags_node.clients.viewer.run import run_viewer

    os.nice(NICENESS)
    knock(node)

    def ready(url: str, bound: int) -> None:
        if json_out:
            show({"url": url, "port": bound})
        else:
            console.print(f"open [bold]{escape(url)}[/] in a browser  (Ctrl-C ends)", soft_wrap=True)

    stop = threading.Event()
    on_stop_signals(stop.set)
    run_viewer(host, port, insecure, node, ready, export=_file_of, stop=stop)


def _file_of(gaussians: Gaussians, camera: Camera, t_capture_ns: int, kind: str) -> bytes:
    """Write the model as `sags export` does: a mesh, points or splats, in metres.

    Raises:
        SagsError: it shows nothing.
    """
    from sags_node.tools.export.export import Orbit, export  # torch comes along, which few need
    from sags_node.tools.export.scene import Scene

    with TemporaryDirectory(prefix="sags-view-") as folder:
        file = Path(folder, "model.ply")
        scene = Scene(gaussians, camera, t_capture_ns)
        export(scene, {kind: file}, Orbit(0.0, 0.0), lambda *progress: None)
        return file.read_bytes()
