"""`sags bridge`: what a node sends, in the words of other systems."""

from __future__ import annotations

import importlib.util
import logging
import os
import threading
from collections.abc import Callable, Mapping
from contextlib import nullcontext
from dataclasses import replace
from functools import partial, wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from rich.markup import escape

from sags_node.cli.launching import as_json, file_option, positive, shown
from sags_node.cli.node_options import NICENESS, both_options, knock, run_dir_option
from sags_node.errors import SagsError, UsageError, install
from sags_node.files import check_file, whole
from sags_node.terminal.console import console, on_stop_signals, show

if TYPE_CHECKING:
    from sags_node.messaging.address import NodeAddress

INSTALL = f"install it with: {install('bridges')}"

max_age_option = partial(shown, "--max-age", type=positive, default=0.4)
Ready = Callable[[str, int], None]  # host and port, once peers can come
Say = Callable[[str, Mapping[str, Any]], None]  # in words, and as fields for machines

log = logging.getLogger(__name__)


@click.group()
def bridge() -> None:
    """Bring a running node into another system: one process for each.

    \b
    3D Slicer, PLUS, a navigation system     sags bridge openigtlink
    looking from a desk, plots, layouts      sags bridge foxglove
    programs of ROS 2, RViz                  sags bridge ros2
    web pages, Unity, no ZeroMQ              sags bridge web
    dVRK's and other keyed displays          sags bridge gst
    a browser on this machine, no set-up     sags view
    a program of your own                    none: docs/clients.md

    A bridge asks the node only for what its peers take, and the node never waits for it. What becomes too old
    is taken back, with the reason. Node and bridge may be started in any order, and restarted.

    These protocols know no keys and no encryption: a bridge serves this machine only, unless --insecure
    is given. docs/bridges.md says what each carries, how fast, and what it costs.
    """


def _common(command: Callable[..., None]) -> Callable[..., None]:
    """Options of every bridge; the command gets them as `node`, `overlay`, `max_age`, `stop`, and
    `say`, which tells where it is once peers can come."""

    @both_options
    @shown("--overlay-ns", default="overlay", help="Namespace of a sags overlay.")
    @run_dir_option
    @max_age_option(help="Seconds since capture after which an image is taken back.")
    @as_json
    @wraps(command)
    def with_common(node: NodeAddress, overlay_ns: str, json_out: bool, **rest: Any) -> None:
        from sags_node.messaging.address import NodeAddress
        from sags_node.messaging.node_clock import NodeClock
        from sags_node.messaging.rundir import read_connection

        knock(node)
        remote = node.endpoint is not None and node.control is not None
        clock = NodeClock.at(node) if remote else None
        overlay = NodeAddress(overlay_ns, run_dir=node.run_dir, clock=clock)  # its stamps are the node's
        stop = threading.Event()

        def say(words: str, fields: Mapping[str, Any]) -> None:
            if node.endpoint is None:
                try:
                    read_connection(node.ns, node.run_dir)
                except SagsError as error:
                    console.print(f"waiting: {error}", markup=False, soft_wrap=True)
            if json_out:
                show(dict(fields))
            else:
                console.print(f"{words}  (Ctrl-C ends)")

        on_stop_signals(stop.set)
        with clock or nullcontext():
            command(node=replace(node, clock=clock), overlay=overlay, say=say, stop=stop, **rest)

    return with_common


