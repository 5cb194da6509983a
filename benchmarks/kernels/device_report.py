"""The table of a GPU for people: tables for a terminal, and a plot."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from rich.table import Table

from benchmarks.kernels.plot import Bar, stacked_bars
from benchmarks.kernels.report import (
    Row,
    add_stages,
    by_stage,
    drawing_name,
    new_table,
    peaks_table,
    stages_table,
)


def tables(measured: Row) -> Iterator[Table | str]:
    """`measured` as `measure_device_kernels` returns it."""
    rows = measured["rasterize"]
    yield peaks_table(measured["peaks"], [measured["device"]], f"{measured['machine']}; {measured['clock']}")
    yield _drawings(rows)
    yield _against_gsplat(rows, measured["gsplat"]) if "gsplat" in rows[0] else measured["gsplat"]
    stages = stages_table()
    for row in rows:
        add_stages(stages, row, drawing_name(row))
    yield stages


def plot(measured: Row) -> str:
    """Where the time goes, ours and gsplat's, as SVG."""
    bars: list[Bar] = []
    for row in measured["rasterize"]:
        bars.append((drawing_name(row), by_stage(row)))
        if "gsplat" in row:
            theirs = row["gsplat"]
            backward_ms = theirs["forward_backward_ms"] - theirs["forward_ms"]
            stages = {"gsplat, forward": theirs["forward_ms"], "gsplat, backward": max(0.0, backward_ms)}
            bars.append(("gsplat", stages))
    title = f"Rasteriser, forward and backward, {measured['device']} ({measured['clock']})"
    return stacked_bars([(title, bars)])


def _drawings(rows: Sequence[Row]) -> Table:
    made = new_table("drawing", "forward ms", "+ backward ms", "of peak")
    for row in rows:
        times = f"{row['forward_ms']:.3f}", f"{row['forward_backward_ms']:.3f}"
        made.add_row(drawing_name(row), *times, f"{row['share_of_peak']:.0%}")
    return made


def _against_gsplat(rows: Sequence[Row], version: str) -> Table:
    """gsplat's times, and how many times as fast ours is."""
    made = new_table(
        version, "forward ms", "ours faster", "+ backward ms", "ours faster", "same outputs ms",
        "ours faster", "outputs apart",
    )  # fmt: skip
    for row in rows:
        theirs, ours_ms = row["gsplat"], row["forward_backward_ms"]
        cells = []
        for key, own_ms in (
            ("forward_ms", row["forward_ms"]),
            ("forward_backward_ms", ours_ms),
            ("same_outputs_forward_backward_ms", ours_ms),
        ):
            cells += [f"{theirs[key]:.3f}", f"{theirs[key] / own_ms:.2f}x"]
        apart = max(theirs["planes_apart"], theirs["gradients_apart"])
        made.add_row(drawing_name(row), *cells, f"{apart:.1e}")
    return made
