"""What the online mapper is compared with: the picture before, a warp by stereo, stereo alone, a fit."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.quality.sgbm import JudgedSGBM
from sags_node.config.schema import Box
from sags_node.engine.rasterizer.rasterize import Rasterizer, make_rasterizer
from sags_node.engine.rasterizer.views import colours_of
from sags_node.errors import UsageError
from sags_node.evaluation import metrics
from sags_node.evaluation.measure import FrameRow, MeasureOptions, Progress
from sags_node.evaluation.spool import Spool, SpooledFrame
from sags_node.evaluation.summary import summarise
from sags_node.evaluation.warp import warp_to_right
from sags_node.mapping.right_eye import right_eye_mask
from sags_node.pipeline.session import Session
from sags_node.sources.source import open_source
from sags_node.types import U8, Bool, StereoRig
from sags_node.vision.rectify import Rectifier

SGBM_SCALES = (1, 2)

Row = dict[str, Any]  # with the keys of `sags eval` that apply


def measured_baselines(
    session: Session, spool: Spool, size: tuple[int, int], options: MeasureOptions, progress: Progress
) -> list[Row]:
    """Baselines that need the recording, over the frames of a run and with its masks.

    Args:
        session: what was run.
        spool: what the run showed.
        size: of the run's pictures, width and height, px.

    Returns:
        A row for each baseline; none for a recording without a right eye.

    Raises:
        UsageError: the pictures are too small to match at `SGBM_SCALES`.
        SagsError: the recording cannot be read again.
    """
    config = session.config
    rectifier = Rectifier(session.rig, *size)
    usable = right_pixels(session.rig, size, config.vision.tissue.exclude)
    rasterizer = make_rasterizer("numba", *size)
    matchers = [
        JudgedSGBM(config.vision.stereo, rectifier.camera, rectifier.baseline, scale) for scale in SGBM_SCALES
    ]
    places = {frame_id: place for place, frame_id in enumerate(spool.frame_ids)}
    warped: list[FrameRow] = []
    drawn: list[FrameRow] = []
    matched: list[list[FrameRow]] = [[] for _ in matchers]
    matching_ms: list[list[float]] = [[] for _ in matchers]
    covered: list[float] = []
    with open_source(config.source.model_copy(update={"pace": "step"})) as frames:
        for done, frame in enumerate(frames):
            progress("baselines", done)
            place, pair = places.get(frame.frame_id), rectifier(frame)
            if place is None or pair.right is None:
                continue
            shown = spool.read(place)
            if place % options.every == 0:
                warp, model, share = _right_views(shown, pair.left, pair.right, usable, rasterizer)
                warped.append(FrameRow(frame.frame_id, 0.0, {"novel": {"psnr": warp}}))
                drawn.append(FrameRow(frame.frame_id, 0.0, {"novel": {"psnr": model}}))
                covered.append(share)
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
        return {group: summarise(session.name, rows, options, config.segments, None)[group]}

    return [
        {
            "name": "left picture, warped by stereo",
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
    """What the figures of a run say of the picture before and of its own stereo stage."""
    rows = []
    if run["predict"] is not None:
        predict = dict(run["predict"])
        copied: Row = {"psnr": predict["copy_psnr"]}
        for name, figures in predict.items():
            if isinstance(figures, Mapping):
                copied[name] = {"psnr": figures["copy_psnr"]}
        rows.append({"name": "the picture before, shown again", "predict": copied})
    if run["stage_ms"]["depth"] is not None:
        times_ms = {"p50": run["stage_ms"]["depth"]}
        rows.append({"name": "the stereo stage alone", "frame_ms": times_ms, "depth": run["measured_depth"]})
    return rows


def read_fits(files: Sequence[Path]) -> list[Row]:
    """Offline fits, with the session they were made of: rows from the figures that `sags fit` wrote.

    Raises:
        UsageError: a file cannot be read or holds something else.
    """
    rows = []
    for file in files:
        try:
            figures = json.loads(file.read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            raise UsageError(f"cannot read {file} as figures of a fit: {error}") from None
        if not isinstance(figures, dict) or not {"session", "seconds", "heldout"} <= figures.keys():
            raise UsageError(f"{file} holds no figures of a fit; give the figures.json that sags fit wrote")
        row = {
            "session": figures["session"],
            "name": f"offline fit, {figures['seconds']:.0f} s in all",
            "heldout": figures["heldout"],
            "depth": figures.get("depth"),
            "gaussians": {"mean": figures.get("gaussians")},
            "file": str(file),
        }
        rows.append(row)
    return rows


def right_pixels(rig: StereoRig, size: tuple[int, int], exclude: Sequence[Box]) -> Bool:
    """Where the rectified right picture of `size` shows the raw one outside the boxes, [H, W]."""
    shown = np.ones((rig.right.height, rig.right.width), np.bool_)
    for x, y, width, height in exclude:
        shown[y : y + height, x : x + width] = False
    # A rectifier looks masks up in the left eye: the right one takes its place, under the common projection.
    swapped = StereoRig(rig.name, replace(rig.right, P=rig.left.P), rig.left)
    return Rectifier(swapped, *size).mask(shown)


def _right_views(
    shown: SpooledFrame, left: U8, right: U8, usable: Bool, rasterizer: Rasterizer
) -> tuple[float, float, float]:
    """PSNR of the warp and of the model against the right picture, both where the warp is known, as `novel`
    is measured; and the share of `novel`'s pixels that is."""
    camera = shown.snapshot.camera
    focal_px = float(camera.K[0, 0])
    depths = shown.depth[shown.tissue & (shown.depth > 0)]
    mask = right_eye_mask(shown.tissue, depths, focal_px, shown.baseline) & usable
    warp, known = warp_to_right(metrics.as_float(left), shown.measured_depth, focal_px, shown.baseline)
    right_camera = camera.moved_right(shown.baseline)
    planes = rasterizer.forward(shown.snapshot.gaussians, right_camera)
    model = colours_of(planes)
    truth, both = metrics.as_float(right), mask & known
    warp_psnr, model_psnr = (
        metrics.psnr(metrics.fit_gain_offset(picture, truth, both), truth, both) for picture in (warp, model)
    )
    return warp_psnr, model_psnr, float(both.sum() / max(1, mask.sum()))
