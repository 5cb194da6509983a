"""`benchmarks soak` on a small node with all its neighbours: real processes and sockets."""

from __future__ import annotations

import json
import math
import os
from pathlib import Path
from unittest.mock import ANY

import pytest
from command_line import figures_of

from benchmarks.__main__ import main
from benchmarks.node import neighbours, soak
from sags_node.errors import SagsError

pytestmark = [pytest.mark.live, pytest.mark.alone]
SMALL = ("replay/phantom_pull", "source.pace:=realtime", "mapping.max_gaussians:=2000")


def test_a_node_and_all_its_neighbours_run_and_are_measured(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(soak, "WARM_UP", 1.0)
    out = tmp_path / "soak.json"
    arguments = ["soak", *SMALL, "--frames", "50", "--window", "10", "--json", "--out", str(out)]
    measured = figures_of(*arguments, command=main)
    assert json.loads(out.read_text()) == {"provenance": ANY} | measured
    ends = [window["frames"] for window in measured["windows"]]  # with those that the node left out
    assert len(ends) == 5 and all(end >= due for end, due in zip(ends, range(10, 51, 10), strict=True))
    assert measured["published"] + measured["dropped"] == measured["frames"] >= 50
    for window in measured["windows"]:
        assert 0 < window["latency_p50_ms"] <= window["latency_p99_ms"]
        assert 20 < window["psnr"] < 60
        assert window["threads"] > 5 and window["descriptors"] > 10 and window["rss_mb"] > 50
        assert window["overlay_mb"] > 50
        assert (window["viewer_mb"] is None) == (neighbours.find_browser() is None)
    latency = measured["latency_ms"]
    assert latency["p50"] <= latency["p99"] <= latency["p99.9"] <= latency["max"]
    assert measured["visits"]["visits"] > 0 and measured["recordings"]["recordings"] == 1
    assert measured["recordings"]["failed"] == 0 and not measured["interrupted"]
    assert all(math.isfinite(found["slope"]) for found in measured["per_1000_frames"].values())
    assert "visits of subscribers" in soak.statement(measured) and soak.table(measured).row_count == 5


@pytest.mark.parametrize("name", ["overlay", "viewer"])
def test_a_neighbour_that_ends_is_not_measured(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It would cost nothing, and the figures would say so."""
    if name == "viewer" and neighbours.find_browser() is None:
        pytest.skip("needs Chromium")
    beside = neighbours.overlay if name == "overlay" else neighbours.viewer
    run_dir = tmp_path / "sags"
    run_dir.mkdir(mode=0o700)
    with pytest.raises(SagsError, match=f"the {name} ended before its time"), beside(run_dir) as process:
        os.kill(process, 9)
        os.waitid(os.P_PID, process, os.WEXITED | os.WNOWAIT)
