"""An archive on one page: how its figures are spread, run time against error, and the worst recordings."""

import math
from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

import cv2
import numpy as np

from sags_lab.archive.store import RECORDINGS, REPORT, Store
from sags_node.tools.evaluation.page import page, picture_uri, plot_grid
from sags_node.tools.evaluation.plots import Series, line_plot

BLUE = "#2166ac"
SPREAD = {  # column -> title
    "online.psnr": "PSNR of the running model, dB",
    "heldout.psnr": "PSNR of frames it never saw, dB",
    "depth.median_mm": "median error of the model's depth, mm",
    "track.median_mm": "median error of followed points, mm",
    "frame_ms.p50": "a frame, median, ms",
    "seconds": "seconds for a recording",
}
AGAINST = {  # two columns -> title
    ("frame_ms.p50", "online.psnr"): "PSNR of the running model (dB), over the median time of a frame (ms)",
    ("frame_ms.p50", "depth.median_mm"): "depth error (mm), over the median time of a frame (ms)",
    ("frames", "seconds"): "seconds for a recording, over its frames",
}
WORST_BY = ("online.psnr", "heldout.psnr")  # the first that any recording has; the lowest are the worst
WORST = 6  # recordings that are shown
MOST_FAILURES = 200  # lines
SHEET_WIDTH = 1000  # px


def write_overview(store: Store, rows: Sequence[Mapping[str, Any]]) -> None:
    """Write `report.html`, which needs no other file.

    Args:
        rows: of `results.parquet`.

    Raises:
        OSError: it cannot be written.
    """
    done = [row for row in rows if row["state"] == "done"]
    jobs = {str(row.get("job")) for row in done}
    said = f"{len(rows)} recordings: {len(done)} done; {', '.join(sorted(jobs)) or 'nothing'}"
    parts = [f'<p class="quiet">{escape(said)}</p>', _failures(rows)]
    parts += ["<h2>How the figures are spread</h2>", _grid(_spreads(done))]
    parts += ["<h2>Run time against error</h2>", _grid(_scatters(done))]
    parts += ["<h2>The worst</h2>", *_worst(store, done)]
    store.write(REPORT, page(f"Archive {store.url}", parts).encode())


def _failures(rows: Sequence[Mapping[str, Any]]) -> str:
    failed = [row for row in rows if row["state"] == "quarantined"]
    if not failed:
        return ""
    lines = [
        f"<tr><td>{escape(row['id'])}</td><td>{escape(str(row['reason']))}</td></tr>"
        for row in failed[:MOST_FAILURES]
    ]
    more = f'<p class="quiet">and {len(failed) - MOST_FAILURES} more</p>' * (len(failed) > MOST_FAILURES)
    return f"<h2>Quarantined: {len(failed)}</h2><table>{''.join(lines)}</table>{more}"


def _spreads(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """A plot for each figure: its sorted values over the percentage of recordings below."""
    plots = []
    for column, title in SPREAD.items():
        values = sorted(value for row in rows if (value := _number(row, column)) is not None)
        shares = np.linspace(0, 100, len(values)) if len(values) > 1 else [50.0]
        points = list(zip(map(float, shares), values, strict=True)) if values else []
        plots.append(
            line_plot(
                title,
                [Series("", BLUE, points, len(points) < 2)],
                {},
                "so many % of the recordings are below",
            )
        )
    return plots


def _scatters(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    plots = []
    for (across, up), title in AGAINST.items():
        pairs = [(_number(row, across), _number(row, up)) for row in rows]
        points = sorted((x, y) for x, y in pairs if x is not None and y is not None)
        plots.append(line_plot(title, [Series("", BLUE, points, dots=True)], {}, across=""))
    return plots


def _number(row: Mapping[str, Any], column: str) -> float | None:
    value = row.get(column)
    return float(value) if isinstance(value, int | float) and math.isfinite(value) else None


def _grid(plots: Sequence[str]) -> str:
    return plot_grid(plots) if any(plots) else '<p class="quiet">no such figures</p>'


def _worst(store: Store, rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """The `WORST` recordings, each with the sheet of images of its own report."""
    column = next((each for each in WORST_BY if any(_number(row, each) is not None for row in rows)), None)
    if column is None:
        return ['<p class="quiet">no figure to tell them by</p>']
    known = [(value, row["id"]) for row in rows if (value := _number(row, column)) is not None]
    parts = []
    for value, id in sorted(known)[:WORST]:
        parts.append(f"<h3>{escape(id)}: {column} {value:.2f}</h3>")
        sheet = store.read(f"{RECORDINGS}/{id}/report/sheet.png")
        read = None if sheet is None else cv2.imdecode(np.frombuffer(sheet, np.uint8), cv2.IMREAD_COLOR_RGB)
        if read is not None:
            height = max(1, round(read.shape[0] * SHEET_WIDTH / read.shape[1]))
            small = cv2.resize(read, (SHEET_WIDTH, height), interpolation=cv2.INTER_AREA)
            parts.append(f'<img alt="input, model, depth, error" src="{picture_uri(small)}">')
    return parts
