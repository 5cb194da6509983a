"""The depth tables for people."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from rich.table import Table

Row = Mapping[str, Any]


def tables(measured: Mapping[str, Any]) -> Iterator[Table]:
    """`measured` as `measure_recording`, `measure_faults` or `measure_ct` returns it."""
    if "faults" in measured:
        yield from _fault_tables(measured["faults"])
        return
    title = f"{measured['session']}, depth against truth: {measured['truth'].replace('_', ' ')}"
    yield _settings_table(title, measured["settings"])
    yield _confidence_table(measured["confidence"])
    if "regions" in measured:
        yield _regions_table(measured["regions"])


def _settings_table(title: str, rows: Sequence[Row]) -> Table:
    made = Table("setting", "median, mm", "p90", "too far by", "coverage", title=title)
    to_surface = "nearest_median_mm" in rows[0]
    made.add_column("to the surface, p90" if to_surface else "where the first knows, p90")
    made.add_column("ms")
    for row in rows:
        if to_surface:
            beside = _two(row["nearest_median_mm"], row["nearest_p90_mm"])
        else:
            there = row["where_configured_knows"]
            beside = _two(there["median_mm"], there["p90_mm"])
        coverage = "-" if row["coverage"] is None else f"{row['coverage']:.1%}"
        made.add_row(row["name"], *_errors(row), coverage, beside, _number(row["ms"], ".1f"))
    return made


def _confidence_table(rows: Sequence[Row]) -> Table:
    made = Table("confidence, as configured", "share", "median, mm", "p90", "too far by")
    for row in rows:
        made.add_row(f"{row['above']:g} to {row['up_to']:g}", _number(row["share"], ".1%"), *_errors(row))
    return made


def _regions_table(rows: Sequence[Row]) -> Table:
    made = Table("region", "stage: median, p90, mm", "too far by", "coverage", title="by region")
    for head in ("drawn: median, p90, mm", "too far by", "coverage", "too far by, where the stage knows"):
        made.add_column(head)
    for row in rows:
        cells = []
        for side in (row["stage"], row["drawn"]):
            coverage = _number(side["coverage"], ".1%")
            cells += [_two(side["median_mm"], side["p90_mm"]), _number(side["bias_mm"], "+.2f"), coverage]
        made.add_row(
            row["region"], *cells, _number(row["drawn"]["where_configured_knows"]["bias_mm"], "+.2f")
        )
    return made


def _fault_tables(rows: Sequence[Row]) -> Iterator[Table]:
    """One table for each fault: median, p90 and coverage of each setting, level by level."""
    for fault in dict.fromkeys(row["fault"] for row in rows):
        levels = [row for row in rows if row["fault"] == fault]
        heads = [f"{row['level']:g}" for row in levels]
        made = Table(fault, *heads, title=f"phantom, {fault} rising: median, p90, mm, coverage")
        made.add_row("white, of the tissue", *(f"{row['white']:.1%}" for row in levels))
        for settings in zip(*(row["settings"] for row in levels), strict=True):
            made.add_row(settings[0]["name"], *(_brief(setting) for setting in settings))
        yield made


def _brief(row: Row) -> str:
    if row["median_mm"] is None:
        return "-"
    return f"{row['median_mm']:.2f}, {row['p90_mm']:.2f}, {row['coverage']:.0%}"


def _errors(row: Row) -> tuple[str, str, str]:
    return _number(row["median_mm"], ".2f"), _number(row["p90_mm"], ".2f"), _number(row["bias_mm"], "+.2f")


def _two(median: float | None, p90: float | None) -> str:
    return f"{_number(median, '.2f')}, {_number(p90, '.2f')}"


def _number(value: float | None, shown: str) -> str:
    return "-" if value is None else format(value, shown)
