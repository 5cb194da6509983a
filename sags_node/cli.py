"""The `sags` command. Exit codes: 0 ok, 1 failure, 2 usage, 3 data lost, 130 stopped with Ctrl-C."""

from __future__ import annotations

import json
import logging
import os
import signal
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import click
from rich.console import Console
from rich.logging import RichHandler
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from sags_node import __version__
from sags_node.apps import text
from sags_node.errors import SagsError, UsageError

if TYPE_CHECKING:
    from sags_node.session import Session

# Results go to stdout; what is going on, and errors, to stderr.
console = Console(stderr=True, highlight=False)

positive = click.FloatRange(min=0, min_open=True)

as_json = click.option("--json", "json_out", is_flag=True, help="Print JSON on stdout, for machines.")
endpoint_option = click.option(
    "--endpoint", help="Data socket of the node; default: the connection file of the node on this machine."
)
ns_option = click.option("--ns", default="sags", show_default=True, help="Namespace of the topics.")


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
@click.option("--seconds", type=float, help="Stop after so long; default: when the source ends or Ctrl-C.")
@as_json
def run(launch: tuple[str, ...], seconds: float | None, json_out: bool) -> None:
    """Run the node: map the source and publish the results until it ends.

    Without a launch file the built-in phantom session plays in a loop.

    \b
    sags run launch/d4d_pull.yaml
    sags run launch/v4l2.yaml source.left:=/dev/video-left mapping.budget_ms:=25
    """
    from sags_node.apps.run import health_table, run_node
    from sags_node.node import Node

    path, overrides = _split(launch)
    if path is None:
        overrides = ["source.loop:=true", *overrides]
    session = _open(path, overrides)
    node = Node(session.config, session.rig, session.source)
    console.print(
        f"publishing on {', '.join(node.endpoints)} as [bold]{session.config.ns}/...[/]  (Ctrl-C ends)"
    )
    health = run_node(node, seconds, console)
    if json_out:
        click.echo(json.dumps(asdict(health)))
    else:
        console.print(health_table(health))


@main.command()
@click.argument("launch", nargs=-1, metavar="[LAUNCH.yaml | SESSION] [key:=value ...]")
@click.option("--seconds", type=float, default=10.0, show_default=True, help="How long it plays.")
@click.option("--out", type=click.Path(path_type=Path), default=Path("out/demo"), show_default=True)
@as_json
def demo(launch: tuple[str, ...], seconds: float, out: Path, json_out: bool) -> None:
    """Play a session live beside an overlay subscriber, and leave a report.

    The node publishes over real sockets; `sags overlay` runs as its own process and consumes. The report
    shows input, render, depth and error side by side and figures over time. Default: the built-in phantom.
    """
    from sags_node.apps.demo import run_demo

    path, overrides = _split(launch)
    # Its own sockets and run directory, so that a demo does not meet a node that is already running.
    with tempfile.TemporaryDirectory(prefix="sags-demo-") as private:
        forced = ["source.loop:=true", "source.pace:=realtime", f"source.frames:={round(30 * seconds)}"]
        forced += [
            "publish.data:=[tcp://127.0.0.1:*]",
            "publish.control:=null",
            f"publish.run_dir:={private}",
        ]
        session = _open(path, [*forced, *overrides])
        with _progress("playing") as show:
            outcome = run_demo(session, out, show)
    if json_out:
        click.echo(json.dumps(outcome.summary))
        return
    console.print(outcome.table)
    console.print(f"report: [bold]{outcome.report}[/], overlay video beside it")


