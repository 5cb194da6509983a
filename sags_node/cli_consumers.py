"""`sags overlay` and `sags topic`: look at what a running node publishes."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import Any

import click
from rich.markup import escape

from sags_node.apps import text
from sags_node.apps.launching import as_json, positive
from sags_node.apps.terminal import console, show

endpoint_option = click.option(
    "--endpoint", help="Data socket of the node; default: the connection file of the node on this machine."
)
ns_option = click.option("--ns", default="sags", show_default=True, help="Namespace of the topics.")


def keys_options(command: Callable[..., None]) -> Callable[..., None]:
    """Options for a node that wants keys; the command gets them as `keys`."""

    @click.option(
        "--key",
        metavar="FILE.key",
        type=click.Path(path_type=Path),
        help="Your secret key file (sags keygen), for a node that wants one.",
    )
    @click.option(
        "--server-key",
        metavar="KEY",
        help="The node's .pub file or the key itself; default: the connection file.",
    )
    @wraps(command)
    def with_keys(*args: Any, key: Path | None, server_key: str | None, **rest: Any) -> None:
        from sags_node.messaging.address import client_keys

        command(*args, keys=client_keys(key, server_key), **rest)

    return with_keys


@click.command()
@endpoint_option
@click.option("--control", metavar="ENDPOINT", help="Control socket of the node; needed with --endpoint.")
@ns_option
@keys_options
@click.option(
    "--scene",
    metavar="FILE.yaml",
    type=click.Path(path_type=Path),
    help="Meshes, points and labels, and the anchors that hold them; default: a built-in target.",
)
@click.option(
    "--pin", type=(float, float), metavar="U V", help="Pixel of the target; default: middle of tissue."
)
@click.option("--repin", is_flag=True, help="Pin again where it was after the model was started anew.")
@click.option(
    "--max-age",
    type=positive,
    default=0.5,
    show_default=True,
    help="Seconds after which an overlay is blanked.",
)
@click.option(
    "--show-latency", is_flag=True, help="Write the time from capture to overlay into the left eye."
)
@click.option("--own-ns", default="overlay", show_default=True, help="Namespace of what is published here.")
@click.option(
    "--run-dir",
    type=click.Path(path_type=Path),
    help="Of the connection files, the node's and this overlay's; default: that of the node.",
)
@click.option("--seconds", type=positive, help="Stop after so long; default: Ctrl-C.")
@click.option("--save", type=click.Path(path_type=Path), help="Write what is shown: .mp4, or .png.")
@as_json
def overlay(json_out: bool, **options: Any) -> None:
    """Publish geometry held by the tissue, for both eyes.

    It is tested against the depth of the tissue, hidden behind instruments, and blank as soon as anything it
    needs is stale. The node may be started later and restarted. docs/wire.md says what is published and how a
    scene file looks.
    """
    from sags_node.apps.overlay import Options, run_overlay

    def tell(said: str) -> None:
        console.print(escape(said), soft_wrap=True)

    summary = run_overlay(Options(**options), tell)
    show(summary if json_out else text.overlay_table(summary))


@click.group()
def topic() -> None:
    """Look at what a running node publishes, as `ros2 topic` does.

    An overlay, a player and others are found by their namespace: --ns overlay.
    """


@topic.command("list")
@endpoint_option
@ns_option
@keys_options
@click.option("--seconds", type=positive, default=3.0, show_default=True, help="How long to listen.")
@as_json
def topic_list(endpoint: str | None, ns: str, seconds: float, json_out: bool, keys: Any) -> None:
    """Every topic with its type, and the rate and size of what was heard.

    \b
    sags topic list
    sags topic list --ns overlay
    """
    from sags_node.apps import topic as tool

    rows = tool.topic_list(endpoint=endpoint, ns=ns, seconds=seconds, keys=keys)
    show(rows if json_out else text.topics_table(rows))


@topic.command("echo")
@click.argument("name")
@endpoint_option
@ns_option
@keys_options
@click.option("--count", type=click.IntRange(1), help="Stop after so many messages; default: Ctrl-C.")
@as_json
def topic_echo(
    name: str, endpoint: str | None, ns: str, count: int | None, json_out: bool, keys: Any
) -> None:
    """Print the messages of topic NAME, bulk data as shape and range.

    Warnings of its sender go to stderr.
    """
    from sags_node.apps import topic as tool
    from sags_node.apps.notices import Notices

    notices = Notices(lambda line: console.print(line, markup=False, soft_wrap=True))
    for message in tool.topic_echo(
        name, endpoint=endpoint, ns=ns, count=count, keys=keys, warned=notices.update
    ):
        show(message if json_out else text.echo_text(message))


def _measuring(name: str, doc: str) -> None:
    """The commands that listen to one topic for a while."""

    @topic.command(name, help=doc)
    @click.argument("topic_name", metavar="NAME")
    @endpoint_option
    @ns_option
    @keys_options
    @click.option("--seconds", type=positive, default=5.0, show_default=True, help="How long to listen.")
    @as_json
    def command(
        topic_name: str, endpoint: str | None, ns: str, seconds: float, json_out: bool, keys: Any
    ) -> None:
        from sags_node.apps import topic as tool

        measure = getattr(tool, f"topic_{name}")
        figures = measure(topic_name, endpoint=endpoint, ns=ns, seconds=seconds, keys=keys)
        show(figures if json_out else getattr(text, f"{name}_text")(figures))


_measuring("hz", "Rate of topic NAME, and min, max and std dev of the intervals.")
_measuring("bw", "Bytes per second and per message of topic NAME.")
_measuring("delay", "Age of the messages of topic NAME: now minus the capture stamp.")
