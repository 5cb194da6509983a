"""Play a recording through the node's own pipeline, then measure what it showed."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Literal, Self

from sags_node.config.launch_file import load_launch
from sags_node.config.schema import LaunchConfig, LiveSource, PublishConfig
from sags_node.errors import SagsError, UsageError
from sags_node.evaluation.gallery import Picture
from sags_node.evaluation.measure import FrameRow, MeasureOptions, Measurer, OnPicture, Progress
from sags_node.evaluation.spool import Spool
from sags_node.evaluation.summary import GROUPS, summarise
from sags_node.kernels.threads import configure_threads
from sags_node.mapping.devices import ALL_SKIPS, Skips, affordable, device_of
from sags_node.node.node import Node
from sags_node.pipeline.pipeline import Pipeline
from sags_node.pipeline.session import Session, at_best_scale, open_posed, open_session
from sags_node.pipeline.warm_up import warm_up
from sags_node.sources.source import Source
from sags_node.terminal.console import stop_signals
from sags_node.types import FrameResult, StereoFrame
from sags_node.vision.rectify import Rectifier
from sags_node.vision.tissue import TissueMask

Pace = Literal["realtime", "step"]
PROGRESS_PERIOD = 0.2  # s
DEFAULT_OPTIONS = MeasureOptions()


@dataclass(frozen=True, slots=True)
class Evaluation:
    """The outcome of one measured run."""

    summary: dict[str, Any]  # the keys of `sags eval --json`
    rows: list[FrameRow]
    pictures: list[Picture]


def evaluate(
    launch: Path | str | None,
    overrides: Sequence[str] = (),
    options: MeasureOptions = DEFAULT_OPTIONS,
    pace: Pace = "step",
    iterations: int | None = None,
    progress: Progress = lambda what, frames: None,
) -> Evaluation:
    """Run a recorded session once and measure it.

    Args:
        launch: a launch file or a session folder; None: the built-in phantom.
        overrides: `key:=value`, as for `sags run`.
        pace: `realtime` plays on the recording's clock through the node, sockets included, and drops what
            comes too late; `step` takes every frame in turn, without threads or sockets.
        iterations: fixed steps per frame instead of the time budget; with `step`, figures are reproducible.
        progress: called with what is going on and the frames done.

    Raises:
        UsageError: a wrong key, value or path, live cameras, or a segment that is named like a figure.
        SagsError: the recording cannot be used, the disk is full, or nothing was processed.
    """
    asked = load_launch(launch, overrides)
    if isinstance(asked.source, LiveSource):
        raise UsageError("live cameras cannot be measured; record them first, then evaluate the recording")
    _check_segments(asked)
    forced = ["source.loop:=false", f"source.pace:={pace}"]
    if asked.publish.right == "auto":
        forced.append("publish.right:=false")  # a measured run does not depend on who looks at it
    if iterations is not None:
        forced.append(f"mapping.iterations:={iterations}")
    session = open_session(
        launch, [*overrides, *forced], lambda done, total: progress("rendering the phantom (once)", done)
    )
    progress("loading kernels", 0)
    warm_up(session.config)
    session = at_best_scale(session)
    with Spool() as spool:
        if pace == "realtime":
            # Its own sockets, away from those of a node that may be running on this machine.
            private = {"data": (), "ipc": True, "control": None, "run_dir": spool.folder / "run"}
            publish = session.config.publish.model_copy(update=private)
            run_realtime(session, publish, options, spool, progress)
        else:
            run_step(session, options, spool, progress)
        return measure(session, spool, options, overrides, progress)


def measure(
    session: Session,
    spool: Spool,
    options: MeasureOptions,
    overrides: Sequence[str] = (),
    progress: Progress = lambda what, frames: None,
    on_picture: OnPicture = lambda frame_id, left: None,
) -> Evaluation:
    """Measure a finished run against the recording it was played from, which is read once more.

    Args:
        on_picture: called with each frame's number and its rectified left picture.

    Raises:
        SagsError: nothing was processed, or the recording cannot be read again.
    """
    if len(spool) == 0:
        raise SagsError(
            "no frame was processed; check source.start, source.frames, source.warm_up and the hold-out"
        )
    config = session.config
    measurer = _measured(session, spool, options, progress, on_picture)
    summary = summarise(
        session.name,
        measurer.rows,
        options,
        config.segments,
        None
        if config.mapping.iterations is not None
        else config.mapping.frame_ms(session.source.rate if config.in_real_time else None),
    )
    summary["settings"] = {
        "overrides": list(overrides),
        "pace": None if isinstance(config.source, LiveSource) else config.source.pace,
        "iterations": config.mapping.iterations,
        "max_gaussians": affordable(config, *session.working_size),
        "backend": "numba",  # what draws for the measuring
        "device": device_of(config).kind,
        "width": session.working_size[0],
        "height": session.working_size[1],
        "pose": config.vision.pose,
        "depth_reference": measurer.depth_kind,
        "hold_out": options.hold_out,
        "novel_every": options.every,
    }
    return Evaluation(summary, measurer.rows, measurer.gallery.pictures)


def run_step(
    session: Session, options: MeasureOptions, spool: Spool, progress: Progress, skips: Skips = ALL_SKIPS
) -> Pipeline:
    """Every frame in turn, none lost; only the pipeline's own work is timed. Returns it as it is then."""
    configure_threads(session.config.engine.threads)
    pipeline = Pipeline(session.config, session.rig, skips=skips)
    budget = pipeline.make_budget()
    with session.source as source:
        for frame in source:
            if options.holds_out(frame.frame_id):
                continue
            started = time.perf_counter()
            result = pipeline.process(frame, budget)
            if frame.warm_up:
                continue
            frame_ms = (time.perf_counter() - started) * 1e3
            spool.add(result, frame_ms, time.monotonic_ns(), warnings=pipeline.warnings)
            progress("playing", len(spool))
    return pipeline


