"""Draws what a frame's time buys, as a PNG: image, depth and points of each recording."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

from sags_node.tools.evaluation.plots import as_png, new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Drawn

WIDTH, HEIGHT, SMALL = 1100, 520, 260  # px: a panel's width and height; height of panels without images
BESIDE, LETTER, LINE = 11, 6, 12  # px: from a point to its name; width of a letter; height of a line
COLOURS = {
    "default": "#1e1e1e",
    "budgets": "#2166ac",
    "resolutions": "#b2182b",
    "gaussians": "#1b7837",
    "rungs": "#994fa1",
    "hosts": "#e66101",
}
TICKS_MS = (5, 10, 15, 20, 25, 30, 40, 50, 75, 100, 150, 200, 300, 500, 1000)

Row = Mapping[str, Any]


class Figure(NamedTuple):
    """A figure that is drawn over the time of a frame."""

    name: str
    unit: str
    group: str
    key: str

    def place(self, row: Row) -> tuple[float, float]:
        return row["frame_ms"]["p50"], row[self.group][self.key]


PICTURE = Figure("PSNR* of the model at full size", "dB", "online_at_full_size", "psnr")
DEPTH = Figure("median depth error", "mm", "depth", "median_mm")
POINTS = Figure("median error of points on the tissue", "mm", "track", "median_mm")
FIGURES = (PICTURE, DEPTH, POINTS)


def picture(measured: Row) -> bytes:
    """Draw `measured`, as `measure_pareto` returns it, as a PNG."""
    panels = [
        (session, figure, _rows(session, figure))
        for session in measured["sessions"]
        for figure in FIGURES
        if _rows(session, figure)
    ]
    heights = [HEIGHT if figure is PICTURE else SMALL for _, figure, _ in panels]
    with new_figure(WIDTH, sum(heights)) as drawn:
        every = drawn.subplots(len(panels), 1, squeeze=False, height_ratios=heights)[:, 0]
        for axes, (session, figure, rows) in zip(every, panels, strict=True):
            _panel(axes, session, figure, rows)
            if figure is PICTURE:
                _label(drawn, axes, rows)
        return as_png(drawn)


def _rows(session: Row, figure: Figure) -> list[Row]:
    """Settings and hosts that have the figure."""
    live = [row | {"non_dominated": False} for row in session["hosts"]]
    every = [*session["settings"], *live]
    return [row for row in every if (row.get(figure.group) or {}).get(figure.key) is not None]


def _panel(axes: Axes, session: Row, figure: Figure, rows: Sequence[Row]) -> None:
    rate = session["rate_hz"]
    filled = "; filled: no other setting is better in both" if figure is PICTURE else ""
    axes.set_title(f"{session['session']}, {session['frames']} frames: {figure.name}{filled}", loc="left")
    axes.set_xscale("log")
    axes.set_xlabel("ms, the median frame")
    axes.set_ylabel(figure.unit)
    axes.axvline(1e3 / rate, color="#828282", linewidth=1)
    axes.annotate(f"camera: {rate:g} Hz", (1e3 / rate, 0), (3, 4), ("data", "axes fraction"), "offset points")
    if figure is PICTURE:
        front = sorted(figure.place(row) for row in rows if row["non_dominated"])
        axes.plot(*zip(*front, strict=True), color="#828282", linewidth=1)
    named = set()
    for row in rows:
        part = row["part"]
        colour = COLOURS[part]
        inside = colour if row["non_dominated"] and figure is PICTURE else "white"
        label = None if part in named else part
        axes.plot(*figure.place(row), "o", color=colour, markerfacecolor=inside, label=label)
        named.add(part)
    axes.margins(x=0.15)  # names stand right of their points
    low, high = axes.get_xlim()
    axes.set_xticks([ms for ms in TICKS_MS if low <= ms <= high])
    axes.xaxis.set_major_formatter("{x:g}")
    axes.minorticks_off()
    if figure is PICTURE:
        axes.legend(loc="best")


def _label(drawn: Drawn, axes: Axes, rows: Sequence[Row]) -> None:
    """The name of each point beside it, or above or below its neighbours' names."""
    drawn.draw_without_rendering()  # it settles where points lie
    taken: list[tuple[float, float, float]] = []  # left, right, bottom, px
    for row in rows:
        said = _difference(row["name"], rows[0]["name"])
        x, y = axes.transData.transform(PICTURE.place(row))
        left, right = x + BESIDE, x + BESIDE + LETTER * len(said)
        rooms = [
            down
            for down in (-4, 8, -16, 20, -28, 32)
            if not any(left < b and a < right and abs(y + down - c) < LINE for a, b, c in taken)
        ]
        down = rooms[0] if rooms else -4
        taken.append((left, right, y + down))
        axes.annotate(
            said, PICTURE.place(row), (BESIDE, down), textcoords="offset pixels", color=COLOURS[row["part"]]
        )


def _difference(name: str, default: str) -> str:
    """The parts of a name "budget, size, N" that differ from the default's."""
    usual = default.split(", ")
    return ", ".join(said for said in name.split(", ") if said not in usual) or name
