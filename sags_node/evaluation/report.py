"""A run on one page: its video, what it was worth, pictures, plots over time, and every figure."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from sags_node.evaluation import calibration
from sags_node.evaluation.figure_table import groups, headings
from sags_node.evaluation.gallery import Picture
from sags_node.evaluation.measure import FrameRow
from sags_node.evaluation.page import encoded, page, picture_uri, svg_uri
from sags_node.evaluation.plots import Series, line_plot
from sags_node.evaluation.provenance import provenance
from sags_node.evaluation.run import RunFacts
from sags_node.evaluation.tiles import ERROR_AT_TOP, depth_range, tiles
from sags_node.evaluation.verdict import flat, verdict
from sags_node.files import check_folder, check_results, whole
from sags_node.types import U8

BLUE, ORANGE, GREEN, GREY = "#2166ac", "#d6604d", "#1b7837", "#777777"
REPORT, SHEET, TITLE = "report.html", "sheet.png", "SAGS: "
COLUMNS = ("camera", "model", "depth", "error")


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
    folder: Path,
    summary: Mapping[str, Any],
    rows: Sequence[FrameRow],
    pictures: Sequence[Picture],
    video: str | None = None,
) -> Path:
    """Write `report.html` (below 2 MB, and whole but for its video) and `sheet.png` (its pictures) into
    `folder`.

    Args:
        summary: as `summarise` makes it.
        video: name of a file in `folder` that browsers play.

    Returns:
        The path of `report.html`.

    Raises:
        SagsError: the folder cannot be written to.
    """
    check_folder(folder)
    near, far = depth_range(pictures)
    sheet = [tiles(picture, near, far) for picture in pictures]
    text = page(
        f"{TITLE}{summary['session']}",
        [
            f'<p class="quiet">{escape(_origin())}</p>',
            f'<div class="first">{_video(video)}{_verdict(summary)}</div>',
            warning_table(rows),
            "<h2>Pictures</h2>",
            _pictures(pictures, sheet),
            f'<p class="quiet">Grey: not tissue, or nothing known. Depth from {near * 1e3:.0f} to '
            f"{far * 1e3:.0f} mm. The error is brightest at {ERROR_AT_TOP:.0%} of full scale.</p>",
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


def _origin() -> str:
    known = provenance()
    return f"{known['command']}; {known['date']}; revision {known['revision']}"


def _video(name: str | None) -> str:
    if name is None:
        return ""
    return f'<video src="{escape(name)}" controls autoplay muted loop playsinline></video>'


def _verdict(summary: Mapping[str, Any]) -> str:
    lines = [f"<tr><th>{what}</th><td>{escape(said)}</td></tr>" for what, said in verdict(flat(summary))]
    return f'<table class="verdict">{"".join(lines)}</table>'


def _pictures(pictures: Sequence[Picture], sheet: Sequence[Sequence[U8]]) -> str:
    lines = []
    worst = min((picture.psnr for picture in pictures), default=None)
    for picture, line in zip(pictures, sheet, strict=True):
        note = " (the worst)" if picture.psnr == worst and len(pictures) > 1 else ""
        cells = "".join(
            f'<figure><img alt="{name}" src="{picture_uri(tile)}"><figcaption>{name}</figcaption></figure>'
            for name, tile in zip(COLUMNS, line, strict=True)
        )
        lines.append(f"<h3>frame {picture.frame_id}, {picture.psnr:.1f} dB{note}</h3>")
        lines.append(f'<div class="pictures">{cells}</div>')
    return "\n".join(lines)


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
    return f'<h2 class="warning">Warnings</h2><table>{"".join(lines)}</table>' if lines else ""


def _plots(rows: Sequence[FrameRow], spans: Mapping[str, tuple[int, int]]) -> str:
    def figure(label: str, colour: str, key: str, dots: bool = False) -> Series:
        group, _, name = key.partition(".")
        found = ((row.frame_id, row.figures.get(group, {}).get(name)) for row in rows)
        points = [(frame, value) for frame, value in found if value is not None]
        return Series(label, colour, points, dots)

    def run(label: str, colour: str, value: Callable[[RunFacts], float | None]) -> Series:
        """Without the first frame, which takes long."""
        found = [(row.frame_id, value(row.facts)) for row in rows if row.facts is not None]
        return Series(label, colour, [(frame, each) for frame, each in found[1:] if each is not None])

    tallies = [row.calibration for row in rows if row.calibration is not None]
    sure = calibration.points(tallies, 0.9)
    plots = [
        line_plot(
            "How near the picture is to the camera's: PSNR, dB; higher is better",
            [
                figure("a frame ahead", ORANGE, "predict.psnr"),
                figure("the model alone, of a frame that it learnt from", BLUE, "online.psnr"),
                figure("the picture before, again", GREY, "predict.copy_psnr"),
                figure("kept back, never seen", GREEN, "heldout.psnr", dots=True),
            ],
            spans,
        ),
        line_plot(
            "How long a frame took: ms (grey: missed)",
            [
                run("stamp to sending", BLUE, lambda facts: facts.latency_ms),
                run("work", ORANGE, lambda facts: facts.frame_ms),
            ],
            spans,
            gaps=[row.frame_id for row in rows if row.facts is None],
        ),
        line_plot(
            "How far the depth is off: mm, lower is better",
            [
                figure("nine of ten below", ORANGE, "depth.p90_mm"),
                figure("half below", BLUE, "depth.median_mm"),
                figure("half below, stereo alone", GREY, "measured_depth.median_mm"),
            ],
            spans,
        ),
        line_plot(
            "Whether depth knows its error: real over predicted, mm",
            [
                Series("nine of ten below", ORANGE, sure),
                Series("half below", BLUE, calibration.points(tallies, 0.5)),
                Series("as predicted", GREY, [(middle, middle) for middle, _ in sure]),
            ],
            {},
            across="predicted error, mm",
        ),
    ]
    if not tallies:  # no true depth
        gaussians = run("Gaussians", BLUE, lambda facts: facts.gaussians)
        plots.append(line_plot("How many Gaussians the model has", [gaussians], spans))
    shown = [f'<img alt="plot" src="{svg_uri(plot)}">' for plot in plots if plot]
    return f'<div class="plots">{"".join(shown)}</div>'


def _figure_table(summary: Mapping[str, Any]) -> str:
    head = "".join(f"<td>{escape(name)}</td>" for name in headings(summary))
    lines = ['<table class="figures">']
    for group, rows in groups(summary).items():
        lines.append(f'<tr class="quiet"><th>{group}</th>{head}<td>compared with</td></tr>')
        for what, values, compared in rows:
            cells = "".join(f'<td class="number">{escape(value)}</td>' for value in values)
            lines.append(f'<tr><td>{escape(what)}</td>{cells}<td class="quiet">{escape(compared)}</td></tr>')
    return "\n".join([*lines, "</table>"])
