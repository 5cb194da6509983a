"""The `sags` command. Exit codes: 0 ok, 1 failure, 2 usage, 130 stopped with Ctrl-C."""

from __future__ import annotations

import errno
import logging
import os
import re
import shlex
import signal
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from importlib.metadata import distribution
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from rich.markup import escape

from sags_node import __version__
from sags_node.cli.bag import bag
from sags_node.cli.bridge import bridge
from sags_node.cli.calib import calib
from sags_node.cli.control import anchor, param, pause, reset, resume
from sags_node.cli.export import export
from sags_node.cli.latency import latency
from sags_node.cli.launching import (
    all_figures,
    as_json,
    launch_argument,
    open_launched,
    path_option,
    positive,
    show_findings,
    show_outcome,
    shown,
    split,
    split_recording,
    words_of,
)
from sags_node.cli.measure import measure
from sags_node.cli.new import new
from sags_node.cli.node_options import WHICH_NODE, control_option, node_options, ns_option
from sags_node.cli.offline import evaluate, fit
from sags_node.cli.overlay import overlay
from sags_node.cli.register import register
from sags_node.cli.topic import topic
from sags_node.cli.view import view
from sags_node.errors import SagsError, UsageError, install
from sags_node.terminal.console import console, interrupt, log_handler, progress, show, stop_signals, visible
from sags_node.tools.evaluation.plots import check_plots

if TYPE_CHECKING:
    from sags_node.messaging.address import NodeAddress

log = logging.getLogger(__name__)
OF_THE_NODE = frozenset("torch cv2 open3d onnxruntime numba PIL mcap lz4 zstandard av".split())
NO_ROOM = (errno.ENOSPC, errno.EDQUOT)  # the disk is full, also the one that stdout goes to
CLOSED = (errno.EACCES, errno.EPERM, errno.ENAMETOOLONG)  # the path cannot be looked up


SECTIONS = {
    "Run": "demo run new import doctor phantom health param pause resume reset",
    "Look": "view topic anchor overlay register",
    "Record": "bag export archive",
    "Measure": "eval fit measure latency calib",
    "Connect": "bridge keygen",
}


class Sags(click.Group):
    """A group that reports expected errors as `_one_message` does; its help has the commands in sections."""

    sections: Mapping[str, str] = {}

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        names = {title: said.split() for title, said in self.sections.items()}
        placed = set[str]().union(*names.values())
        rest = [name for name in self.list_commands(ctx) if name not in placed]
        for title, those in (names | {"More" if names else "Commands": rest}).items():
            there = {name: self.commands[name] for name in those if name in self.commands}
            rows = [(name, each.get_short_help_str(66)) for name, each in there.items() if not each.hidden]
            if rows:
                with formatter.section(title):
                    formatter.write_dl(rows)
        if names:
            with formatter.section("Which node, for commands that look for one"):
                formatter.write_dl(list(WHICH_NODE.items()))

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        with _one_message(ctx):
            return super().parse_args(ctx, args)

    def invoke(self, ctx: click.Context) -> Any:
        try:
            with _one_message(ctx):
                return super().invoke(ctx)
        except (KeyboardInterrupt, SystemError) as error:
            # C code that calls Python turns a Ctrl-C into a SystemError, and C code around that, as where a
            # kernel is loaded, into one more.
            cause: BaseException | None = error
            while isinstance(cause, SystemError):
                cause = cause.__cause__
            if not isinstance(cause, KeyboardInterrupt):
                raise
            console.print("stopped")
            ctx.exit(130)


@contextmanager
def _one_message(ctx: click.Context) -> Iterator[None]:
    """Turn an expected error into one message and an exit code."""
    try:
        return (yield)
    except click.UsageError as error:
        if (said := visible(error.format_message())) == error.format_message():
            raise
        raise click.UsageError(said, error.ctx) from None
    except SagsError as error:
        said, code = str(error), error.exit_code
    except ImportError as error:
        library, code = re.match(r"(lib\S+\.so\S*): cannot open", str(error)), 2
        if library is None and str(error.name).partition(".")[0] not in OF_THE_NODE:
            raise
        said = f"{error.name} is not installed: this is for a client; for all of it {install('node')}"
        if library is not None:
            said = f"{library[1]} is missing on this system; sags doctor says which package has it"
    except Exception as error:
        if (refused := _of_the_system(error)) is None:
            raise
        said, code = refused
    if console.quiet:
        log.error("%s", said)
    console.print(f"[red]error:[/] {escape(said)}", soft_wrap=True)
    ctx.exit(code)


