"""Draws where the rasteriser's time goes."""

from collections.abc import Mapping
from typing import Any

from sags_node.tools.evaluation.plots import as_svg, new_figure

WIDTH, HEAD, BAR, NAMED = 860, 70, 28, 17  # px


def plot(measured: Mapping[str, Any]) -> bytes:
    """Draw as SVG a bar for each drawing with default settings, divided into stages, the total at its end."""
    usual = {"sh_degree": 0, "active_tiles": 1, "scene": "surface", "threads": measured["threads"]}
    bars = {
        f"{row['n']:,}, {row['width']}x{row['height']}": {each["stage"]: each["ms"] for each in row["stages"]}
        for row in measured["rasterize"]
        if usual.items() <= row.items()
    }
    stages = list(dict.fromkeys(stage for times in bars.values() for stage in times))
    with new_figure(WIDTH, max(HEAD + BAR * len(bars), NAMED * len(stages) + HEAD // 2)) as figure:
        axes = figure.subplots()
        title = f"Rasteriser, forward and backward, {measured['threads']} threads"
        axes.set_title(title, loc="left", fontweight="bold")
        ends = [0.0] * len(bars)
        for stage in stages:
            times = [each.get(stage, 0.0) for each in bars.values()]
            axes.barh(list(bars), times, left=ends, label=stage)
            ends = [end + ms for end, ms in zip(ends, times, strict=True)]
        for place, end in enumerate(ends):
            axes.annotate(f"{end:.1f} ms", (end, place), (4, -3), textcoords="offset points")
        axes.invert_yaxis()
        axes.margins(x=0.1)  # for the totals
        axes.grid(visible=False)
        axes.legend(loc="upper left", bbox_to_anchor=(1, 1))
        return as_svg(figure).encode()
