"""`sags topic`: look at what a running node publishes."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Literal

import click

from sags_node.cli.launching import as_json, part_of, positive, shown
from sags_node.cli.node_options import control_option, data_options
from sags_node.terminal import text
from sags_node.terminal.console import json_text, show, tell

if TYPE_CHECKING:
    from sags_node.messaging.address import NodeAddress


def _completed(ctx: click.Context, param: click.Parameter, incomplete: str) -> list[str]:
    from sags_node.messaging.topics import OVERLAY_TOPICS, TOPICS

    return [each.name for each in (*TOPICS, *OVERLAY_TOPICS) if each.name.startswith(incomplete)]


some_topics = click.argument("names", nargs=-1, required=True, metavar="NAME...", shell_complete=_completed)


@click.group()
def topic() -> None:
    """Look at what a running node publishes, as `ros2 topic` does.

    An overlay, a player and others are found by their namespace: --ns overlay.
    """


@topic.command("list")
@data_options
@shown("--seconds", type=positive, default=3.0, help="How long to listen.")
@as_json
def topic_list(seconds: float, json_out: bool, node: NodeAddress) -> None:
    """List the topics: their types, and rate and size of what was heard.

    \b
    sags topic list
    sags topic list --ns overlay
    """
    from sags_node.messaging import introspection as tool

    rows = tool.topic_list(node, seconds)
    show(rows if json_out else text.topics_table(rows))


@topic.command("info")
@click.argument("name", shell_complete=_completed)
@data_options
@shown("--seconds", type=positive, default=1.0, help="How long to listen.")
@as_json
def topic_info(name: str, seconds: float, json_out: bool, node: NodeAddress) -> None:
    """Say what topic NAME is: type, content, and how many send it now."""
    from sags_node.messaging import introspection as tool

    found = tool.topic_info(name, node, seconds)
    show(found if json_out else text.yaml_text(found))


@topic.command("echo")
@some_topics
@data_options
@click.option("--count", type=click.IntRange(1), help="Stop after so many messages in all; default: Ctrl-C.")
@click.option("--once", "count", flag_value=1, type=int, help="Stop after the first message.")
@click.option("--field", metavar="KEY", help="Print only this of each: content.status, delay_s, content.K.0.")
@as_json
def topic_echo(
    names: tuple[str, ...], count: int | None, field: str | None, json_out: bool, node: NodeAddress
) -> None:
    """Print the messages of topics, bulk data as shape and range.

    Warnings of their sender go to stderr, and why it pauses.

    \b
    sags topic echo tf
    sags topic echo status --once --field content.rate_hz
    """
    from sags_node.messaging import introspection as tool
    from sags_node.terminal.notices import Notices

    notices = Notices(tell)
    for message in tool.topic_echo(names, node, count=count, warned=notices.update, silent=tell):
        found: Any = part_of(message, field) if field else message
        show(json_text(found) if json_out else text.echo_text(found))


def _measuring(name: Literal["hz", "bw", "delay"], doc: str, *more: Callable[..., Any]) -> None:
    """Add a command that listens to topics, one after the other; `more` are options that only it has."""

    @topic.command(name, help=doc)
    @some_topics
    @data_options
    @shown("--seconds", type=positive, default=5.0, help="How long to listen to each.")
    @as_json
    def command(names: tuple[str, ...], json_out: bool, **asked: Any) -> None:
        from sags_node.messaging import introspection as tool

        found = {each: tool.topic_figures(name, each, **asked) for each in names}
        if json_out:
            show(found if len(found) > 1 else found[names[0]])
            return
        for each, figures in found.items():
            said: str = getattr(text, f"{name}_text")(figures)
            show(f"{each}: {said}" if len(found) > 1 else said)

    for option in more:
        option(command)


_measuring("hz", "Rate of topics, and min, max and std dev of the intervals.")
_measuring("bw", "Bytes per second and per message of topics.")
_measuring(
    "delay",
    "Age of the messages of topics: now minus the capture stamp. Of a node on another machine, --control "
    "lets its clock be asked for; else both clocks are taken to be equal.",
    control_option,
)