def _of_the_system(error: Exception) -> tuple[str, int] | None:
    """Message and exit code of an error of the system, else None. Not by type: a ZMQError is no OSError."""
    number, file = getattr(error, "errno", None), getattr(error, "filename", None)
    if number in CLOSED and file is not None:
        return f"cannot open {file}: {os.strerror(number)}; check the path and your rights", 2
    if number in NO_ROOM:
        return f"cannot write {file or 'what was asked for'}: {os.strerror(number)}", 1
    if number in (errno.EMFILE, errno.ENFILE):
        return "too many open files; let this process open more, e.g. ulimit -n 1024", 1
    if isinstance(error, MemoryError) or number == errno.ENOMEM:
        return f"no memory is left{f' ({error})' if str(error) else ''}; end others, or see ulimit -v", 1
    if str(error) == "can't start new thread":
        return f"{error}; see ulimit -u and ulimit -v, or a container's limit of processes and memory", 1
    return None


def sags_group(function: Callable[..., None]) -> Sags:
    """Make a `Sags` group of a function that takes the arguments of `begin`: they are its options."""
    function = click.option(
        "--log",
        "form",
        type=click.Choice(["text", "json"]),
        default="text",
        show_default=True,
        help="What stderr gets: lines for people, or one JSON object for each event.",
    )(function)
    function = click.option("--verbose", "-v", is_flag=True, help="Show what happens inside.")(function)
    return click.group(cls=Sags, context_settings={"help_option_names": ["-h", "--help"]})(function)


def begin(verbose: bool, form: str) -> None:
    """Set up messages and signals before a command runs."""
    level = logging.INFO if verbose else logging.WARNING
    signal.signal(signal.SIGINT, interrupt)  # even if `&` in a script had it ignored: then kill -INT works
    signal.signal(signal.SIGTERM, interrupt)  # a service manager's stop is a Ctrl-C
    sys.unraisablehook = interrupt.unraisable
    if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:  # so is the terminal's end, except under nohup
        signal.signal(signal.SIGHUP, interrupt)
    console.quiet = form == "json"
    logging.basicConfig(level=level, format="%(message)s", handlers=[log_handler()])


@sags_group
@click.version_option(__version__)
def main(verbose: bool, form: str) -> None:
    """SAGS node: an online, deformable Gaussian model of tissue from stereo endoscope video.

    Frames come from a recording or from cameras; rendered views, metric depth, points and splats go out over
    ZeroMQ on this machine. Start with `sags demo`.

    Research software, not a medical device.

    \b
    For completion of commands, options and topics (also zsh_source, fish_source):
    eval "$(_SAGS_COMPLETE=bash_source sags)"
    """
    begin(verbose, form)


# ---- run, demo -------------------------------------------------------------------------------------------


@main.command()
@launch_argument
@click.option("--seconds", type=positive, help="Stop after so long; default: when the source ends or Ctrl-C.")
@as_json
def run(launch: tuple[str, ...], seconds: float | None, json_out: bool) -> None:
    """Run the node: map the source and publish until it ends.

    It plays a launch file, a recording, a folder of videos or images (see sags import --check), or a video
    that shows both eyes; without any the built-in phantom session in a loop. Without a calibration it plays
    all the same: depth then has no unit, and all that is published says so.

    In the table at its end "dropped" frames were not shown. "skipped" counts frames that went without a step,
    or, as "frame", equalled the one before. "quality" says how often depth was matched.

    \b
    sags run my_folder
    sags run both_eyes.mp4 rig:=calib/mine
    sags run launch/d4d_pull.yaml
    sags run launch/v4l2.yaml source.left:=/dev/video-left mapping.budget_ms:=25
    """
    from sags_node.cli.foreground import ended_text, health_table, inputs_text, run_node
    from sags_node.config.launch_file import load_launch
    from sags_node.config.schema import PhantomSource
    from sags_node.messaging.content import health_fields
    from sags_node.node.node import Node
    from sags_node.node.service_manager import ServiceManager
    from sags_node.tools.calibration.guess import guess_rig

    manager = ServiceManager(os.environ)
    path, overrides = split(launch)
    if path is None and isinstance(load_launch(None, overrides).source, PhantomSource):
        overrides = ["source.loop:=true", *overrides]
    session = open_launched(path, overrides, guess_rig)
    with stop_signals() as stop:
        node = Node(session.config, session.rig, session.source, manager=manager)
        where = escape(", ".join(node.endpoints))
        console.print(
            f"publishing on {where} as [bold]{session.config.ns}/...[/]  (Ctrl-C ends)", soft_wrap=True
        )
        for line in inputs_text(session.config):
            console.print(line, markup=False, soft_wrap=True)
        health = run_node(node, seconds, console, stop)
    ended = ended_text(node.sent, session.source.frame_count)
    show(health_fields(health) if json_out else health_table(health, ended))


