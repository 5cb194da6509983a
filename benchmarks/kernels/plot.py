"""Stacked bars of stage times as an SVG file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from sags_node.tools.evaluation.plots import as_svg, new_figure

WIDTH, HEAD, BAR, NAMED = 860, 70, 28, 17  # px

Bar = tuple[str, Mapping[str, float]]  # label, stage -> ms
Chart = tuple[str, Sequence[Bar]]  # title, bars


def stacked_bars(charts: Sequence[Chart]) -> str:
    """Charts one below the other, on one scale. A bar is divided into its stages and ends with its total."""
    heights = [max(HEAD + BAR * len(bars), NAMED * len(_stages(bars)) + HEAD // 2) for _, bars in charts]
    with new_figure(WIDTH, sum(heights)) as figure:
        panels = figure.subplots(len(charts), 1, squeeze=False, sharex=True, height_ratios=heights)[:, 0]
        for axes, (title, bars) in zip(panels, charts, strict=True):
            axes.set_title(title, loc="left", fontweight="bold")
            labels = [label for label, _ in bars]
            ends = [0.0] * len(bars)
            for stage in _stages(bars):
                times = [each.get(stage, 0.0) for _, each in bars]
                axes.barh(labels, times, left=ends, label=stage)
                ends = [end + ms for end, ms in zip(ends, times, strict=True)]
            for place, end in enumerate(ends):
                axes.annotate(f"{end:.1f} ms", (end, place), (4, -3), textcoords="offset points")
            axes.invert_yaxis()
            axes.margins(x=0.1)  # for the totals
            axes.grid(visible=False)
            axes.legend(loc="upper left", bbox_to_anchor=(1, 1))
        return as_svg(figure)


def _stages(bars: Sequence[Bar]) -> list[str]:
    return list(dict.fromkeys(stage for _, times in bars for stage in times))
