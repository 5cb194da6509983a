"""`benchmarks registration` and `deform`: how exactly a model is placed on tissue, and follows it."""

from __future__ import annotations

from pathlib import Path

import click

from sags_node.cli.launching import as_json, check_files, figures_option, folder_option, shown, write_json
from sags_node.terminal.console import progress, show


@click.command("registration")
@folder_option("--ct", help="The pair of the Open-CAS set with its CT surface, too.")
@shown("--seeds", type=click.IntRange(1), default=20, help="Phantoms, and errors of the picked points.")
@figures_option
@as_json
def bench_registration(ct: Path | None, seeds: int, out: Path | None, json_out: bool) -> None:
    """How exactly a model is placed on tissue, and whether the errors told are true.

    A part of the phantom's surface, moved, is registered to what the node measures of it in a second, from
    five pairs of points that are 1 mm off along each axis. Errors of five targets 20 mm below the surface:
    by the pairs alone, after the fit to the surface, by Open3D's ICP from the same start; and how many are
    within what was told. What must be refused is counted with its remedy.

    \b
    python -m benchmarks registration --ct $SAGS_DATA/tmi_ct_pair --out benchmarks/results/registration.json
    """
    from benchmarks.quality import registration

    check_files(out)
    with progress("registering") as advance:
        measured = registration.measure_registration(ct, seeds, advance)
    for table in [measured] if json_out else registration.tables(measured):
        show(table)
    write_json(out, measured)


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
