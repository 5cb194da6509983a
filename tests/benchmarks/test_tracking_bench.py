"""`benchmarks tracking`: its truths, and what it says of the node on the phantom."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from places import SESSION

from benchmarks.quality.followers import sample
from benchmarks.quality.tracking import measure_tracking
from benchmarks.quality.tracking_report import tables
from sags_node.errors import SagsError
from sags_node.mapping.anchors import Anchors
from sags_node.pipeline.session import Session, open_session


def opened(*overrides: str) -> Session:
    return open_session(SESSION, ["source.pace:=step", "source.loop:=false", *overrides])


def measured(*overrides: str, frames: Sequence[int] = (4, 12), beside: Sequence[str] = ()) -> dict[str, Any]:
    return measure_tracking(opened(*overrides), frames, lambda done, of, what: None, beside)


def test_anchors_stay_where_the_flow_goes() -> None:
    found = measured("source.reference.tracks:=null")
    for row in found["frames"]:
        assert row["anchors"] > 10 and row["gaussians"] > 1000
        assert row["anchors_px"]["p50"] < 0.3 and row["gaussians_px"]["p50"] < 0.8
    assert found["frames"][1]["motion_px"]["p90"] > 1.5  # they had to move
    assert found["truth"] == "direct flow" and found["methods"]["anchors"]["average_jaccard"] is None
    assert [table.row_count for table in tables(found)][:2] == [2, 1]


def test_all_who_follow_stand_beside_on_the_true_points() -> None:
    found = measured(frames=range(1, 13), beside=["lucas_kanade", "dense_flow", "unmoved"])
    methods = found["methods"]
    assert found["truth"] == "exact" and found["anchors"] > 50
    assert methods.keys() == {"anchors", "lucas_kanade", "dense_flow", "unmoved", "direct_flow"}
    for name in ("anchors", "lucas_kanade", "dense_flow", "direct_flow"):
        assert methods[name]["off_by_px"]["p50"] < 0.4 and methods[name]["sure"] > 0.7
        assert methods[name]["average_jaccard"] > methods["unmoved"]["average_jaccard"]
    assert methods["unmoved"]["off_by_px"]["p50"] > 0.4 and methods["unmoved"]["sure"] == 1
    counts = [
        sum(row["count"] for row in found["reliability_mm"][part])
        for part in ("bins", "in_sight", "out_of_sight")
    ]
    assert counts[0] == 12 * found["anchors"] == counts[1] + counts[2] and min(counts) > 0
    assert len(tables(found)) == 4


def test_a_model_of_any_size_is_followed() -> None:
    """OpenCV samples at most 32,766 places at once."""
    flow = np.zeros((30, 40, 2), np.float32)
    flow[..., 0], flow[..., 1] = np.arange(40), np.arange(30)[:, None]
    places = np.random.default_rng(0).uniform(0, [39, 29], (70_000, 2))
    assert sample(flow, places) == pytest.approx(places, abs=1 / 32)  # px: what OpenCV rounds places to


def test_anchors_that_stand_still_are_seen_to_be_wrong(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Anchors, "update", lambda self, *arguments: None)
    row = measured(frames=[12])["frames"][0]
    assert row["anchors_px"]["p90"] == pytest.approx(row["motion_px"]["p90"], rel=0.1)
    assert np.isfinite(row["gaussians_px"]["p90"])


def test_a_recording_that_is_too_short_is_named() -> None:
    with pytest.raises(SagsError, match="ends before frame 5000"):
        measured(frames=[2, 5000])
