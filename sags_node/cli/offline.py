"""`sags eval` and `sags fit`: they work on a recording, not on a running node."""

from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import click

from sags_node.cli.launching import (
    STEPWISE,
    all_figures,
    as_json,
    check_files,
    figures_option,
    launch_argument,
    lpips_option,
    open_launched,
    path_option,
    show_outcome,
    show_verdict,
    shown,
    source_text,
    split,
    split_recording,
    write_json,
)
from sags_node.errors import UsageError
from sags_node.files import alone
from sags_node.terminal.console import console, progress, show
from sags_node.tools.evaluation.plots import check_plots

HOLD_OUT = 8  # every so many frames, as in the literature


@click.command("eval")
@launch_argument
@shown(
    "--pace",
    type=click.Choice(["realtime", "step"]),
    default="realtime",
    help="realtime: a node of its own, on the recording's clock; step: every frame in turn, no sockets.",
)
@click.option(
    "--iterations", type=click.IntRange(0), help="Fixed steps per frame: reproducible with --pace step."
)
@click.option(
    "--warm-up",
    type=click.IntRange(0),
    metavar="FRAMES",
    help="The first frames are played and not measured: source.warm_up.",
)
@click.option(
    "--hold-out",
    type=click.IntRange(0),
    help="Leave out every N-th frame; 0: none.  [default: 8 with --pace step; a live node sees all]",
)
@shown("--every", type=click.IntRange(1), default=5, help="Right eye and LPIPS on every N-th frame.")
@lpips_option
@click.option("--paper-psnr", is_flag=True, help="Also PSNR: what given masks hide counts as perfect.")
@click.option(
    "--hidden",
    is_flag=True,
    help="Also hide boxes of tissue in a second run (--pace step): how good is what is shown there?",
)
@click.option(
    "--aside", is_flag=True, help="Also views from 2 to 20 mm aside (--pace step, the phantom alone)."
)
@path_option("--report", help="Folder for an HTML report.")
@path_option(
    "--receipt",
    help="File for what was compared: frames, masks, sizes, calibration and their digests. --out has it too.",
)
@figures_option
@all_figures
@as_json
def evaluate(
    launch: tuple[str, ...],
    pace: str,
    iterations: int | None,
    warm_up: int | None,
    hold_out: int | None,
    hidden: bool,
    aside: bool,
    report: Path | None,
    receipt: Path | None,
    out: Path | None,
    verbose: bool,
    json_out: bool,
    **what: Any,
) -> None:
    """Measure a recorded session: run time against error.

    It is played, then read once more and compared with what was shown. In real time that is what a
    subscriber gets: rate, latency, images and depth. Then up to 150 frames are played again, frame by
    frame, for the right eye and hidden tissue; without truth also for depth beside its own stereo, and
    points that are followed forth and back. --pace step shows the model every frame on any machine.

    \b
    sags eval launch/d4d_pull.yaml --out out.json
    sags eval launch/d4d_pull.yaml --pace step --iterations 2 --report out/d4d
    """
    from sags_node.config.launch_file import load_launch
    from sags_node.tools.evaluation.measure import MeasureOptions
    from sags_node.tools.evaluation.report import check_report, write_report
    from sags_node.tools.evaluation.session import Pace
    from sags_node.tools.evaluation.session import evaluate as measure

    path, overrides = split(launch)
    if warm_up is not None:
        overrides.append(f"source.warm_up:={warm_up}")
    if hidden and pace != "step":
        raise click.UsageError("--hidden needs --pace step: boxes are taken from the node's own masks")
    if hold_out is None:
        hold_out = HOLD_OUT if pace == "step" else 0
    if aside and pace != "step":
        raise click.UsageError("--aside needs --pace step: only there the model is known frame by frame")
    options = MeasureOptions(hold_out, hidden=hidden, aside=aside, second=True, **what)
    if report is not None:
        check_plots()
        check_report(report)
    check_files(out, receipt)
    console.print(source_text(load_launch(path, overrides).source), markup=False, soft_wrap=True)
    with progress("measuring") as advance:
        outcome = measure(
            path,
            overrides,
            options,
            cast(Pace, pace),
            iterations,
            lambda what, done, count: advance(done, count, what),
        )
    page = None
    if report is not None:
        page = write_report(report, outcome.summary, outcome.rows, outcome.pictures)
    show_outcome(outcome.summary, page, verbose, json_out)
    write_json(receipt, outcome.receipt | {"settings": outcome.summary["settings"]})
    write_json(out, outcome.summary | {"receipt": outcome.receipt})


