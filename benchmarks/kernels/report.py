"""The kernel table for people: a few tables for a terminal, and a plot."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from rich.table import Table

from benchmarks.kernels.check import Compared
from benchmarks.kernels.plot import Bar, stacked_bars

Row = Mapping[str, Any]


def tables(measured: Row) -> Iterator[Table]:
    """`measured` as `measure_kernels` returns it."""
    peaks = measured["peaks"]
    names = [f"{each['threads']} thread{'s' if each['threads'] > 1 else ''}" for each in peaks]
    yield peaks_table(peaks, names, measured["machine"])
    yield _drawings(measured["rasterize"])
    yield _stages(measured)
    yield from _contention(measured)


def check_table(compared: Sequence[Compared], tolerance: float) -> Table:
    """The slowest kernel first."""
    made = new_table("kernel", "ms", "kept ms", "ratio", "")
    for each in compared:
        verdict = "slower" if each.ratio > tolerance else ""
        made.add_row(each.kernel, f"{each.ms:.2f}", f"{each.kept_ms:.2f}", f"{each.ratio:.2f}", verdict)
    return made


def plot(measured: Row) -> str:
    """Where the time goes, as SVG."""
    drawings: list[Bar] = [
        (f"{_count(row['n'])}, {row['width']}x{row['height']}", by_stage(row))
        for row in measured["rasterize"]
        if _is_plain(row, measured["threads"])
    ]
    threads = f"{measured['threads']} threads"
    return stacked_bars([(f"Rasteriser, forward and backward, {threads}", drawings)])


def peaks_table(peaks: Sequence[Row], names: Sequence[str], title: str) -> Table:
    """What each of `names` reached."""
    sizes = [f"{int(size) >> 20} MiB" for size in peaks[0]["bytes_per_s_over"]]
    made = new_table("peak of this machine", "multiply-adds", *sizes, title=title)
    for name, peak in zip(names, peaks, strict=True):
        bandwidths = [f"{rate / 1e9:.0f} GB/s" for rate in peak["bytes_per_s_over"].values()]
        made.add_row(name, f"{peak['operations_per_s'] / 1e9:.0f} G/s", *bandwidths)
    return made


def _drawings(rows: Sequence[Row]) -> Table:
    made = new_table(
        "drawing", "threads", "forward ms", "+ backward ms", "of peak", "torch twin ms", "faster"
    )
    for row in rows:
        twin = row.get("twin_forward_backward_ms")
        made.add_row(
            drawing_name(row),
            str(row["threads"]),
            f"{row['forward_ms']:.2f}",
            f"{row['forward_backward_ms']:.2f}",
            f"{row['share_of_peak']:.0%}",
            "" if twin is None else f"{twin:.0f}",
            "" if twin is None else f"{row['speedup_over_twin']:.0f}x",
        )
    return made


def _stages(measured: Row) -> Table:
    made = new_table("stage", "of", "ms", "of peak", "bound by", "pairs/s")
    for row in measured["rasterize"]:
        if _is_plain(row, measured["threads"]):
            add_stages(made, row, drawing_name(row))
    for section in ("losses", "adam"):
        for row in measured[section]:
            add_stages(made, row, _kernel(section, row))
    return made


def _kernel(section: str, row: Row) -> str:
    if section == "losses":
        return f"losses, {row['width']}x{row['height']}"
    return f"{section}, {_count(row['n'])}"


def _contention(measured: Row) -> Iterator[Table]:
    """Rows whose timings are maps from p50 and p90 to ms."""
    for section in ("rhythm", "contention"):
        for row in measured.get(section, []):
            what = f"forward and backward, {_count(row['n'])} at {row['width']}x{row['height']}"
            made = new_table(what, "p50 ms", "p90 ms")
            for key, spread in row.items():
                if isinstance(spread, Mapping):
                    situation = key.removesuffix("_ms").replace("_", " ")
                    made.add_row(situation, f"{spread['p50']:.2f}", f"{spread['p90']:.2f}")
            yield made


def add_stages(made: Table, row: Row, of: str) -> None:
    for stage in row["stages"]:
        share, pairs = f"{stage['share_of_peak']:.0%}", ""
        if "pairs_per_s" in stage:
            pairs = f"{stage['pairs_per_s'] / 1e9:.2f} G"
        made.add_row(stage["stage"], of, f"{stage['ms']:.3f}", share, stage["bound"], pairs)


def _is_plain(row: Row, threads: int) -> bool:
    special = row["sh_degree"] > 0 or row["active_tiles"] < 1
    return not special and row["scene"] == "surface" and row["threads"] == threads


def drawing_name(row: Row) -> str:
    parts = [f"{_count(row['n'])} at {row['width']}x{row['height']}"]
    if row["scene"] != "surface":
        parts.append(row["scene"])
    if row["sh_degree"] > 0:
        parts.append(f"harmonics of degree {row['sh_degree']}")
    if row["active_tiles"] < 1:
        parts.append(f"{row['active_tiles']:.0%} of the tiles")
    return ", ".join(parts)


def by_stage(row: Row) -> dict[str, float]:
    return {stage["stage"]: stage["ms"] for stage in row["stages"]}


def _count(n: int) -> str:
    if n < 1000:
        return str(n)
    return f"{n / 1e3:.0f}k" if n < 999_500 else f"{n / 1e6:.2g}M"


def new_table(first: str, *others: str, title: str | None = None) -> Table:
    made = Table(box=None, padding=(0, 3, 0, 0), pad_edge=False, title=title, title_justify="left")
    made.add_column(first)
    for heading in others:
        made.add_column(heading, justify="right")
    return made
