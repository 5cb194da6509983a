"""A node that is played live on hosts with less to give: real processes, and figures of each."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from benchmarks.node import hosts
from sags_node.errors import SagsError

pytestmark = [pytest.mark.live, pytest.mark.alone]
SHORT = ["source.frames:=20"]  # at 10 Hz


def test_hosts_are_played_and_leave_the_machine_as_it_was(
    phantom_session: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    chosen = {"one core": None, "with a reader of everything": hosts.reader}
    monkeypatch.setattr(hosts, "neighbours", lambda: chosen)
    mine, said = os.sched_getaffinity(0), []
    rows = hosts.measure_hosts(str(phantom_session), SHORT, 2.0, said.append)
    assert [row["name"] for row in rows] == list(chosen) and len(said) == 2
    for row in rows:
        assert 0 < row["share_after_first_second"] <= 1 and row["latency_ms"]["p50"] > 0
        assert row["online"]["psnr"] > 15 and sum(row["rungs"].values()) > 0
    assert os.sched_getaffinity(0) == mine


def test_a_run_that_fails_says_why(phantom_session: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(hosts, "neighbours", lambda: {"alone": None})
    with pytest.raises(SagsError, match=r"mapping\.rung 99"):
        hosts.measure_hosts(str(phantom_session), [*SHORT, "mapping.rung:=99"], 2.0, lambda what: None)