@main.command("eval")
@click.argument("session", nargs=-1, metavar="[LAUNCH.yaml | SESSION] [key:=value ...]")
@click.option(
    "--pace",
    type=click.Choice(["realtime", "step"]),
    default="realtime",
    show_default=True,
    help="realtime: the recording's clock, late frames are dropped; step: every frame, no threads.",
)
@click.option("--iterations", type=int, help="Fixed steps per frame: reproducible with --pace step.")
@click.option(
    "--hold-out", type=int, default=8, show_default=True, help="Leave out every so manieth frame; 0: none."
)
@click.option("--every", type=int, default=5, show_default=True, help="Right eye and LPIPS on every so many.")
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
    """Measure a recorded session: run time against error, played through the node's own pipeline.

    \b
    sags eval launch/d4d_pull.yaml --json out.json
    sags eval launch/d4d_pull.yaml --pace step --iterations 2 --report out/d4d
    """
    from sags_node.evaluation.measure import Options
    from sags_node.evaluation.report import summary_table, write_report
    from sags_node.evaluation.session import Pace
    from sags_node.evaluation.session import evaluate as measure

    path, overrides = _split(session)
    options = Options(hold_out, every, lpips_weights, paper_psnr)
    with _progress("measuring") as show:
        outcome = measure(
            path,
            overrides,
            options,
            cast(Pace, pace),
            iterations,
            lambda what, frames: show(frames, None, what),
        )
    if report is not None:
        page = write_report(report, outcome.summary, outcome.rows, outcome.pictures)
        console.print(f"report: [bold]{page}[/]")
    if json_out == "-":
        click.echo(json.dumps(outcome.summary, indent=1))
    elif json_out is not None:
        _write(Path(json_out), json.dumps(outcome.summary, indent=1) + "\n")
    else:
        console.print(summary_table(outcome.summary))


# ---- consumers -------------------------------------------------------------------------------------------


@main.command()
@endpoint_option
@ns_option
@click.option("--pin", type=(float, float), metavar="U V", help="Tissue pixel to pin to; default: centre.")
@click.option("--seconds", type=float, help="Stop after so long; default: Ctrl-C.")
@click.option("--save", type=click.Path(path_type=Path), help="Write what is shown: .mp4, or .png.")
@as_json
def overlay(
    endpoint: str | None,
    ns: str,
    pin: tuple[float, float] | None,
    seconds: float | None,
    save: Path | None,
    json_out: bool,
) -> None:
    """Draw virtual geometry pinned to the tissue over the live left picture of a running node.

    It is depth-tested against the tissue, hidden behind instruments, and blanks when anything it needs is
    stale; the video itself is never hidden.
    """
    from sags_node.apps.overlay import run_overlay

    summary = run_overlay(endpoint=endpoint, ns=ns, pin=pin, seconds=seconds, save=save)
    _report(summary, json_out)


@main.group()
def topic() -> None:
    """Look at what a running node publishes, in the words of `ros2 topic`."""


@topic.command("list")
@endpoint_option
@ns_option
@click.option("--seconds", type=float, default=2.0, show_default=True, help="How long to listen.")
@as_json
def topic_list(endpoint: str | None, ns: str, seconds: float, json_out: bool) -> None:
    """Topics heard, with their type, rate and size."""
    from sags_node.apps import topic as tool

    _report_rows(tool.topic_list(endpoint=endpoint, ns=ns, seconds=seconds), json_out)


@topic.command("echo")
@click.argument("name")
@endpoint_option
@ns_option
@click.option("--count", type=int, help="Stop after so many messages.")
@as_json
def topic_echo(name: str, endpoint: str | None, ns: str, count: int | None, json_out: bool) -> None:
    """Print the messages of a topic; bulk data as shape and range."""
    from sags_node.apps import topic as tool

    for message in tool.topic_echo(name, endpoint=endpoint, ns=ns, count=count):
        _report(message, json_out)


def _rate_command(name: str, doc: str) -> None:
    @topic.command(name, help=doc)
    @click.argument("topic_name", metavar="NAME")
    @endpoint_option
    @ns_option
    @click.option("--seconds", type=float, default=5.0, show_default=True, help="How long to listen.")
    @as_json
    def command(topic_name: str, endpoint: str | None, ns: str, seconds: float, json_out: bool) -> None:
        from sags_node.apps import topic as tool

        measure = getattr(tool, f"topic_{name}")
        _report(measure(topic_name, endpoint=endpoint, ns=ns, seconds=seconds), json_out)


_rate_command("hz", "Average rate, min, max and std dev of the intervals, and the window.")
_rate_command("bw", "Bytes per second and per message.")
_rate_command("delay", "Age of messages: now minus the capture stamp.")


# ---- tools -----------------------------------------------------------------------------------------------


