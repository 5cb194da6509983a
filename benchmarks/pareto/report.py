"""Run time against error, for people: a table for each recording, and one of its skip rules."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from rich.table import Table

from benchmarks.tables import filled

Row = Mapping[str, Any]

PICTURES = "online", "online_at_full_size", "predict", "heldout", "novel"
SETTING = (
    "", "", "ms p50", "p99", "CPU", "model, dB", "at full size", "next, shown", "held out", "right eye",
    "depth, mm", "p90", "cover", "points, mm", "N",
)  # fmt: skip
SKIP = "rule", "model, dB: on", "off", "change", "depth, mm: on", "off", "change", "saved, ms"
HOST = (
    "host", "frames after the first second", "first render, ms", "frame, ms: p50", "p99",
    "latency, ms: p50", "p99", "size, px", "model at full size, dB", "N", "viewer, updates/s",
)  # fmt: skip
TIMES = "{frame_ms[p50]:.1f}", "{frame_ms[p99]:.1f}", "{latency_ms[p50]:.1f}", "{latency_ms[p99]:.1f}"


def tables(measured: Row) -> Iterator[Table]:
    """Make the tables; `measured` as `measure_pareto` returns it."""
    for session in measured["sessions"]:
        yield _settings(session)
        if session["skips"]:
            depths = "{on[depth][median_mm]:.3f}", "{off[depth][median_mm]:.3f}", "{depth_mm:+.3f}"
            psnrs = "{on[online][psnr]:.2f}", "{off[online][psnr]:.2f}", "{online_db:+.2f}"
            cells = "{rule}", *psnrs, *depths, "{saved_ms:.2f}"
            yield filled(_table(session, *SKIP), session["skips"], *cells, unknown="–")
        if session["hosts"]:
            yield _hosts(session)


def _settings(session: Row) -> Table:
    made, segments = _table(session, *SETTING), list(session["segments"])
    for place, row in enumerate(session["settings"]):
        marks = ("*" if row["non_dominated"] else " ") + ("default" if place == 0 else "")
        _add(made, row, segments, marks)
    made.add_section()
    for row in session["baselines"]:
        _add(made, row, segments, "")
    made.add_section()
    parts = f"; dB: all / {' / '.join(segments)}" if segments else ""
    stars = f"* no other setting is better in both, time and image at full size{parts}"
    made.caption = f"{stars}\n{session['why_default']}"
    return made


def _add(made: Table, row: Row, segments: Sequence[str], marks: str) -> None:
    """A setting or a baseline; a dash for what it does not have."""
    times = "{frame_ms[p50]:.1f}", "{frame_ms[p99]:.1f}", "{cpu_ms[p50]:.1f}"
    pictures = (_decibels(row, group, segments) for group in PICTURES)
    depth = "{depth[median_mm]:.2f}", "{depth[p90_mm]:.2f}", "{depth[coverage]:.1%}"
    cells = *times, *pictures, *depth, "{track[median_mm]:.2f}", "{gaussians[mean]:,.0f}"
    filled(made, [row], marks, "{name}", *cells, unknown="–")


def _hosts(session: Row) -> Table:
    made, segments = _table(session, *HOST), list(session["segments"])
    for row in session["hosts"]:
        share, first = "{share_after_first_second:.1%}", "{first_render_ms:.0f}"
        shown = "{size[0]}x{size[1]}", _decibels(row, "online_at_full_size", segments)
        cells = "{name}", share, first, *TIMES, *shown, "{gaussians[mean]:,.0f}", "{updates_per_s:.1f}"
        filled(made, [row], *cells, unknown="–")
        if "unread" in row:  # by its own account: nobody saw an image
            cells = "alone, nobody reads", "-", "-", *TIMES, "-", "-", "{gaussians:,.0f}", "-"
            filled(made, [row["unread"]], *cells, unknown="–")
    return made


def _decibels(row: Row, group: str, segments: Sequence[str]) -> str:
    """The cell of a group of figures, of all frames and of each segment."""
    if row.get(group) is None:
        return "–"
    return " / ".join(f"{{{group}{part}[psnr]:.2f}}" for part in ("", *(f"[{name}]" for name in segments)))


def _table(session: Row, *headings: str) -> Table:
    title = f"{session['session']}, {session['frames']} frames"
    made = Table(box=None, padding=(0, 3, 0, 0), pad_edge=False, title=title, title_justify="left")
    made.caption_justify = "left"
    for place, heading in enumerate(headings):
        made.add_column(heading, justify="right" if place > 1 else "left", no_wrap=True)
    return made
