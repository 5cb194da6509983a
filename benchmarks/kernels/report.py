"""The kernel table for people: a few tables for a terminal, and a plot."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from typing import Any

from rich.table import Table

from benchmarks.kernels.check import Compared
from benchmarks.tables import filled, plain_table
from sags_node.tools.evaluation.plots import as_svg, new_figure

WIDTH, HEAD, BAR, NAMED = 860, 70, 28, 17  # px

Row = Mapping[str, Any]


def tables(measured: Row) -> Iterator[Table]:
    """Make the tables; `measured` as `measure_kernels` returns it."""
    yield _peaks(measured)
    yield _drawings(measured["rasterize"])
    yield _stages(measured)
    yield from _contention(measured)


def check_table(compared: Sequence[Compared], tolerance: float) -> Table:
    """Make the table of a comparison, the slowest kernel first."""
    rows = [asdict(each) | {"verdict": "slower" * (each.ratio > tolerance)} for each in compared]
    made = plain_table("kernel", "ms", "kept ms", "ratio", "")
    return filled(made, rows, "{kernel}", "{ms:.2f}", "{kept_ms:.2f}", "{ratio:.2f}", "{verdict}")


def plot(measured: Row) -> str:
    """Draw where the time goes, as SVG: for each drawing a bar that is divided into stages, with the total at
    its end."""
    bars = {
        f"{_count(row['n'])}, {row['width']}x{row['height']}": {
            each["stage"]: each["ms"] for each in row["stages"]
        }
        for row in _plain(measured)
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
        return as_svg(figure)


def _peaks(measured: Row) -> Table:
    peaks = measured["peaks"]
    sizes = [f"{int(size) >> 20} MiB" for size in peaks[0]["bytes_per_s_over"]]
    made = plain_table("peak of this machine", "multiply-adds", *sizes, title=measured["machine"])
    for peak in peaks:
        name = f"{peak['threads']} thread{'s' if peak['threads'] > 1 else ''}"
        bandwidths = [f"{rate / 1e9:.0f} GB/s" for rate in peak["bytes_per_s_over"].values()]
        made.add_row(name, f"{peak['operations_per_s'] / 1e9:.0f} G/s", *bandwidths)
    return made


def _drawings(rows: Sequence[Row]) -> Table:
    made = plain_table(
        "drawing", "threads", "forward ms", "+ backward ms", "of peak", "torch twin ms", "faster"
    )
    cells = "{threads}", "{forward_ms:.2f}", "{forward_backward_ms:.2f}", "{share_of_peak:.0%}"
    for row in rows:
        twin = (
            ("{twin_forward_backward_ms:.0f}", "{speedup_over_twin:.0f}x")
            if "speedup_over_twin" in row
            else ()
        )
        filled(made, [row], drawing_name(row), *cells, *twin)
    return made


def _stages(measured: Row) -> Table:
    named = [(drawing_name(row), row) for row in _plain(measured)]
    named += [(f"losses, {row['width']}x{row['height']}", row) for row in measured["losses"]]
    named += [(f"adam, {_count(row['n'])}", row) for row in measured["adam"]]
    made = plain_table("stage", "of", "ms", "of peak", "bound by", "pairs/s")
    for name, row in named:
        for stage in row["stages"]:
            pairs = f"{stage['pairs_per_s'] / 1e9:.2f} G" if "pairs_per_s" in stage else ""
            filled(made, [stage], "{stage}", name, "{ms:.3f}", "{share_of_peak:.0%}", "{bound}", pairs)
    return made


def _contention(measured: Row) -> Iterator[Table]:
    """Tables of the rows whose timings have p50 and p90, ms."""
    for section in ("rhythm", "contention"):
        for row in measured.get(section, []):
            what = f"forward and backward, {_count(row['n'])} at {row['width']}x{row['height']}"
            spreads = [
                {**spread, "what": key.removesuffix("_ms").replace("_", " ")}
                for key, spread in row.items()
                if isinstance(spread, Mapping)
            ]
            yield filled(plain_table(what, "p50 ms", "p90 ms"), spreads, "{what}", "{p50:.2f}", "{p90:.2f}")


def _plain(measured: Row) -> list[Row]:
    """The drawings with default settings."""
    special = {"sh_degree": 0, "active_tiles": 1, "scene": "surface", "threads": measured["threads"]}
    return [row for row in measured["rasterize"] if special.items() <= row.items()]


def drawing_name(row: Row) -> str:
    parts = [f"{_count(row['n'])} at {row['width']}x{row['height']}"]
    if row["scene"] != "surface":
        parts.append(row["scene"])
    if row["sh_degree"] > 0:
        parts.append(f"harmonics of degree {row['sh_degree']}")
    if row["active_tiles"] < 1:
        parts.append(f"{row['active_tiles']:.0%} of the tiles")
    return ", ".join(parts)


def _count(n: int) -> str:
    if n < 1000:
        return str(n)
    return f"{n / 1e3:.0f}k" if n < 999_500 else f"{n / 1e6:.2g}M"
