"""`benchmarks lengths`: how exactly is measured between anchors."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import click

from benchmarks.commands.measuring import measures, step_by_step
from sags_node.cli.launching import launch_argument
from sags_node.terminal.console import progress


@click.command("lengths")
@launch_argument
@measures
def bench_lengths(launch: tuple[str, ...]) -> tuple[Any, Iterable[Any]]:
    """How exactly lengths and areas between anchors are measured, and whether the errors told are true.

    Anchors are pinned at points of the phantom that its first frame shows. Every fifth frame distances, paths
    of four and triangles between them are compared with the true ones; beside it the first frame's value,
    unchanged.

    \b
    python -m benchmarks lengths source.seconds:=8 --out benchmarks/results/lengths.json
    """
    from benchmarks.quality import measuring

    with progress("measuring") as advance:
        measured = measuring.measure_lengths(step_by_step(launch, "lengths"), advance)
    return measured, measuring.tables(measured)
