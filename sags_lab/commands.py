"""What this package adds to the `sags` command: `archive`, `eval --protocol`, `export --lerobot`."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from click.core import ParameterSource

from sags_lab.archive.command import archive
from sags_lab.lerobot.option import version_option
from sags_node.cli.launching import check_files, words_of, write_json
from sags_node.errors import UsageError
from sags_node.terminal import text
from sags_node.terminal.console import progress, show
from sags_node.tools.evaluation.figures import flat

if TYPE_CHECKING:
    from sags_lab.lerobot.form import Version


def extend(sags: click.Group) -> None:
    """Add these to `sags`. `sags_node.cli.main` calls it, through the entry point `sags.commands`."""
    sags.add_command(archive)
    _wrap(sags.commands["eval"], _by_protocol, protocol_option)
    _wrap(sags.commands["export"], _with_lerobot, lerobot_option, version_option)


protocol_option = click.option(
    "--protocol",
    type=click.Choice(["d4d", "endonerf", "scared", "stereomis", "stir"]),
    help="Measure a public data set, in its own layout, by its own rules (docs/evaluation.md).",
)
lerobot_option = click.option(
    "--lerobot",
    metavar="FOLDER",
    type=click.Path(path_type=Path, file_okay=False),
    help="Depth, tracks, both images and masks of every frame of a recording, in the form of LeRobot.",
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
        _measure(protocol, **arguments)


def _measure(
    protocol: str,
    launch: tuple[str, ...],
    iterations: int | None,
    lpips_weights: Path | None,
    out: Path | None,
    json_out: bool,
    **others: Any,
) -> None:
    """Measure a data set by its protocol. `others`: options of `sags eval` that no protocol takes."""
    from sags_lab.protocols import run
    from sags_lab.protocols.d4d import measure_d4d

    source_of = click.get_current_context().get_parameter_source
    idle = others.keys() - {"verbose"} | ({"lpips_weights"} if protocol != "endonerf" else set())
    given = [name for name in sorted(idle) if source_of(name) is ParameterSource.COMMANDLINE]
    if given:
        options = ", ".join(f"--{name.replace('_', '-')}" for name in given)
        raise UsageError(f"--protocol {protocol} measures by rules of its own: leave out {options}")
    path, overrides = words_of(launch)
    if path is None:
        raise UsageError(f"--protocol {protocol} needs the data set's folder")
    if iterations is not None:
        overrides = [*overrides, f"mapping.iterations:={iterations}"]
    check_files(out)
    with progress("measuring") as advance:

        def tell(done: int, what: str) -> None:
            advance(done, None, what)

        measures: dict[str, Callable[..., dict[str, Any]]] = {
            "d4d": measure_d4d,
            "endonerf": partial(run.measure_endonerf, lpips=lpips_weights),
            "scared": run.measure_scared,
            "stereomis": run.measure_stereomis,
            "stir": run.measure_stir,
        }
        found = {"protocol": protocol, **measures[protocol](Path(path), overrides, progress=tell)}
    if json_out:
        show(found)
    else:
        table = text.table()
        for key, value in flat(found).items():
            shown = "–" if value is None else f"{value:.4g}" if isinstance(value, float) else str(value)
            table.add_row(key, shown)
        show(table)
    write_json(out, found)


def _with_lerobot(own: Callable[..., None], lerobot_version: Version, **arguments: Any) -> None:
    from sags_node.tools.export.played import KINDS, Kind

    def made(folder: Path, rate: float, size: tuple[int, int]) -> Any:
        from sags_lab.lerobot.dataset import LeRobot

        return LeRobot(folder, rate, lerobot_version)

    KINDS["lerobot"] = Kind(made, is_folder=True)
    own(**arguments)
