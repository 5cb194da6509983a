"""`sags bench tracking`: its truth, and what it says of the node on the phantom."""

import numpy as np
import pytest
from places import SESSION

from sags_node.benchmark.quality.tracking import measure_tracking, sample, table
from sags_node.errors import SagsError
from sags_node.mapping.anchors import Anchors
from sags_node.session import Session, open_session


def opened() -> Session:
    return open_session(SESSION, ["source.pace:=step", "source.loop:=false"])


def test_anchors_stay_where_the_flow_goes() -> None:
    measured = measure_tracking(opened(), [4, 12], lambda done, of, what: None)
    for row in measured["frames"]:
        assert row["anchors"] > 10 and row["gaussians"] > 1000
        assert row["anchors_px"]["p50"] < 0.3 and row["gaussians_px"]["p50"] < 0.8
    assert measured["frames"][1]["motion_px"]["p90"] > 1.5  # they had to move
    assert table(measured).row_count == 2


def test_a_model_of_any_size_is_followed() -> None:
    """OpenCV samples at most 32,766 places at once."""
    flow = np.zeros((30, 40, 2), np.float32)
    flow[..., 0], flow[..., 1] = np.arange(40), np.arange(30)[:, None]
    places = np.random.default_rng(0).uniform(0, [39, 29], (70_000, 2))
    assert sample(flow, places) == pytest.approx(places, abs=1 / 32)  # px: what OpenCV rounds places to


def test_anchors_that_stand_still_are_seen_to_be_wrong(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Anchors, "update", lambda self, *arguments: None)
    row = measure_tracking(opened(), [12], lambda done, of, what: None)["frames"][0]
    assert row["anchors_px"]["p90"] == pytest.approx(row["motion_px"]["p90"], rel=0.1)
    assert np.isfinite(row["gaussians_px"]["p90"])


def test_a_recording_that_is_too_short_is_named() -> None:
    with pytest.raises(SagsError, match="ends before frame 5000"):
        measure_tracking(opened(), [2, 5000], lambda done, of, what: None)
