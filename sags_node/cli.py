"""The `sags` command. Exit codes: 0 ok, 1 failure, 2 usage, 130 stopped with Ctrl-C."""

from __future__ import annotations

import json
import logging
import signal
import tempfile
from collections.abc import Callable
from dataclasses import asdict
from functools import wraps
from pathlib import Path
from typing import Any, cast

import click
from rich.logging import RichHandler
from rich.markup import escape

from sags_node import __version__
from sags_node.apps import text
from sags_node.apps.launching import as_json, open_launched, positive, split
from sags_node.apps.terminal import check_file, check_folder, console, progress, show, writing
from sags_node.cli_bench import bench
from sags_node.errors import SagsError, UsageError

endpoint_option = click.option(
    "--endpoint", help="Data socket of the node; default: the connection file of the node on this machine."
)
ns_option = click.option("--ns", default="sags", show_default=True, help="Namespace of the topics.")


def keys_options(command: Callable[..., None]) -> Callable[..., None]:
    """Options for a node that wants keys; the command gets them as `keys`."""

    @click.option(
        "--key",
        metavar="FILE.key",
        type=click.Path(path_type=Path),
        help="Your secret key file (sags keygen), for a node that wants one.",
    )
    @click.option(
        "--server-key",
        metavar="KEY",
        help="The node's .pub file or the key itself; default: the connection file.",
    )
    @wraps(command)
    def with_keys(*args: Any, key: Path | None, server_key: str | None, **rest: Any) -> None:
        from sags_node.messaging.address import client_keys

        command(*args, keys=client_keys(key, server_key), **rest)

    return with_keys


class Sags(click.Group):
    """Turns expected errors into one message and an exit code."""

    def invoke(self, ctx: click.Context) -> Any:
        try:
            return super().invoke(ctx)
        except SagsError as error:
            console.print(f"[red]error:[/] {escape(str(error))}", soft_wrap=True)
            ctx.exit(error.exit_code)
        except KeyboardInterrupt:
            console.print("stopped")
            ctx.exit(130)


@click.group(cls=Sags, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__)
@click.option("--verbose", "-v", is_flag=True, help="Show what happens inside.")
def main(verbose: bool) -> None:
    """SAGS node: an online, deformable Gaussian model of tissue from stereo endoscope video.

    Frames come from a recording or from cameras; rendered views, metric depth, points and splats go out over
    ZeroMQ on this machine. Start with `sags demo`.

    Research software, not a medical device.
    """
    level = logging.INFO if verbose else logging.WARNING
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # a service manager's stop is a Ctrl-C
    logging.basicConfig(
        level=level, format="%(message)s", handlers=[RichHandler(console=console, show_path=False)]
    )


# ---- run, demo, eval -------------------------------------------------------------------------------------


@main.command()
@click.argument("launch", nargs=-1, metavar="[LAUNCH.yaml | SESSION] [key:=value ...]")
@click.option("--seconds", type=positive, help="Stop after so long; default: when the source ends or Ctrl-C.")
@as_json
def run(launch: tuple[str, ...], seconds: float | None, json_out: bool) -> None:
    """Run the node: map the source and publish until it ends.

    Without a launch file the built-in phantom session plays in a loop.

    \b
    sags run launch/d4d_pull.yaml
    sags run launch/v4l2.yaml source.left:=/dev/video-left mapping.budget_ms:=25
    """
    from sags_node.apps.run import health_table, run_node
    from sags_node.config import PhantomSource, load_launch
    from sags_node.node import Node

    path, overrides = split(launch)
    if path is None and isinstance(load_launch(None, overrides).source, PhantomSource):
        overrides = ["source.loop:=true", *overrides]
    session = open_launched(path, overrides)
    node = Node(session.config, session.rig, session.source)
    where = escape(", ".join(node.endpoints))
    console.print(f"publishing on {where} as [bold]{session.config.ns}/...[/]  (Ctrl-C ends)", soft_wrap=True)
    health = run_node(node, seconds, console)
    show(asdict(health) if json_out else health_table(health))


