"""`sags archive`: many recordings, on this machine or on a Ray cluster."""

from __future__ import annotations

from pathlib import Path

import click
from rich.markup import escape

from sags_node.cli.launching import as_json
from sags_node.terminal import text
from sags_node.terminal.console import console, progress, show


@click.group()
def archive() -> None:
    """Work through thousands of recordings, on this machine or on a Ray cluster."""


@archive.command()
@click.argument("folder", type=click.Path(path_type=Path))
@click.option(
    "--out",
    default="archive.csv",
    show_default=True,
    metavar="FILE",
    help="The manifest, .csv or .parquet; a path, or a URL that fsspec knows.",
)
@click.option(
    "--rig",
    type=click.Path(path_type=Path),
    help="Calibration of recordings that bring none; default: the nearest folder calib beside or above.",
)
@as_json
def scan(folder: Path, out: str, rig: Path | None, json_out: bool) -> None:
    """List all recordings below a folder in a manifest, and say why the others cannot be played.

    Each one is opened once, as sags run would. The manifest is a table: recording, rig, overrides, weight.

    \b
    sags archive scan /data/theatre3 --out theatre3.parquet
    """
    from sags_node.archive.manifest import write_manifest
    from sags_node.archive.scan import scan as look

    with progress("looking") as advance:
        found = look(folder, rig, advance)
    write_manifest(out, found.recordings)
    refused = [{"path": each.path, "why": each.why} for each in found.refused]
    console.print(
        f"{len(found.recordings)} recordings: [bold]{escape(out)}[/]; {len(refused)} cannot be played",
        soft_wrap=True,
    )
    if json_out:
        show(
            {
                "recordings": [{"recording": each.name, "id": each.id} for each in found.recordings],
                "refused": refused,
            }
        )
    elif refused:
        show(text.rows_table(refused))
