"""What commands that open a session have in common."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from sags_node.apps.terminal import console, progress
from sags_node.errors import UsageError

if TYPE_CHECKING:
    from sags_node.session import Session

positive = click.FloatRange(min=0, min_open=True)

as_json = click.option("--json", "json_out", is_flag=True, help="Print JSON on stdout, for machines.")


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


def open_launched(path: str | None, overrides: Sequence[str]) -> Session:
    """Open a session and make its kernels ready, saying what takes long."""
    from sags_node.session import open_session
    from sags_node.warm_up import warm_up

    with progress("rendering the phantom (once)") as advance:
        session = open_session(path, overrides, advance)
    with console.status("loading kernels (compiled once per machine, about half a minute)"):
        warm_up(session.config)
    return session