@main.command()
@launch_argument
@shown("--seconds", type=positive, default=10.0, help="How long it plays.")
@path_option(
    *("-o", "--out"),
    default=Path("out/demo"),
    show_default=True,
    help="Folder for report.html, sheet.png and overlay.mp4; older ones are replaced.",
)
@all_figures
@as_json
def demo(launch: tuple[str, ...], seconds: float, out: Path, verbose: bool, json_out: bool) -> None:
    """Play a session live beside an overlay subscriber; leave a report.

    The node publishes over real sockets; `sags overlay` runs as its own process and consumes. The report
    shows input, render, depth and error side by side and figures over time. Default: the built-in phantom.
    """
    from sags_node.pipeline.session import open_session
    from sags_node.tools.demo import VIDEO, run_demo
    from sags_node.tools.evaluation.report import check_report

    no_cameras = "sags demo plays recordings; for cameras use sags run and sags overlay"
    path, overrides = split_recording(launch, no_cameras)
    check_plots()
    check_report(out, VIDEO)
    live = ["source.loop:=true", "source.pace:=realtime"]
    opened = open_launched(path, [*live, *overrides])  # says what it plays, and at what size
    with opened.source as source:
        frames = max(1, round(source.rate * seconds))
    # Its own sockets and run directory, so that a demo does not meet a node that is already running.
    with tempfile.TemporaryDirectory(prefix="sags-demo-") as private:
        forced = [*live, f"source.frames:={frames}", f"vision.scale:={opened.config.vision.scale}"]
        forced += [
            "publish.data:=[tcp://127.0.0.1:*]",
            "publish.control:=tcp://127.0.0.1:*",
            f"publish.run_dir:={private}",
        ]
        session = open_session(path, [*forced, *overrides])
        with progress("playing") as advance:
            outcome = run_demo(session, out, advance)
    show_outcome(outcome.summary, outcome.report, verbose, json_out)


# ---- tools -----------------------------------------------------------------------------------------------


@main.command()
@click.argument("folder", type=click.Path(path_type=Path))
@click.argument("overrides", nargs=-1, metavar="[key:=value ...]")
def phantom(folder: Path, overrides: tuple[str, ...]) -> None:
    """Write a synthetic stereo session with exact truth.

    FOLDER must be new or empty. Keys: seconds, rate, width, height, seed, camera_motion, smoke, noise, blur,
    gloss, still_tissue, blackout.

    \b
    sags phantom out/session seconds:=8 seed:=3 camera_motion:=orbit smoke:=0.3
    """
    from sags_node.config.launch_file import section_of
    from sags_node.phantom import PhantomScene, write_session

    scene = section_of(PhantomScene, overrides)
    with progress("rendering") as advance:
        write_session(scene, folder, rate=scene.rate or 30.0, progress=advance)
    console.print(
        f"session: [bold]{escape(str(folder))}[/]; play it with: sags run {escape(shlex.quote(str(folder)))}"
    )


