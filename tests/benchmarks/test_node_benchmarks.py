"""`python -m benchmarks crowd`, `bridges`, `hosts` and `soak` on small nodes: real processes and sockets."""

import json
import math
import os
from pathlib import Path
from unittest.mock import ANY

import pytest
from command_line import figures_of

from benchmarks.__main__ import main
from benchmarks.node import crowd, hosts, neighbours, soak
from sags_node.errors import SagsError

pytestmark = [pytest.mark.live, pytest.mark.alone]

SMALL = ("replay/phantom_pull", "source.pace:=realtime", "mapping.max_gaussians:=2000")


def test_everybody_hears_the_node_and_it_does_not_wait_for_any(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(crowd, "WARM_UP", 2.0)
    measured = crowd.measure_crowd(SMALL, 5.0, 7.0, lambda *_: None, 3)
    alone, read, crowded, _ = measured["phases"]
    assert [each["phase"] for each in measured["phases"]] == ["alone", "one reader", "crowd", "alone again"]
    assert read["peers"]["reader"]["messages"] > 3 * 6
    assert set(crowded["peers"]) == {"fast", "slow", "dead", "3 more"} and not alone["peers"]
    fast, slow = crowded["peers"]["fast"], crowded["peers"]["slow"]
    assert slow["rate_hz"] < 1 / crowd.SLOW < fast["rate_hz"]
    # The slow one takes what is new, not what has queued up behind it.
    assert slow["since_sent_ms"]["p50"] < 1e3 * crowd.SLOW
    assert crowded["peers"]["3 more"]["messages"] > 3 * 6
    assert crowded["rate_hz"]["p50"] > 0.5 * alone["rate_hz"]["p50"]


def test_a_node_that_does_not_start_says_why() -> None:
    with pytest.raises(SagsError, match=r"did not start.*no_such_key"):
        crowd.measure_crowd(("no_such_key:=1",), 1.0, 1.0, lambda *_: None)


def test_each_bridge_gives_pictures_and_says_what_it_costs(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("pyigtl", reason="no bridges without: pip install '.[bridges]'")
    pytest.importorskip("foxglove", reason="no bridges without: pip install '.[bridges]'")
    pytest.importorskip("av", reason="no H.264 without PyAV")
    pytest.importorskip("cyclonedds", reason="ROS 2 needs: pip install '.[ros2]'")
    from benchmarks.node import bridges

    monkeypatch.setattr(crowd, "WARM_UP", 0.5)
    few = ("openigtlink", "foxglove, H.264", "ros2, small")  # each takes seconds
    monkeypatch.setattr(bridges, "CASES", tuple(case for case in bridges.CASES if case.name in few))
    rows = bridges.measure_bridges(SMALL, 4.0, lambda *_: None)
    alone, *bridged = rows
    assert alone["bridge"] == "none" and [row["bridge"] for row in bridged] == list(few)
    for row in bridged:
        assert row["pictures_hz"] > 0 and row["messages_hz"] >= row["pictures_hz"]
        assert 0 < row["age_ms"]["p50"] and row["cpu_ms_per_frame"] > 0 and row["node_rate_hz"] > 0
    raw, thin, small = (row["mb_per_s"] / row["pictures_hz"] for row in bridged)
    assert thin < raw / 10 and small < raw


SHORT = ["source.frames:=20"]  # at 10 Hz


def test_hosts_are_played_and_leave_the_machine_as_it_was(
    phantom_session: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    left_out = ("beside a busy process", "with the overlay")
    chosen = {name: beside for name, beside in hosts.neighbours().items() if name not in left_out}
    monkeypatch.setattr(hosts, "neighbours", lambda: chosen)
    mine, said = os.sched_getaffinity(0), []
    rows = hosts.measure_hosts(str(phantom_session), SHORT, said.append)
    assert [row["name"] for row in rows] == list(chosen) and len(said) == len(chosen)
    assert rows[0]["unread"]["latency_ms"]["p50"] > 0
    for row in rows:
        assert 0 < row["share_after_first_second"] <= 1 and row["latency_ms"]["p50"] > 0
        assert row["online_at_full_size"]["psnr"] > 15 and sum(row["rungs"].values()) > 0
        assert ("updates_per_s" in row) == (row["name"] == "with the viewer")
        assert row.get("updates_per_s", 0) >= 0, "none, where the browser gets nothing of the cores"
    assert os.sched_getaffinity(0) == mine


def test_a_run_that_fails_says_why(phantom_session: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(hosts, "neighbours", lambda: {"alone": None})
    with pytest.raises(SagsError, match=r"mapping\.rung 99"):
        hosts.measure_hosts(str(phantom_session), [*SHORT, "mapping.rung:=99"], lambda what: None)


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


@pytest.mark.parametrize(
    ("command", "beside"), [("overlay", neighbours.overlay), ("view", neighbours.viewer)]
)
def test_a_neighbour_that_ends_is_not_measured(command: str, beside: hosts.Beside, tmp_path: Path) -> None:
    """It would cost nothing, and the figures would say so."""
    if command == "view" and neighbours.find_browser() is None:
        pytest.skip("needs Chromium")
    run_dir = tmp_path / "sags"
    run_dir.mkdir(mode=0o700)
    with pytest.raises(SagsError, match=f"sags {command} ended before its time"), beside(run_dir) as process:
        os.kill(process, 9)
        os.waitid(os.P_PID, process, os.WEXITED | os.WNOWAIT)
