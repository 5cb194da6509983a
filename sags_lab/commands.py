"""What this package adds to the `sags` command: `archive`, `eval --protocol`, `export --lerobot`."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from sags_lab.archive.command import archive
from sags_lab.lerobot.option import version_option
from sags_lab.protocols.option import evaluate_protocol, protocol_option

if TYPE_CHECKING:
    from sags_lab.lerobot.form import Version


def extend(sags: click.Group) -> None:
    """Add them. Called by `sags_node.cli.main`, by the entry point `sags.commands`."""
    sags.add_command(archive)
    _wrap(sags.commands["eval"], _by_protocol, protocol_option)
    _wrap(sags.commands["export"], _with_lerobot, lerobot_option, version_option)


lerobot_option = click.option(
    "--lerobot",
    metavar="FOLDER",
    type=click.Path(path_type=Path, file_okay=False),
    help="Depth, tracks, both pictures and masks of every frame of a recording, in the form of LeRobot.",
)


def _wrap(command: click.Command, around: Callable[..., None], *options: Callable[..., Any]) -> None:
    """Give a command more options; `around` takes them, and calls the command's own work (`own`)."""
    own = command.callback
    command.callback = lambda **arguments: around(own, **arguments)
    for option in options:
        option(command)


def _by_protocol(own: Callable[..., None], protocol: str | None, **arguments: Any) -> None:
    if protocol is None:
        own(**arguments)
    else:
        evaluate_protocol(protocol, **arguments)


def _with_lerobot(own: Callable[..., None], lerobot_version: Version, **arguments: Any) -> None:
    from sags_node.tools.export.played import KINDS, Kind

    def made(folder: Path, rate: float, size: tuple[int, int]) -> Any:
        from sags_lab.lerobot.dataset import LeRobot

        return LeRobot(folder, rate, lerobot_version)

    KINDS["lerobot"] = Kind(made, is_folder=True)
    own(**arguments)
