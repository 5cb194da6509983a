"""`sags topic`: look at what a running node publishes."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Literal

import click

from sags_node.cli.launching import as_json, positive, shown
from sags_node.cli.node_options import data_options
from sags_node.terminal import text
from sags_node.terminal.console import show, tell

if TYPE_CHECKING:
    from sags_node.messaging.address import NodeAddress


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
    """Every topic with its type, and the rate and size of what was heard.

    \b
    sags topic list
    sags topic list --ns overlay
    """
    from sags_node.messaging import introspection as tool

    rows = tool.topic_list(node, seconds)
    show(rows if json_out else text.topics_table(rows))


@topic.command("echo")
@click.argument("name")
@data_options
@click.option("--count", type=click.IntRange(1), help="Stop after so many messages; default: Ctrl-C.")
@as_json
def topic_echo(name: str, count: int | None, json_out: bool, node: NodeAddress) -> None:
    """Print the messages of topic NAME, bulk data as shape and range.

    Warnings of its sender go to stderr.
    """
    from sags_node.messaging import introspection as tool
    from sags_node.terminal.notices import Notices

    notices = Notices(tell)
    for message in tool.topic_echo(name, node, count=count, warned=notices.update):
        show(message if json_out else text.echo_text(message))


def _measuring(name: Literal["hz", "bw", "delay"], doc: str, *more: Callable[..., Any]) -> None:
    """The commands that listen to one topic for a while; `more` are options of one alone."""

    @topic.command(name, help=doc)
    @click.argument("topic_name", metavar="NAME")
    @data_options
    @shown("--seconds", type=positive, default=5.0, help="How long to listen.")
    @as_json
    def command(topic_name: str, json_out: bool, **asked: Any) -> None:
        from sags_node.messaging import introspection as tool

        figures = tool.topic_figures(name, topic_name, **asked)
        show(figures if json_out else getattr(text, f"{name}_text")(figures))

    for option in more:
        option(command)


_measuring("hz", "Rate of topic NAME, and min, max and std dev of the intervals.")
_measuring("bw", "Bytes per second and per message of topic NAME.")
_measuring(
    "delay",
    "Age of the messages of topic NAME: now minus the capture stamp. Of a node on another machine, --control "
    "lets its clock be asked for; else both clocks are taken to be equal.",
    click.option("--control", metavar="ENDPOINT", help="Control socket of the node."),
)
