"""Control nodes or the paper's field, `mapping.method`: what each shows of the same recordings.

Live, on the recording's clock, for the rate; then frame by frame with a fixed number of steps, for the
error. At the end of that the model is asked for all frames of the last two seconds. A field has a state for
each time; nodes have only their present state.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import Advance
from sags_node.config.schema import MappingMethod
from sags_node.engine.rasterizer.rasterize import make_rasterizer
from sags_node.engine.rasterizer.views import colours_of
from sags_node.mapping.mapper import Mapper
from sags_node.pipeline.pipeline import Pipeline
from sags_node.pipeline.session import open_session
from sags_node.pipeline.warm_up import warm_up
from sags_node.quality.metrics import as_float, psnr
from sags_node.tools.evaluation.measure import MeasureOptions
from sags_node.tools.evaluation.run import MappedFrame, Run
from sags_node.tools.evaluation.session import evaluate, measure
from sags_node.tools.evaluation.steps import run_step
from sags_node.types import U8

METHODS: tuple[MappingMethod, ...] = ("nodes", "sags")
SIZES = ((320, 256), (640, 512))
WINDOW_NS = 2_000_000_000  # as long as the field remembers
SHOWN = {"online": "psnr", "predict": "psnr", "heldout": "psnr", "depth": "median_mm", "track": "median_px"}


STEPS = ("mapping.iterations:=3", "mapping.rung:=7")  # of the run frame by frame
TABLES = (
    "width height method live.rate_hz live.latency_ms.p50 live.latency_ms.p99 live.psnr step.online"
    " step.predict step.heldout step.window step.depth step.track step.frame_ms.p50",
)


def measure_methods(
    launch: Path | str | None, overrides: Sequence[str], advance: Advance
) -> list[dict[str, Any]]:
    """Measure a row for each size and method."""
    rows: list[dict[str, Any]] = []
    for width, height in SIZES:
        for method in METHODS:
            advance(len(rows), len(SIZES) * len(METHODS), f"{method} at {width} x {height}")
            chosen = [
                *overrides, f"mapping.method:={method}", f"vision.width:={width}", f"vision.height:={height}"
            ]  # fmt: skip
            alone = [*chosen, "publish.detail:=false"]  # the model is compared, not the camera's images
            seen = evaluate(launch, alone, MeasureOptions(hold_out=0), pace="realtime")
            live = seen.summary
            row: dict[str, Any] = {"method": method, "width": width, "height": height}
            row["live"] = {
                "rate_hz": live["rate_hz"],
                "latency_ms": live["latency_ms"],
                "frames": live["frames"],
                "psnr": live["online"]["psnr"],
                "receipt": seen.receipt,
            }
            rows.append(row | _step_by_step(launch, [*alone, *STEPS]))
    return rows


def _step_by_step(launch: Path | str | None, overrides: Sequence[str]) -> dict[str, Any]:
    forced = ["source.loop:=false", "source.pace:=step", "publish.right:=false"]
    session = open_session(launch, [*overrides, *forced])
    warm_up(session.config)
    pictures: dict[int, U8] = {}
    with Run() as run:
        pipeline = run_step(session, MeasureOptions(), run, lambda what, frames: None)
        found = measure(session, run, MeasureOptions(), on_picture=pictures.__setitem__)
        summary = found.summary
        window = _window_psnr(pipeline, run, pictures)
    step = {group: summary[group][key] for group, key in SHOWN.items() if summary.get(group)}
    more = {"window": window, "frame_ms": summary["frame_ms"], "receipt": found.receipt}
    return {"step": step | more}


def _window_psnr(pipeline: Pipeline, run: Run, pictures: dict[int, U8]) -> float:
    """Mean PSNR, dB over tissue, of the frames of the last two seconds: the model at the end of the run is
    drawn for the time of each."""
    mapper, camera, found = pipeline.mapper, pipeline.rectifier.camera, []
    rasterizer = make_rasterizer("numba", camera.width, camera.height)
    last_ns = 0
    for shown in map(run.read, reversed(run.frame_ids)):
        assert isinstance(shown, MappedFrame)
        last_ns = last_ns or shown.snapshot.t_capture_ns
        frame_id, t_ns, seen_by = shown.snapshot.frame_id, shown.snapshot.t_capture_ns, shown.snapshot.camera
        if t_ns <= last_ns - WINDOW_NS:
            break
        now = mapper.model.gaussians() if isinstance(mapper, Mapper) else mapper.at(t_ns, [seen_by])
        drawn = colours_of(rasterizer.forward(now, seen_by))
        found.append(psnr(drawn, as_float(pictures[frame_id]), shown.tissue))
    return float(np.mean(found))
