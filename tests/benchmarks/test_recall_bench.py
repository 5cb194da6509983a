"""`benchmarks recall`: a small phantom that is covered and turned away from."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from benchmarks.quality import recall
from sags_node.config.schema import FoldersSource
from sags_node.errors import UsageError
from sags_node.pipeline.session import open_session

SMALL = [
    *("source.seconds:=1", "source.width:=320", "source.height:=256", "source.pace:=step"),
    *("vision.width:=320", "vision.height:=256", "mapping.max_gaussians:=8000"),
]


def measured(monkeypatch: pytest.MonkeyPatch, scenario: recall.Scenario) -> dict[str, Any]:
    monkeypatch.setattr(recall, "SCENARIOS", [scenario])
    monkeypatch.setattr(recall, "BEFORE", 1.2)
    monkeypatch.setattr(recall, "AFTER", 1.2)
    session = open_session("launch/phantom.yaml", SMALL)
    found = recall.measure_recall(session, 2.0, lambda done, of, what: None)
    assert next(table.row_count for table in recall.tables(found)) == 1
    for key in ("reliability_px", "reliability_mm"):
        bins = found[key]["bins"]
        assert sum(row["count"] for row in bins) > 500
        assert bins[-1]["right"] > max(0.9, bins[0]["right"])  # who says to be sure is
    return dict(found["rows"][0])


def test_most_anchors_come_back_after_the_scope_looked_elsewhere(monkeypatch: pytest.MonkeyPatch) -> None:
    row = measured(monkeypatch, "turned away")
    assert row["anchors"] > 30 and row["found"] > max(0.5, row["unmoved"]) and row["wrong"] < 0.1


def test_only_the_phantom_knows_its_points() -> None:
    session = open_session("launch/phantom.yaml", SMALL)
    other = session.config.model_copy(
        update={"source": FoldersSource(left=Path("left"), right=Path("right"))}
    )
    with pytest.raises(UsageError, match="phantom"):
        recall.measure_recall(replace(session, config=other), 2.0, lambda done, of, what: None)
