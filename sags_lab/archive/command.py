"""`sags archive`: many recordings, on this machine or on a Ray cluster."""

from __future__ import annotations

import shlex
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from rich.markup import escape
from rich.table import Table

from sags_lab.archive.cluster import check_installed
from sags_lab.archive.jobs import JOBS
from sags_lab.lerobot.option import version_option
from sags_node.cli.launching import (
    all_figures,
    as_json,
    check_files,
    figures_option,
    force_option,
    from_zero,
    launch_argument,
    positive,
    shown,
    split_recording,
    words_of,
    write_json,
)
from sags_node.errors import SagsError, UsageError
from sags_node.terminal import text
from sags_node.terminal.console import console, progress, show
from sags_node.tools.evaluation.plots import check_plots, has_plots

if TYPE_CHECKING:
    from sags_lab.archive.manifest import Recording
    from sags_lab.archive.run import Tally
    from sags_lab.lerobot.form import Version


@click.group()
def archive() -> None:
    """Work through thousands of recordings, here or on a cluster."""


@archive.command()
@click.argument("folder", type=click.Path(path_type=Path))
@shown(
    *("-o", "--out"),
    default="archive.csv",
    metavar="FILE",
    help="The manifest, .csv or .parquet; a path, or a URL that fsspec knows.",
)
@click.option(
    "--rig",
    type=click.Path(path_type=Path),
    help="Calibration of recordings that bring none; default: the nearest folder calib beside or above.",
)
@click.option(
    "--segment",
    type=positive,
    metavar="SECONDS",
    help="A row for each part of a recording, equally long and no longer than this; default: one for all.",
)
@shown(
    "--warm-up",
    type=from_zero,
    default=2.0,
    metavar="SECONDS",
    help="What is played before a segment, so that the model is there when it begins.",
)
@force_option
@as_json
def scan(
    folder: Path,
    out: str,
    rig: Path | None,
    segment: float | None,
    warm_up: float,
    force: bool,
    json_out: bool,
) -> None:
    """List the recordings below a folder in a manifest.

    What cannot be played is named with the reason. Each one is opened once, as sags run would. The manifest
    is a table: recording, rig, overrides, weight, segment.

    \b
    sags archive scan /data/theatre3 --out theatre3.parquet
    sags archive scan /data/theatre3 --out theatre3.csv --segment 300
    """
    check_installed()
    from sags_lab.archive.manifest import beside, check_manifest, write_manifest
    from sags_lab.archive.scan import scan as look
    from sags_lab.archive.segments import Cut

    check_manifest(out, force)
    with progress("looking") as advance:
        found = look(folder, rig, advance, None if segment is None else Cut(segment, warm_up))
    listed = [beside(each, out) for each in found.recordings]
    write_manifest(out, listed)
    refused = [{"path": each.path, "why": each.why} for each in found.refused]
    rows = "" if segment is None else f" in {len(listed)} rows"
    console.print(
        f"{len({each.name for each in listed})} recordings{rows}: [bold]{escape(out)}[/]; "
        f"{len(refused)} cannot be played",
        soft_wrap=True,
    )
    if json_out:
        show(
            {
                "recordings": [
                    {"recording": each.name, "segment": each.segment, "id": each.id} for each in listed
                ],
                "refused": refused,
            }
        )
    elif refused:
        show(text.rows_table(refused))


