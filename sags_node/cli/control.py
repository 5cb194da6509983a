"""What is asked of a running node from the shell: anchors, parameters, pause and reset."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from sags_node.cli.launching import as_json, group_of, part_of
from sags_node.cli.node_options import asked_options, endpoint_option
from sags_node.errors import SagsError, UsageError
from sags_node.terminal import text
from sags_node.terminal.console import json_text, show

if TYPE_CHECKING:
    from sags_node.messaging.address import NodeAddress

ANCHORS_WAIT = 3.0  # s for the anchors of a frame


asking = group_of(asked_options, as_json)  # of a command that asks a node; it gets the node as `node`


def ask(node: NodeAddress, op: str, args: dict[str, Any] | None = None) -> Any:
    """Return the node's answer; see `ControlClient.request`."""
    from sags_node.messaging.control import ControlClient

    with ControlClient.at(node) as client:
        return client.request(op, args)


# ---- anchors ---------------------------------------------------------------------------------------------


@click.group()
def anchor() -> None:
    """Pin points to the tissue, look at them and remove them.

    The node carries an anchor with the tissue, also while an instrument hides it. docs/wire.md says what each
    column means and how sure it is.
    """


@anchor.command()
@click.argument("pixel", nargs=2, type=float, metavar="U V")
@asking
def pin(pixel: tuple[float, float], json_out: bool, node: NodeAddress) -> None:
    """Pin an anchor at pixel U V of the left image.

    Prints its number. The image is left/image_rect_color. It has the calibration's size, or that of
    vision.width and height in the launch file, on every machine. A pixel without depth is refused.

    \b
    sags anchor pin 320 256
    """
    pinned = ask(node, "add_anchor", {"u": pixel[0], "v": pixel[1]})
    if json_out:
        show(pinned)
        return
    sure = pinned["depth_confidence"]
    unsure = "" if sure >= 0.5 else "; below 0.5 its depth is a guess"
    show(f"anchor {pinned['id']} in frame {pinned['frame_id']}; depth confidence {sure:.2f}{unsure}")


@anchor.command("list")
@endpoint_option
@asking
def list_anchors(json_out: bool, node: NodeAddress) -> None:
    """Say where the anchors are in the newest frame.

    Columns: number, x y z (m, world), pixel, visibility, confidence (it is still on its tissue) and depth
    confidence. Show no anchor as sure whose confidence is below 0.5. Without a calibration lengths have no
    unit.
    """
    from sags_node.messaging.received import ReceivedCloud, TopicName
    from sags_node.messaging.subscriber import Subscriber

    name = TopicName("anchors", ReceivedCloud)
    with Subscriber.at(node, [name]) as subscriber:
        newest = subscriber.wait(name, ANCHORS_WAIT)
        if newest is None:
            raise SagsError(f"no anchors came: {subscriber.problem(name)}")
    columns = ("id", "x", "y", "z", "u", "v", "visibility", "confidence", "depth_confidence")
    rows = [{key: point[key].item() for key in columns} for point in newest.points]
    if json_out:
        unit = {"unit": "m" if newest.metric else None}
        show([row | unit for row in rows])
    elif not rows:
        show("no anchors; pin one: sags anchor pin U V")
    else:
        show(text.rows_table([{key: _short(key, value) for key, value in row.items()} for row in rows]))
        if not newest.metric:
            show("x y z have no unit: the node has no calibration")


def _short(key: str, value: float) -> str:
    digits = {"id": 0, "x": 4, "y": 4, "z": 4, "u": 1, "v": 1}
    return f"{value:.{digits.get(key, 2)}f}"


@anchor.command()
@click.argument("number", type=int)
@asking
def remove(number: int, json_out: bool, node: NodeAddress) -> None:
    """Remove the anchor with this NUMBER."""
    ask(node, "remove_anchor", {"id": number})
    show({"removed": number} if json_out else f"anchor {number} is removed")


# ---- parameters ------------------------------------------------------------------------------------------


