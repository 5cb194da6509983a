"""Every figure of a run once, with its key, its unit and what it is compared with.

`summarise` makes them, and the terminal and the page of a report show them: in words (`verdict`) and in
tables (`groups`).
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

Flat = Mapping[str, Any]


def flat(figures: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """All numbers and words of nested figures in one row, named by their path: `online.psnr`."""
    row: dict[str, Any] = {}
    for key, value in figures.items():
        if isinstance(value, Mapping):
            row |= flat(value, f"{prefix}{key}.")
        elif not isinstance(value, list):
            row[f"{prefix}{key}"] = value
    return row


def below(figures: Flat, prefix: str) -> dict[str, Any]:
    """The figures below a key, named by the rest of their path: counts by reason, by rung, by warning."""
    return {key[len(prefix) + 1 :]: value for key, value in figures.items() if key.startswith(prefix + ".")}


@dataclass(frozen=True, slots=True)
class Figure:
    """A figure; a key that ends in `.*` stands for one for each key below it."""

    what: str
    key: str
    unit: str = ""  # %: of a share
    digits: int = 0
    baseline: str = ""  # what it is compared with
    baseline_key: str = ""
    nothing: bool = False  # zero says that nothing happened, and has no row


def _times(what: str, key: str, baseline: str = "", baseline_key: str = "") -> list[Figure]:
    names = {"p50": "median", "p90": "nine of ten below", "p99": "99 of 100 below", "max": "longest"}
    figures = [Figure(f"{what}, {name}", f"{key}.{part}", "ms", 1) for part, name in names.items()]
    return [Figure(figures[0].what, figures[0].key, "ms", 1, baseline, baseline_key), *figures[1:]]


def _psnr(what: str, key: str, baseline: str = "", baseline_key: str = "") -> Figure:
    return Figure(what, key, "dB", 1, baseline, baseline_key)


def _paper(what: str, group: str) -> tuple[Figure, Figure]:
    ssim = Figure(f"{what}, SSIM, masked pixels counted as equal", f"{group}.paper_ssim", "", 3)
    return _psnr(f"{what}, masked pixels counted as equal", f"{group}.paper_psnr"), ssim


_COPY = "the image before, shown again"
_BEFORE = f"{_COPY}: {{:.1f}} dB"
_WORTH = "near while tissue rests, but without depth, another view or hidden tissue"
_STEREO = "stereo alone"
_WARP = "left image, warped"
_AHEAD = (
    ("predict", "one frame ahead"),
    ("predict_2", "two frames ahead"),
    ("predict_3", "three frames ahead"),
)
_RETURNED = (("forth_back.moved_mm", " once back at the first frame, after moving {:.2f} mm"),)
_MOVED = "moved in between", "forth_back.moved_mm"
AWAY = (2, 5, 10, 20)  # mm to the right of the left eye

TABLE: dict[str, list[Figure]] = {
    "Overlay": [
        Figure("frames that came", "overlay.frames"),
        Figure("shown on", "overlay.overlay"),
        Figure("not shown", "overlay.blanked.*"),
        *_times("camera's stamp to sending", "overlay.latency_ms"),
        *_times("drawing", "overlay.draw_ms"),
        Figure("times it stood still", "overlay.freezes.count", nothing=True),
        Figure("seconds it stood still", "overlay.freezes.seconds", "s", 1, nothing=True),
        Figure("messages lost", "overlay.lost", nothing=True),
    ],
    "Points": [
        Figure("off, median", "track.median_mm", "mm", 2),
        Figure("off, nine of ten below", "track.p90_mm", "mm", 2),
        Figure("off, median", "track.median_px", "px", 1),
        Figure("lost", "track.lost", "%"),
        Figure("forth and back: off, median", "forth_back.median_mm", "mm", 2, *_MOVED),
        Figure("forth and back: off, nine of ten below", "forth_back.p90_mm", "mm", 2),
        Figure("forth and back: off, median", "forth_back.median_px", "px", 1),
        Figure("forth and back: lost", "forth_back.lost", "%"),
    ],
    "Depth": [
        Figure("error, median", "depth.median_mm", "mm", 2, _STEREO, "measured_depth.median_mm"),
        Figure("error, nine of ten below", "depth.p90_mm", "mm", 2, _STEREO, "measured_depth.p90_mm"),
        Figure("error, root mean square", "depth.rmse_mm", "mm", 2, _STEREO, "measured_depth.rmse_mm"),
        Figure("share of the tissue", "depth.coverage", "%", 0, _STEREO, "measured_depth.coverage"),
        Figure("from the frame's own stereo, median", "stereo.median_mm", "mm", 2),
        Figure("from the frame's own stereo, nine of ten below", "stereo.p90_mm", "mm", 2),
        Figure("share of the tissue", "stereo.coverage", "%", 0, _STEREO, "stereo.stereo_coverage"),
        Figure("share that calls itself sure", "depth_confidence.sure_share", "%"),
        Figure("error of that, nine of ten below", "depth_confidence.sure_p90_mm", "mm", 2),
        Figure("flicker", "flicker.depth_mm", "mm", 2, _STEREO, "flicker.measured_depth_mm"),
        Figure("camera, error of position", "pose.ate_mm", "mm", 2, "a rigid scene", "pose.rigid_ate_mm"),
        Figure("camera, largest", "pose.max_mm", "mm", 2, "a rigid scene", "pose.rigid_max_mm"),
        Figure("camera, frame to frame", "pose.rpe_mm", "mm", 2, "a rigid scene", "pose.rigid_rpe_mm"),
        Figure("camera, turn", "pose.rpe_deg", "degrees", 3, "a rigid scene", "pose.rigid_rpe_deg"),
    ],
    "Right eye and hidden tissue": [
        _psnr("right eye, from the model", "novel.psnr"),
        _psnr("right eye, as it was shown", "right.psnr", _WARP, "right.warp_psnr"),
        _psnr("right eye, the model alone", "right.model_psnr", _COPY, "right.copy_psnr"),
        Figure("right eye, share that is compared", "right.coverage", "%"),
        _psnr("hidden tissue", "hidden.psnr", "last seen", "hidden.copy_psnr"),
        _psnr("hidden tissue, the model alone", "hidden.model_psnr"),
        *(_psnr(f"from {mm} mm aside", f"view_{mm}.psnr", _WARP, f"view_{mm}.warp_psnr") for mm in AWAY),
        *(_psnr(f"from {mm} mm aside, the model alone", f"view_{mm}.model_psnr") for mm in AWAY),
    ],
    "Camera": [
        Figure("frames of the recording", "frames"),
        Figure("of those played once more, frame by frame", "second_run.frames"),
        Figure("shown", "processed"),
        Figure("missed", "dropped", nothing=True),
        Figure("kept back for testing", "held_out", nothing=True),
        Figure("rate", "rate_hz", "frames/s", 1),
        Figure("first frame", "first_render_ms", "ms", 1),
        *_times("camera's stamp to sending", "latency_ms"),
    ],
    "Model": [
        Figure("Gaussians, mean", "gaussians.mean"),
        Figure("Gaussians, at most", "gaussians.max"),
        Figure("memory at the start", "rss_mb.start", "MB"),
        Figure("memory at the end", "rss_mb.end", "MB"),
        Figure("memory, at most", "rss_mb.max", "MB"),
        Figure("frames on rung", "rungs.*"),
        Figure("frames that left out", "skipped.*"),
        Figure("frames with the warning", "warnings.*"),
    ],
    "Work": [
        *_times("work on a frame", "frame_ms", "the time it may take", "budget_ms"),
        Figure("of that, median of", "stage_ms.*", "ms", 2),
        *_times("processor time for a frame", "cpu_ms"),
        Figure("steps of refinement for a frame", "iterations_per_frame", "", 1),
    ],
    "Image": [
        _psnr("the model, PSNR over tissue", "online.psnr", _COPY, "predict.copy_psnr"),
        Figure("the model, SSIM (1: equal)", "online.ssim", "", 3),
        Figure("the model, LPIPS (0: equal)", "online.lpips", "", 3),
        _psnr("left render, mostly the frame's own image", "shown.psnr", _COPY, "predict.copy_psnr"),
        Figure("left render, SSIM", "shown.ssim", "", 3),
        Figure("left render, LPIPS", "shown.lpips", "", 3),
        *(_psnr(f"predicted {ahead}", f"{key}.psnr", _COPY, f"{key}.copy_psnr") for key, ahead in _AHEAD),
        *(_psnr(f"{ahead}, the model alone", f"{key}.model_psnr") for key, ahead in _AHEAD),
        _psnr("kept back, drawn from the frame before", "heldout.psnr", _COPY, "heldout.copy_psnr"),
        Figure("kept back, SSIM", "heldout.ssim", "", 3),
        Figure("kept back, LPIPS", "heldout.lpips", "", 3),
        _psnr("kept back, once the next is known", "between.psnr", "mean of both", "between.mean_psnr"),
        _psnr("both carried along the motion", "between.carried_psnr", "mean of both", "between.mean_psnr"),
        Figure("flicker where nothing moves", "flicker.picture", "grey levels", 2, "input", "flicker.input"),
        Figure("flicker of the right eye", "flicker.right", "grey levels", 2, "input", "flicker.input"),
        Figure("share of the tissue that stands still", "flicker.share", "%"),
        *_paper("the model", "online"),
        *_paper("left render", "shown"),
        *_paper("kept back", "heldout"),
    ],
}

# Groups pooled over points and frames; the others are means over frames.
POOLED = ("depth_confidence", "track", "pose", "forth_back")


def _means() -> dict[str, list[str]]:
    found: dict[str, list[str]] = {}
    for figure in (*TABLE["Image"], *TABLE["Right eye and hidden tissue"], *TABLE["Depth"]):
        for whole in (figure.key, figure.baseline_key):
            group, _, key = whole.partition(".")
            if key and group not in POOLED and key not in found.setdefault(group, []):
                found[group].append(key)
    return found


MEANS = _means()  # keys of each group of figures of a frame, of which a run has the mean

Row = tuple[str, list[str], str]  # what, its values, what the first is compared with


def headings(summary: Mapping[str, Any]) -> list[str]:
    """The headings of the values of a row."""
    segments = list(summary.get("segments") or {})
    return ["all frames", *segments] if segments else ["value"]


def groups(summary: Mapping[str, Any]) -> dict[str, list[Row]]:
    """The rows of each group. A row has a value for the whole run and one for each segment. A figure without
    values has no row, nor have counts and times of what did not happen. A group without rows is left out."""
    figures = flat(summary)
    segments = list(summary.get("segments") or {})
    made = {group: _rows(figures, each, segments) for group, each in TABLE.items()}
    return {group: rows for group, rows in made.items() if rows}


def _rows(figures: Flat, asked: Sequence[Figure], segments: Sequence[str]) -> list[Row]:
    rows: list[Row] = []
    for figure in asked:
        each = figure.key.endswith(".*")
        if each:
            named = below(figures, figure.key[:-2]).items()
            found = [(f"{figure.what}: {name}", [_number(value, figure)], "") for name, value in named]
        else:
            group, _, key = figure.key.partition(".")
            values = [figures.get(figure.key), *(figures.get(f"{group}.{name}.{key}") for name in segments)]
            compared = figures.get(figure.baseline_key)
            said = "" if compared is None else f"{figure.baseline}: {_number(compared, figure)}"
            found = [(figure.what, [_number(value, figure) for value in values], said)]
        shown = set("123456789") if each or figure.nothing else set("0123456789")
        rows += [row for row in found if shown.intersection("".join(row[1]))]
    return rows


def _number(value: float | None, figure: Figure) -> str:
    if value is None:
        return ""
    if figure.unit == "%":
        return f"{100 * value:.{figure.digits}f} %"
    return f"{value:,.{figure.digits}f} {figure.unit}".strip()


AGAINST = {  # `settings.depth_reference`
    "exact": "exact truth",
    "structured_light": "a structured-light scan",
    "ct": "a CT scan",
    "stereo_network": "the depth of a stereo network",
}


def verdict(figures: Flat) -> list[tuple[str, str]]:
    """The run in words: a name and a line each; what an overlay needs comes first.

    Args:
        figures: of `summarise`, and of an overlay under `overlay`, made `flat`. What is missing or None is
            left out.
    """
    right = ("right.psnr", "{:.1f} dB PSNR"), ("right.warp_psnr", f" ({_WARP}: {{:.1f}} dB)")
    hidden = ("hidden.psnr", "{:.1f} dB PSNR"), ("hidden.model_psnr", " (the model alone: {:.1f} dB;")
    last = "hidden.copy_psnr", " as it was last seen: {:.1f} dB)"
    unseen = ("heldout.psnr", "{:.1f} dB PSNR on frames kept back"), ("heldout.copy_psnr", f" ({_BEFORE})")
    again = "the first {} frames, frame by frame, for the right eye, hidden tissue and what has no truth"
    warned = below(figures, "warnings").items()
    lines = {
        "overlay": _overlay(figures),
        "points": _points(figures),
        "depth": _depth(figures),
        "right eye": _said(figures, *right),
        "hidden": _said(figures, *hidden, last),
        "speed": _speed(figures),
        "latency": _latency(figures),
        "unseen": _said(figures, *unseen),
        "image": _image(figures),
        "quality": _quality(figures),
        "warnings": ", ".join(f"{code} ({count} frames)" for code, count in warned),
        "played again": _said(figures, ("second_run.frames", again)),
        "machine": _machine(figures),
    }
    return [(name, said) for name, said in lines.items() if said]


def _said(figures: Flat, *pieces: tuple[str, str]) -> str:
    """The pieces of text whose figures are known, joined; empty where the first is not known."""
    if figures.get(pieces[0][0]) is None:
        return ""
    return "".join(text.format(figures[key]) for key, text in pieces if figures.get(key) is not None)


def _overlay(figures: Flat) -> str:
    """The line on the overlay; its age is from the camera's stamp of a frame until its overlay is sent."""
    came = figures.get("overlay.frames")
    share = f" ({figures['overlay.overlay'] / came:.0%})" if came else ""
    on = _said(figures, ("overlay.overlay", "on {}"), ("overlay.frames", f" of {{}} frames{share}"))
    age = _said(figures, *_middle("overlay.latency_ms"))
    blanked = (f"; {count} without: {why}" for why, count in below(figures, "overlay.blanked").items())
    return "".join((on, f", {age} after the camera" if on and age else "", *blanked))


