"""`sags bag`: record what a node publishes, look at recordings, fix them and play them again."""

from __future__ import annotations

import json
import shlex
import signal
import sys
import threading
from _thread import start_new_thread
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from rich.markup import escape
from rich.table import Table

from sags_node.cli.launching import (
    STEPWISE,
    as_json,
    from_zero,
    launch_argument,
    open_launched,
    path_option,
    played_instead,
    positive,
    session_option,
    shown,
    split_recording,
)
from sags_node.cli.node_options import data_options
from sags_node.errors import SagsError, UsageError
from sags_node.messaging.topics import plain_name
from sags_node.terminal import text
from sags_node.terminal.console import console, on_stop_signals, progress, show

if TYPE_CHECKING:
    from sags_node.clients.recording.recorder import RecordOptions
    from sags_node.messaging.address import NodeAddress

DATA_LOST = 3  # exit code

recording = click.argument("path", metavar="RECORDING", type=click.Path(path_type=Path))


@click.group()
def bag() -> None:
    """Record and play, as `ros2 bag` does: rosbag2 folders with MCAP."""


@bag.command()
@launch_argument
@session_option
@path_option("-o", "--out", "--output", help="New folder; default: sags_<date>_<time>.")
@click.option("-a", "--all", "everything", is_flag=True, help="Record all topics, as without --topics.")
@click.option("--topics", multiple=True, metavar="NAME...", help="Record only these.")
@shown(
    "--compression",
    type=click.Choice(["none", "jpeg", "png"]),
    default="none",
    help="Of 8-bit images. jpeg: alpha, masks and color_key become png: they stay exact.",
)
@shown(
    *("--max-cache", "max_cache_mb"),
    type=positive,
    default=256.0,
    metavar="MB",
    help="What may wait for the disk, or be kept for a snapshot; beyond it messages are dropped and counted.",
)
@shown(
    *("-b", "--max-bag-size"),
    type=click.IntRange(0),
    default=0,
    metavar="BYTES",
    help="Go on in a new file of the folder when one is so large; 0: never.",
)
@shown(
    *("-d", "--max-bag-duration"),
    type=from_zero,
    default=0.0,
    metavar="SECONDS",
    help="Go on in a new file of the folder when one is so long; 0: never.",
)
@click.option(
    *("--snapshot-mode", "snapshot_seconds"),
    type=positive,
    metavar="SECONDS",
    help="Keep only the last seconds, as far as --max-cache holds them; write them on SIGUSR1.",
)
@click.option("--stdin", "from_stdin", is_flag=True, help="A line on stdin is as SIGUSR1, its end as Ctrl-C.")
@data_options
@click.option("--seconds", type=positive, help="Stop after so long; default: Ctrl-C.")
@as_json
def record(
    launch: tuple[str, ...],
    session: str | None,
    out: Path | None,
    everything: bool,
    topics: tuple[str, ...],
    max_bag_size: int,
    max_bag_duration: float,
    from_stdin: bool,
    seconds: float | None,
    json_out: bool,
    node: NodeAddress,
    **how: Any,
) -> None:
    """Record what a running node publishes until Ctrl-C.

    If a recording is named, it is played through a node of its own, and what that publishes is recorded.

    Leaves a rosbag2 folder: MCAP files that Foxglove, PlotJuggler and `ros2 bag` open, and metadata.yaml.
    Calibration and parameters are attached. Uncompressed images of both eyes take up to 27 bytes for each
    pixel of a frame: 265 MB/s for 640x512 px at 30 Hz. Messages that the disk was too slow for are counted as
    dropped, those that never arrived as lost. A killed recorder's file is fixed by `sags bag recover`.

    \b
    sags bag record -o out/case1 --compression jpeg
    sags bag record --topics left/image_rect_color right/image_rect_color
    sags bag record -o out/case2 --max-bag-size 4000000000
    sags bag record -o out/last --snapshot-mode 20 --max-cache 6000 & kill -USR1 $!
    sags bag record launch/d4d_pull.yaml -o out/case3 mapping.budget_ms:=100
    """
    from datetime import datetime

    stray = tuple(said for said in launch if ":=" not in said and not Path(said).exists())
    if stray and not topics:
        raise UsageError(
            f"{' '.join(stray)}: no such recording; topics are named so: --topics {' '.join(stray)}; without "
            "--topics all are recorded"
        )
    launch, topics = tuple(said for said in launch if said not in stray), (*topics, *stray)
    if everything and topics:
        raise UsageError("--all or --topics, not both")
    words = played_instead(launch, session)
    if launch and words is None:
        raise UsageError(f"{launch[0]}: key:=value needs a recording: sags bag record RECORDING key:=value")
    live = how["snapshot_seconds"] is not None or from_stdin or seconds is not None or node.endpoint
    if words is not None and live:
        raise UsageError(
            "a recording is recorded as a whole: no --snapshot-mode, --stdin, --seconds, --endpoint"
        )

    from sags_node.clients.recording.bag_writer import Limits
    from sags_node.clients.recording.recorder import Recorder, RecordOptions
    from sags_node.findings import by_code, by_stage
    from sags_node.messaging.stream import check_topic
    from sags_node.node.recorder import findings
    from sags_node.terminal.console import tell as warn
    from sags_node.terminal.notices import Notices

    def tell(said: dict[str, Any]) -> None:
        if from_stdin:
            click.echo(json.dumps(said))
            sys.stdout.flush()
        else:
            line = " ".join(f"{what}: {value}" for what, value in said.items())
            console.print(escape(line), soft_wrap=True)

    with _failure_reported(tell if from_stdin else None):
        names = tuple(check_topic(plain_name(node.ns, name)).name for name in topics)
        options = RecordOptions(
            folder=out or Path(f"sags_{datetime.now():%Y%m%d_%H%M%S}"),
            topics=names,
            limits=Limits(max_bag_size, max_bag_duration),
            node=node,
            **how,
        )
        if words is not None:
            summary = _recorded(words, options)
            show(summary if json_out else recorded_table(summary))
            return
        notices = Notices(warn)

        def watched(summary: dict[str, Any]) -> None:
            if from_stdin:
                tell({"progress": {key: said for key, said in summary.items() if key != "topics"}})
            else:
                notices.update(by_code(by_stage(findings(summary))))
                advance(summary["messages"])

        recorder = Recorder(options)
        on_stop_signals(recorder.stop)
        signal.signal(signal.SIGUSR1, lambda *_: start_new_thread(recorder.snapshot, ()))
        if from_stdin:
            _on_lines(recorder.snapshot, at_the_end=recorder.stop)
        if seconds is not None:
            timer = threading.Timer(seconds, recorder.stop)
            timer.daemon = True
            timer.start()
        try:
            with progress("recording, messages") as advance:
                summary = recorder.run(tell, watched)
        except KeyboardInterrupt:
            saved = f"sags bag recover {shlex.quote(str(options.folder))} -o OUT"
            warn(f"broken off: save what is there with: {saved}")
            raise
    show(summary if json_out else recorded_table(summary))


