"""A run on one page: its video, what it was worth, plots over time, every figure, and images."""

from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from sags_node.files import check_folder, check_results, whole
from sags_node.quality.gallery import ERROR_AT_TOP, Picture, depth_range, tiles
from sags_node.tools.evaluation import calibration
from sags_node.tools.evaluation.figures import flat, groups, headings, verdict
from sags_node.tools.evaluation.measure import FrameRow
from sags_node.tools.evaluation.page import encoded, page, picture_uri, plot_grid
from sags_node.tools.evaluation.plots import Series, line_plot
from sags_node.tools.evaluation.provenance import provenance
from sags_node.types import U8

BLUE, ORANGE, GREEN, GREY = "#2166ac", "#d6604d", "#1b7837", "#777777"
REPORT, SHEET, TITLE = "report.html", "sheet.png", "SAGS: "
COLUMNS = ("camera", "model", "depth", "error")
SHOWN = ("camera", "shown", "depth")  # mostly the camera's image: its error would say nothing of the model


def check_report(folder: Path, *more: str) -> None:
    """Check, before any work, that a report and `more` files can be written into this folder.

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
    """Write `report.html` (below 2 MB, and whole but for its video) and `sheet.png` (its images) into
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
    columns = SHOWN if any("shown" in row.figures for row in rows) else COLUMNS
    sheet = [tiles(picture, near, far)[: len(columns)] for picture in pictures]
    brightest = f" The error is brightest at {ERROR_AT_TOP:.0%} of full scale." if columns is COLUMNS else ""
    text = page(
        f"{TITLE}{summary['session']}",
        [
            f'<p class="quiet">{escape("{command}; {date}; revision {revision}".format(**provenance()))}</p>',
            f'<div class="first">{_video(video)}{_verdict(summary)}</div>',
            warning_table(rows),
            "<h2>Over time</h2>",
            _plots(rows, summary.get("segments") or {}),
            "<h2>Figures</h2>",
            _figure_groups(summary),
            "<h2>Images</h2>",
            _pictures(pictures, columns, sheet),
            f'<p class="quiet">Grey: not tissue, or nothing known. Depth from {near * 1e3:.0f} to '
            f"{far * 1e3:.0f} mm.{brightest}</p>",
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


def _video(name: str | None) -> str:
    if name is None:
        return ""
    return f'<video src="{escape(name)}" controls autoplay muted loop playsinline></video>'


def _verdict(summary: Mapping[str, Any]) -> str:
    lines = [f"<tr><th>{what}</th><td>{escape(said)}</td></tr>" for what, said in verdict(flat(summary))]
    return f'<table class="verdict">{"".join(lines)}</table>'


def _pictures(pictures: Sequence[Picture], columns: Sequence[str], sheet: Sequence[Sequence[U8]]) -> str:
    lines = []
    worst = min((picture.psnr for picture in pictures), default=None)
    for picture, line in zip(pictures, sheet, strict=True):
        note = " (the worst)" if picture.psnr == worst and len(pictures) > 1 else ""
        cells = "".join(
            f'<figure><img alt="{name}" src="{picture_uri(tile)}"><figcaption>{name}</figcaption></figure>'
            for name, tile in zip(columns, line, strict=True)
        )
        lines.append(f"<h3>frame {picture.frame_id}, {picture.psnr:.1f} dB{note}</h3>")
        lines.append(f'<div class="images">{cells}</div>')
    return "\n".join(lines)


def warning_table(rows: Sequence[FrameRow]) -> str:
    """Return what the run warned of, when, and what to do; nothing where it did not."""
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
    def series(label: str, colour: str, key: str, dots: bool = False) -> Series:
        """The series of a figure (`depth.p90_mm`), or of what the run says itself (`frame_ms`)."""
        group, _, name = key.partition(".")
        points = []
        for row in rows if name else ran[1:]:  # the first frame takes long
            value = row.figures.get(group, {}).get(name) if name else getattr(row.facts, key)
            if value is not None:
                points.append((row.frame_id, value))
        return Series(label, colour, points, dots)

    ran = [row for row in rows if row.facts is not None]
    missed = [row.frame_id for row in rows if row.facts is None]
    tallies = [row.calibration for row in rows if row.calibration is not None]
    sure = calibration.points(tallies, 0.9)
    off, against = "depth", "off: mm, lower is better"
    if not any(off in row.figures for row in rows):
        off, against = "stereo", "from the frame's own stereo: mm"
    plots = [
        line_plot(
            f"How far the depth is {against}",
            [
                series("nine of ten below", ORANGE, f"{off}.p90_mm"),
                series("half below", BLUE, f"{off}.median_mm"),
                series("half below, stereo alone", GREY, "measured_depth.median_mm"),
            ],
            spans,
        ),
        line_plot(
            "Whether depth knows its error: mm",
            [
                Series("nine of ten below", ORANGE, sure),
                Series("half below", BLUE, calibration.points(tallies, 0.5)),
                Series("as predicted", GREY, [(middle, middle) for middle, _ in sure]),
            ],
            {},
            across="predicted",
            up="real",
        ),
        line_plot(
            "Right eye and hidden tissue: PSNR, dB; higher is better",
            [
                series("right eye", ORANGE, "right.psnr"),
                series("left image, warped", GREY, "right.warp_psnr"),
                series("hidden tissue", BLUE, "hidden.psnr", dots=True),
                series("as it was last seen", GREY, "hidden.copy_psnr", dots=True),
            ],
            spans,
        ),
        line_plot(
            "How long a frame took: ms (grey: missed or kept back)",
            [series("stamp to sending", BLUE, "latency_ms"), series("work", ORANGE, "frame_ms")],
            spans,
            gaps=missed,
        ),
        line_plot(
            "How near the image is to the camera's: PSNR, dB; higher is better",
            [
                series("left render, mostly this image", BLUE, "shown.psnr"),
                series("a frame ahead", ORANGE, "predict.psnr"),
                series("the model alone, of a frame that it learnt from", BLUE, "online.psnr"),
                series("the image before, again", GREY, "predict.copy_psnr"),
                series("kept back, never seen", GREEN, "heldout.psnr", dots=True),
            ],
            spans,
        ),
    ]
    plots = [plot for plot in plots if plot]
    if len(plots) % 2:  # two stand in a row
        gaussians = series("Gaussians", BLUE, "gaussians")
        plots.insert(-1, line_plot("How many Gaussians the model has", [gaussians], spans))
    return plot_grid(plots)


def _figure_groups(summary: Mapping[str, Any]) -> str:
    """Return a table for each group, side by side where the window is wide; each with the segments it has."""
    names = headings(summary)
    tables = []
    for group, rows in groups(summary).items():
        filled = [column for column in range(len(names)) if any(any(row[1][column:]) for row in rows)]
        head = "".join(f'<td class="quiet">{escape(names[column])}</td>' for column in filled)
        lines = [f"<table><tr><th>{group}</th>{head}</tr>"]
        for what, values, compared in rows:
            cells = "".join(f'<td class="number">{escape(value)}</td>' for value in values[: len(filled)])
            beside = f'<div class="quiet">{escape(compared)}</div>' if compared else ""
            lines.append(f"<tr><td>{escape(what)}{beside}</td>{cells}</tr>")
        tables.append("\n".join([*lines, "</table>"]))
    wide = " wide" if len(names) > 1 else ""
    return f'<div class="figures{wide}">{"".join(tables)}</div>'
