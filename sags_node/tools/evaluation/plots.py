"""Plots by matplotlib, which is the extra `report`."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.util import find_spec
from io import BytesIO, StringIO
from typing import TYPE_CHECKING, Any

from sags_node.errors import UsageError, install

if TYPE_CHECKING:
    from matplotlib.figure import Figure

WIDTH, HEIGHT = 640, 280  # px, of `line_plot`
DPI = 100
_STYLE: dict[Any, Any] = {
    "svg.fonttype": "none",  # text stays text
    "svg.hashsalt": "sags",  # the same plot is the same file
    "text.parse_math": False,
    "font.size": 8,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#dddddd",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "legend.frameon": False,
    "figure.constrained_layout.use": True,
}


def has_plots() -> bool:
    """Tell whether matplotlib is installed."""
    return find_spec("matplotlib") is not None


def check_plots() -> None:
    """Check that matplotlib is installed, before long work whose result is a plot.

    Raises:
        UsageError: matplotlib is not installed.
    """
    if not has_plots():
        raise UsageError(f"plots need matplotlib, which is not installed: {install('report')}")


@contextmanager
def new_figure(width: float, height: float) -> Iterator[Figure]:
    """Make an empty figure, size in px; fill and write it in the `with` block. Raises as `check_plots`."""
    check_plots()
    import matplotlib
    from matplotlib.figure import Figure

    with matplotlib.rc_context(_STYLE):  # whoever else plots in this process keeps their own style
        yield Figure((width / DPI, height / DPI), dpi=DPI)


def as_svg(figure: Figure) -> str:
    """A whole SVG file."""
    file = StringIO()
    figure.savefig(file, format="svg", metadata={"Date": None})
    return file.getvalue()


def as_png(figure: Figure) -> bytes:
    """A whole PNG file."""
    file = BytesIO()
    figure.savefig(file, format="png")
    return file.getvalue()


@dataclass(frozen=True, slots=True)
class Series:
    """A line through points (x, mostly the frame, and value) in order; NaN breaks it."""

    label: str
    colour: str
    points: Sequence[tuple[float, float]]
    dots: bool = False  # single points, not joined


def line_plot(
    title: str,
    series: Sequence[Series],
    spans: Mapping[str, tuple[int, int]],
    across: str = "frame",
    gaps: Sequence[int] = (),
    up: str = "",
) -> str:
    """An SVG file of several series; empty text when there is nothing to draw.

    Args:
        spans: first and last frame of what is shaded and named, unless it is half of all or more.
        across: label of the x axis; empty: the title says it.
        gaps: frames that are shaded grey.
        up: label of the y axis; empty: the title says it.
    """
    series = [each for each in series if any(math.isfinite(value) for _, value in each.points)]
    if not series:
        return ""
    with new_figure(WIDTH, HEIGHT) as figure:
        axes = figure.subplots()
        axes.set_title(title, loc="left", fontweight="bold", fontsize=10)
        for each in series:
            places, values = zip(*each.points, strict=True)
            style = {"linestyle": "", "marker": "o", "markersize": 3} if each.dots else {"linewidth": 1.2}
            axes.plot(places, values, color=each.colour, label=each.label, **style)
        first, last = axes.get_xlim()
        for name, span in spans.items():
            begin, end = max(span[0], first), min(span[1], last)
            if 0 <= end - begin < (last - first) / 2:  # half a clip, shaded, would hide the others
                axes.axvspan(begin, end, color="#f2e3c6", zorder=0)
                corner = begin, 1
                axes.annotate(name, corner, (3, -9), ("data", "axes fraction"), "offset points")
        for frame in gaps:
            axes.axvspan(frame - 0.5, frame + 0.5, color="#dddddd", linewidth=0, zorder=0)
        axes.set_xlim(first, last)
        axes.set_xlabel(across)
        axes.set_ylabel(up)
        if len(series) > 1:
            figure.legend(loc="outside lower left", ncols=len(series) if len(series) < 4 else 2)  # all fit
        return as_svg(figure)