def _listening(port: int) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Options of a bridge that peers connect to; the command gets them as `host`, `port` and `ready`."""

    def decorate(command: Callable[..., None]) -> Callable[..., None]:
        @shown("--host", default="127.0.0.1", help="Address to serve on.")
        @shown("--port", type=click.IntRange(0, 65535), default=port, help="0: any free one.")
        @click.option("--insecure", is_flag=True, help="Serve also to other machines: there are no keys.")
        @wraps(command)
        def with_address(host: str, insecure: bool, say: Say, **rest: Any) -> None:
            from sags_node.messaging.security import is_loopback

            if not is_loopback(host):
                _check_open(f"--host {host}", insecure)

            def ready(host: str, bound: int) -> None:
                say(f"listening on [bold]{escape(host)}:{bound}[/]", {"host": host, "port": bound})

            command(host=host, ready=ready, **rest)

        return with_address

    return decorate


def _check_open(option: str, insecure: bool) -> None:
    """Refuse an option that lets other machines in, unless `insecure`; then warn."""
    if not insecure:
        raise UsageError(
            f"{option} would show the video to all who reach it, without keys or encryption; leave it "
            "out and look from elsewhere through ssh -L, or give --insecure"
        )
    log.warning("%s: anybody who reaches it sees the video and can ask things of the node", option)


def _check_installed(module: str, package: str, command: str) -> None:
    if importlib.util.find_spec(module) is None:
        raise UsageError(f"sags bridge {command} needs {package}; {INSTALL}")


@bridge.command()
@_common
@_listening(port=18944)
@click.option(
    "--send",
    metavar="NAMES",
    default="",
    help="Some of picture,render,overlay,surface,anchors,camera; default: all.",
)
@shown("--rate", type=positive, default=10.0, help="Hz of all but the surface.")
@shown("--surface-rate", type=positive, default=2.0, help="Hz of the surface.")
@shown(
    "--surface-step",
    type=click.IntRange(2, 128),
    default=16,
    help="Pixels between two corners of the surface.",
)
def openigtlink(send: str, ready: Ready, stop: threading.Event, **options: Any) -> None:
    """Serve 3D Slicer, PLUS and others that speak OpenIGTLink.

    Devices SagsPicture, SagsRender, SagsOverlay (IMAGE), SagsSurface (POLYDATA), SagsAnchors (POINT),
    SagsLeftCamera (TRANSFORM), SagsState (STATUS). Millimetres; R = -x, A = -y, S = z of the optical frame.

    \b
    sags run launch/d4d_pull.yaml &
    sags bridge openigtlink
    Slicer examples/slicer/sags.mrml

    A list of points sent to the device SagsPin is pinned to the tissue.

    Needs the extra `bridges`: pip install '.[bridges]' in a clone.
    """
    _check_installed("pyigtl", "pyigtl", "openigtlink")
    from sags_node.clients.bridge.openigtlink import IgtlOptions, run_openigtlink

    chosen = tuple(name for name in send.split(",") if name)
    os.nice(NICENESS)
    run_openigtlink(IgtlOptions(send=chosen, **options), ready, stop)


@bridge.command()
@_common
@_listening(port=8766)
@click.option("--pin", is_flag=True, help="Let peers pin and remove anchors.")
@click.option(
    "--origin",
    "origins",
    multiple=True,
    metavar="URL",
    help="Pages from there may connect too, e.g. https://or.example.org; repeatable.",
)
def web(ready: Ready, stop: threading.Event, **options: Any) -> None:
    """Serve web pages, Unity and others by WebSocket.

    The messages are the node's own, byte for byte, with their header as JSON. http://127.0.0.1:8766 shows the
    model, its depth and the anchors; its client /sags.js is one file to take along. A client in C# for Unity
    is in examples/unity. Peers say which topics they want, thin ones too.

    \b
    sags run launch/d4d_pull.yaml &
    sags bridge web
    xdg-open http://127.0.0.1:8766

    Pages of other origins are refused unless --origin names them.

    Needs the extra `bridges`: pip install '.[bridges]' in a clone.
    """
    _check_installed("websockets", "websockets", "web")
    from sags_node.clients.bridge.web import WebOptions, run_web

    run_web(WebOptions(**options), ready, stop)


@bridge.command()
@click.option("--left", metavar="LAUNCH", help="What comes behind the left eye's images.")
@click.option("--right", metavar="LAUNCH", help="What comes behind the right eye's.")
@shown("--rate", type=positive, default=60.0, help="Hz of the display.")
@shown("--overlay-ns", default="overlay", help="Namespace of the sags overlay.")
@run_dir_option
@max_age_option(help="Seconds since capture after which there is only the key colour.")
def gst(overlay_ns: str, run_dir: Path | None, **options: Any) -> None:
    """Write the overlay into GStreamer, on its key colour.

    For displays that blend by that colour, such as dVRK's.

    LAUNCH is the rest of a pipeline, as for gst-launch-1.0. It gets BGRx images at the display's rate.
    Where nothing fresh is there, they are the key colour alone, which such a display shows as nothing.

    \b
    sags overlay &
    sags bridge gst --left 'videoconvert ! autovideosink'
    sags bridge gst --left 'unixfdsink socket-type=abstract socket-path=dvrk_gst:left_ar:RIG' \\
                    --right 'unixfdsink socket-type=abstract socket-path=dvrk_gst:right_ar:RIG'

    unixfdsink, for dVRK's sockets, needs GStreamer 1.24.
    """
    from sags_node.clients.bridge.gst import GstOptions, run_gst
    from sags_node.messaging.address import NodeAddress

    stop = threading.Event()
    on_stop_signals(stop.set)
    ready = partial(console.print, "writing as soon as an overlay is there  (Ctrl-C ends)")
    run_gst(GstOptions(NodeAddress(overlay_ns, run_dir=run_dir), **options), ready, stop)


@bridge.command()
@_common
@_listening(port=8765)
@click.option("--rate", type=positive, help="Hz of each topic, at most; default: all that come.")
@click.option("--pin", is_flag=True, help="Let peers pin anchors: a click in the 3D panel.")
@file_option("--layout", metavar="FILE.json", help="Write the layout for this namespace, and end.")
def foxglove(layout: Path | None, ready: Ready, stop: threading.Event, **options: Any) -> None:
    """Serve Foxglove: every topic live, on ws://127.0.0.1:8765.

    Topics come as the node sends them, and images as H.264 too where PyAV is there (.../h264): for a thin
    link, look at those. Only what a panel shows is asked of the node.

    \b
    sags run launch/d4d_pull.yaml &
    sags bridge foxglove
    Foxglove: Open connection, ws://127.0.0.1:8765; Layout, Import: examples/foxglove/sags.json

    Any web page that is open in a browser of this machine can connect too. So peers can look, and do nothing
    else unless --pin is given.

    Needs the extra `bridges`: pip install '.[bridges]' in a clone.
    """
    _check_installed("foxglove", "foxglove-sdk", "foxglove")
    if layout is not None:
        from sags_node.clients.bridge.foxglove_layout import layout_of

        check_file(layout)
        with whole(layout) as partial:
            partial.write_text(layout_of(options["node"].ns, options["overlay"].ns), encoding="utf-8")
        return
    from sags_node.clients.bridge.foxglove import FoxgloveOptions, run_foxglove

    os.nice(NICENESS)
    run_foxglove(FoxgloveOptions(**options), ready, stop)


@bridge.command()
@_common
@click.option(
    "--domain", type=click.IntRange(0, 232), help="Number of the graph; default: $ROS_DOMAIN_ID, else 0."
)
@shown("--interface", default="lo", help="Network interface; lo: this machine only.")
@click.option("--insecure", is_flag=True, help="Serve also to other machines: there are no keys.")
@shown(
    "--view",
    "views",
    multiple=True,
    default=("ros",),
    metavar="NAME",
    help="A view that peers may open and see; several times.",
)
@shown(
    "--points",
    type=click.IntRange(1),
    default=8000,
    help="Of /sags/points, at most; /sags/points/all has all.",
)
def ros2(
    domain: int | None, interface: str, insecure: bool, say: Say, stop: threading.Event, **options: Any
) -> None:
    """Publish every topic into a ROS 2 graph, without ROS.

    Topics are under /sags; and there are /tf and /diagnostics. Read .../compressed, .../compressedDepth and
    /sags/points, which are small: a receiver of ROS 2 loses what is larger than 160 kB, until its machine
    gives it more:

    \b
    sudo sysctl -w net.core.rmem_default=16777216

    \b
    sags run launch/d4d_pull.yaml &
    sags bridge ros2
    rviz2: fixed frame world, PointCloud2 /sags/points, Reliability Policy: Best Effort

    Requests are topics under /sags/request; answers come on /sags/answer. RViz's tool Publish Point pins an
    anchor when its topic is /sags/request/add_anchor.

    Needs the extra `ros2`: pip install '.[ros2]' in a clone.
    """
    if interface != "lo":
        _check_open(f"--interface {interface}", insecure)
    from pydantic import ValidationError

    from sags_node.clients.bridge.ros2 import Ros2Options, run_ros2
    from sags_node.config.schema import RosGraph
    from sags_node.ros.graph import where

    try:
        graph = RosGraph(domain=domain, interface=interface)
    except ValidationError:
        raise UsageError(f"--interface {interface!r} is not the name of a network interface") from None

    def ready(domain: int, interface: str) -> None:
        say(f"in [bold]{escape(where(domain, interface))}[/]", {"domain": domain, "interface": interface})

    os.nice(NICENESS)
    run_ros2(Ros2Options(graph=graph, **options), ready, stop)