@archive.command()
@click.argument("source", nargs=-1, metavar="MANIFEST|FOLDER [key:=value ...]")
@click.option(
    "--job",
    type=click.Choice(sorted(JOBS)),
    required=True,
    help="eval: figures and a report; fit: the offline fit; record: a bag of all that a node publishes; "
    "depth, tracks, render, lerobot: as sags export.",
)
@click.option(
    "-o", "--out", required=True, metavar="FOLDER|URL", help="Where the results lie; the same one goes on."
)
@click.option("--ray", "address", metavar="HOST:PORT", help="A Ray cluster; default: --local.")
@click.option("--local", is_flag=True, help="This machine alone; the default.")
@click.option("--limit", type=click.IntRange(1), help="Only so many recordings, the first of the list.")
@click.option("--retry-failed", is_flag=True, help="Also those that are quarantined.")
@shown("--attempts", type=click.IntRange(1), default=3, help="Then one is quarantined.")
@click.option(
    "--timeout", type=positive, metavar="S", help="Seconds that one recording may take; default: any."
)
@click.option(
    "--memory",
    type=positive,
    metavar="GB",
    help="Memory that one recording may take; Ray starts no more at once than fit.  [default: any]",
)
@shown(
    "--stage-limit",
    type=positive,
    default=50.0,
    metavar="GB",
    help="What may be fetched for one recording whose path is a URL.",
)
@click.option("--rig", type=click.Path(path_type=Path), help="As for sags archive scan, of a FOLDER.")
@click.option(
    "--options", default="", metavar="TEXT", help="More options of the job's command, e.g. '--hold-out 0'."
)
@as_json
def run(
    source: tuple[str, ...],
    job: str,
    out: str,
    address: str | None,
    local: bool,
    limit: int | None,
    retry_failed: bool,
    attempts: int,
    timeout: float | None,
    memory: float | None,
    stage_limit: float,
    rig: Path | None,
    options: str,
    json_out: bool,
) -> None:
    """Do a job with every recording of a manifest, or of a folder.

    The same command again does what is missing: recordings that are done stay, unless their files, the
    settings or the version changed. A recording that fails is tried again, then quarantined.

    engine.threads:=N is the number of cores of each recording (default: 1), device:=cuda asks for a GPU; here
    for all, or in a row of the manifest.

    \b
    sags archive run theatre3.csv --job eval --out out/theatre3 --options '--iterations 2'
    sags archive run s3://lab/all.parquet --job fit --out s3://lab/fits --ray head:6379 --timeout 7200
    """
    check_installed()
    from sags_lab.archive.jobs import NEEDS_PLOTS
    from sags_lab.archive.manifest import as_csv
    from sags_lab.archive.overview import write_overview
    from sags_lab.archive.process import Limits
    from sags_lab.archive.results import read_results, write_results
    from sags_lab.archive.results import status as found
    from sags_lab.archive.run import describe
    from sags_lab.archive.run import run as work_through
    from sags_lab.archive.segments import check_frames
    from sags_lab.archive.store import REPORT, RESULTS, Store
    from sags_lab.archive.work import Plan, needs
    from sags_node.tools.evaluation.provenance import revision

    path, overrides = words_of(source)
    if path is None:
        raise UsageError("name a manifest (sags archive scan makes one), or a folder of recordings")
    if local and address is not None:
        raise UsageError("--local is this machine alone; leave it out, or leave out --ray")
    if job in NEEDS_PLOTS:
        check_plots()
    limits = Limits(memory, timeout, stage_limit)
    plan = Plan(job, tuple(overrides), tuple(shlex.split(options)), out, revision(), limits)
    needs(plan)
    recordings = _listed(path, rig)[:limit]
    check_frames(recordings, overrides)
    store = Store(out)
    with store.locked():
        describe(store, recordings, plan, as_csv(recordings))
        with progress(job) as advance:
            began = time.monotonic()

            def tell(tally: Tally, line: str) -> None:
                if line:
                    console.print(escape(line), soft_wrap=True)
                advance(tally.kept + tally.done + tally.quarantined, tally.of, _doing(tally, began))

            tally = work_through(store, recordings, plan, attempts, tell, retry_failed, address)
        write_results(store, recordings)
        if has_plots():
            write_overview(store, read_results(store))
    state = found(store)
    show(state if json_out else _state_table(state))
    page = f", report: [bold]{escape(out)}/{REPORT}[/]" if has_plots() else ""
    console.print(f"table: [bold]{escape(out)}/{RESULTS}[/]{page}", soft_wrap=True)
    if tally.stopping.is_set():
        raise KeyboardInterrupt
    if tally.waits:
        raise SagsError(f"{state['missing']} are missing: {tally.waits}")
    if state["quarantined"]:
        raise SagsError(f"{state['quarantined']} recordings failed; sags archive show {out} ID says why")


def _listed(path: str, rig: Path | None) -> list[Recording]:
    """The recordings of a manifest or folder."""
    from sags_lab.archive.manifest import read_manifest
    from sags_lab.archive.scan import scan as look

    if not Path(path).is_dir():
        return read_manifest(path)
    with progress("looking") as advance:
        found = look(Path(path), rig, advance)
    for refused in found.refused:
        console.print(f"left out: {escape(refused.path)}: {escape(refused.why)}", soft_wrap=True)
    if not found.recordings:
        raise UsageError(f"{path} holds no recording that can be played")
    return found.recordings


def _doing(tally: Tally, began: float) -> str:
    rate = tally.frames / (time.monotonic() - began)
    where = ", ".join(f"{host} {count}" for host, count in sorted(tally.hosts.items()))
    if not tally.hosts and not tally.running:
        return "starting Ray"
    parts = [f"{tally.running} handed out", f"{tally.quarantined} failed", f"{rate:.1f} frames/s", where]
    return ", ".join(part for part in parts if part)


def _state_table(state: dict[str, Any]) -> Table:
    made = text.table()
    counts = (f"{state[what]} {what}" for what in ("done", "quarantined", "missing"))
    made.add_row(f"{state['job']}, {state['recordings']} recordings", ", ".join(counts))
    for each in state["failed"]:
        what = "quarantined" if each["quarantined"] else "failed"
        made.add_row(each["id"], f"{what} after {each['attempts']} attempts: {each['reason']}")
    return made


