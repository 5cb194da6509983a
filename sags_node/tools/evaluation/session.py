"""Play a recording through the node's own pipeline, then measure what it showed."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from sags_node.config.launch_file import load_launch
from sags_node.config.schema import LaunchConfig, LiveSource
from sags_node.errors import SagsError, UsageError
from sags_node.mapping.devices import affordable, backend_of, device_of
from sags_node.messaging.address import NodeAddress
from sags_node.pipeline.session import Session, at_best_scale, open_session
from sags_node.pipeline.warm_up import warm_up
from sags_node.quality.gallery import Picture
from sags_node.tools.evaluation import live
from sags_node.tools.evaluation.aside import Aside
from sags_node.tools.evaluation.figures import MEANS
from sags_node.tools.evaluation.hidden import measure_hidden
from sags_node.tools.evaluation.measure import FrameRow, MeasureOptions, Measurer, OnPicture, Progress
from sags_node.tools.evaluation.receipt import Receipt
from sags_node.tools.evaluation.run import Run
from sags_node.tools.evaluation.second import measure_second
from sags_node.tools.evaluation.steps import again, run_step
from sags_node.tools.evaluation.summary import quality, rounded, summarise
from sags_node.vision.rectify import Rectifier

Pace = Literal["realtime", "step"]
DEFAULT_OPTIONS = MeasureOptions()


@dataclass(frozen=True, slots=True)
class Evaluation:
    """The outcome of one measured run."""

    summary: dict[str, Any]  # the keys of `sags eval --json`
    rows: list[FrameRow]
    pictures: list[Picture]
    receipt: dict[str, Any]  # see `Receipt.as_json`


def evaluate(
    launch: Path | str | None,
    overrides: Sequence[str] = (),
    options: MeasureOptions = DEFAULT_OPTIONS,
    pace: Pace = "step",
    iterations: int | None = None,
    progress: Callable[[str, int, int | None], None] = lambda what, frames, count: None,
) -> Evaluation:
    """Run a recorded session once and measure it.

    Args:
        launch: a launch file or a session folder; None: the built-in phantom.
        overrides: `key:=value`, as for `sags run`.
        options: a live node sees every frame: with `realtime` none can be held out.
        pace: `realtime` plays on the recording's clock in a node of its own, and measures what a subscriber
            gets of it (`live`); `step` takes every frame in turn, without threads or sockets.
        iterations: fixed steps per frame instead of the time budget; with `step`, figures are reproducible.
        progress: called with what is going on, the frames done and those in all.

    Raises:
        UsageError: a wrong key, value or path, live cameras, or a segment that is named like a figure.
        SagsError: the recording cannot be used, the disk is full, or nothing was processed.
    """
    asked = load_launch(launch, overrides)
    if isinstance(asked.source, LiveSource):
        raise UsageError("live cameras cannot be measured; record them first, then evaluate the recording")
    if pace == "realtime" and options.hold_out:
        raise UsageError("a live node sees every frame: leave --hold-out out, or add --pace step")
    _check_segments(asked)
    forced = ["source.loop:=false", f"source.pace:={pace}"]
    if asked.publish.right == "auto":
        forced.append("publish.right:=false")  # a measured run does not depend on who looks at it
    if iterations is not None:
        forced.append(f"mapping.iterations:={iterations}")
    session = open_session(
        launch,
        [*overrides, *forced],
        lambda done, total: progress("rendering the phantom (once)", done, total),
    )
    count = session.source.frame_count
    progress("loading kernels", 0, count)

    def told(what: str, done: int) -> None:
        progress(what, done, count)

    warm_up(session.config)
    with Run() as run:
        if pace == "step":
            run_step(at_best_scale(session), options, run, told)
            found = measure(session, run, options, overrides, told)
        else:
            # Its own sockets, away from those of a node that may be running on this machine.
            run_dir = run.folder / "run"
            sockets = ["publish.data:=[]", "publish.ipc:=true", "publish.control:=null"]
            arguments = [*overrides, *forced, *sockets, f"publish.run_dir:={run_dir}"]
            node = NodeAddress(session.config.ns, run_dir=run_dir)
            account = live.play([*([] if launch is None else [str(launch)]), *arguments], node, run, told)
            found = measure(_as_shown(session, run), run, options, overrides, told)
            # Those figures only the node knows.
            found.summary.update({key: account[key] for key in ("frame_ms", "stage_ms", "skipped")})
    return completed(found, at_best_scale(session), options, progress)


def completed(
    found: Evaluation,
    session: Session,
    options: MeasureOptions,
    progress: Callable[[str, int, int | None], None],
) -> Evaluation:
    """Add, if asked for (`options.second`), what only two more runs can measure.

    Args:
        session: as the node plays it, at its size.
    """
    if not options.second:
        return found
    summary = found.summary
    session = _at_usual_rung(session, summary)
    more, told = measure_second(session, options.every, summary["hidden"] is None, progress)
    missing = {group for group in MEANS if summary[group] is None}
    if summary["settings"]["depth_reference"] is not None:
        missing.discard("stereo")
    followed = any(row.track is not None for row in found.rows)
    rows = []
    for row in found.rows:
        also = more.get(row.frame_id, row)
        figures = {group: also.figures[group] for group in missing & also.figures.keys()}
        track = row.track if followed else also.track
        rows.append(replace(row, figures=row.figures | figures, track=track))
    summary |= rounded({**quality(rows, options, session.config.played_segments), **told})
    return replace(found, rows=rows)


def _at_usual_rung(session: Session, summary: dict[str, Any]) -> Session:
    """The session fixed at the rung that most frames had: the machine's load then changes nothing."""
    if not summary["rungs"]:
        return session
    rung = max(summary["rungs"], key=summary["rungs"].__getitem__)
    mapping = session.config.mapping.model_copy(update={"rung": rung})
    return replace(session, config=session.config.model_copy(update={"mapping": mapping}))


