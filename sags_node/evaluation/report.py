"""A run on one page that opens anywhere: pictures, plots over time, and the figures."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from sags_node.evaluation import calibration
from sags_node.evaluation.gallery import Picture
from sags_node.evaluation.measure import FrameRow
from sags_node.evaluation.page import encoded, page, picture_uri, svg_uri
from sags_node.evaluation.plots import Series, line_plot
from sags_node.evaluation.spool import RunFacts
from sags_node.evaluation.tiles import ERROR_AT_TOP, depth_range, tiles
from sags_node.files import check_folder, check_results, whole
from sags_node.types import U8

BLUE, ORANGE, GREEN = "#2166ac", "#d6604d", "#1b7837"
REPORT, SHEET, TITLE = "report.html", "sheet.png", "SAGS: "
COLUMNS = ("input", "model", "depth", "error")


def check_report(folder: Path, *more: str) -> None:
    """Before any work: may a report be written into this folder, and `more` files beside it?

    Raises:
        UsageError: other files of those names are there.
        SagsError: it cannot be written to.
    """
    page = folder / REPORT
    ours = page.is_file() and TITLE.encode() in page.read_bytes()[:200]
    check_results(folder, (REPORT, SHEET, *more), ours)


def write_report(
    folder: Path, summary: Mapping[str, Any], rows: Sequence[FrameRow], pictures: Sequence[Picture]
) -> Path:
    """Write `report.html` (self-contained, below 2 MB) and `sheet.png` (its pictures) into `folder`.

    Args:
        summary: as `summarise` makes it.

    Returns:
        The path of `report.html`.

    Raises:
        SagsError: the folder cannot be written to.
    """
    check_folder(folder)
    near, far = depth_range(pictures)
    sheet = [tiles(picture, near, far) for picture in pictures]
    title = f"{TITLE}{summary['session']}"
    text = page(
        title,
        [
            f'<p class="quiet">{escape(_circumstances(summary))}</p>',
            "<h2>What it showed</h2>",
            warning_table(rows),
            _picture_table(pictures, sheet),
            f'<p class="quiet">Grey: not tissue, or nothing known. Depth from {near * 1e3:.0f} to '
            f"{far * 1e3:.0f} mm; the error is brightest at {ERROR_AT_TOP:.0%} of full scale.</p>",
            "<h2>Over time</h2>",
            _plots(rows, summary.get("segments") or {}),
            "<h2>Figures</h2>",
            _figure_table(summary),
        ],
    )
    report = folder / REPORT
    with whole(report) as file:
        file.write_text(text, encoding="utf-8")
    if sheet:
        grid = np.concatenate([np.concatenate(line, axis=1) for line in sheet])
        with whole(folder / SHEET) as file:
            file.write_bytes(encoded(".png", grid))
    return report


def _circumstances(summary: Mapping[str, Any]) -> str:
    settings = summary.get("settings") or {}
    said = [f"{key} {_text(value)}" for key, value in settings.items() if value not in (None, [])]
    return "; ".join([str(summary.get("machine", "")), *said])


def _picture_table(pictures: Sequence[Picture], sheet: Sequence[Sequence[U8]]) -> str:
    head = "".join(f"<th>{name}</th>" for name in COLUMNS)
    lines = [f'<table class="pictures"><tr>{head}</tr>']
    worst = min((picture.psnr for picture in pictures), default=None)
    for picture, line in zip(pictures, sheet, strict=True):
        note = " (the worst)" if picture.psnr == worst and len(pictures) > 1 else ""
        caption = f"frame {picture.frame_id}, {picture.psnr:.1f} dB{note}"
        cells = "".join(
            f'<td><img alt="{name}" src="{picture_uri(tile)}"></td>'
            for name, tile in zip(COLUMNS, line, strict=True)
        )
        lines.append(f'<tr>{cells}</tr><tr><td colspan="4" class="quiet">{caption}</td></tr>')
    return "\n".join([*lines, "</table>"])


def warning_table(rows: Sequence[FrameRow]) -> str:
    """What the run warned of, when, and what to do; nothing where it did not."""
    frames: dict[str, list[int]] = {}
    said: dict[str, str] = {}
    for row in rows:
        for code, text in ({} if row.facts is None else row.facts.warnings).items():
            frames.setdefault(code, []).append(row.frame_id)
            said[code] = text
    lines = [
        f"<tr><td>{escape(said[code])}</td><td>{len(shown)} frames, {shown[0]} to {shown[-1]}</td>"
        f'<td class="quiet">{escape(code)}, see docs/warnings.md</td></tr>'
        for code, shown in frames.items()
    ]
    return f'<h3>Warnings</h3><table class="warnings">{"".join(lines)}</table>' if lines else ""


def _plots(rows: Sequence[FrameRow], spans: Mapping[str, tuple[int, int]]) -> str:
    def quality(label: str, colour: str, group: str, dots: bool = False) -> Series:
        points = [(row.frame_id, row.figures[group]["psnr"]) for row in rows if group in row.figures]
        return Series(label, colour, points, dots)

    def run(label: str, colour: str, value: Callable[[RunFacts], float | None]) -> Series:
        found = [(row.frame_id, value(row.facts)) for row in rows if row.facts is not None]
        return Series(label, colour, [(frame, each) for frame, each in found[1:] if each is not None])

    plots = [
        line_plot(
            "PSNR over tissue, dB",
            [
                quality("online", BLUE, "online"),
                quality("predicted", ORANGE, "predict"),
                quality("held out", GREEN, "heldout", dots=True),
                quality("right eye", "#7b3294", "novel", dots=True),
            ],
            spans,
        ),
        line_plot(
            "one frame (without the first), ms",
            [run("processing", BLUE, lambda facts: facts.frame_ms)],
            spans,
        ),
        line_plot(
            "capture to publish (without the first frame), ms",
            [run("latency", BLUE, lambda facts: facts.latency_ms)],
            spans,
        ),
        line_plot("Gaussians", [run("Gaussians", BLUE, lambda facts: facts.gaussians)], spans),
    ]
    rungs = run("rung", BLUE, lambda facts: facts.rung)
    if rungs.points:
        plots.append(line_plot("rung of the ladder of quality", [rungs], spans))
    tallies = [row.calibration for row in rows if row.calibration is not None]
    sure = calibration.points(tallies, 0.9)
    plots.append(
        line_plot(
            "nine of ten real errors of depth are below (mm), over the predicted error (mm)",
            [
                Series("real", BLUE, sure),
                Series("half of them", GREEN, calibration.points(tallies, 0.5)),
                Series("as predicted", ORANGE, [(middle, middle) for middle, _ in sure]),
            ],
            {},
        )
    )
    shown = [f'<img alt="plot" src="{svg_uri(plot)}">' for plot in plots if plot]
    return f'<div class="plots">{"".join(shown)}</div>'


def _figure_table(summary: Mapping[str, Any]) -> str:
    lines = ['<table class="figures">']
    for key, value in summary.items():
        if key not in {"settings", "machine", "session"}:
            lines.append(f'<tr><td>{escape(key)}</td><td class="number">{escape(_text(value))}</td></tr>')
    return "\n".join([*lines, "</table>"])


def _text(value: Any) -> str:
    """A figure for people: maps on one line, None as a dash."""
    if value is None:
        return "–"
    if isinstance(value, Mapping):
        return ", ".join(f"{key} {_inner(part)}" for key, part in value.items()) or "–"
    if isinstance(value, list):
        return " ".join(_text(part) for part in value)
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _inner(value: Any) -> str:
    return f"({_text(value)})" if isinstance(value, Mapping) else _text(value)
