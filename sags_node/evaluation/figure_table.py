"""Every figure of a run in groups, each with its unit and what it is compared with."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from sags_node.evaluation.verdict import Flat, below, flat


@dataclass(frozen=True, slots=True)
class Figure:
    """One figure; a key that ends in `.*` is one for each key below it."""

    what: str
    key: str
    unit: str = ""  # %: of a share
    digits: int = 0
    baseline: str = ""  # what it is compared with
    baseline_key: str = ""


def _times(what: str, key: str, baseline: str = "", baseline_key: str = "") -> list[Figure]:
    names = {"p50": "median", "p90": "nine of ten below", "p99": "99 of 100 below", "max": "longest"}
    figures = [Figure(f"{what}, {name}", f"{key}.{part}", "ms", 1) for part, name in names.items()]
    return [Figure(figures[0].what, figures[0].key, "ms", 1, baseline, baseline_key), *figures[1:]]


def _psnr(what: str, key: str, baseline: str = "", baseline_key: str = "") -> Figure:
    return Figure(what, key, "dB", 1, baseline, baseline_key)


_COPY = "the picture before, shown again"
_STEREO = "stereo alone"
_WARP = "left picture, warped"
_AWAY = (2, 5, 10, 20)

GROUPS: dict[str, list[Figure]] = {
    "Speed": [
        Figure("frames of the recording", "frames"),
        Figure("shown", "processed"),
        Figure("missed", "dropped"),
        Figure("kept back for testing", "held_out"),
        Figure("rate", "rate_hz", "frames/s", 1),
        Figure("first frame", "first_render_ms", "ms", 1),
        *_times("camera's stamp to sending", "latency_ms"),
        *_times("work on a frame", "frame_ms", "the time it may take", "budget_ms"),
        Figure("of that, median of", "stage_ms.*", "ms", 2),
        *_times("processor time for a frame", "cpu_ms"),
        Figure("steps of refinement for a frame", "iterations_per_frame", "", 1),
        Figure("Gaussians, mean", "gaussians.mean"),
        Figure("Gaussians, at most", "gaussians.max"),
        Figure("memory at the start", "rss_mb.start", "MB"),
        Figure("memory at the end", "rss_mb.end", "MB"),
        Figure("memory, at most", "rss_mb.max", "MB"),
        Figure("frames on rung", "rungs.*"),
        Figure("frames that left out", "skipped.*"),
        Figure("frames with the warning", "warnings.*"),
    ],
    "Picture": [
        _psnr("the model, PSNR over tissue", "online.psnr", _COPY, "predict.copy_psnr"),
        Figure("the model, SSIM (1: equal)", "online.ssim", "", 3),
        Figure("the model, LPIPS (0: equal)", "online.lpips", "", 3),
        _psnr("left render, mostly the frame's own picture", "shown.psnr", _COPY, "predict.copy_psnr"),
        Figure("left render, SSIM", "shown.ssim", "", 3),
        Figure("left render, LPIPS", "shown.lpips", "", 3),
        _psnr("predicted one frame ahead", "predict.psnr", _COPY, "predict.copy_psnr"),
        _psnr("predicted two frames ahead", "predict_2.psnr", _COPY, "predict_2.copy_psnr"),
        _psnr("predicted three frames ahead", "predict_3.psnr", _COPY, "predict_3.copy_psnr"),
        _psnr("one frame ahead, the model alone", "predict.model_psnr"),
        _psnr("two frames ahead, the model alone", "predict_2.model_psnr"),
        _psnr("three frames ahead, the model alone", "predict_3.model_psnr"),
        _psnr("hidden tissue", "hidden.psnr", "last seen", "hidden.copy_psnr"),
        _psnr("hidden tissue, the model alone", "hidden.model_psnr"),
        *(
            _psnr(
                f"from {away} mm aside", f"view_{away}.psnr", "left picture, warped", f"view_{away}.warp_psnr"
            )
            for away in (2, 5, 10, 20)
        ),
        *(_psnr(f"from {mm} mm aside", f"view_{mm}.psnr", _WARP, f"view_{mm}.warp_psnr") for mm in _AWAY),
        *(_psnr(f"from {mm} mm aside, the model alone", f"view_{mm}.model_psnr") for mm in _AWAY),
        _psnr("kept back, drawn from the frame before", "heldout.psnr", _COPY, "heldout.copy_psnr"),
        Figure("kept back, SSIM", "heldout.ssim", "", 3),
        Figure("kept back, LPIPS", "heldout.lpips", "", 3),
        _psnr("kept back, once the next is known", "between.psnr", "mean of both", "between.mean_psnr"),
        _psnr("both carried along the motion", "between.carried_psnr", "mean of both", "between.mean_psnr"),
        _psnr("right eye, from the model", "novel.psnr"),
        _psnr("right eye, as it was shown", "right.psnr", _WARP, "right.warp_psnr"),
        _psnr("right eye, the model alone", "right.model_psnr", _COPY, "right.copy_psnr"),
        Figure("right eye, share that is compared", "right.coverage", "%"),
        Figure("flicker where nothing moves", "flicker.picture", "grey levels", 2, "input", "flicker.input"),
        Figure("flicker of the right eye", "flicker.right", "grey levels", 2, "input", "flicker.input"),
        Figure("share of the tissue that stands still", "flicker.share", "%"),
        _psnr("the model, masked pixels counted as equal", "online.paper_psnr"),
        Figure("the model, SSIM, masked pixels counted as equal", "online.paper_ssim", "", 3),
        _psnr("kept back, masked pixels counted as equal", "heldout.paper_psnr"),
        Figure("kept back, SSIM, masked pixels counted as equal", "heldout.paper_ssim", "", 3),
    ],
    "Depth": [
        Figure("error, median", "depth.median_mm", "mm", 2, _STEREO, "measured_depth.median_mm"),
        Figure("error, nine of ten below", "depth.p90_mm", "mm", 2, _STEREO, "measured_depth.p90_mm"),
        Figure("error, root mean square", "depth.rmse_mm", "mm", 2, _STEREO, "measured_depth.rmse_mm"),
        Figure("share of the tissue", "depth.coverage", "%", 0, _STEREO, "measured_depth.coverage"),
        Figure("share that calls itself sure", "depth_confidence.sure_share", "%"),
        Figure("error of that, nine of ten below", "depth_confidence.sure_p90_mm", "mm", 2),
        Figure("flicker", "flicker.depth_mm", "mm", 2, _STEREO, "flicker.measured_depth_mm"),
        Figure("camera, error of position", "pose.ate_mm", "mm", 2, "a rigid scene", "pose.rigid_ate_mm"),
        Figure("camera, largest", "pose.max_mm", "mm", 2, "a rigid scene", "pose.rigid_max_mm"),
        Figure("camera, frame to frame", "pose.rpe_mm", "mm", 2, "a rigid scene", "pose.rigid_rpe_mm"),
        Figure("camera, turn", "pose.rpe_deg", "degrees", 3, "a rigid scene", "pose.rigid_rpe_deg"),
    ],
    "Points": [
        Figure("off, median", "track.median_mm", "mm", 2),
        Figure("off, nine of ten below", "track.p90_mm", "mm", 2),
        Figure("off, median", "track.median_px", "px", 1),
        Figure("lost", "track.lost", "%"),
    ],
    "Overlay": [
        Figure("frames that came", "overlay.frames"),
        Figure("shown on", "overlay.overlay"),
        Figure("not shown", "overlay.blanked.*"),
        *_times("camera's stamp to sending", "overlay.latency_ms"),
        *_times("drawing", "overlay.draw_ms"),
        Figure("times it stood still", "overlay.freezes.count"),
        Figure("seconds it stood still", "overlay.freezes.seconds", "s", 1),
        Figure("messages lost", "overlay.lost"),
    ],
}

Row = tuple[str, list[str], str]  # what, its values, what the first is compared with


def headings(summary: Mapping[str, Any]) -> list[str]:
    """Of the values of a row."""
    segments = list(summary.get("segments") or {})
    return ["all frames", *segments] if segments else ["value"]


def groups(summary: Mapping[str, Any]) -> dict[str, list[Row]]:
    """Rows of each group; a row has a value of the whole run and one of each segment. What is not known in
    any has no row, and a group without rows is left out."""
    figures = flat(summary)
    segments = list(summary.get("segments") or {})
    made = {group: _rows(figures, each, segments) for group, each in GROUPS.items()}
    return {group: rows for group, rows in made.items() if rows}


def _rows(figures: Flat, asked: Sequence[Figure], segments: Sequence[str]) -> list[Row]:
    rows = []
    for figure in asked:
        if figure.key.endswith(".*"):
            each = below(figures, figure.key[:-2])
            found = [(f"{figure.what}: {name}", [value], "") for name, value in each.items()]
        else:
            group, _, key = figure.key.partition(".")
            values = [figures.get(figure.key), *(figures.get(f"{group}.{name}.{key}") for name in segments)]
            compared = figures.get(figure.baseline_key)
            said = "" if compared is None else f"{figure.baseline}: {_number(compared, figure)}"
            found = [(figure.what, values, said)]
        rows += [
            (what, [_number(value, figure) for value in values], said)
            for what, values, said in found
            if any(value is not None for value in values)
        ]
    return rows


def _number(value: float | None, figure: Figure) -> str:
    if value is None:
        return ""
    if figure.unit == "%":
        return f"{100 * value:.{figure.digits}f} %"
    return f"{value:,.{figure.digits}f} {figure.unit}".strip()
