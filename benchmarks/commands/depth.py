"""`benchmarks depth`: how right the depth is."""

from __future__ import annotations

from pathlib import Path

import click

from sags_node.cli.launching import (
    as_json,
    check_files,
    figures_option,
    file_option,
    force_option,
    launch_argument,
    open_launched,
    split_recording,
    write_json,
)
from sags_node.errors import UsageError
from sags_node.evaluation.plots import check_plots
from sags_node.files import whole
from sags_node.terminal.console import progress, show

FAULT_SIZE = (640, 512)  # px
FAULT_FRAMES = 4


@click.command("depth")
@launch_argument
@click.option(
    "--ct",
    type=click.Path(path_type=Path, file_okay=False),
    metavar="FOLDER",
    help="One pair of the Open-CAS set against its CT surface, instead of a recording.",
)
@click.option("--faults", is_flag=True, help="The phantom with noise, blur, smoke and highlights rising.")
@click.option(
    "--eyes",
    is_flag=True,
    help="The eyes' depths against each other, for a recording without reference depth.",
)
@click.option(
    "--network",
    type=click.Path(path_type=Path, dir_okay=False, exists=True),
    metavar="FILE.onnx",
    help="A depth network to compare as well.",
)
@figures_option
@file_option(
    "--picture", metavar="FILE.jpg", help="With --ct: draw the left picture, the depth and its error."
)
@file_option("--plot", metavar="FILE.png", help="Draw the errors over run time; not with --faults or --eyes.")
@force_option
@as_json
def bench_depth(
    launch: tuple[str, ...],
    ct: Path | None,
    faults: bool,
    eyes: bool,
    network: Path | None,
    out: Path | None,
    picture: Path | None,
    plot: Path | None,
    force: bool,
    json_out: bool,
) -> None:
    """How right the depth is, and how much there is of it.

    The stereo stage at every scale, beside OpenCV's SGBM in its place and as its own sample sets it up, and a
    network where one is given.
    Median, 90th percentile and median signed error (below 0: too near), the share of the tissue that has a
    depth, the time of one pair, and whether the confidence orders the errors.

    A recording, by default the built-in phantom, is played with one step of the mapper a frame; at
    most every tenth frame is compared with its reference depth, and so is the depth of the drawn model, also
    by region: near and far, at edges, beside instruments, where the right eye does not see. With --eyes the
    depth from the left eye is compared with that from the right one.

    \b
    python -m benchmarks depth launch/d4d_pull.yaml --out benchmarks/results/depth_d4d.json
    python -m benchmarks depth --ct $SAGS_DATA/tmi_ct_pair --out benchmarks/results/depth_tmi.json
    python -m benchmarks depth --faults --out benchmarks/results/depth_phantom.json
    python -m benchmarks depth launch/d4d_pull.yaml --network stereo.onnx
    python -m benchmarks depth launch/hamlyn_heart.yaml --eyes
    """
    from benchmarks.quality import depth, depth_ct, depth_eyes, depth_plot, depth_report

    if (ct is not None) + faults + bool(launch) > 1:
        raise UsageError("a recording, --ct or --faults: give one of them")
    if eyes and (faults or ct is not None):
        raise UsageError("--eyes is for a recording; leave --ct and --faults out")
    if picture is not None and ct is None:
        raise UsageError("--picture draws what --ct measures; add --ct FOLDER")
    if plot is not None:
        if faults or eyes:
            raise UsageError("--plot draws errors of one scene; leave --faults and --eyes out")
        check_plots()
    check_files(out, picture, plot, force=force)
    if ct is not None:
        pair = depth_ct.read_ct_pair(ct)
        with progress("measuring") as advance:
            measured = depth_ct.measure_ct(pair, advance, network)
        if picture is not None:
            with whole(picture) as partial:
                partial.write_bytes(depth_ct.picture(pair))
    elif faults:
        with progress("measuring") as advance:
            measured = depth.measure_faults(FAULT_SIZE, FAULT_FRAMES, depth.FAULTS, advance, network)
    else:
        no_cameras = "benchmarks depth needs a recording; live cameras have no reference depth"
        path, overrides = split_recording(launch, no_cameras)
        session = open_launched(path, [*overrides, "source.loop:=false", "source.pace:=step"])
        with progress("playing") as advance:
            measure = depth_eyes.measure_eyes if eyes else depth.measure_recording
            measured = measure(session, advance, network=network)
    if plot is not None:
        with whole(plot) as partial:
            partial.write_bytes(depth_plot.picture(measured))
    for table in [measured] if json_out else depth_report.tables(measured):
        show(table)
    write_json(out, measured)
