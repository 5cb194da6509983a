"""`benchmarks masks`: how right the tissue masks are."""

from __future__ import annotations

import click

from benchmarks.commands.measuring import (
    STEP,
    Measured,
    each_recording,
    measures,
)
from sags_node.cli.launching import (
    open_launched,
)
from sags_node.terminal.console import progress


@click.command("masks")
@click.argument("launch", nargs=-1, metavar="[LAUNCH.yaml | SESSION]... [key:=value ...]")
@measures
def bench_masks(launch: tuple[str, ...]) -> Measured:
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

    paths, overrides = each_recording(launch, "masks")
    methods = ["session", "classical", "none"]
    if any(override.startswith("vision.tissue.path:=") for override in overrides):
        methods.append("onnx")
    rows = []
    for path in paths:
        for method in methods:
            session = open_launched(path, [*overrides, *STEP, f"vision.tissue.method:={method}"])
            with progress("playing") as advance:
                rows.append(masks.measure_masks(session, advance))
    return rows, [masks.table(rows)]
