"""`sags measure`: lengths and areas between anchors, live."""

from __future__ import annotations

import re
import threading
import time
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import click

from sags_node.cli.launching import as_json, path_option, positive, shown
from sags_node.cli.node_options import data_options
from sags_node.errors import SagsError
from sags_node.terminal.console import show, stop_signals

if TYPE_CHECKING:
    from sags_node.messaging.address import NodeAddress

PATIENCE = 3.0  # s for the anchors of a first frame
LOOK = 0.2  # s to wait for new anchors, and for the other messages of their frame

Record = dict[str, Any]


@click.command()
@click.argument("numbers", nargs=-1, type=int, required=True, metavar="ANCHOR ANCHOR ...")
@click.option(
    "--area", is_flag=True, help="Of the polygon with these corners, named in their order around it."
)
@shown("--rate", type=positive, default=5.0, help="Lines a second, at most.")
@data_options
@path_option("--run-dir", help="Of the connection file.")
@click.option("--seconds", type=positive, help="Stop after so long; default: Ctrl-C.")
@as_json
def measure(
    numbers: tuple[int, ...],
    area: bool,
    rate: float,
    seconds: float | None,
    json_out: bool,
    node: NodeAddress,
) -> None:
    """Measure on the tissue between anchors, a line for each update.

    Two anchors: their distance. More: the length of the way along them. Lines between anchors are straight:
    for a way along the surface pin some more on it. Stretch is the ratio to the first value that was sure.

    Nine of ten errors are meant to be smaller than the one that is told. It follows from the confidence of
    the anchors' depth, and from how exactly anchors are followed in the image. A value is unsure, and says
    why, while one of its anchors is hidden, may be on other tissue, or has a guessed depth. With a lost
    anchor there is no value. Without a calibration lengths have no unit.

    \b
    sags anchor pin 250 200                    # prints 1; then 2, 3
    sags measure 1 2
    sags measure 1 2 3 --json --seconds 10
    sags measure --area 1 2 3
    """
    from sags_node.messaging.measure import check_numbers

    check_numbers(numbers, area)
    kind = "area" if area else "distance" if len(numbers) == 2 else "path"
    with stop_signals() as stop:
        for record in follow(node, numbers, area, rate, seconds, stop):
            said = {"kind": kind, "anchors": list(numbers), **record}
            show(said if json_out else _line(said))


def follow(
    node: NodeAddress, numbers: tuple[int, ...], area: bool, rate: float, seconds: float | None,
    stop: threading.Event,
) -> Iterator[Record]:  # fmt: skip
    """Yield a record for each value until `seconds` have passed or `stop` is set; mm, areas in mm2.

    While nothing fresh comes there is one record, which says why.

    Raises:
        SagsError: no node, no anchors came, one of these was never there, or the node was started anew.
    """
    from sags_node.messaging.measure import ANCHORS, MEASURING, Measured, measure
    from sags_node.messaging.subscriber import Subscriber

    begun, due, elapsed, silence = time.monotonic(), 0.0, 0.0, None
    before = newest = reference = None
    unit, scale = ("mm2", 1e6) if area else ("mm", 1e3)

    def record(measured: Measured) -> Record:
        stretch = None if reference is None else measured.stretch(reference)
        return {
            "value": None if measured.value is None else measured.value * scale,
            "error": None if measured.error is None else measured.error * scale,
            "unit": unit if measured.metric else None,
            "sure": measured.unsure is None,
            "unsure": measured.unsure,
            "stretch": None if stretch is None else stretch[0],
            "stretch_error": None if stretch is None else stretch[1],
        }

    with Subscriber.at(node, MEASURING) as subscriber:
        while not stop.is_set() and (seconds is None or time.monotonic() - begun < seconds):
            came = subscriber.wait(ANCHORS, LOOK, after=newest)
            newest = came or newest
            problem = subscriber.problem(ANCHORS)
            if before is None and problem is not None:
                if time.monotonic() - begun > PATIENCE:
                    raise SagsError(f"no anchors came: {problem}")
                continue
            if problem is not None:
                kind = re.sub(r"\d", "", problem)  # it tells an age, which grows
                if silence != kind:
                    silence = kind
                    yield {"seconds": None, "stamp_ns": None} | record(Measured(None, None, problem))
                continue
            silence = None
            frame = None if came is None else subscriber.aligned(MEASURING, came.stamp_ns, LOOK)
            if came is None or frame is None or time.monotonic() < due:
                continue
            due = max(due + 1 / rate, time.monotonic())
            measured = measure(frame, numbers, area)
            if before is None:
                there = [int(row["id"]) for row in came.points]
                if not set(numbers) <= set(there):
                    pinned = f"there are {', '.join(map(str, there))}" if there else "there are none"
                    raise SagsError(f"{measured.unsure}; {pinned}; pin one: sags anchor pin U V")
            elif came.meta.session != before.meta.session:
                raise SagsError(
                    "the node was started anew: its anchors are other points; pin and measure anew"
                )
            else:
                elapsed += 1e-9 * max(0, came.stamp_ns - before.stamp_ns)  # clocks may be set back
            before = came
            if reference is None and measured.unsure is None:
                reference = measured
            yield {"seconds": elapsed, "stamp_ns": came.stamp_ns} | record(measured)


def _line(said: Record) -> str:
    when = "" if said["seconds"] is None else f"{said['seconds']:7.2f} s  "
    if said["value"] is None:
        return f"{when}no {said['kind']}: {said['unsure']}"
    unit = said["unit"] or "(no unit: the node has no calibration)"
    error = "" if said["error"] is None else f" +- {said['error']:.2f}"
    if said["unsure"] is not None:
        return f"{when}{said['kind']} about {said['value']:.1f}{error} {unit}, unsure: {said['unsure']}"
    stretch = said["stretch"]
    ratio = "" if stretch is None else f"  stretch {stretch:.3f} +- {said['stretch_error']:.3f}"
    return f"{when}{said['kind']} {said['value']:.2f}{error} {unit}{ratio}"
