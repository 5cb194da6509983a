"""Benchmark commands of the running node: time against error, endurance, tracking, subscribers."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from benchmarks.commands.measuring import (
    Measured,
    each_recording,
    made_ready,
    measures,
    recordings_argument,
    split,
    step_by_step,
    writes,
)
from sags_node.cli.launching import (
    file_option,
    force_option,
    launch_argument,
    open_launched,
    positive,
    shown,
)
from sags_node.errors import SagsError, UsageError
from sags_node.tools.evaluation.plots import check_plots

if TYPE_CHECKING:
    from benchmarks import Advance
    from benchmarks.node.endurance import Order
    from benchmarks.quality.scope import Motion


@click.command("pareto")
@recordings_argument
@click.option(
    "--only",
    metavar="PARTS",
    help="Some of budgets,resolutions,gaussians,skips (all by default), rungs, hosts.",
)
@click.option("--frames", type=click.IntRange(1), help="Of each recording; default: all.")
@shown(
    "--repeat",
    type=click.IntRange(1),
    default=1,
    help="Play each setting so often; the run of middle speed counts.",
)
@file_option("--plot", metavar="FILE.png", help="Draw the image's quality over the time of a frame.")
@force_option
@measures("measuring", "plot")
def bench_pareto(
    launch: tuple[str, ...],
    only: str | None,
    frames: int | None,
    repeat: int,
    plot: Path | None,
    advance: Advance,
) -> Measured:
    """Run time against error of the online mapper.

    Plays recordings, by default the built-in phantom, with other time budgets, working sizes and numbers of
    Gaussians than their launch files say, and with each rule that skips work on and off. Settings that no
    other beats in both time and image are marked. Beside them: the previous image shown again, the left
    image warped into the right eye, stereo alone, and the offline fit (benchmarks/results/fit_*.json).

    A smaller working size is measured at that size, and once more at the launch file's, for which its
    Gaussians are drawn there: the figure to compare. Takes three to five seconds per frame.

    The part rungs plays each rung of the ladder of quality, with one step a frame: its time and its quality.
    The part hosts plays live, sockets included: with the machine for itself; on one of its cores; beside a
    busy process, the overlay, a reader of everything and the viewer (with a browser, where there is one). It
    tells how many frames are shown after the first second, how fast and how well.

    \b
    python -m benchmarks pareto launch/d4d_pull.yaml launch/phantom.yaml source.start:=2 --frames 50 \\
        --out benchmarks/results/pareto.json --plot docs/pareto.png
    """
    from benchmarks.pareto import measure
    from benchmarks.pareto.plot import picture
    from benchmarks.pareto.settings import PARTS, Sweep

    paths, overrides = each_recording(launch, "pareto")
    if frames is not None:
        overrides.append(f"source.frames:={frames}")
    sweep = Sweep(PARTS if only is None else tuple(only.split(",")), repeat)
    if plot is not None:
        check_plots()
    measured = measure.measure_pareto(paths, overrides, sweep, advance)
    return measured, measure.TABLES, writes(plot, lambda: picture(measured))


@click.command("endurance")
@launch_argument
@shown("--frames", type=click.IntRange(1), default=10_000, help="To be played.")
@shown("--window", type=click.IntRange(2), default=500, help="Frames of a line of the table.")
@shown(
    "--order",
    type=click.Choice(["there-and-back", "wrap", "walk"]),
    default="there-and-back",
    help="Without a jump; from the start again after the last frame; or a random walk that never repeats.",
)
@shown("--seed", type=int, default=0, help="Of the walk and the camera's noise.")
@measures("playing")
def bench_endurance(
    launch: tuple[str, ...], frames: int, window: int, order: Order, seed: int, advance: Advance
) -> Measured:
    """Whether the node lasts: thousands of frames in a row.

    Plays a recording, by default the built-in phantom, over and over, with the launch file's time budget and
    each frame in turn. Window by window: times, PSNR on tissue against each frame, Gaussians, nodes and
    memory; at the end how they change per 1000 frames, and what a scene costs in which nothing moves. Takes
    the budget for each frame, so six minutes for 10,000 at 33 ms; Ctrl-C ends it with the table so far.

    \b
    python -m benchmarks endurance launch/d4d_pull.yaml --order walk --out endurance.json
    """
    from benchmarks.node import endurance

    session = step_by_step(launch, "endurance")
    measured = endurance.measure_endurance(session, frames, window, order, advance, seed)
    return measured, endurance.TABLES


@click.command("soak")
@launch_argument
@shown(
    "--frames",
    type=click.IntRange(1),
    default=18_000,
    help="Of the camera, published or left out; 10 minutes.",
)
@shown("--window", type=click.IntRange(2), default=900, help="Frames of a line of the table.")
@click.option(
    "--check", is_flag=True, help="Fail if a figure gets worse beyond its scatter, by a tenth an hour."
)
@measures("running")
def bench_soak(launch: tuple[str, ...], frames: int, window: int, check: bool, advance: Advance) -> Measured:
    """Whether a live node lasts beside all that uses it.

    Runs a node, by default of the built-in phantom, in a process of its own and in real time, with the
    overlay, the viewer and a browser, a recorder and three subscribers; the last two come and go. Window by
    window: rate, latency, PSNR on tissue, memory, open files and threads; at the end how they change per 1000
    frames, and p99.9 of the latency. 100,000 frames take an hour at 30 Hz; Ctrl-C ends it with the table so
    far.

    \b
    python -m benchmarks soak --frames 100000 --window 5000 --out benchmarks/results/soak.json
    """
    from benchmarks.node import soak

    made_ready(launch, "soak")
    measured = soak.measure_soak(launch, frames, window, advance)

    def judge() -> None:
        if check and (worse := soak.worsening(measured)):
            raise SagsError(f"worse with time: {', '.join(worse)}")

    return measured, soak.TABLES, judge


@click.command("tracking")
@launch_argument
@shown("--frames", "numbers", default="10,20,30,40,50,60,70,80,90", help="After how many frames to measure.")
@measures("following")
def bench_tracking(launch: tuple[str, ...], numbers: str, advance: Advance) -> Measured:
    """How well anchors stay on the tissue.

    Pins anchors all over the first frame of a recording, follows them with one step of the mapper a frame,
    and compares with true points, where the recording has them (the phantom), else with direct optical flow
    between the first and a later frame, where that is consistent. The model's Gaussians beside them, and
    CSRT, pyramidal Lucas-Kanade and dense flow on the same points. Whether confident anchors are right.

    \b
    python -m benchmarks tracking launch/d4d_pull.yaml --out benchmarks/results/tracking_d4d.json
    """
    from benchmarks.quality import tracking

    if not all(number.strip().isdigit() and int(number) > 0 for number in numbers.split(",")):
        raise UsageError(f"--frames {numbers}: give numbers above 0 with commas between, e.g. 10,40")
    session = step_by_step(launch, "tracking")
    measured = tracking.measure_tracking(session, [int(n) for n in numbers.split(",")], advance)
    return measured, tracking.TABLES


@click.command("recall")
@launch_argument
@shown("--seconds", type=positive, default=10.0, help="Out of sight.")
@measures("following")
def bench_recall(launch: tuple[str, ...], seconds: float, advance: Advance) -> Measured:
    """Whether anchors come back after a long time out of sight.

    Pins anchors to the phantom's tissue. Then a cloth covers it, or it is dark and the scope moves, or the
    scope turns away; meanwhile the tissue moves on. Once it is back: how many anchors are on their points
    again, how many are sure and wrong, and how many would be right if they had not moved at all. Also how
    often anchors of some confidence are right, in all frames.

    \b
    python -m benchmarks recall source.seed:=1 --out benchmarks/results/recall.json
    """
    from benchmarks.quality import recall

    path, overrides = split(launch, "recall", "needs the phantom")
    session = open_launched(path, [*overrides, "source.pace:=step"])
    return recall.measure_recall(session, seconds, advance), recall.TABLES


@click.command("scope")
@launch_argument
@click.option(
    "--motion",
    "motions",
    multiple=True,
    type=click.Choice(["sway", "zoom", "orbit"]),
    help="This one alone; may be given several times. Default: all.",
)
@shown("--seconds", type=positive, default=120.0, help="Of each motion.")
@measures("following")
def bench_scope(
    launch: tuple[str, ...], motions: tuple[Motion, ...], seconds: float, advance: Advance
) -> Measured:
    """How accurate the pose of a moving scope stays.

    The phantom's scope sways, zooms and orbits over breathing, pulled tissue, at 10 Hz. Its pose is given,
    estimated from the images, given by a robot that is off by some mm and a degree, and refined from that;
    beside them a camera that takes the scene for rigid, and the pose that fits true points best. Errors of
    the path, drift over whole breaths, images and depth. Takes some minutes for each motion.

    \b
    python -m benchmarks scope --motion orbit source.width:=320 source.height:=256
    """
    from benchmarks.quality import scope
    from sags_node.config.launch_file import load_launch

    config = load_launch(*split(launch, "scope", "needs the phantom"))
    return scope.measure_scope(config, motions or scope.MOTIONS, seconds, advance), scope.TABLES


@click.command("crowd")
@launch_argument
@shown("--seconds", type=positive, default=60.0, help="With the crowd; a quarter for each of the others.")
@measures("listening")
def bench_crowd(launch: tuple[str, ...], seconds: float, advance: Advance) -> Measured:
    """Whether subscribers disturb the node.

    Runs a node, by default of the built-in phantom, in a process of its own: alone; with one reader of
    everything; and with a fast subscriber, a slow one (200 ms a frame), a dead one (never reads) and twenty
    more, each group in its own process. The node's rate, latency and memory, and how old the frames are that
    the subscribers take.

    \b
    python -m benchmarks crowd --seconds 600 --out benchmarks/results/crowd.json
    """
    from benchmarks.node import crowd

    made_ready(launch, "crowd")
    return crowd.measure_crowd(launch, seconds / 4, seconds, advance), crowd.TABLES


@click.command("bridges")
@launch_argument
@shown("--seconds", type=positive, default=30.0, help="Of each bridge.")
@measures("listening")
def bench_bridges(launch: tuple[str, ...], seconds: float, advance: Advance) -> Measured:
    """What each bridge gives and costs.

    Runs a node, by default of the built-in phantom, in a process of its own: alone, and beside each bridge of
    sags bridge with one peer that reads all it gets. Per bridge: rate and bytes, the age of what the peer
    gets, CPU time of the bridge for each frame of the node, and the node's own rate and latency.

    \b
    python -m benchmarks bridges launch/d4d_pull.yaml --out benchmarks/results/bridges.json
    """
    from benchmarks.node import bridges

    made_ready(launch, "bridges")
    return bridges.measure_bridges(launch, seconds, advance), bridges.TABLES


@click.command("thin")
@launch_argument
@shown("--frames", type=click.IntRange(1), default=60, help="To measure.")
@measures("making")
def bench_thin(launch: tuple[str, ...], frames: int, advance: Advance) -> Measured:
    """What thin images cost.

    Plays a recording, by default the built-in phantom, and makes each kind of thin image of every frame
    (docs/wire.md). CPU time to make and to decode one, its size, and what it takes of a link at 30 Hz.

    \b
    python -m benchmarks thin launch/d4d_pull.yaml --out benchmarks/results/thin.json
    """
    from benchmarks.node import thin

    return thin.measure_thin(step_by_step(launch, "thin"), frames, advance), thin.TABLES


@click.command("inputs")
@shown("--seconds", type=positive, default=10.0, help="Of each way.")
@click.option("--only", metavar="NAME", help="Ways that begin so, e.g. gst; default: all.")
@measures("listening")
def bench_inputs(seconds: float, only: str | None, advance: Advance) -> Measured:
    """What a live pair costs until the mapper has it.

    Two images of 1280x1024 px, 30 times a second, by each way into the node (docs/inputs.md). CPU time of a
    pair in the node and in the process that sends, and the time from the stamp until the pair is there. The
    sender also makes the images.

    \b
    python -m benchmarks inputs --out benchmarks/results/inputs.json
    """
    from benchmarks.node import inputs

    return inputs.measure_inputs(seconds, only, advance), inputs.TABLES
