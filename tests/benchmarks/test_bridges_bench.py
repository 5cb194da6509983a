"""`benchmarks bridges` on a small node: real processes and sockets."""

from __future__ import annotations

import pytest

pytest.importorskip("pyigtl", reason="no bridges without: pip install '.[bridges]'")
pytest.importorskip("foxglove", reason="no bridges without: pip install '.[bridges]'")
pytest.importorskip("av", reason="no H.264 without PyAV")
pytest.importorskip("cyclonedds", reason="ROS 2 needs: pip install '.[ros2]'")

from benchmarks.node import bridges, crowd

pytestmark = [pytest.mark.live, pytest.mark.alone]

SMALL = ("replay/phantom_pull", "source.pace:=realtime", "mapping.max_gaussians:=2000")


def test_each_bridge_gives_pictures_and_says_what_it_costs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(crowd, "WARM_UP", 0.5)
    few = ("openigtlink", "foxglove, H.264", "ros2, small")  # each takes seconds
    monkeypatch.setattr(bridges, "CASES", tuple(case for case in bridges.CASES if case.name in few))
    rows = bridges.measure_bridges(SMALL, 4.0, lambda done, of, what: None)
    alone, *bridged = rows
    assert alone["bridge"] == "none" and [row["bridge"] for row in bridged] == list(few)
    for row in bridged:
        assert row["pictures_hz"] > 0 and row["messages_hz"] >= row["pictures_hz"]
        assert 0 < row["age_ms"]["p50"] and row["cpu_ms_per_frame"] > 0 and row["node_rate_hz"] > 0
    raw, thin, small = (row["mb_per_s"] / row["pictures_hz"] for row in bridged)
    assert thin < raw / 10 and small < raw
    assert bridges.table(rows).row_count == 4
