"""`benchmarks deform`: how well a registered model follows tissue that is pulled."""

from __future__ import annotations

from pathlib import Path

import click

from sags_node.cli.launching import as_json, check_files, figures_option, shown, write_json
from sags_node.terminal.console import progress, show


@click.command("deform")
@shown("--seeds", type=click.IntRange(1), default=5, help="Phantoms.")
@figures_option
@as_json
def bench_deform(seeds: int, out: Path | None, json_out: bool) -> None:
    """How well a registered model follows tissue that is pulled.

    A part of the phantom's surface, and the same 5, 10 and 20 mm below it, is held by anchors while the
    surface is pulled by 10 mm and more: rigid, and bent with it (`deform: true`). Errors of its vertices to
    the truth; below the surface that is an elastic half space, by definition. What the check of the residual
    says of both.

    \b
    python -m benchmarks deform --out benchmarks/results/deform.json
    """
    from benchmarks.quality import deform

    check_files(out)
    with progress("pulling") as advance:
        measured = deform.measure_deform(seeds, advance)
    for table in [measured] if json_out else deform.tables(measured):
        show(table)
    write_json(out, measured)
