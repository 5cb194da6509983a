"""What a person should know of a recording that runs."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from sags_node.types import Finding

SILENT_SECONDS = 3.0  # without a message; a node says its status once a second
LOW_SECONDS = 300.0  # that the disk has room for
WHOLE = 0.9  # of the seconds asked for a snapshot: the oldest message came after their beginning


def findings(summary: Mapping[str, Any]) -> Iterator[Finding]:
    """The findings of what `Recorder.summary` says."""
    folder, silent, free = summary["folder"], summary["silent_s"], summary["free_bytes"]
    if silent > SILENT_SECONDS:
        yield Finding(
            "recording_silent",
            f"nothing has come to {folder} for {silent:.0f} s: does the node run, and do frames come?",
        )
    missing, asked, kept = summary["lost"], summary["snapshot_seconds"], summary["kept_s"]
    if asked is None:
        missing += summary["dropped"]
    elif summary["dropped"] and kept < WHOLE * asked:
        yield Finding(
            "recording_loses",
            f"the last {asked:g} s do not fit into memory, {kept:.2f} s are kept for a snapshot: raise "
            "--max-cache (max_cache_mb), or record fewer topics",
        )
    if missing:
        yield Finding(
            "recording_loses",
            f"{missing} messages are missing in {folder}: the disk or the machine is too slow; record fewer "
            "topics, or with compression jpeg",
        )
    if summary["rejected"]:
        yield Finding(
            "recording_rejects",
            f"{summary['rejected']} messages are not in {folder}: {summary['rejected_why']}",
        )
    if free is not None and free < LOW_SECONDS * 1e6 * summary["mb_per_s"]:
        yield Finding(
            "recording_disk_low",
            f"the disk of {folder} is full in {free / 1e6 / summary['mb_per_s']:.0f} s at "
            f"{summary['mb_per_s']} MB/s: make room, record fewer topics, or with compression jpeg",
        )
