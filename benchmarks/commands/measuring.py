"""What the benchmark commands have in common."""

import functools
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

from sags_node.cli.launching import (
    as_json,
    check_files,
    figures_option,
    open_launched,
    split_recording,
    write_json,
)
from sags_node.pipeline.session import Session
from sags_node.terminal.console import show

Measured = tuple[Any, Iterable[Any]]  # figures, and tables of them for people
RECORDINGS = "plays recordings; record the cameras first"
STEP = ("source.loop:=false", "source.pace:=step")


def measures(command: Callable[..., Measured]) -> Callable[..., None]:
    """Add --out and --json to a command that returns what it measured."""

    @figures_option
    @as_json
    @functools.wraps(command)
    def run(*arguments: Any, out: Path | None, json_out: bool, **options: Any) -> None:
        check_files(out)
        measured, tables = command(*arguments, **options)
        for table in [measured] if json_out else tables:
            show(table)
        write_json(out, measured)

    return run


def split(launch: Sequence[str], name: str, needs: str = RECORDINGS) -> tuple[str | None, list[str]]:
    """Return path and overrides of a recording for the benchmark `name`."""
    return split_recording(launch, f"benchmarks {name} {needs}")


def step_by_step(launch: Sequence[str], name: str) -> Session:
    """Open a recording that is played once, frame by frame."""
    path, overrides = split(launch, name)
    return open_launched(path, [*overrides, *STEP])


def each_recording(launch: Sequence[str], name: str) -> tuple[list[str | None], list[str]]:
    """Return the recordings' paths, by default that of the built-in phantom, and the overrides for all."""
    overrides = [argument for argument in launch if ":=" in argument]
    alone = [[path, *overrides] for path in launch if ":=" not in path] or [overrides]
    return [split(arguments, name)[0] for arguments in alone], overrides
