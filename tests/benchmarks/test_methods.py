"""Control nodes and the paper's field side by side: the figures are there, and say what a field is for."""

from __future__ import annotations

import json
from pathlib import Path

from click.testing import CliRunner

from benchmarks.__main__ import main


def test_a_field_knows_the_last_seconds_and_nodes_do_not(phantom_session: Path) -> None:
    arguments = [
        "methods",
        str(phantom_session),
        "source.frames:=20",
        "mapping.max_gaussians:=6000",
        "--json",
    ]
    result = CliRunner().invoke(main, arguments)
    assert result.exit_code == 0, result.output
    rows = json.loads(result.stdout)
    assert [row["method"] for row in rows] == ["nodes", "sags"] * 2
    for nodes, sags in zip(rows[::2], rows[1::2], strict=True):
        assert sags["step"]["window"] > nodes["step"]["window"]
        assert (
            sags["step"]["receipt"] == nodes["step"]["receipt"] and sags["live"]["receipt"]["frames"]["count"]
        )
        assert all(row["live"]["rate_hz"] > 0 and row["step"]["online"] > 20 for row in (nodes, sags))


def test_live_cameras_are_refused(tmp_path: Path) -> None:
    launch = tmp_path / "live.yaml"
    launch.write_text("source: {kind: v4l2}\n")
    result = CliRunner().invoke(main, ["methods", str(launch)])
    assert result.exit_code == 2 and "recordings" in result.output