@main.command()
@click.argument("launch", nargs=-1, metavar="[LAUNCH.yaml | SESSION] [key:=value ...]")
@click.option("--seconds", type=positive, default=10.0, show_default=True, help="How long it plays.")
@click.option(
    "--out",
    type=click.Path(path_type=Path),
    default=Path("out/demo"),
    show_default=True,
    help="Folder for report.html, sheet.png and overlay.mp4; older ones are replaced.",
)
@as_json
def demo(launch: tuple[str, ...], seconds: float, out: Path, json_out: bool) -> None:
    """Play a session live beside an overlay subscriber; leave a report.

    The node publishes over real sockets; `sags overlay` runs as its own process and consumes. The report
    shows input, render, depth and error side by side and figures over time. Default: the built-in phantom.
    """
    from sags_node.apps.demo import run_demo
    from sags_node.config import V4l2Source, load_launch
    from sags_node.session import open_session

    path, overrides = split(launch)
    if isinstance(load_launch(path, overrides).source, V4l2Source):
        raise UsageError("sags demo plays recordings; for cameras use sags run and sags overlay")
    check_folder(out)
    with open_launched(path, overrides).source as source:
        frames = max(1, round(source.rate * seconds))
    # Its own sockets and run directory, so that a demo does not meet a node that is already running.
    with tempfile.TemporaryDirectory(prefix="sags-demo-") as private:
        forced = ["source.loop:=true", "source.pace:=realtime", f"source.frames:={frames}"]
        forced += [
            "publish.data:=[tcp://127.0.0.1:*]",
            "publish.control:=null",
            f"publish.run_dir:={private}",
        ]
        session = open_session(path, [*forced, *overrides])
        with progress("playing") as advance:
            outcome = run_demo(session, out, advance)
    show(outcome.summary if json_out else outcome.table)
    console.print(f"report: [bold]{escape(str(outcome.report))}[/], overlay video beside it", soft_wrap=True)


@main.command("eval")
@click.argument("session", nargs=-1, metavar="[LAUNCH.yaml | SESSION] [key:=value ...]")
@click.option(
    "--pace",
    type=click.Choice(["realtime", "step"]),
    default="realtime",
    show_default=True,
    help="realtime: the recording's clock, late frames are dropped; step: every frame, no threads.",
)
@click.option(
    "--iterations", type=click.IntRange(0), help="Fixed steps per frame: reproducible with --pace step."
)
@click.option(
    "--hold-out",
    type=click.IntRange(0),
    default=8,
    show_default=True,
    help="Leave out every so manieth frame; 0: none.",
)
@click.option(
    "--every",
    type=click.IntRange(1),
    default=5,
    show_default=True,
    help="Right eye and LPIPS on every so manieth frame.",
)
@click.option("--lpips-weights", type=click.Path(path_type=Path), help="npz of LPIPS SqueezeNet weights.")
@click.option("--paper-psnr", is_flag=True, help="Also PSNR with masked pixels counted as perfect.")
@click.option("--report", type=click.Path(path_type=Path), help="Folder for an HTML report.")
@click.option("--json", "json_out", metavar="FILE", help="Write the figures as JSON to FILE, - for stdout.")
def evaluate(
    session: tuple[str, ...],
    pace: str,
    iterations: int | None,
    hold_out: int,
    every: int,
    lpips_weights: Path | None,
    paper_psnr: bool,
    report: Path | None,
    json_out: str | None,
) -> None:
    """Measure a recorded session: run time against error.

    It is played through the node's own pipeline, then read once more and compared with what was shown.

    \b
    sags eval launch/d4d_pull.yaml --json out.json
    sags eval launch/d4d_pull.yaml --pace step --iterations 2 --report out/d4d
    """
    from sags_node.evaluation.measure import Options
    from sags_node.evaluation.report import summary_table, write_report
    from sags_node.evaluation.session import Pace
    from sags_node.evaluation.session import evaluate as measure

    path, overrides = split(session)
    options = Options(hold_out, every, lpips_weights, paper_psnr)
    # A long run must not end with nowhere to put its figures.
    if report is not None:
        check_folder(report)
    if json_out is not None and json_out != "-":
        check_file(Path(json_out))
    with progress("measuring") as advance:
        outcome = measure(
            path,
            overrides,
            options,
            cast(Pace, pace),
            iterations,
            lambda what, frames: advance(frames, None, what),
        )
    if report is not None:
        with writing(report):
            page = write_report(report, outcome.summary, outcome.rows, outcome.pictures)
        console.print(f"report: [bold]{escape(str(page))}[/]", soft_wrap=True)
    if json_out is None:
        show(summary_table(outcome.summary))
    elif json_out == "-":
        show(outcome.summary)
    else:
        with writing(Path(json_out)):
            Path(json_out).write_text(json.dumps(outcome.summary, indent=1) + "\n", encoding="utf-8")