def _points(figures: Flat) -> str:
    """The line on points: their errors against true points, else those of following forth and back."""
    for group, more in (("track", ()), ("forth_back", _RETURNED)):
        lost = f"{group}.lost"
        gone = lost, "; {:.0%} lost with their Gaussians (anchors take new ones)"
        said = _said(figures, *_off(group), *more, gone)
        if said or figures.get(lost) is not None:
            return said or "all given up"
    return ""


def _off(group: str) -> tuple[tuple[str, str], ...]:
    nine = f"{group}.p90_mm", ", nine of ten within {:.2f} mm"
    return (f"{group}.median_mm", "{:.2f} mm off (median)"), nine


def _middle(key: str) -> tuple[tuple[str, str], ...]:
    return (f"{key}.p50", "{:.0f} ms (p50)"), (f"{key}.p99", ", {:.0f} ms (p99)")


def _speed(figures: Flat) -> str:
    if figures.get("processed") is None:
        return ""
    shown = f"{figures['processed']} of {figures['frames'] - figures['held_out']} frames shown"
    kept = f"; {figures['held_out']} others kept back for testing" if figures["held_out"] else ""
    if figures.get("latency_ms.p50") is not None:
        speed = _said(figures, ("rate_hz", " at {:.1f} frames/s"))
        return f"{shown}{speed}, {figures['dropped']} missed{kept}"
    speed = _said(figures, ("rate_hz", "{:.1f} frames/s would be possible; "))
    return f"{speed}frame by frame, {shown}{kept}"


