"""`benchmarks disturbances`: what becomes of the node when something is wrong with the pictures."""

from __future__ import annotations

import difflib
from pathlib import Path

import click

from benchmarks.commands.measuring import STEP, split
from sags_node.cli.launching import (
    as_json,
    check_files,
    figures_option,
    force_option,
    launch_argument,
    open_launched,
    positive,
    shown,
    write_json,
)
from sags_node.errors import UsageError
from sags_node.files import whole
from sags_node.terminal.console import progress, show


@click.command("disturbances")
@launch_argument
@click.option(
    "--only",
    multiple=True,
    metavar="NAME",
    help="These alone; may be given several times. Default: all. The undisturbed run is always played.",
)
@click.option(
    "--from",
    "start",
    type=click.IntRange(0),
    metavar="FRAME",
    help="Where each begins. Default: the launch file's first segment, else 40 % of the recording.",
)
@shown(
    "--seconds",
    type=positive,
    default=1.0,
    help="That each lasts; dark (0.5 s), flash (2 frames) and cut (10 frames) at most so long.",
)
@click.option(
    "--pictures",
    type=click.Path(path_type=Path, file_okay=False),
    metavar="DIR",
    help="Write a PNG for each: both eyes as they came, the model and its depth, before, amid and after.",
)
@figures_option
@force_option
@as_json
def bench_disturbances(
    launch: tuple[str, ...],
    only: tuple[str, ...],
    start: int | None,
    seconds: float,
    pictures: Path | None,
    out: Path | None,
    force: bool,
    json_out: bool,
) -> None:
    """What bad pictures do to the node.

    Plays a recording with both eyes, by default the built-in phantom, once for each disturbance, frame by
    frame with one step of the mapper: undisturbed, disturbed for a second, undisturbed again. The picture is
    compared with what the tissue really looked like at that time; published depth with the recording's
    reference; anchors, pinned before, with true surface points, or with where the undisturbed run has them.
    When the node warns, when it stops, how soon the picture is as before, how many models were made anew.
    Instruments are found, not given (vision.tissue.method:=session gives them).

    \b
    smoke         fills the space, drifts, is sucked off; thicker before what is far
    blood         covers half the picture and is sucked off
    fog_right, fog_left, drops      on one lens, on both
    black_right, frozen_right, frozen (both), late_right (3 frames), knocked, swapped, equal
    dark, flicker, flash, blur      the lamp, the exposure, a spark, a shaken scope
    cut           another scene for ten frames
    lost_frames, jpeg               a fifth of the frames; a capture card that compresses too much

    Takes ten to thirty seconds each. Keys: benchmarks/disturbances.md.

    \b
    python -m benchmarks disturbances launch/d4d_pull.yaml --out new.json --pictures out/disturbances
    python -m benchmarks disturbances --only fog_right --only late_right
    """
    from benchmarks.disturbances import DISTURBANCES
    from benchmarks.quality import disturbances, disturbances_report

    for name in set(only) - set(DISTURBANCES):
        near = difflib.get_close_matches(name, DISTURBANCES, n=1)
        hint = f"did you mean '{near[0]}'?" if near else f"there are {', '.join(DISTURBANCES)}"
        raise UsageError(f"--only: unknown disturbance '{name}'; {hint}")
    path, overrides = split(launch, "disturbances")
    names = only or tuple(DISTURBANCES)
    drawn = [] if pictures is None else [pictures / f"{name}.png" for name in ("clean", *names)]
    check_files(out, *drawn, force=force)

    def draw(name: str, shots: list[disturbances.Shot]) -> None:
        if pictures is not None:
            with whole(pictures / f"{name}.png") as file:
                file.write_bytes(disturbances_report.strip(shots))

    session = open_launched(path, ["vision.tissue.method:=classical", *overrides, *STEP])
    with progress("playing") as advance:
        measured = disturbances.measure_disturbances(session, names, start, seconds, advance, draw)
    show(measured if json_out else disturbances_report.table(measured))
    write_json(out, measured)