@main.command()
@click.argument("dataset", nargs=-1, metavar="[DATASET | LAUNCH.yaml] [key:=value ...]")
@click.option(
    "--out", type=click.Path(path_type=Path), default=Path("out/fit"), show_default=True, help="Folder."
)
@click.option("--resume", is_flag=True, help="Go on from the checkpoint in the folder; same settings.")
@click.option(
    "--schedule",
    type=click.Choice(["paper", "online"]),
    default="online",
    show_default=True,
    help="paper: random points, warm-up on the first frame; online: one pass of the mapper.",
)
@click.option(
    "--warm-up", type=click.IntRange(0), default=1000, show_default=True, help="Iterations; paper only."
)
@click.option(
    "--iterations", type=click.IntRange(0), default=3000, show_default=True, help="With deformation."
)
@click.option(
    "--tokens",
    type=click.Choice(["self", "planes", "nodes"]),
    default="nodes",
    show_default=True,
    help="What the attention sees: the Gaussian alone, its levels, or all control nodes.",
)
@click.option(
    "--monocular",
    is_flag=True,
    help="The depth is an estimate from one picture, true up to scale and shift; paper only.",
)
@click.option("--no-adaptive", is_flag=True, help="Without the self-adaptive block of the decoder.")
@click.option("--no-alias-free", is_flag=True, help="Without both filters.")
@click.option(
    "--max-gaussians",
    type=click.IntRange(100, 2_000_000),
    default=60_000,
    show_default=True,
    help="Cap on N.",
)
@click.option("--seed", type=int, default=0, show_default=True, help="Of everything random.")
@click.option(
    "--hold-out", type=click.IntRange(0), default=8, show_default=True, help="Test on every so manieth."
)
@click.option("--lpips-weights", type=click.Path(path_type=Path), help="npz of LPIPS SqueezeNet weights.")
@as_json
def fit(
    dataset: tuple[str, ...],
    out: Path,
    resume: bool,
    schedule: str,
    warm_up: int,
    iterations: int,
    tokens: str,
    monocular: bool,
    no_adaptive: bool,
    no_alias_free: bool,
    max_gaussians: int,
    seed: int,
    hold_out: int,
    lpips_weights: Path | None,
    json_out: bool,
) -> None:
    """Fit the SAGS model offline to a whole recording.

    Every eighth frame is for testing. By default the online mapper plays the recording once, and what it saw
    is refined jointly; --schedule paper is the protocol of the paper: warm-up on the first frame, then all
    parameters together (with --tokens self: its decoder).

    DATASET is a folder in EndoNeRF or SCARED layout, or any session the node can play. Leaves a checkpoint,
    the model as PLY (standard 3DGS fields, filters folded in), the drawn test frames and figures.json.

    \b
    sags fit launch/d4d_pull.yaml --out out/d4d
    sags fit /data/endonerf/pulling_soft_tissues --schedule paper --tokens self
    """
    from sags_node.apps.fit import figures_table, fit_session
    from sags_node.config import V4l2Source, load_launch
    from sags_node.evaluation.measure import Options
    from sags_node.fitting.settings import MONOCULAR, STEREO, FitSettings, Schedule, Tokens

    path, overrides = split(dataset)
    if isinstance(load_launch(path, overrides).source, V4l2Source):
        raise UsageError("live cameras cannot be fitted; record them first, then fit the recording")
    if monocular and schedule != "paper":
        raise UsageError("--monocular needs --schedule paper: the online start measures distances")
    options = Options(hold_out, 1, lpips_weights)
    settings = FitSettings(
        schedule=cast(Schedule, schedule),
        warm_up=warm_up,
        iterations=iterations,
        tokens=cast(Tokens, tokens),
        adaptive=not no_adaptive,
        antialias=not no_alias_free,
        max_gaussians=max_gaussians,
        seed=seed,
        weights=MONOCULAR if monocular else STEREO,
    )
    check_folder(out)
    session = open_launched(path, [*overrides, "source.loop:=false", "source.pace:=step"])
    with progress("fitting") as advance:
        found = fit_session(session, settings, options, out, resume, advance)
    show(found if json_out else figures_table(found))


