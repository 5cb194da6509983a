"""Options of commands that look for a running node."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial, wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from sags_node.cli.launching import Command, group_of
from sags_node.terminal.console import tell

if TYPE_CHECKING:
    from sags_node.messaging.address import NodeAddress

KNOCK = 3.0  # s for a refusal, which takes a few handshakes
NICENESS = 19  # of a client's process: the node goes first, where both want the same cores

WHICH_NODE = {  # said once, by `sags --help`
    "--ns": "Its namespace, sags by default. An overlay, a player and others have their own: --ns overlay.",
    "--endpoint": "Its data socket; default: the connection file of the node on this machine.",
    "--control": "Its control socket, which a node of another machine needs beside --endpoint.",
    "--run-dir": "Folder of the connection file; default: that of this user.",
    "--key": "Your secret key file (sags keygen), for a node that wants one.",
    "--server-key": "The node's .pub file or the key itself; default: the connection file.",
}


class NodeOption(click.Option):
    """An option that says where a node is. The help of a command names all of these in one line."""

    def get_help_record(self, ctx: click.Context) -> tuple[str, str] | None:
        taken = [each for each in ctx.command.params if isinstance(each, NodeOption)]
        names = ", ".join(each.opts[0] for each in taken)
        return (names, "Which node: see sags --help.") if self is taken[0] else None


def _option(name: str, **how: Any) -> Callable[[Command], Command]:
    return click.option(name, cls=NodeOption, help=WHICH_NODE[name], **how)


_path = partial(_option, type=click.Path(path_type=Path))
endpoint_option = _option("--endpoint", metavar="ENDPOINT")
control_option = _option("--control", metavar="ENDPOINT")
ns_option = _option("--ns", default="sags", metavar="NAME")
run_dir_option = _path("--run-dir", metavar="FOLDER")


def node_options(command: Command) -> Command:
    """Add the options for a node that wants keys. The command gets them, and the other options that say where
    the node is, as `node`."""

    @_path("--key", metavar="FILE.key")
    @_option("--server-key", metavar="KEY")
    @wraps(command)
    def with_node(*args: Any, key: Path | None, server_key: str | None, **rest: Any) -> None:
        from sags_node.messaging.address import NodeAddress, client_keys

        said = {name: rest.pop(name) for name in ("ns", "endpoint", "control", "run_dir") if name in rest}
        command(*args, node=NodeAddress(**said, keys=client_keys(key, server_key)), **rest)

    return with_node


def knock(node: NodeAddress) -> None:
    """Hear whether the endpoint, if one is given, lets this client in: what waits for a node does not ask.

    Raises:
        SagsError: it does not.
    """
    from sags_node.messaging.stream import listen_to

    if node.endpoint is not None and not any(listen_to(node, ["status"], KNOCK)):
        tell(f"waiting: nothing comes from {node.endpoint}; is the node running?")


data_options = group_of(endpoint_option, ns_option, node_options)  # for commands that listen to it
asked_options = group_of(control_option, ns_option, run_dir_option, node_options)  # for commands that ask it
both_options = group_of(control_option, data_options)
