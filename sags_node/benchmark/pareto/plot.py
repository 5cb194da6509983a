"""Picture quality over run time as a PNG: a panel for each recording."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from sags_node.plotting import as_png, new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes

WIDTH, HEIGHT = 1100, 520  # px of a panel
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
    figure = new_figure(WIDTH, HEIGHT * len(sessions))
    for axes, session in zip(figure.subplots(len(sessions), 1, squeeze=False)[:, 0], sessions, strict=True):
        _panel(axes, session)
    return as_png(figure)


def _panel(axes: Axes, session: Row) -> None:
    live = [row | {"online_at_full_size": row["online"], "non_dominated": False} for row in session["hosts"]]
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
    axes.plot(*zip(*front, strict=True), color="#828282", linewidth=1) if front else None
    named = set()
    for row in rows:
        part, place = row["part"], _place(row)
        colour = COLOURS[part]
        axes.plot(
            *place, "o", color=colour, markerfacecolor=colour if row["non_dominated"] else "white",
            label=None if part in named else part,
        )  # fmt: skip
        named.add(part)
        said = _difference(row["name"], rows[0]["name"])
        axes.annotate(said, place, (8, -3), textcoords="offset points", color=colour)
    axes.margins(x=0.15)  # names stand right of their points
    low, high = axes.get_xlim()
    axes.set_xticks([ms for ms in TICKS_MS if low <= ms <= high])
    axes.xaxis.set_major_formatter("{x:g}")
    axes.minorticks_off()
    axes.legend(loc="best")


def _place(row: Row) -> tuple[float, float]:
    return row["frame_ms"]["p50"], row["online_at_full_size"]["psnr"]


def _difference(name: str, default: str) -> str:
    """Of a name "budget, size, N": what is not as in the default's."""
    usual = default.split(", ")
    return ", ".join(said for said in name.split(", ") if said not in usual) or name
