"""Error of depth over run time as a PNG: what a setting costs beside what it brings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from sags_node.evaluation.plots import as_png, new_figure

WIDTH, HEIGHT = 900, 420  # px
BESIDE, ABOVE, BELOW = 8, 4, -11  # px, of a name to its point
TICKS_MS = (2, 3, 5, 7, 10, 15, 20, 30, 50, 70, 100, 150, 200, 300, 500)
TICKS_MM = (0.1, 0.2, 0.3, 0.5, 0.7, 1, 1.5, 2, 3, 5, 7, 10, 20)
STAGE, PLAIN, NETWORK = "#2166ac", "#828282", "#b2182b"


def picture(measured: Mapping[str, Any]) -> bytes:
    """PNG of `measured` as `measure_recording` or `measure_ct` returns it: each setting from its median error
    (a dot) up to the one that nine of ten errors stay below."""
    shown = [row for row in measured["settings"] if row["ms"] and row["median_mm"]]
    rows: Sequence[Mapping[str, Any]] = sorted(shown, key=lambda row: float(row["ms"]))
    with new_figure(WIDTH, HEIGHT) as figure:
        axes = figure.subplots()
        axes.set_title(
            f"{measured['session']}: error of depth over the time of one pair, median and p90", loc="left"
        )
        axes.set_xscale("log")
        axes.set_yscale("log")
        for place, row in enumerate(rows):
            colour = _colour(row["name"])
            axes.plot([row["ms"]] * 2, [row["median_mm"], row["p90_mm"]], color=colour, linewidth=1)
            axes.plot(row["ms"], row["median_mm"], "o", color=colour)
            axes.plot(row["ms"], row["p90_mm"], "_", color=colour)
            axes.annotate(
                row["name"],
                (row["ms"], row["median_mm"]),
                (BESIDE, ABOVE if place % 2 else BELOW),  # names of neighbours do not meet
                textcoords="offset pixels",
                color=colour,
            )
        axes.margins(x=0.2, y=0.1)  # names stand right of their points
        for axis, ticks, unit in ((axes.xaxis, TICKS_MS, "ms"), (axes.yaxis, TICKS_MM, "mm")):
            low, high = axis.get_view_interval()
            axis.set_ticks([tick for tick in ticks if low <= tick <= high])
            axis.set_major_formatter("{x:g}")
            axis.set_label_text(unit)
        axes.minorticks_off()
        return as_png(figure)


def _colour(name: str) -> str:
    if name.startswith("network"):
        return NETWORK
    return PLAIN if name.startswith("plain") else STAGE
