"""The depth tables for people."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from rich.table import Table

from benchmarks.tables import filled

Row = Mapping[str, Any]
ERRORS = "{median_mm:.2f}", "{p90_mm:.2f}", "{bias_mm:+.2f}"


def tables(measured: Mapping[str, Any]) -> Iterator[Table]:
    """Make the tables; `measured` as `measure_recording`, `measure_faults` or `measure_ct` returns it."""
    if "faults" in measured:
        yield from _fault_tables(measured["faults"])
        return
    title = f"{measured['session']}, depth against truth: {measured['truth'].replace('_', ' ')}"
    yield _settings_table(title, measured["settings"])
    confidence = Table("confidence, as configured", "share", "median, mm", "p90", "too far by")
    yield filled(confidence, measured["confidence"], "{above:g} to {up_to:g}", "{share:.1%}", *ERRORS)
    if "regions" in measured:
        yield _regions_table(measured["regions"])


def _settings_table(title: str, rows: Sequence[Row]) -> Table:
    if "nearest_median_mm" in rows[0]:
        where, beside = "to the surface", "{nearest_median_mm:.2f}, {nearest_p90_mm:.2f}"
    else:
        where = "where the first knows"
        beside = "{where_configured_knows[median_mm]:.2f}, {where_configured_knows[p90_mm]:.2f}"
    made = Table("setting", "median, mm", "p90", "too far by", "coverage", f"{where}, p90", "ms", title=title)
    return filled(made, rows, "{name}", *ERRORS, "{coverage:.1%}", beside, "{ms:.1f}")


def _regions_table(rows: Sequence[Row]) -> Table:
    made = Table("region", title="by region")
    cells = ["{region}"]
    for side in ("stage", "drawn"):
        for heading in (f"{side}: median, p90, mm", "too far by", "coverage"):
            made.add_column(heading)
        cells += [f"{{{side}[median_mm]:.2f}}, {{{side}[p90_mm]:.2f}}", f"{{{side}[bias_mm]:+.2f}}"]
        cells.append(f"{{{side}[coverage]:.1%}}")
    made.add_column("too far by, where the stage knows")
    return filled(made, rows, *cells, "{drawn[where_configured_knows][bias_mm]:+.2f}")


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