def _recorded(launch: Sequence[str], options: RecordOptions) -> dict[str, Any]:
    from sags_node.cli.played_bag import record_session

    no_cameras = "live cameras are recorded from the running node; name no recording"
    path, overrides = split_recording(launch, no_cameras)
    if options.folder.exists():
        raise UsageError(f"{options.folder} exists already; name a new folder")
    opened = open_launched(path, [*overrides, *STEPWISE])
    with progress("recording") as advance:
        return record_session(opened, options, advance)


@bag.command()
@recording
@shown("-r", "--rate", type=positive, default=1.0, help="Times as fast.")
@click.option("-l", "--loop", is_flag=True, help="Begin anew at the end.")
@click.option("-d", "--delay", type=from_zero, default=0.0, help="Seconds to wait before.")
@click.option(
    "--clock",
    "clock_hz",
    is_flag=False,
    flag_value=40.0,  # as in ros2 bag play
    type=positive,
    metavar="[HZ]",
    help="Publish the recording's time on the topic clock, so often; without a number 40 Hz.",
)
@click.option("-p", "--start-paused", is_flag=True, help="Wait for the first Enter.")
@click.option("--start-offset", type=from_zero, default=0.0, help="Seconds to leave out.")
@click.option("--playback-duration", type=positive, help="Seconds of the recording to play.")
@click.option("--topics", multiple=True, metavar="NAME", help="Play only this; may be repeated.")
@click.option("-x", "--exclude", multiple=True, metavar="NAME", help="Do not play this; may be repeated.")
@click.option("-m", "--remap", multiple=True, metavar="OLD:=NEW", help="Publish under another name.")
@shown("--endpoint", default="tcp://127.0.0.1:5556", help="Where to publish.")
@shown("--ns", default="sags", help="Namespace of the topics.")
@path_option("--run-dir", metavar="FOLDER", help="Where consumers find it; default: your own.")
@as_json
def play(
    path: Path,
    start_paused: bool,
    topics: tuple[str, ...],
    exclude: tuple[str, ...],
    remap: tuple[str, ...],
    endpoint: str,
    ns: str,
    run_dir: Path | None,
    json_out: bool,
    **how: Any,
) -> None:
    """Publish a recording again; Enter pauses and goes on.

    Subscribers get it as from a node: stamps are moved to now, compressed images are sent raw. It takes no
    requests: no anchors (sags overlay, clicks in sags view), views nor sags health. Those need a node, which
    plays the images of a recording: sags run PATH.

    \b
    sags bag play out/case1 --rate 0.5 --loop
    sags bag play out/case1 --clock 100
    """
    from sags_node.clients.recording.player import Player, PlayOptions
    from sags_node.config.schema import PublishConfig

    ns = ns.strip("/")
    options = PlayOptions(
        topics=tuple(plain_name(ns, name) for name in topics),
        exclude=tuple(plain_name(ns, name) for name in exclude),
        remap=remappings(remap, ns),
        **how,
    )

    def ready(endpoints: Sequence[str]) -> None:
        where = ", ".join(endpoints)
        console.print(escape(f"publishing {path} on {where} as {ns}/...  (Ctrl-C ends)"), soft_wrap=True)

    config = PublishConfig(data=(endpoint,), control=None, run_dir=run_dir)
    player = Player(path, options, config, ns, start_paused)
    on_stop_signals(player.stop)
    _on_lines(player.toggle_pause)
    summary = player.play(ready)
    show(summary if json_out else f"{summary['messages']} messages in {summary['seconds']} s")


