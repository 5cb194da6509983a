"""Plots of a report: values over the frame, or over what else lies across."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from sags_node.evaluation.plotting import as_svg, new_figure

WIDTH, HEIGHT = 720, 200  # px


@dataclass(frozen=True, slots=True)
class Series:
    """Points (frame, or what else lies across, and value) in order; NaN breaks the line."""

    label: str
    colour: str
    points: Sequence[tuple[float, float]]
    dots: bool = False  # single points, not joined


def line_plot(title: str, series: Sequence[Series], spans: Mapping[str, tuple[int, int]]) -> str:
    """An SVG file of several series; `spans` (first and last frame) are shaded and named.

    Empty text when there is nothing to draw.
    """
    series = [each for each in series if any(math.isfinite(value) for _, value in each.points)]
    if not series:
        return ""
    with new_figure(WIDTH, HEIGHT) as figure:
        axes = figure.subplots()
        axes.set_title(title, loc="left", fontweight="bold", fontsize=9)
        for each in series:
            across, values = zip(*each.points, strict=True)
            style = {"linestyle": "", "marker": "o", "markersize": 3} if each.dots else {"linewidth": 1.2}
            axes.plot(across, values, color=each.colour, label=each.label, **style)
        first, last = axes.get_xlim()
        for name, (begin, end) in spans.items():
            if begin <= last and first <= end:
                axes.axvspan(max(begin, first), min(end, last), color="#f2e3c6", zorder=0)
                corner = max(begin, first), 1
                axes.annotate(name, corner, (3, -9), ("data", "axes fraction"), "offset points")
        axes.set_xlim(first, last)
        if len(series) > 1:
            axes.legend(loc="upper left", bbox_to_anchor=(1, 1))
        return as_svg(figure)