main.add_command(bench)


# ---- consumers -------------------------------------------------------------------------------------------


@main.command()
@endpoint_option
@ns_option
@keys_options
@click.option("--pin", type=(float, float), metavar="U V", help="Tissue pixel to pin to; default: centre.")
@click.option("--seconds", type=positive, help="Stop after so long; default: Ctrl-C.")
@click.option("--save", type=click.Path(path_type=Path), help="Write what is shown: .mp4, or .png.")
@as_json
def overlay(
    endpoint: str | None,
    ns: str,
    pin: tuple[float, float] | None,
    seconds: float | None,
    save: Path | None,
    json_out: bool,
    keys: Any,
) -> None:
    """Draw geometry pinned to the tissue over a node's live picture.

    The shape is depth-tested against the tissue, hidden behind instruments, and blanks when anything it
    needs is stale; the video itself is never hidden.
    """
    from sags_node.apps.overlay import run_overlay

    summary = run_overlay(endpoint=endpoint, ns=ns, pin=pin, seconds=seconds, save=save, keys=keys)
    show(summary if json_out else text.overlay_table(summary))


@main.group()
def topic() -> None:
    """Look at what a running node publishes, as `ros2 topic` does."""


@topic.command("list")
@endpoint_option
@ns_option
@keys_options
@click.option("--seconds", type=positive, default=3.0, show_default=True, help="How long to listen.")
@as_json
def topic_list(endpoint: str | None, ns: str, seconds: float, json_out: bool, keys: Any) -> None:
    """Every topic with its type, and the rate and size of what was heard."""
    from sags_node.apps import topic as tool

    rows = tool.topic_list(endpoint=endpoint, ns=ns, seconds=seconds, keys=keys)
    show(rows if json_out else text.topics_table(rows))


@topic.command("echo")
@click.argument("name")
@endpoint_option
@ns_option
@keys_options
@click.option("--count", type=click.IntRange(1), help="Stop after so many messages; default: Ctrl-C.")
@as_json
def topic_echo(
    name: str, endpoint: str | None, ns: str, count: int | None, json_out: bool, keys: Any
) -> None:
    """Print the messages of topic NAME; bulk data as shape and range."""
    from sags_node.apps import topic as tool

    for message in tool.topic_echo(name, endpoint=endpoint, ns=ns, count=count, keys=keys):
        show(message if json_out else text.echo_text(message))


def _measuring(name: str, doc: str) -> None:
    """The commands that listen to one topic for a while."""

    @topic.command(name, help=doc)
    @click.argument("topic_name", metavar="NAME")
    @endpoint_option
    @ns_option
    @keys_options
    @click.option("--seconds", type=positive, default=5.0, show_default=True, help="How long to listen.")
    @as_json
    def command(
        topic_name: str, endpoint: str | None, ns: str, seconds: float, json_out: bool, keys: Any
    ) -> None:
        from sags_node.apps import topic as tool

        measure = getattr(tool, f"topic_{name}")
        figures = measure(topic_name, endpoint=endpoint, ns=ns, seconds=seconds, keys=keys)
        show(figures if json_out else getattr(text, f"{name}_text")(figures))


