"""What commands that open a session or keep figures have in common."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from sags_node.errors import UsageError
from sags_node.terminal.console import check_file, console, progress, writing

if TYPE_CHECKING:
    from sags_node.engine.device import Device
    from sags_node.session import Session

Command = TypeVar("Command", bound=Callable[..., Any])

positive = click.FloatRange(min=0, min_open=True)

launch_argument = click.argument("launch", nargs=-1, metavar="[LAUNCH.yaml | SESSION] [key:=value ...]")
as_json = click.option("--json", "json_out", is_flag=True, help="Print JSON on stdout, for machines.")
lpips_option = click.option(
    "--lpips-weights", type=click.Path(path_type=Path), help="npz of LPIPS SqueezeNet weights."
)


def file_option(name: str, metavar: str, says: str) -> Callable[[Command], Command]:
    """An option for one file, no folder."""
    kind = click.Path(path_type=Path, dir_okay=False)
    return click.option(name, type=kind, metavar=metavar, help=says)


table_option = file_option("--out", "FILE.json", "Write the table as JSON.")


def split(arguments: Sequence[str]) -> tuple[str | None, list[str]]:
    """A launch file or session folder, if there is one, and the overrides."""
    overrides = [argument for argument in arguments if ":=" in argument]
    paths = [argument for argument in arguments if ":=" not in argument]
    for path in paths:
        if "=" in path and not Path(path).exists():
            raise UsageError(f"'{path}' is not an override; write {path.replace('=', ':=', 1)}")
    if len(paths) > 1:
        raise UsageError(f"one launch file or session at a time, not {', '.join(paths)}")
    return (paths[0] if paths else None), overrides


def split_recording(arguments: Sequence[str], no_cameras: str) -> tuple[str | None, list[str]]:
    """`split`, for a command that cannot do with live cameras; `no_cameras` says what to do instead.

    Raises:
        UsageError: the source is live cameras, or the launch is wrong.
    """
    from sags_node.config import LiveSource
    from sags_node.launch_file import load_launch

    path, overrides = split(arguments)
    if isinstance(load_launch(path, overrides).source, LiveSource):
        raise UsageError(no_cameras)
    return path, overrides


def open_launched(path: str | None, overrides: Sequence[str]) -> Session:
    """Open a session and make its kernels ready, saying what takes long and what it runs on."""
    from sags_node.mapping.devices import device_of
    from sags_node.session import open_session
    from sags_node.warm_up import warm_up

    with progress("rendering the phantom (once)") as advance:
        session = open_session(path, overrides, advance)
    with console.status("loading kernels (compiled once per machine, about half a minute)"):
        warm_up(session.config)
    console.print(_runs_on(device_of(session.config)), soft_wrap=True)
    return session


def _runs_on(device: Device) -> str:
    return f"refining on {device.name}" + (f" ({device.reason})" if device.reason else "")


def count_frames(path: str | None, overrides: Sequence[str], seconds: float) -> int:
    """How many frames a recording plays in so long."""
    with open_launched(path, overrides).source as source:
        return max(1, round(source.rate * seconds))


def check_files(*files: Path | None) -> None:
    """A long run must not end with nowhere to put its figures.

    Raises:
        SagsError: one of the files that were asked for cannot be written.
    """
    for file in files:
        if file is not None:
            check_file(file)


def write_json(file: Path | None, figures: Mapping[str, Any] | list[Any]) -> None:
    """Keep figures, if a file was asked for, and under `provenance` where they come from. A list of them is
    kept under `rows`.

    Raises:
        SagsError: it cannot be written.
    """
    if file is not None:
        from sags_node.evaluation.provenance import provenance

        rows = {"rows": figures} if isinstance(figures, list) else figures
        with writing(file):
            text = json.dumps({"provenance": provenance()} | dict(rows), indent=1)
            file.write_text(text + "\n", encoding="utf-8")