@archive.command()
@click.argument("out", metavar="OUT")
@as_json
def status(out: str, json_out: bool) -> None:
    """Say how far an archive is, and what failed.

    Also while it runs, from any machine.
    """
    check_installed()
    from sags_lab.archive.results import status as found
    from sags_lab.archive.store import Store

    state = found(Store(out))
    show(state if json_out else _state_table(state))


@archive.command("show")
@click.argument("out", metavar="OUT")
@click.argument("id", metavar="ID")
@all_figures
@as_json
def show_one(out: str, id: str, verbose: bool, json_out: bool) -> None:
    """Show all about one recording.

    Its figures (--verbose: all of them, and the log), or its failed attempts, their log and the command that
    repeats them.

    ID may be the beginning of one.
    """
    check_installed()
    from sags_lab.archive.results import of_one
    from sags_lab.archive.store import Store
    from sags_node.tools.evaluation.figures import verdict

    found = of_one(Store(out), id)
    if json_out:
        show(found)
        return
    made = text.table()
    made.add_row(found["id"], found["state"])
    for attempt in (found["failed"] or {}).get("attempts", ()):
        made.add_row("", f"{attempt['reason']} ({attempt['seconds']:.1f} s, {attempt['host']})")
    if found["failed"] is not None:
        made.add_row("repeat", found["failed"]["command"])
    figures = {key: value for key, value in (found["figures"] or {}).items() if value is not None}
    if figures.get("job") == "eval":
        for what, said in [
            *verdict(figures),
            ("report", f"{out}/recordings/{found['id']}/report/report.html"),
        ]:
            made.add_row(what, said)
    if verbose or figures.get("job") != "eval":
        for key, value in figures.items():
            if verbose or not key.startswith("settings."):
                made.add_row(key, str(value))
    show(made)
    if verbose or found["failed"] is not None:
        console.print(found["log"], markup=False, soft_wrap=True)


@archive.command()
@click.argument("out", metavar="OUT")
@click.argument("folder", type=click.Path(path_type=Path))
@version_option
def dataset(out: str, folder: Path, lerobot_version: Version) -> None:
    """Make one LeRobot data set of all that --job lerobot has done.

    An episode for each recording or segment, in the order of the manifest. FOLDER must be new or empty.

    \b
    sags archive run theatre3.csv --job lerobot --out out/theatre3
    sags archive dataset out/theatre3 out/dataset
    """
    check_installed()
    from sags_lab.archive.results import listed, settings
    from sags_lab.archive.store import RECORDINGS, Store
    from sags_lab.lerobot.dataset import merge

    store = Store(out)
    if store.local is None:
        raise UsageError(f"{out} is no folder of this machine; copy it here first")
    about, recordings = listed(store)
    done = store.done(settings(store))
    if about["job"] != "lerobot" or not done:
        raise UsageError(f"{out} holds {len(done)} results of {about['job']}; run --job lerobot first")
    episodes = [each.id for each in recordings if each.id in done]
    if rest := len(recordings) - len(episodes):
        console.print(f"{rest} recordings are not done, and left out: sags archive status {escape(out)}")
    frames = merge([store.local / RECORDINGS / id / "lerobot" for id in episodes], folder, lerobot_version)
    console.print(
        f"{len(episodes)} episodes, {frames} frames: [bold]{escape(str(folder))}[/]", soft_wrap=True
    )


@archive.command()
@launch_argument
@click.option(
    "--job", "jobs", type=click.Choice(sorted(JOBS)), multiple=True, help="May be repeated; default: all."
)
@shown(
    "--frames",
    type=click.IntRange(4),
    default=120,
    help="That are played; and a fourth of them, to tell what a start costs.",
)
@figures_option
@as_json
def costs(
    launch: tuple[str, ...], jobs: tuple[str, ...], frames: int, out: Path | None, json_out: bool
) -> None:
    """Say what each job costs for an hour of video.

    The beginning of a recording is played twice for each, on one core (engine.threads). CPU seconds, seconds
    and bytes are extrapolated by frames. A fit holds all its frames in memory: its hour is made of clips.

    \b
    sags archive costs launch/d4d_pull.yaml mapping.iterations:=2 --job depth --job tracks
    """
    check_installed()
    from sags_lab.archive.costs import job_costs
    from sags_node.pipeline.session import open_session
    from sags_node.tools.evaluation.figures import flat

    path, overrides = split_recording(launch, "live cameras have no length; name a recording")
    with open_session(path, [*overrides, "source.loop:=false"]).source as source:
        rate, count = source.rate, source.frame_count or 0
    if path is None or count < frames:
        raise UsageError(f"a recording of {frames} frames is needed, this one has {count}; change --frames")
    check_files(out)
    asked = jobs or sorted(JOBS)
    with progress("measuring") as advance:
        rows = job_costs(
            str(Path(path).resolve()), overrides, asked, frames, rate,
            lambda done, job: advance(done, len(asked), job),
        )  # fmt: skip
    show(rows if json_out else text.rows_table([flat(row) for row in rows]))
    write_json(out, rows)
