"""Plays a recording frame by frame: every one in turn, none lost."""

import time

from sags_node.kernels.threads import configure_threads
from sags_node.mapping.devices import ALL_SKIPS, Skips
from sags_node.pipeline.pipeline import Pipeline
from sags_node.pipeline.session import Session, open_posed
from sags_node.sources.source import Source
from sags_node.tools.evaluation.measure import MeasureOptions, Progress
from sags_node.tools.evaluation.run import Run


def run_step(
    session: Session, options: MeasureOptions, run: Run, progress: Progress, skips: Skips = ALL_SKIPS
) -> Pipeline:
    """Process every frame in turn but those held out; time only the pipeline's work. Return the pipeline."""
    configure_threads(session.config.engine.threads)
    pipeline = Pipeline(session.config, session.rig, skips=skips)
    pipeline.predict_motion()  # as soon as a view ahead of the image is open, and such views are measured
    budget = pipeline.make_budget()
    with session.source as source:
        for frame in source:
            if options.holds_out(frame.frame_id):
                continue
            started, before = time.perf_counter(), time.process_time()
            result = pipeline.process(frame, budget)
            if frame.warm_up:
                continue
            frame_ms, cpu_ms = (time.perf_counter() - started) * 1e3, (time.process_time() - before) * 1e3
            run.add(result, frame_ms, time.monotonic_ns(), warnings=pipeline.warnings, cpu_ms=cpu_ms)
            progress("playing", len(run))
    return pipeline


def again(session: Session) -> Source:
    """Open the recording once more: every frame, with its ground truth."""
    played = session.config.source.model_copy(update={"pace": "step"})
    return open_posed(session.config.model_copy(update={"source": played}), session.rig)
