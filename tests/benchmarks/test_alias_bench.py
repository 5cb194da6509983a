"""`python -m benchmarks alias`."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from command_line import figures_of

from benchmarks.__main__ import main


def test_its_figures_say_of_the_phantom_what_the_tests_say_of_a_wall(tmp_path: Path) -> None:
    out, drawn = tmp_path / "alias.json", tmp_path / "alias.png"
    figures = figures_of("alias", "--quick", "--json", "--out", out, "--picture", drawn, command=main)
    table = json.loads(out.read_text())
    assert table.pop("provenance") and table == figures
    assert table["receipt"]["frames"]["count"] == 1
    assert table["gain_db_quarter"] > 3
    assert table["gain_db_distance_4"] > 3
    quarter = table["psnr_at_size"][0]
    assert quarter["both"] - quarter["none"] == pytest.approx(table["gain_db_quarter"])
    assert all(abs(row["both"]) < 0.02 for row in table["thin_vessel_brightness_change"])
    assert drawn.read_bytes().startswith(b"\x89PNG")