_measuring("hz", "Rate of topic NAME, and min, max and std dev of the intervals.")
_measuring("bw", "Bytes per second and per message of topic NAME.")
_measuring("delay", "Age of the messages of topic NAME: now minus the capture stamp.")


# ---- tools -----------------------------------------------------------------------------------------------


@main.command()
@click.argument("folder", type=click.Path(path_type=Path))
@click.argument("overrides", nargs=-1, metavar="[key:=value ...]")
def phantom(folder: Path, overrides: tuple[str, ...]) -> None:
    """Write a synthetic stereo session with exact truth.

    FOLDER must be new or empty. Keys: seconds, rate, width, height, seed, camera_motion, smoke, noise, blur.

    \b
    sags phantom out/session seconds:=8 seed:=3 camera_motion:=true smoke:=0.3
    """
    from sags_node.config import PhantomSource, load_launch
    from sags_node.phantom import write_session

    config = load_launch(None, [f"source.{override}" for override in overrides]).source
    if not isinstance(config, PhantomSource):
        raise UsageError(f"sags phantom writes phantom sessions; kind:={config.kind} is something else")
    with progress("rendering") as advance:
        write_session(config, folder, rate=config.rate or 30.0, progress=advance)
    console.print(f"session: [bold]{escape(str(folder))}[/]; play it with: sags run {escape(str(folder))}")


@main.command()
@click.argument("name")
@click.option(
    "--out", type=click.Path(path_type=Path), default=Path(), show_default=True, help="Folder for both files."
)
def keygen(name: str, out: Path) -> None:
    """Make a key pair for a node or for a client.

    NAME.key is secret: it stays with whoever runs the node or the client. NAME.pub is for the other side. A
    node with keys encrypts its tcp sockets and lets in only clients whose .pub it has.

    \b
    sags keygen node --out keys
    sags keygen viewer --out keys/clients
    sags run publish.key:=keys/node.key publish.allow:=keys/clients 'publish.data:=[tcp://*:5556]'
    sags topic hz tf --endpoint tcp://HOST:5556 --key keys/clients/viewer.key --server-key keys/node.pub
    """
    from sags_node.messaging.security import write_key_pair

    secret, public = write_key_pair(out, name)
    console.print(f"secret, stays here: [bold]{escape(str(secret))}[/]", soft_wrap=True)
    console.print(f"public, give it to the other side: [bold]{escape(str(public))}[/]", soft_wrap=True)


@main.command()
@click.argument("launch", nargs=-1, metavar="[LAUNCH.yaml] [key:=value ...]")
@as_json
def doctor(launch: tuple[str, ...], json_out: bool) -> None:
    """Check that everything the node needs is here."""
    from sags_node.apps.doctor import as_rows, examine
    from sags_node.config import load_launch

    checks = examine(load_launch(*split(launch)))
    rows = as_rows(checks)
    show(rows if json_out else text.rows_table(rows))
    if any(check.level == "error" for check in checks):
        raise SagsError("something the node needs is missing; see the mends above")


@main.group()
def calib() -> None:
    """Work with camera calibrations."""


@calib.command("check")
@click.argument("folder", type=click.Path(path_type=Path))
@as_json
def calib_check(folder: Path, json_out: bool) -> None:
    """Look over a calibration for what usually goes wrong.

    FOLDER holds left.yaml and right.yaml (ROS camera_info).
    """
    from sags_node.calibration import check_rig, read_rig

    findings = check_rig(read_rig(folder))
    rows = [asdict(finding) for finding in findings]
    show(rows if json_out else text.rows_table(rows))
    if any(finding.level == "error" for finding in findings):
        raise SagsError(f"{folder} cannot be used as it is; see the mends above")
