"""`sags bag`: what its commands say to people."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from rich.table import Table

from sags_node.errors import UsageError
from sags_node.messaging.topics import plain_name
from sags_node.terminal import text


def remappings(said: Sequence[str], ns: str) -> dict[str, str]:
    """`old:=new` of `--remap`.

    Raises:
        UsageError: one is written otherwise.
    """
    pairs = [item.partition(":=") for item in said]
    for old, assigned, new in pairs:
        if not (old and assigned and new):
            raise UsageError(f"--remap {old}{assigned}{new}: write old:=new")
    return {plain_name(ns, old): plain_name(ns, new) for old, _, new in pairs}


def recorded_table(summary: Mapping[str, Any]) -> Table:
    """Return what a recorder wrote and what it could not."""
    from sags_node.node.recorder_state import SILENT_SECONDS  # brings NumPy along, which --help does not need

    table = text.table("topic", "messages", "dropped", "lost")
    for name, row in summary["topics"].items():
        table.add_row(name, str(row["messages"]), str(row["dropped"]), str(row["lost"]))
    table.add_row("in all", str(summary["messages"]), str(summary["dropped"]), str(summary["lost"]))
    silent = summary["silent_s"]
    ended = f"; nothing came in the last {silent:.0f} s" if silent > SILENT_SECONDS else ""
    size = f"{summary['bytes'] / 1e6:.1f} MB at {summary['mb_per_s']} MB/s"
    table.caption = f"{summary['folder']}: {size}{ended}"
    return table


def info_table(info: Mapping[str, Any]) -> Table:
    """Return what a bag holds."""
    table = text.table("topic", "type", "messages", "Hz", "lost", "longest gap (s)")
    for row in info["topics"]:
        cells = (row[key] for key in ("topic", "type", "messages", "rate_hz", "lost", "longest_gap_s"))
        table.add_row(*("-" if cell is None else str(cell) for cell in cells))
    files = f" in {len(info['files'])} files" if len(info["files"]) > 1 else ""
    held = f"{info['duration_s']} s, {info['messages']} messages, {info['size'] / 1e6:.1f} MB{files}"
    table.caption = f"{info['path']}: {held}"
    return table


def recovered_text(done: Mapping[str, Any]) -> str:
    """Return what was saved and what was not."""
    saved = f"{done['messages']} messages saved to {done['folder']}"
    if not done["lost"]:
        return f"{saved}; nothing was lost"
    parts = {
        "damaged chunks": done["chunks_damaged"],
        "messages without a topic": done["messages_lost"],
        "bytes that are no records": done["bytes_skipped"],
        "files cut off or never closed": done["unclosed_files"],
    }
    return f"{saved}; not whole: " + ", ".join(f"{what} {count}" for what, count in parts.items() if count)