def run_realtime(
    session: Session, publish: PublishConfig, options: MeasureOptions, spool: Spool, progress: Progress
) -> None:
    """The node itself, threads and sockets included, on the recording's clock."""

    def keep(result: FrameResult, latency_ms: float) -> None:
        frame_ms, warnings = sum(result.timings_ms.values()), node.health().warnings
        spool.add(result, frame_ms, time.monotonic_ns(), latency_ms, warnings)

    config = session.config.model_copy(update={"publish": publish})
    with stop_signals() as stop:
        node = Node(config, session.rig, _WithoutHeldOut(session.source, options), on_result=keep)
        try:
            node.start()
            while not (stop.is_set() or node.wait(PROGRESS_PERIOD)):
                progress("playing", len(spool))
        finally:
            node.stop()
    if stop.is_set():
        raise KeyboardInterrupt


class _WithoutHeldOut:
    """A source whose held-out frames never reach the node."""

    def __init__(self, source: Source, options: MeasureOptions) -> None:
        self._source = source
        self._options = options

    @property
    def rate(self) -> float:
        return self._source.rate

    @property
    def frame_count(self) -> int | None:
        return self._source.frame_count

    @property
    def dropped(self) -> int:
        return self._source.dropped

    def __enter__(self) -> Self:
        self._source.__enter__()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._source.__exit__(kind, error, trace)

    def __iter__(self) -> Iterator[StereoFrame]:
        return (frame for frame in self._source if not self._options.holds_out(frame.frame_id))

    def stop(self) -> None:
        self._source.stop()


def _measured(
    session: Session, spool: Spool, options: MeasureOptions, progress: Progress, on_picture: OnPicture
) -> Measurer:
    """Read the recording again, with its truth, and measure every frame."""
    config = session.config
    rectifier = Rectifier(session.rig, *session.working_size)
    tissue = TissueMask(config.vision.tissue, rectifier)
    exclude = config.vision.tissue.exclude
    measurer = Measurer(spool, rectifier, tissue, options, exclude, config.vision.pose, on_picture)
    played = config.source.model_copy(update={"pace": "step"})
    with open_posed(config.model_copy(update={"source": played}), session.rig) as frames:
        measurer.run(frames, progress)
    return measurer


def _check_segments(config: LaunchConfig) -> None:
    figures = {key for keys in GROUPS.values() for key in keys}
    for name in config.segments:
        if name in figures:
            raise UsageError(f"segments.{name}: a segment cannot be named like a figure; rename it")
