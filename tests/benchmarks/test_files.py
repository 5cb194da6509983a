"""No benchmark writes over a file that it did not make."""

from __future__ import annotations

from pathlib import Path

import pytest
from command_line import refused

from benchmarks.__main__ import main

WRITERS = [
    *((name, "--out") for name in main.commands if name != "transport"),
    ("alias", "--picture"),
    ("depth", "--plot"),
    ("pareto", "--plot"),
]


@pytest.mark.parametrize(("name", "option"), WRITERS)
def test_what_it_did_not_make_stays(tmp_path: Path, name: str, option: str) -> None:
    """It says so before any work."""
    mine = tmp_path / "mine.png"
    mine.write_text("source: {kind: videos}")
    refused(2, name, option, mine, said=(str(mine), "exists already", "choose another name"), command=main)
    assert mine.read_text() == "source: {kind: videos}"
