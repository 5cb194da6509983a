"""`benchmarks masks`: how right the tissue masks are."""

from __future__ import annotations

from pathlib import Path

import click

from sags_node.cli.launching import (
    as_json,
    check_files,
    figures_option,
    open_launched,
    split_recording,
    write_json,
)
from sags_node.terminal.console import progress, show


@click.command("masks")
@click.argument("launch", nargs=-1, metavar="[LAUNCH.yaml | SESSION]... [key:=value ...]")
@figures_option
@as_json
def bench_masks(launch: tuple[str, ...], out: Path | None, json_out: bool) -> None:
    """How right masks are that were found, and what they bring.

    Plays recordings that have masks of their own, by default the built-in phantom, once with these, once with
    those found without them (classical), once with none, and with a network's where vision.tissue.path is
    given; one step of the mapper a frame. Intersection over union of the instruments, the share of them that
    is missed, the share of tissue taken for them, what flickers; PSNR and depth error of the model, always
    under the recording's own mask.

    \b
    python -m benchmarks masks launch/d4d_pull.yaml launch/phantom.yaml --out benchmarks/results/masks.json
    """
    from benchmarks.quality import masks

    overrides = [argument for argument in launch if ":=" in argument]
    alone = [[path, *overrides] for path in launch if ":=" not in path] or [overrides]
    no_cameras = "benchmarks masks plays recordings; record the cameras first"
    paths = [split_recording(arguments, no_cameras)[0] for arguments in alone]
    methods = ["session", "classical", "none"]
    if any(override.startswith("vision.tissue.path:=") for override in overrides):
        methods.append("onnx")
    check_files(out)
    rows = []
    for path in paths:
        for method in methods:
            forced = ["source.loop:=false", "source.pace:=step", f"vision.tissue.method:={method}"]
            session = open_launched(path, [*overrides, *forced])
            with progress("playing") as advance:
                rows.append(masks.measure_masks(session, advance))
    show(rows if json_out else masks.table(rows))
    write_json(out, rows)
