"""Options of commands that look for a running node."""

from __future__ import annotations

from functools import wraps
from pathlib import Path
from typing import Any

import click

from sags_node.cli.launching import Command, group_of, path_option

NICENESS = 19  # of a client's process: the node goes first, where both want the same cores

endpoint_option = click.option(
    "--endpoint", help="Data socket of the node; default: the connection file of the node on this machine."
)
own_control_option = click.option(
    "--control", metavar="ENDPOINT", help="Control socket; default: the node's connection file."
)
ns_option = click.option("--ns", default="sags", show_default=True, help="Namespace of the topics.")


def node_options(command: Command) -> Command:
    """Options for a node that wants keys; the command gets them, and what other options say of where the node
    is, as `node`."""

    @path_option(
        "--key", metavar="FILE.key", help="Your secret key file (sags keygen), for a node that wants one."
    )
    @click.option(
        "--server-key",
        metavar="KEY",
        help="The node's .pub file or the key itself; default: the connection file.",
    )
    @wraps(command)
    def with_node(*args: Any, key: Path | None, server_key: str | None, **rest: Any) -> None:
        from sags_node.messaging.address import NodeAddress, client_keys

        said = {name: rest.pop(name) for name in ("ns", "endpoint", "control", "run_dir") if name in rest}
        command(*args, node=NodeAddress(**said, keys=client_keys(key, server_key)), **rest)

    return with_node


data_options = group_of(endpoint_option, ns_option, node_options)  # for what the node sends
