"""Run time against error, for people: a table for each recording, and one of its skip rules."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from rich.table import Table

Row = Mapping[str, Any]


def tables(measured: Row) -> Iterator[Table]:
    """`measured` as `measure_pareto` returns it."""
    for session in measured["sessions"]:
        yield _settings(session)
        if session["skips"]:
            yield _skips(session)
        if session["hosts"]:
            yield _hosts(session)


def _settings(session: Row) -> Table:
    made = _table(
        session,
        "",
        "",
        "ms p50",
        "p99",
        "CPU",
        "online, dB",
        "at full size",
        "predict",
        "held out",
        "right eye",
        "depth, mm",
        "p90",
        "cover",
        "points, mm",
        "N",
    )
    segments = list(session["segments"])
    for place, row in enumerate(session["settings"]):
        marks = ("*" if row["non_dominated"] else " ") + ("default" if place == 0 else "")
        made.add_row(marks, row["name"], *_figures(row, segments))
    made.add_section()
    for row in session["baselines"]:
        made.add_row("", row["name"], *_figures(row, segments))
    made.add_section()
    parts = f"; dB: all / {' / '.join(segments)}" if segments else ""
    stars = f"* no other setting is better in both, time and picture at full size{parts}"
    made.caption = f"{stars}\n{session['why_default']}"
    return made


def _skips(session: Row) -> Table:
    made = _table(
        session, "rule", "online, dB: on", "off", "change", "depth, mm: on", "off", "change", "saved, ms"
    )
    for row in session["skips"]:
        on, off = row["on"], row["off"]
        made.add_row(
            row["rule"],
            _number(on["online"]["psnr"], ".2f"),
            _number(off["online"]["psnr"], ".2f"),
            _number(row["online_db"], "+.2f"),
            *(_number((each["depth"] or {}).get("median_mm"), ".3f") for each in (on, off)),
            _number(row["depth_mm"], "+.3f"),
            _number(row["saved_ms"], ".2f"),
        )
    return made


def _hosts(session: Row) -> Table:
    made = _table(
        session, "host", "frames after the first second", "first render, ms", "frame, ms: p50", "p99",
        "latency, ms: p50", "p99", "size, px", "online at full size, dB", "N",
    )  # fmt: skip
    for row in session["hosts"]:
        made.add_row(
            row["name"],
            _number(row["share_after_first_second"], ".1%"),
            _number(row["first_render_ms"], ".0f"),
            *_times(row),
            "x".join(map(str, row["size"])),
            _decibels(row["online_at_full_size"], list(session["segments"])),
            _number(row["gaussians"]["mean"], ",.0f"),
        )
        if "unread" in row:  # by its own account: nobody saw a picture
            unread = row["unread"]
            gaussians = _number(unread["gaussians"], ",.0f")
            made.add_row("alone, nobody reads", "-", "-", *_times(unread), "-", "-", gaussians)
    return made


def _times(row: Row) -> list[str]:
    """The median and p99 of a frame's time, then of its latency."""
    return [_number(row[key][place], ".1f") for key in ("frame_ms", "latency_ms") for place in ("p50", "p99")]


def _figures(row: Row, segments: Sequence[str]) -> list[str]:
    """The cells of a setting or a baseline; a dash for what it does not have."""
    times, depth = row.get("frame_ms") or {}, row.get("depth") or {}
    pictures = ("online", "online_at_full_size", "predict", "heldout", "novel")
    return [
        _number(times.get("p50"), ".1f"),
        _number(times.get("p99"), ".1f"),
        _number((row.get("cpu_ms") or {}).get("p50"), ".1f"),
        *(_decibels(row.get(group), segments) for group in pictures),
        _number(depth.get("median_mm"), ".2f"),
        _number(depth.get("p90_mm"), ".2f"),
        _number(depth.get("coverage"), ".1%"),
        _number((row.get("track") or {}).get("median_mm"), ".2f"),
        _number((row.get("gaussians") or {}).get("mean"), ",.0f"),
    ]


def _decibels(group: Row | None, segments: Sequence[str]) -> str:
    if group is None:
        return "–"
    parts = [group["psnr"], *((group.get(name) or {}).get("psnr") for name in segments)]
    return " / ".join(_number(value, ".2f") for value in parts)


def _number(value: float | None, shown: str) -> str:
    return "–" if value is None else format(value, shown)


def _table(session: Row, *headings: str) -> Table:
    title = f"{session['session']}, {session['frames']} frames"
    made = Table(
        box=None,
        padding=(0, 3, 0, 0),
        pad_edge=False,
        title=title,
        title_justify="left",
        caption_justify="left",
    )
    for place, heading in enumerate(headings):
        made.add_column(heading, justify="right" if place > 1 else "left", no_wrap=True)
    return made