@click.command()
@click.argument("dataset", nargs=-1, metavar="[DATASET | LAUNCH.yaml] [key:=value ...]")
@path_option("-o", "--out", default=Path("out/fit"), show_default=True, help="Folder.")
@click.option("--resume", is_flag=True, help="Go on from the checkpoint in the folder; same settings.")
@shown(
    "--schedule",
    type=click.Choice(["online", "paper", "released"]),
    default="online",
    help="online: one pass of the mapper, then refining; paper: random points, warm-up on the first frame, "
    "then all together, images of half the size first, and images half way between frames, too; released: "
    "neither, and the authors' numbers, but for their spherical harmonics.",
)
@click.option("--warm-up", type=click.IntRange(0), help="Iterations; not for online.  [default: 1000]")
@click.option(
    "--iterations",
    type=click.IntRange(0),
    help="With deformation; paper does 0.6 times as many before, at half the size.  "
    "[default: 12 for each training frame, 2000 to 8000; not online: 3000]",
)
@click.option(
    "--tokens",
    type=click.Choice(["self", "nodes"]),
    help="What the attention sees: the Gaussian alone, or all control nodes.  "
    "[default: nodes; not online: self]",
)
@click.option(
    "--monocular",
    is_flag=True,
    help="The depth is an estimate from one image, true up to scale and shift; not for online.",
)
@click.option(
    "--block",
    type=click.Choice(["adaptive", "mlp", "none"]),
    help="Of the decoder: the self-adaptive one, an MLP of its size, or none.  [default: adaptive]",
)
@click.option("--no-alias-free", is_flag=True, help="Without both filters.")
@click.option(
    "--max-gaussians",
    type=click.IntRange(100, 2_000_000),
    help="Cap on N.  [default: one for 3.3 px of tissue, at least 60000; released: 960000]",
)
@click.option(
    "--set", "changes", multiple=True, metavar="KEY=VALUE", help="Any other setting, say shape.levels=4."
)
@shown("--seed", type=int, default=0, help="Of everything random.")
@shown("--hold-out", type=click.IntRange(0), default=8, help="Test on every N-th frame; 0: none.")
@lpips_option
@all_figures
@as_json
def fit(
    dataset: tuple[str, ...],
    out: Path,
    resume: bool,
    schedule: str,
    monocular: bool,
    no_alias_free: bool,
    changes: tuple[str, ...],
    hold_out: int,
    lpips_weights: Path | None,
    verbose: bool,
    json_out: bool,
    **asked: Any,
) -> None:
    """Fit the SAGS model offline to a whole recording.

    Every eighth frame is for testing. By default the online mapper plays the recording once, and what it saw
    is refined jointly; --schedule paper is the protocol of the paper: warm-up on the first frame, then all
    parameters together. Of what it changes, --set midway=false, --set coarse=0 and --set slopes=false each
    leave out a part.

    DATASET is a folder in EndoNeRF or SCARED layout, or any session the node can play. Leaves a checkpoint,
    the model as PLY (standard 3DGS fields, filters folded in), the drawn test frames and figures.json.

    The schedules paper and released learn on a GPU where one can be used (device:=auto or cuda); online runs
    on the CPU.

    \b
    sags fit launch/d4d_pull.yaml --out out/d4d
    sags fit /data/endonerf/pulling_soft_tissues --schedule paper
    """
    from sags_node.cli.fit_folder import check_fit, device_of, figures_table, fit_session, fit_verdict
    from sags_node.config.launch_file import load_launch
    from sags_node.tools.evaluation.measure import MeasureOptions
    from sags_node.tools.fitting.settings import MONOCULAR, PRESETS, check_used, with_changes

    no_cameras = "live cameras cannot be fitted; record them first, then fit the recording"
    path, overrides = split_recording(dataset, no_cameras)
    settings = PRESETS[schedule]
    if monocular and settings.schedule == "online":
        raise UsageError("--monocular needs --schedule paper: the online start measures distances")
    options = MeasureOptions(hold_out, 1, lpips_weights)
    given = {name: value for name, value in asked.items() if value is not None}
    named = {*given, *(change.partition("=")[0] for change in changes)}
    if "max_gaussians" in named:
        given["pixels_each"] = 0.0
    if monocular:
        given["weights"] = replace(settings.weights, **MONOCULAR)
    settings = replace(settings, antialias=not no_alias_free, **given)
    settings = with_changes(settings, changes)
    check_used(settings, PRESETS[schedule])
    check_fit(out)
    by_length = settings.schedule == "online" and "iterations" not in named
    device = device_of(load_launch(path, overrides).device, settings.schedule)
    session = open_launched(path, [*overrides, f"device:={device or 'cpu'}", *STEPWISE])
    with alone(out), progress("fitting") as advance:
        found = fit_session(session, settings, options, out, resume, advance, device, by_length)
    if json_out:
        show(found)
        return
    show_verdict([*fit_verdict(found), ("where", f"{out}: model.ply, test/, figures.json")])
    if verbose:
        show(figures_table(found))