@main.command()
@click.argument("name")
@path_option("-o", "--out", default=Path(), show_default=True, help="Folder for both files.")
def keygen(name: str, out: Path) -> None:
    """Make a key pair for a node or for a client.

    NAME.key is secret: it stays with whoever runs the node or the client. NAME.pub is for the other side. A
    node with keys encrypts its tcp sockets and lets in only clients whose .pub it has.

    Where that .pub is says what the client may do: in a folder named listen it gets data, in one named
    control it may also pause, reset, pin and open views, elsewhere it may do everything.

    \b
    sags keygen node --out keys
    sags keygen viewer --out keys/clients
    sags keygen display --out keys/clients/listen
    sags run publish.key:=keys/node.key publish.allow:=keys/clients 'publish.data:=[tcp://*:5556]'
    sags topic hz tf --endpoint tcp://HOST:5556 --key keys/clients/viewer.key --server-key keys/node.pub
    """
    from sags_node.messaging.security import write_key_pair

    secret, public = write_key_pair(out, name)
    console.print(f"secret, stays here: [bold]{escape(str(secret))}[/]", soft_wrap=True)
    console.print(f"public, give it to the other side: [bold]{escape(str(public))}[/]", soft_wrap=True)


@main.command()
@control_option
@ns_option
@node_options
@as_json
def health(json_out: bool, node: NodeAddress) -> None:
    """Ask a running node whether it does its work.

    Exit code 0: frames come and are shown, or the node was paused. 1: it waits for frames, starts,
    stops, or does not answer within two seconds. For service managers and containers.

    \b
    sags health || systemctl restart sags
    """
    from sags_node.messaging.control import ControlClient

    with ControlClient.at(node) as client:
        answer = client.request("get_health")
    warnings = ", ".join(answer["warnings"])
    show(answer if json_out else answer["state"] + (f"; warnings: {warnings}" if warnings else ""))
    if not answer["healthy"]:
        raise SagsError(f"the node is {answer['state']}: see sags topic echo diagnostics --ns {node.ns}")


@main.command()
@click.argument("launch", nargs=-1, metavar="[LAUNCH.yaml] [key:=value ...]")
@as_json
def doctor(launch: tuple[str, ...], json_out: bool) -> None:
    """Check that everything the node needs is here.

    With a launch file also what it names: images, calibration, devices, networks. No camera is opened.
    """
    from sags_node.config.launch_file import load_launch
    from sags_node.tools.doctor import as_rows, examine

    rows = as_rows(examine(load_launch(*split(launch))))
    show_findings(rows, json_out, "something the node needs is missing")


@main.command("import")
@click.option("--check", metavar="FOLDER", help="The folder, named by an option.")
@click.argument("said", nargs=-1, metavar="FOLDER [key:=value ...]")
@as_json
def import_folder(check: str | None, said: tuple[str, ...], json_out: bool) -> None:
    """Say what a folder is, and what is odd in it; nothing is changed.

    Each thing that is odd or missing comes with its fix. Looked at are layout, counts and gaps, sizes, black
    borders, interlacing, order of the eyes and rows, mask polarity, unit of depth, and the calibration
    against the images; and it is opened as sags run opens it. Exit code 1: it cannot be played as it is.

    \b
    sags import --check /data/endonerf/pulling_soft_tissues
    sags import --check my_folder 'source.instruments:=[85,170]'
    """
    from dataclasses import asdict

    from sags_node.tools.importing.check import check_folder as look_over

    folder, overrides = words_of(said if check is None else [check, *said])
    if folder is None:
        raise UsageError("name a folder: sags import my_folder")
    with progress("looking it over") as advance:
        rows = [asdict(finding) for finding in look_over(Path(folder), overrides, advance)]
    show_findings(rows, json_out, f"{folder} cannot be played as it is")


@main.command("bench", hidden=True, context_settings={"ignore_unknown_options": True})
@click.argument("arguments", nargs=-1, type=click.UNPROCESSED)
def moved_bench(arguments: tuple[str, ...]) -> None:
    """Say where the benchmarks went: they are no part of the installed package."""
    asked = shlex.join(["python", "-m", "benchmarks", *arguments])
    raise UsageError(f"sags bench is now, in a checkout of the sources: {asked}")


for command in (
    *(new, evaluate, fit, export, bag, bridge, calib, overlay, register, view, topic),
    *(anchor, latency, measure, param, pause, resume, reset),
):
    main.add_command(command)
main.sections = SECTIONS
for more in distribution("sags-node").entry_points.select(group="sags.commands"):
    more.load()(main)  # the commands of packages beside this one
