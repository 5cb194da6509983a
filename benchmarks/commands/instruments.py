"""`benchmarks instruments`: how exactly instruments are placed."""

from __future__ import annotations

from pathlib import Path

import click

from sags_node.cli.launching import as_json, check_files, figures_option, shown, write_json
from sags_node.terminal.console import progress, show


@click.command("instruments")
@shown("--seeds", type=click.IntRange(1), default=4, help="Phantoms, each with other instruments before it.")
@figures_option
@as_json
def bench_instruments(seeds: int, out: Path | None, json_out: bool) -> None:
    """How exactly the topic `instruments` tells tips, axes and distances, and whether its confidence is true.

    Instruments are put before the phantom, 5 to 40 mm from the tissue: one, two, crossing, and leaving the
    picture. Beside them is the far end of the mask, at the depth of the tissue there, and at the depth that
    the node's stereo finds on the instrument.

    \b
    python -m benchmarks instruments --out benchmarks/results/instruments.json
    """
    from benchmarks.quality import instruments

    check_files(out)
    with progress("placing") as advance:
        measured = instruments.measure_instruments(seeds, advance)
    for table in [measured] if json_out else instruments.tables(measured):
        show(table)
    write_json(out, measured)
