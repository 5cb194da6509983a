"""What the online mapper is compared with: the image before, a warp by stereo, stereo alone, a fit."""

import json
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.quality.sgbm import JudgedSGBM
from sags_node.engine.rasterizer.rasterize import Drawer
from sags_node.pipeline.session import Session
from sags_node.quality import metrics
from sags_node.sources.source import open_source
from sags_node.tools.evaluation.measure import FrameRow, MeasureOptions, Progress
from sags_node.tools.evaluation.run import MappedFrame, Run
from sags_node.tools.evaluation.summary import summarise
from sags_node.tools.evaluation.warp import right_figures, right_pixels
from sags_node.types import Bool
from sags_node.vision.rectify import Rectifier

RESULTS = Path("benchmarks/results")
SGBM_SCALES = (1, 2)
NO_RIGHT = {"warp_psnr": float("nan"), "model_psnr": float("nan"), "coverage": 0.0}  # no warp is known

Row = dict[str, Any]  # with the keys of `sags eval` that apply


def measured_baselines(
    session: Session, run: Run, size: tuple[int, int], options: MeasureOptions, progress: Progress
) -> list[Row]:
    """Measure the baselines that need the recording, over the frames of a run and with its masks.

    Args:
        session: what was run.
        run: what the run showed.
        size: of the run's images, width and height, px.

    Returns:
        A row for each baseline; none for a recording without a right eye.
    """
    config = session.config
    rectifier = Rectifier(session.rig, *size)
    usable: Bool | None = None
    drawer = Drawer("numba", *size)
    matchers = [
        JudgedSGBM(config.vision.stereo, rectifier.camera, rectifier.baseline, scale) for scale in SGBM_SCALES
    ]
    places = count()
    warped: list[FrameRow] = []
    drawn: list[FrameRow] = []
    matched: list[list[FrameRow]] = [[] for _ in matchers]
    matching_ms: list[list[float]] = [[] for _ in matchers]
    covered: list[float] = []
    with open_source(config.source.model_copy(update={"pace": "step"})) as frames:
        for done, frame in enumerate(frames):
            progress("baselines", done)
            pair, shown = rectifier(frame), run.read(frame.frame_id)
            if not isinstance(shown, MappedFrame) or pair.right is None:
                continue
            if next(places) % options.every == 0:
                if usable is None:
                    usable = right_pixels(rectifier, frame, config.vision.tissue.exclude)
                right = right_figures(shown, pair, usable, drawer).get("right", NO_RIGHT)
                warped.append(FrameRow(frame.frame_id, 0.0, {"novel": {"psnr": right["warp_psnr"]}}))
                drawn.append(FrameRow(frame.frame_id, 0.0, {"novel": {"psnr": right["model_psnr"]}}))
                covered.append(right["coverage"])
            for matcher, rows, times_ms in zip(matchers, matched, matching_ms, strict=True):
                started = time.perf_counter()
                depth, _ = matcher(pair, shown.tissue)
                times_ms.append((time.perf_counter() - started) * 1e3)
                if frame.reference is not None and frame.reference.depth is not None:
                    truth = metrics.resample_nearest(frame.reference.depth, *size)
                    errors = asdict(metrics.depth_errors(depth, truth, shown.tissue))
                    rows.append(FrameRow(frame.frame_id, 0.0, {"depth": errors}))
    if not warped:
        return []

    def figures(rows: Sequence[FrameRow], group: str) -> Row:
        return {group: summarise(session.name, rows, options, config.played_segments, None)[group]}

    return [
        {
            "name": "left image, warped by stereo",
            **figures(warped, "novel"),
            "coverage": round(float(np.mean(covered)), 4),
        },
        {"name": "the model on the same pixels", **figures(drawn, "novel")},
        *(
            {
                "name": f"SGBM alone, scale {scale}",
                "frame_ms": metrics.percentiles(times_ms),
                **figures(rows, "depth"),
            }
            for scale, rows, times_ms in zip(SGBM_SCALES, matched, matching_ms, strict=True)
        ),
    ]


def baselines_of_run(run: Row) -> list[Row]:
    """Return the baselines that a run's figures contain: the image before, and its own stereo stage."""
    rows = []
    if run["predict"] is not None:
        predict = dict(run["predict"])
        copied: Row = {"psnr": predict["copy_psnr"]}
        for name, figures in predict.items():
            if isinstance(figures, Mapping):
                copied[name] = {"psnr": figures["copy_psnr"]}
        rows.append({"name": "the image before, shown again", "predict": copied})
    if run["stage_ms"]["depth"] is not None:
        times_ms = {"p50": run["stage_ms"]["depth"]}
        rows.append({"name": "the stereo stage alone", "frame_ms": times_ms, "depth": run["measured_depth"]})
    return rows


def known_fits(session: str) -> list[Row]:
    """Return rows of the offline fits of this session among the results of `sags fit`."""
    rows = []
    for file in sorted(RESULTS.glob("fit_*.json")):
        figures = json.loads(file.read_text(encoding="utf-8"))
        if figures["session"] == session:
            row = {
                "session": session,
                "name": f"offline fit, {figures['seconds']:.0f} s in all",
                "heldout": figures["heldout"],
                "depth": figures.get("depth"),
                "gaussians": {"mean": figures.get("gaussians")},
                "file": str(file),
            }
            rows.append(row)
    return rows