@click.group()
def param() -> None:
    """Look at a running node's configuration, and change it.

    docs/launch.md has all keys.
    """


@param.command()
@click.argument("name", metavar="[KEY]", required=False)
@asking
def get(name: str | None, json_out: bool, node: NodeAddress) -> None:
    """Print the configuration in force, or the part of it that KEY names.

    \b
    sags param dump > mine.yaml         # all of it, as a launch file
    sags param get mapping.budget_ms    # null: it follows the rate of the frames
    """
    found: Any = ask(node, "get_parameters")
    if name:
        found = part_of(found, name)
    show(({name: found} if name else found) if json_out else text.yaml_text(found))


param.add_command(get, "dump")  # its name in ros2


@param.command()
@click.argument("file", metavar="FILE.yaml", type=click.Path(path_type=Path))
@asking
def load(file: Path, json_out: bool, node: NodeAddress) -> None:
    """Set what differs between a file of sags param dump and the node.

    If one of these keys cannot change, nothing is set: see sags param set.
    """
    from sags_node.config.launch_file import leaves
    from sags_node.config.yaml_reader import read_yaml

    wanted = read_yaml(file, "parameters")
    if not isinstance(wanted, dict):
        raise UsageError(f"{file} has no parameters: write key: value, as sags param dump does")
    now = dict(leaves(ask(node, "get_parameters")))
    asked = _once(leaves(wanted))
    said = {key: value for key, value in asked.items() if key not in now or now[key] != value}
    if said:
        ask(node, "set_parameters", said)
    show(said if json_out else _said(said) or "all of it is so already")


@param.command("set")
@click.argument("overrides", nargs=-1, required=True, metavar="key:=value ...")
@asking
def set_parameters(overrides: tuple[str, ...], json_out: bool, node: NodeAddress) -> None:
    """Change parameters while the node runs; the model stays.

    Only mapping.budget_ms can change. For any other key start the node anew.

    \b
    sags param set mapping.budget_ms:=25
    """
    from sags_node.config.yaml_reader import parse_word

    if len(overrides) == 2 and not any(":=" in word for word in overrides):
        raise UsageError(f"write {overrides[0]}:={overrides[1]}, as for sags run")
    for word in overrides:
        if ":=" not in word:
            raise UsageError(f"'{word}' is not an override; write key:=value, e.g. mapping.budget_ms:=25")
    pairs = (word.split(":=", 1) for word in overrides)
    said = _once((key, parse_word(value, f"the value of {key}:=")) for key, value in pairs)
    ask(node, "set_parameters", said)
    show(said if json_out else _said(said))


def _once(pairs: Iterable[tuple[str, Any]]) -> dict[str, Any]:
    """The values by key; no key may be given twice, as only one value can be in force."""
    values: dict[str, Any] = {}
    for key, value in pairs:
        if key in values:
            raise UsageError(f"{key} is given twice; keep one")
        values[key] = value
    return values


def _said(values: Mapping[str, Any]) -> str:
    return ", ".join(f"{key} is {json_text(value)}" for key, value in values.items())


# ---- pause, resume, reset --------------------------------------------------------------------------------


def _plain(name: str, op: str, done: str, doc: str) -> click.Command:
    """A command that asks for one operation without arguments."""

    @click.command(name, help=doc)
    @asking
    def command(json_out: bool, node: NodeAddress) -> None:
        answer = ask(node, op)
        show(answer if json_out else done)

    return command


pause = _plain(
    "pause",
    "pause",
    "paused; sags resume goes on",
    "Stop mapping and publishing until sags resume. Anchors and views stay. Live frames are dropped "
    "meanwhile; a recording with pace fast or step waits.",
)
resume = _plain("resume", "resume", "running", "Go on after sags pause.")
reset = _plain(
    "reset",
    "reset_model",
    "the next frame begins a new model; anchors must be recognised anew",
    "Forget the model; the next frame begins a new one.\n\nIt is a new epoch, and all anchors are lost until "
    "they are recognised. For another place, or after a new base frame of the robot.",
)