@main.command()
@click.argument("folder", type=click.Path(path_type=Path))
@click.argument("overrides", nargs=-1, metavar="[key:=value ...]")
def phantom(folder: Path, overrides: tuple[str, ...]) -> None:
    """Write a synthetic stereo session with exact truth to FOLDER.

    \b
    sags phantom out/session seconds:=8 seed:=3 camera_motion:=true smoke:=0.3
    """
    from sags_node.config import PhantomSource, load_launch
    from sags_node.phantom import write_session

    if folder.exists() and any(folder.iterdir()):
        raise UsageError(f"{folder} is not empty; nothing is overwritten, name another folder")
    config = load_launch(None, [f"source.{override}" for override in overrides]).source
    assert isinstance(config, PhantomSource)
    with _progress("rendering") as show:
        write_session(config, folder, rate=config.rate or 30.0, progress=show)
    console.print(f"session: [bold]{folder}[/]; play it with `sags run {folder}`")


@main.command()
@click.argument("launch", nargs=-1, metavar="[LAUNCH.yaml] [key:=value ...]")
@as_json
def doctor(launch: tuple[str, ...], json_out: bool) -> None:
    """Check that everything the node needs is here."""
    from sags_node.apps.doctor import as_rows, examine
    from sags_node.config import load_launch

    checks = examine(load_launch(*_split(launch)))
    _report_rows(as_rows(checks), json_out)
    if any(check.level == "error" for check in checks):
        raise SagsError("something the node needs is missing; see the mends above")


@main.group()
def calib() -> None:
    """Work with camera calibrations."""


@calib.command("check")
@click.argument("folder", type=click.Path(path_type=Path))
@as_json
def calib_check(folder: Path, json_out: bool) -> None:
    """Look over FOLDER/left.yaml and right.yaml (ROS camera_info) for what usually goes wrong."""
    from sags_node.calibration import check_rig, read_rig

    findings = check_rig(read_rig(folder))
    _report_rows([asdict(finding) for finding in findings], json_out)
    if any(finding.level == "error" for finding in findings):
        raise SagsError(f"{folder} cannot be used as it is; see the mends above")


# ---- shared ----------------------------------------------------------------------------------------------


def _split(arguments: Sequence[str]) -> tuple[str | None, list[str]]:
    """A launch file or session folder, if there is one, and the overrides."""
    overrides = [argument for argument in arguments if ":=" in argument]
    paths = [argument for argument in arguments if ":=" not in argument]
    if len(paths) > 1:
        raise UsageError(f"one launch file or session at a time, not {', '.join(paths)}")
    return (paths[0] if paths else None), overrides


def _open(path: str | None, overrides: Sequence[str]) -> Any:
    """Open a session and make its kernels ready, saying what takes long."""
    from sags_node.session import open_session
    from sags_node.warm_up import warm_up

    with _progress("rendering the phantom (once)") as show:
        session = open_session(path, overrides, show)
    with console.status("loading kernels (compiled once per machine, about half a minute)"):
        warm_up(session.config)
    return session


@contextmanager
def _progress(what: str) -> Iterator[Callable[..., None]]:
    """A progress bar that appears with its first report: show(done, total=None, what=None)."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, transient=True) as bar:
        task = bar.add_task(what, total=None, visible=False)

        def show(done: int, total: int | None = None, description: str | None = None) -> None:
            bar.update(task, completed=done, total=total, description=description or what, visible=True)

        yield show


def _report(figures: dict[str, Any], json_out: bool) -> None:
    if json_out:
        click.echo(json.dumps(figures))
        return
    table = Table(show_header=False, box=None, padding=(0, 2))
    for key, value in figures.items():
        table.add_row(key, f"{value:.3f}" if isinstance(value, float) else str(value))
    console.print(table)


def _report_rows(rows: Sequence[dict[str, Any]], json_out: bool) -> None:
    if json_out:
        click.echo(json.dumps(list(rows)))
        return
    table = Table(box=None, padding=(0, 2))
    for key in rows[0] if rows else ():
        table.add_column(key)
    for row in rows:
        table.add_row(*(f"{v:.2f}" if isinstance(v, float) else str(v) for v in row.values()))
    console.print(table)


def _write(path: Path, text: str) -> None:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    except OSError as error:
        raise SagsError(f"cannot write {path}: {error.strerror}") from None