@bag.command()
@recording
@as_json
def info(path: Path, json_out: bool) -> None:
    """Say what a recording holds: topics, types, counts, rates, gaps.

    Reads it through, so a damaged file is found here: rosbag2 folders, .mcap, .db3 and ROS 1 .bag files.
    """
    from sags_node.clients.recording.info import bag_info

    found = bag_info(path)
    show(found if json_out else info_table(found))


@bag.command()
@recording
@path_option("-o", "--out", "--output", required=True, help="New folder.")
@as_json
def recover(path: Path, out: Path, json_out: bool) -> None:
    """Save what is whole of a damaged MCAP file or folder.

    Everything up to the damage, and every intact chunk after it. Exit code 3 when something was lost.
    """
    from sags_node.clients.recording.recover import recover as save

    done = save(path, out)
    show(done if json_out else recovered_text(done))
    if done["lost"]:
        click.get_current_context().exit(DATA_LOST)


@contextmanager
def _failure_reported(tell: Callable[[dict[str, Any]], None] | None) -> Iterator[None]:
    """Report a failure through `tell`, too, as `{"error": text}`; None: no program reads it."""
    try:
        yield
    except SagsError as error:
        if tell is not None:
            tell({"error": str(error)})
        raise


def _on_lines(call: Callable[[], None], at_the_end: Callable[[], None] = lambda: None) -> None:
    """Call for each line that comes on stdin, from a thread of its own."""

    def read() -> None:
        try:
            for _ in sys.stdin:
                call()
        finally:
            at_the_end()

    threading.Thread(target=read, name="stdin", daemon=True).start()


def remappings(said: Sequence[str], ns: str) -> dict[str, str]:
    """Return the new names of topics by their old ones, from `old:=new` of `--remap`.

    Raises:
        UsageError: one is written otherwise.
    """
    pairs = [item.partition(":=") for item in said]
    for old, assigned, new in pairs:
        if not (old and assigned and new):
            raise UsageError(f"--remap {old}{assigned}{new}: write old:=new")
    return {plain_name(ns, old): plain_name(ns, new) for old, _, new in pairs}


def recorded_table(summary: Mapping[str, Any]) -> Table:
    """Return a table of what a recorder wrote, dropped and lost."""
    from sags_node.node.recorder import SILENT_SECONDS  # brings NumPy along, which --help does not need

    table = text.table("topic", "messages", "dropped", "lost")
    for name, row in summary["topics"].items():
        table.add_row(name, str(row["messages"]), str(row["dropped"]), str(row["lost"]))
    table.add_row("in all", str(summary["messages"]), str(summary["dropped"]), str(summary["lost"]))
    silent = summary["silent_s"]
    ended = f"; nothing came in the last {silent:.0f} s" if silent > SILENT_SECONDS else ""
    size = f"{summary['bytes'] / 1e6:.1f} MB at {summary['mb_per_s']} MB/s"
    table.caption = f"{summary['folder']}: {size}{ended}"
    return table


def info_table(info: Mapping[str, Any]) -> Table:
    """Return a table of what a bag holds."""
    table = text.table("topic", "type", "messages", "Hz", "lost", "longest gap (s)")
    for row in info["topics"]:
        cells = (row[key] for key in ("topic", "type", "messages", "rate_hz", "lost", "longest_gap_s"))
        table.add_row(*("-" if cell is None else str(cell) for cell in cells))
    files = f" in {len(info['files'])} files" if len(info["files"]) > 1 else ""
    held = f"{info['duration_s']} s, {info['messages']} messages, {info['size'] / 1e6:.1f} MB{files}"
    table.caption = f"{info['path']}: {held}"
    return table


def recovered_text(done: Mapping[str, Any]) -> str:
    """Return what was saved and what was not."""
    saved = f"{done['messages']} messages saved to {done['folder']}"
    if not done["lost"]:
        return f"{saved}; nothing was lost"
    parts = {
        "damaged chunks": done["chunks_damaged"],
        "messages without a topic": done["messages_lost"],
        "bytes that are no records": done["bytes_skipped"],
        "files cut off or never closed": done["unclosed_files"],
        "files missing": done["files_missing"],
    }
    return f"{saved}; not whole: " + ", ".join(f"{what} {count}" for what, count in parts.items() if count)
