"""Per-frame rows -> the figures of a run, in the form that `sags eval --json` prints."""

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from sags_node.quality.metrics import percentiles
from sags_node.tools.evaluation import calibration
from sags_node.tools.evaluation.figures import MEANS
from sags_node.tools.evaluation.lpips import BACKBONE
from sags_node.tools.evaluation.measure import FrameRow, MeasureOptions
from sags_node.tools.evaluation.provenance import machine_name
from sags_node.tools.evaluation.run import RunFacts
from sags_node.tools.evaluation.tracking import pooled
from sags_node.tools.evaluation.trajectory import trajectory_errors

STAGES = ("rectify", "mask", "depth", "map", "render", "publish")


def summarise(
    session: str,
    rows: Sequence[FrameRow],
    options: MeasureOptions,
    segments: Mapping[str, tuple[int, int]],
    budget_ms: float | None,
) -> dict[str, Any]:
    """The figures of one run. What does not apply is None; nothing is invented.

    A figure of quality is the mean over the frames that have it, and again over each named segment
    (`online.motion.psnr`; first and last frame belong to it). Track errors are pooled over points and frames.
    docs/evaluation.md says what each of them is, and what it is compared with.
    """
    facts = [row.facts for row in rows if row.facts is not None]
    counts, memory = [run.gaussians for run in facts], [run.rss_mb for run in facts]
    held_out = sum(options.holds_out(row.frame_id) for row in rows)
    summary: dict[str, Any] = {
        "session": session,
        "frames": len(rows),
        "processed": len(facts),
        "held_out": held_out,
        "dropped": len(rows) - held_out - len(facts),
        **_timings(facts),
        "budget_ms": budget_ms,
        "iterations_per_frame": _mean([run.counts.get("iterations", 0) for run in facts[1:]]),
        **quality(rows, options, segments),
        "forth_back": None,  # of a second run, see `measure_second`
        "second_run": None,
        "gaussians": {"mean": float(np.mean(counts)), "max": max(counts)} if counts else None,
        "rss_mb": {"start": memory[0], "end": memory[-1], "max": max(memory)} if memory else None,
        "skipped": dict(Counter(what for run in facts for what in run.skipped)),
        "warnings": dict(Counter(code for run in facts for code in run.warnings)),
        "rungs": dict(sorted(Counter(run.rung for run in facts if run.rung is not None).items())),
        "psnr_convention": "tissue",
        "lpips_backbone": BACKBONE if options.lpips_weights else None,
        "segments": {name: list(span) for name, span in segments.items()},
        "machine": machine_name(),
    }
    whole: dict[str, Any] = rounded(summary)
    return whole


def quality(
    rows: Sequence[FrameRow], options: MeasureOptions, segments: Mapping[str, tuple[int, int]]
) -> dict[str, dict[str, Any] | None]:
    """The groups of quality figures, over all frames and over each segment; None: no frame has any."""
    groups = _quality(rows, options)
    for name, (first, last) in segments.items():
        inside = [row for row in rows if first <= row.frame_id <= last]
        for group, figures in _quality(inside, options).items():
            if (whole := groups[group]) is not None:
                whole[name] = figures
    return groups


def _timings(facts: Sequence[RunFacts]) -> dict[str, Any]:
    frame_ms = [run.frame_ms for run in facts if run.frame_ms is not None]
    latency_ms = [run.latency_ms for run in facts if run.latency_ms is not None]
    stages = list(STAGES) + [stage for run in facts for stage in run.timings_ms]
    return {
        "rate_hz": _rate(facts),
        "first_render_ms": next(iter(latency_ms or frame_ms), None),
        "latency_ms": percentiles(latency_ms),
        "frame_ms": percentiles(frame_ms),
        "cpu_ms": percentiles([run.cpu_ms for run in facts if run.cpu_ms is not None]),
        "stage_ms": {
            stage: float(np.median(times)) if times else None
            for stage in dict.fromkeys(stages)
            for times in [[run.timings_ms[stage] for run in facts if stage in run.timings_ms]]
        },
    }


def _rate(facts: Sequence[RunFacts]) -> float | None:
    """Published frames per second; if nothing is published, 1 / mean time of the frames after the first."""
    if len(facts) < 2:
        return None
    if facts[0].latency_ms is None:
        return 1e3 / float(np.mean([run.frame_ms for run in facts[1:] if run.frame_ms is not None]))
    return (len(facts) - 1) / ((facts[-1].t_shown_ns - facts[0].t_shown_ns) * 1e-9)


def _quality(rows: Sequence[FrameRow], options: MeasureOptions) -> dict[str, dict[str, Any] | None]:
    groups: dict[str, dict[str, Any] | None] = {}
    for group, keys in MEANS.items():
        figures = [row.figures[group] for row in rows if group in row.figures]
        groups[group] = None
        if figures:
            groups[group] = {
                key: _mean([each[key] for each in figures if key in each])
                for key in keys
                if options.paper_psnr or not key.startswith("paper_")
            }
    tallies = [counts for row in rows if (counts := row.calibration) is not None and counts.any()]
    groups["depth_confidence"] = calibration.figures(tallies) if tallies else None
    groups["track"] = _track(rows)
    groups["pose"] = _pose(rows)
    return groups


def _pose(rows: Sequence[FrameRow]) -> dict[str, float] | None:
    poses = [row.poses for row in rows if row.poses is not None]
    if not poses:
        return None
    known = np.stack([each.known for each in poses])
    rigid = trajectory_errors(np.stack([each.rigid for each in poses]), known)
    return {
        **trajectory_errors(np.stack([each.shown for each in poses]), known),
        **{f"rigid_{name}": error for name, error in rigid.items()},
    }


def _track(rows: Sequence[FrameRow]) -> dict[str, Any] | None:
    tracks = [row.track for row in rows if row.track is not None]
    lost = sum(track.lost for track in tracks)
    followed = sum(len(track.errors_mm) for track in tracks)
    if followed + lost == 0:
        return None
    return {**pooled(tracks), "lost": lost / (lost + followed)}


def _mean(values: Sequence[float]) -> float | None:
    """The mean of those that are no NaN."""
    known = [value for value in values if not math.isnan(value)]
    return float(np.mean(known)) if known else None


def rounded(value: Any) -> Any:
    """Round all numbers to four decimals: beyond them is noise, and the text stays readable."""
    if isinstance(value, dict):
        return {key: rounded(part) for key, part in value.items()}
    if isinstance(value, float):
        return round(value, 4)
    return value