def _latency(figures: Flat) -> str:
    first = "first_render_ms", " from the camera's stamp to sending; {:.0f} ms for the first frame"
    worked = _said(figures, *_middle("frame_ms"))
    return _said(figures, *_middle("latency_ms"), first) or (worked and f"{worked} of work on a frame")


def _image(figures: Flat) -> str:
    """The line on the image: how good a view of the next frame is, as a frame's left render is mostly its
    own image. Of a live run, whose views are not known, it is on that render."""
    shown = {
        "predict.psnr": "of the next frame",
        "shown.psnr": "of the frame itself, mostly its own image",
        "online.psnr": "by the model",
    }
    for key, name in shown.items():
        if figures.get(key) is not None:
            alone = ""
            if key == "predict.psnr" and figures.get("predict.model_psnr") != figures[key]:
                alone = _said(figures, ("predict.model_psnr", ", the model alone {:.1f} dB"))
            beside = _said(figures, ("predict.copy_psnr", f". {_BEFORE[0].upper()}{_BEFORE[1:]}; {_WORTH}"))
            return f"{figures[key]:.1f} dB PSNR {name}{alone}{beside}"
    return ""


def _depth(figures: Flat) -> str:
    """The line on depth: against a reference, else against the frame's own stereo."""
    reference = AGAINST.get(str(figures.get("settings.depth_reference")), "the recording's")
    covered = "depth.coverage", ", on {:.0%} of the tissue"
    if said := _said(figures, *_off("depth"), covered):
        shared = "measured_depth.coverage", " on {:.0%}"
        alone = _said(figures, ("measured_depth.median_mm", "; stereo alone: {:.2f} mm"), shared)
        return f"{said}, against {reference}{alone}"
    return _said(
        figures,
        ("stereo.median_mm", "{:.2f} mm from the frame's own stereo (median)"),
        ("stereo.p90_mm", ", nine of ten within {:.2f} mm"),
        ("stereo.coverage", "; on {:.0%} of the tissue"),
        ("stereo.stereo_coverage", ", stereo alone on {:.0%}"),
    )


def _quality(figures: Flat) -> str:
    from sags_node.mapping.ladder import GPU_RUNGS, RUNGS  # only here: all load this file; numpy is slow

    rungs = Counter({int(rung): count for rung, count in below(figures, "rungs").items() if count})
    said = []
    if rungs:
        most = rungs.most_common(1)[0][0]
        highest = len(GPU_RUNGS if figures.get("settings.device") == "cuda" else RUNGS) - 1
        said.append(f"rung {most} of 0 to {highest} for most frames ({min(rungs)} to {max(rungs)})")
    said.append(_said(figures, ("gaussians.mean", "{:,.0f} Gaussians on average")))
    said.append(_said(figures, ("settings.width", "{}"), ("settings.height", "x{} px")))
    return ", ".join(filter(None, said))


def _machine(figures: Flat) -> str:
    device = figures.get("settings.device")
    refined = "" if device is None else f"; the model on the {'CPU' if device == 'cpu' else 'GPU'}"
    return f"{figures.get('machine') or ''}{refined}"
