"""What the benchmark commands have in common."""

import functools
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import click

from benchmarks.tables import tables
from sags_node.cli.launching import (
    STEPWISE,
    as_json,
    check_files,
    figures_option,
    open_launched,
    shown,
    split_recording,
    write_json,
)
from sags_node.files import whole
from sags_node.pipeline.session import Session
from sags_node.terminal.console import progress, show

# Figures, the keys of each table of them (see `tables`), and what is done once they are written.
Measured = tuple[Any, Sequence[str]] | tuple[Any, Sequence[str], Callable[[], None]]

RECORDINGS = "plays recordings; record the cameras first"
recordings_argument = click.argument(
    "launch", nargs=-1, metavar="[LAUNCH.yaml | SESSION]... [key:=value ...]"
)


def measures(what: str, *files: str) -> Callable[[Callable[..., Measured]], Callable[..., None]]:
    """Make a command of a function that returns what it measured, with progress, --out and --json.

    Args:
        what: it does. The function is given `advance` to tell of it.
        files: its options that name a file to be written, with --force beside them.
    """

    def decorate(command: Callable[..., Measured]) -> Callable[..., None]:
        @figures_option
        @as_json
        @functools.wraps(command)
        def run(*arguments: Any, out: Path | None, json_out: bool, **options: Any) -> None:
            force = options.pop("force") if files else None
            check_files(out, *(options[name] for name in files), force=force)
            with ExitStack() as stack:
                bars: list[Callable[..., None]] = []  # none yet: a session that is opened has its own

                def advance(*told: Any) -> None:
                    if not bars:
                        bars.append(stack.enter_context(progress(what)))
                    bars[0](*told)

                measured, keys, *then = command(*arguments, advance=advance, **options)
            for table in [measured] if json_out else tables(measured, *keys):
                show(table)
            write_json(out, measured)
            for each in then:
                each()

        return run

    return decorate


def writes(file: Path | None, picture: Callable[[], bytes]) -> Callable[[], None]:
    """Return what writes a picture, if it was asked for."""

    def write() -> None:
        if file is not None:
            with whole(file) as partial:
                partial.write_bytes(picture())

    return write


def seeds_option(count: int, what: str) -> Callable[[Any], Any]:
    return shown("--seeds", type=click.IntRange(1), default=count, help=what)


def split(launch: Sequence[str], name: str, needs: str = RECORDINGS) -> tuple[str | None, list[str]]:
    """Return path and overrides of a recording for the benchmark `name`."""
    return split_recording(launch, f"benchmarks {name} {needs}")


def step_by_step(launch: Sequence[str], name: str) -> Session:
    """Open a recording that is played once, frame by frame."""
    path, overrides = split(launch, name)
    return open_launched(path, [*overrides, *STEPWISE])


def made_ready(launch: Sequence[str], name: str) -> None:
    """Do what takes long and is no part of a node's start: render the phantom, compile kernels."""
    open_launched(*split(launch, name))


def each_recording(launch: Sequence[str], name: str) -> tuple[list[str | None], list[str]]:
    """Return the recordings' paths, by default that of the built-in phantom, and the overrides for all."""
    overrides = [argument for argument in launch if ":=" in argument]
    alone = [[path, *overrides] for path in launch if ":=" not in path] or [overrides]
    return [split(arguments, name)[0] for arguments in alone], overrides
