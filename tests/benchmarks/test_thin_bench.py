"""`benchmarks thin` on a small recording."""

from __future__ import annotations

import pytest
from places import SESSION

from benchmarks.node import thin
from sags_node.errors import SagsError
from sags_node.pipeline.session import open_session


def test_each_kind_has_its_cost_and_smaller_ones_are_smaller(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(thin, "WARM_UP", 2)
    rows = {row["topic"]: row for row in thin.measure_thin(open_session(SESSION), 2, lambda *_: None)}
    assert set(rows) == set(thin.NAMES) and len(rows) == 18
    assert all(row["make_cpu_ms"] >= 0 and row["kB"] > 0 for row in rows.values())
    for kind in ("render/image/jpeg", "render/depth/png"):
        full, half, quarter = (rows[f"thin/{size}/left/{kind}"]["kB"] for size in ("full", "half", "quarter"))
        assert full > half > quarter
        row = rows[f"thin/full/left/{kind}"]
        assert row["Mbit_per_s_at_30_Hz"] == pytest.approx(0.24 * row["kB"], abs=0.1)


def test_a_recording_that_is_too_short_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(thin, "WARM_UP", 50)
    with pytest.raises(SagsError, match="ends before frame 50"):
        thin.measure_thin(open_session(SESSION, ["source.start:=1.2"]), 2, lambda *_: None)
