"""What an hour of video costs, from two lengths of a recording."""

from __future__ import annotations

from pathlib import Path

from command_line import pure_json, refused, sags
from tiny_archive import TINY_FRAMES

from sags_lab.archive.costs import Cost, of_an_hour


def test_a_start_counts_once_and_each_frame_the_same() -> None:
    """3 s to start and 0.1 s for a frame; an hour at 30 Hz has 108,000 frames."""
    short, long = (Cost(3 + 0.1 * n, 4 + 0.2 * n, 300.0, 50 + 1000 * n) for n in (30, 120))
    assert of_an_hour("depth", short, long, 120, 30.0) == {
        "cpu_s": 10_803,
        "wall_s": 21_604,
        "bytes": 108_000_050,
    }
    assert of_an_hour("fit", long, long, 120, 30.0)["cpu_s"] == 900 * 15  # so many clips


def test_the_command_measures_a_recording(tiny_session: Path) -> None:
    asked = ("--job", "depth", "--frames", TINY_FRAMES, "--json")
    rows = pure_json(sags("archive", "costs", tiny_session, "mapping.iterations:=1", *asked).stdout)
    assert [(row["job"], row["frames"], row["seconds_of_video"]) for row in rows] == [("depth", 6, 0.6)]
    assert rows[0]["cpu_s"] > 0.1 and rows[0]["peak_mb"] > 50
    pictures = 2 * 160 * 128 * TINY_FRAMES  # bytes, before they are compressed
    assert 0 < rows[0]["bytes"] < pictures + 10_000
    refused(2, "archive", "costs", tiny_session, "--frames", 7, said=("7 frames", "has 6", "--frames"))
