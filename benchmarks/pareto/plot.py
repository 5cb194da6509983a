"""Picture quality over run time as a PNG: a panel for each recording."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from sags_node.evaluation.plotting import as_png, new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

WIDTH, HEIGHT = 1100, 520  # px of a panel
BESIDE, LETTER, LINE = 11, 6, 12  # px: of a name to its point, of a letter, of a line
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


def picture(measured: Row) -> bytes:
    """PNG of `measured` as `measure_pareto` returns it."""
    sessions = measured["sessions"]
    with new_figure(WIDTH, HEIGHT * len(sessions)) as figure:
        panels = figure.subplots(len(sessions), 1, squeeze=False)[:, 0]
        for axes, session in zip(panels, sessions, strict=True):
            _label(figure, axes, _panel(axes, session))
        return as_png(figure)


def _panel(axes: Axes, session: Row) -> list[Row]:
    """Draws the points of a recording; returns their rows."""
    live = [row | {"non_dominated": False} for row in session["hosts"]]
    rows = [*session["settings"], *live]
    rate = session["rate_hz"]
    axes.set_title(
        f"{session['session']}, {session['frames']} frames: online PSNR* over the median frame; "
        "filled: no other setting is better in both",
        loc="left",
    )
    axes.set_xscale("log")
    axes.set_xlabel("ms per frame")
    axes.set_ylabel("dB")
    axes.axvline(1e3 / rate, color="#828282", linewidth=1)
    axes.annotate(f"camera: {rate:g} Hz", (1e3 / rate, 0), (3, 4), ("data", "axes fraction"), "offset points")
    front = sorted(_place(row) for row in rows if row["non_dominated"])
    axes.plot(*zip(*front, strict=True), color="#828282", linewidth=1)
    named = set()
    for row in rows:
        part, place = row["part"], _place(row)
        colour = COLOURS[part]
        axes.plot(
            *place, "o", color=colour, markerfacecolor=colour if row["non_dominated"] else "white",
            label=None if part in named else part,
        )  # fmt: skip
        named.add(part)
    axes.margins(x=0.15)  # names stand right of their points
    low, high = axes.get_xlim()
    axes.set_xticks([ms for ms in TICKS_MS if low <= ms <= high])
    axes.xaxis.set_major_formatter("{x:g}")
    axes.minorticks_off()
    axes.legend(loc="best")
    return rows


def _label(figure: Figure, axes: Axes, rows: Sequence[Row]) -> None:
    """The name of each point beside it, or above or below its neighbours' names."""
    figure.draw_without_rendering()  # it settles where points lie
    taken: list[tuple[float, float, float]] = []  # left, right, bottom, px
    for row in rows:
        said = _difference(row["name"], rows[0]["name"])
        x, y = axes.transData.transform(_place(row))
        left, right = x + BESIDE, x + BESIDE + LETTER * len(said)
        rooms = [
            down
            for down in (-4, 8, -16, 20, -28, 32)
            if not any(left < b and a < right and abs(y + down - c) < LINE for a, b, c in taken)
        ]
        down = rooms[0] if rooms else -4
        taken.append((left, right, y + down))
        axes.annotate(
            said, _place(row), (BESIDE, down), textcoords="offset pixels", color=COLOURS[row["part"]]
        )


def _place(row: Row) -> tuple[float, float]:
    return row["frame_ms"]["p50"], row["online_at_full_size"]["psnr"]


def _difference(name: str, default: str) -> str:
    """Of a name "budget, size, N": what is not as in the default's."""
    usual = default.split(", ")
    return ", ".join(said for said in name.split(", ") if said not in usual) or name