def _as_shown(session: Session, run: Run) -> Session:
    """The session at the size in which a live node showed it."""
    width, height = run.size()
    vision = session.config.vision.model_copy(update={"width": width, "height": height, "scale": 1.0})
    return replace(session, config=session.config.model_copy(update={"vision": vision}))


def measure(
    session: Session,
    run: Run,
    options: MeasureOptions,
    overrides: Sequence[str] = (),
    progress: Progress = lambda what, frames: None,
    on_picture: OnPicture = lambda frame_id, left: None,
) -> Evaluation:
    """Measure a finished run against the recording it was played from, which is read once more.

    Args:
        on_picture: called with each frame's number and its rectified left image, as it is published.

    Raises:
        SagsError: nothing was processed, or the recording cannot be read again.
    """
    if len(run) == 0:
        raise SagsError(
            "no frame was processed; check source.start, source.frames, source.warm_up and the hold-out"
        )
    config = session.config
    receipt = Receipt(session.rig, session.working_size, options.lpips_weights)
    rectifier = Rectifier(session.rig, *session.working_size, session.published_size)
    aside = Aside(config, session.source.frame_count or 0) if options.aside else None
    measurer = Measurer(run, rectifier, config, options, receipt, on_picture, aside)
    with again(session) as frames:
        measurer.run(frames, progress)
    if options.hidden:
        rows = {row.frame_id: row for row in measurer.rows}
        found = measure_hidden(config, session.rig, again(session), len(rows), progress)
        for frame_id, figures in found.items():
            rows[frame_id].figures["hidden"] = figures
    summary = _summary(session, measurer.rows, options, overrides, measurer.depth_kind)
    return Evaluation(summary, measurer.rows, measurer.gallery.pictures, receipt.as_json())


def _summary(
    session: Session,
    rows: Sequence[FrameRow],
    options: MeasureOptions,
    overrides: Sequence[str],
    depth_kind: str | None,
) -> dict[str, Any]:
    """Figures and settings of a run."""
    config = session.config
    rate = session.source.rate if config.in_real_time else None
    budget_ms = None if config.mapping.iterations is not None else config.mapping.frame_ms(rate)
    summary = summarise(session.name, rows, options, config.played_segments, budget_ms)
    summary["settings"] = {
        "overrides": list(overrides),
        "pace": None if isinstance(config.source, LiveSource) else config.source.pace,
        "iterations": config.mapping.iterations,
        "max_gaussians": affordable(config, *session.working_size),
        "backend": backend_of(config),  # what draws for the measuring
        "device": device_of(config).kind,
        "width": session.working_size[0],
        "height": session.working_size[1],
        "pose": config.vision.pose,
        "depth_reference": depth_kind,
        "hold_out": options.hold_out,
        "novel_every": options.every,
    }
    return summary


def _check_segments(config: LaunchConfig) -> None:
    figures = {key for keys in MEANS.values() for key in keys}
    for name in config.segments:
        if name in figures:
            raise UsageError(f"segments.{name}: a segment cannot be named like a figure; rename it")
