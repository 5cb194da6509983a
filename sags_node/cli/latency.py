"""`sags latency`: the time from showing a code to that code in what a display would show."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import click
from rich.table import Table

from sags_node.cli.launching import as_json, path_option, positive, shown
from sags_node.cli.node_options import data_options
from sags_node.errors import SagsError
from sags_node.terminal import text
from sags_node.terminal.console import console, progress, show, stop_signals, tell

if TYPE_CHECKING:
    from sags_node.messaging.address import NodeAddress


@click.command()
@click.option("--push", metavar="ENDPOINT", help="Push coded images of the phantom there: without a camera.")
@shown("--rate", type=positive, default=30.0, help="Hz of pushed images.")
@shown("--port", type=click.IntRange(0, 65535), default=8768, help="Of the page; 0: any free one.")
@click.option("--overlay", metavar="NS", help="Wait for each image's overlay, in this namespace.")
@shown(
    "--seconds", type=positive, default=10.0, help="How long codes count, from two seconds after the first."
)
@data_options
@path_option("--run-dir", help="Of the connection files.")
@as_json
def latency(
    push: str | None, rate: float, port: int, overlay: str | None, seconds: float, json_out: bool,
    node: NodeAddress,
) -> None:  # fmt: skip
    """Measure the delay from what a camera sees to what a screen shows.

    Numbers as ArUco codes are shown, and read again in the pixels of a virtual screen. It shows the
    running node's left image, and an overlay if one is named. The way between is split by the stamps. Lost
    codes and images that could not be read are counted.

    With a camera: open the page that is printed in a browser on this machine, on the display that the camera
    films. Ten codes a second are shown. The delay of that display is in the figures, and so is the wait for
    an exposure. A display that shows the virtual screen adds its own. All clocks must be this machine's.

    \b
    sags run launch/v4l2.yaml & sags latency --seconds 60

    Without a camera: images are pushed into the node.

    \b
    python examples/send_phantom.py push --rig out/rig        # its calibration
    sags run launch/push.yaml rig:=out/rig & sags overlay &
    sags latency --push tcp://127.0.0.1:5558 --overlay overlay
    """
    from sags_node.clients.latency.run import measure_latency
    from sags_node.clients.latency.shown import Codes, Page, Pushed

    drawn = None if overlay is None else replace(node, ns=overlay, endpoint=None)
    with stop_signals() as stop:
        if push is None:
            codes: Codes = (page := Page(port))
            console.print(f"open {page.address} on the display that is filmed", markup=False, soft_wrap=True)
        else:
            from sags_node.config.schema import PhantomSource
            from sags_node.phantom import cached_session

            with progress("rendering the phantom (once)") as advance:
                session = cached_session(PhantomSource(camera_motion="sway", seconds=2.0), advance)
            codes = Pushed(push, session, rate)
        with codes:
            figures = measure_latency(node, drawn, codes, seconds, tell, stop)
    show(figures if json_out else _table(figures))
    if not figures["read"]:
        raise SagsError("no code was read while it counted")


def _table(figures: Mapping[str, Any]) -> Table:
    rows, last = {}, figures["from"]
    for name, spread in figures["parts_ms"].items():
        rows[f"{last} to {name}"], last = spread, name
    rows[f"{figures['from']} to shown"] = figures["total_ms"]
    table = text.table("ms", *figures["total_ms"])
    for name, spread in rows.items():
        table.add_row(name, *(f"{value:.1f}" for value in spread.values()))
    counted = ("lost", "unreadable", "unknown", "clock_set")
    odd = ", ".join(f"{key.replace('_', ' ')} {figures[key]}" for key in counted if figures[key])
    table.caption = f"{figures['read']} of {figures['codes']} codes read" + (f"; {odd}" if odd else "")
    return table
