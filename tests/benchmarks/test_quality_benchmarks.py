"""`python -m benchmarks recall`, `scope` and `tracking` on small phantoms, and followers."""

from collections.abc import Callable, Sequence
from typing import Any

import cv2
import numpy as np
import pytest
from places import SESSION

from benchmarks.node import thin
from benchmarks.quality import scope
from benchmarks.quality.followers import Csrt, Follower, dense_flow, lucas_kanade, sample
from benchmarks.quality.tracking import measure_tracking
from sags_node.config.launch_file import load_launch
from sags_node.config.schema import PhantomSource
from sags_node.errors import SagsError
from sags_node.mapping.anchors import Anchors
from sags_node.phantom import PhantomScene
from sags_node.pipeline.session import open_session

# ---- `benchmarks scope`: two breaths of a small phantom ------------------------------------------------


BREATHS = [*("source.width:=160", "source.height:=128", "source.rate:=2.5", "mapping.max_gaussians:=1500")]


def test_what_is_told_is_exact_and_what_a_robot_is_off_by_is_what_was_planted() -> None:
    config = load_launch(None, BREATHS)
    assert isinstance(config.source, PhantomSource)
    still = PhantomScene.of(config.source).model_copy(update={"still_tissue": True})
    config = config.model_copy(update={"source": still})
    measured = scope.measure_scope(config, ["zoom"], 8.0, lambda *_: None)
    rows = {row["way"]: row for row in measured["rows"]}
    assert set(rows) == {"session", "estimate", "refine", "robot", "rigid", "points"}
    assert rows["session"]["ate_mm"] == pytest.approx(0, abs=1e-9) and rows["session"]["psnr"] > 25
    # Still points, seen exactly, leave no doubt; a hand turned by a degree turns 15 mm of way by that.
    assert rows["points"]["max_mm"] < 1e-2
    assert rows["robot"]["max_mm"] > 15 * np.sin(np.linalg.norm(scope.HAND_EYE))
    assert measured["receipts"]["zoom"]["frames"]["count"] == 20


# ---- `benchmarks tracking`: its truths, and what it says of the node on the phantom --------------------


def tracked(*overrides: str, frames: Sequence[int] = (4, 12), beside: Sequence[str] = ()) -> dict[str, Any]:
    session = open_session(SESSION, ["source.pace:=step", "source.loop:=false", *overrides])
    return measure_tracking(session, frames, lambda *_: None, beside)


def test_anchors_stay_where_the_flow_goes() -> None:
    found = tracked("source.reference.tracks:=null")
    for row in found["frames"]:
        assert row["anchors"] > 10 and row["gaussians"] > 1000
        assert row["anchors_px"]["p50"] < 0.3 and row["gaussians_px"]["p50"] < 0.8
    assert found["frames"][1]["motion_px"]["p90"] > 1.5  # they had to move
    assert found["receipt"]["frames"]["ids"] == "0-12"
    assert found["truth"] == "direct flow" and found["methods"]["anchors"]["average_jaccard"] is None


def test_a_model_of_any_size_is_followed() -> None:
    """OpenCV samples at most 32,766 places at once."""
    flow = np.zeros((30, 40, 2), np.float32)
    flow[..., 0], flow[..., 1] = np.arange(40), np.arange(30)[:, None]
    places = np.random.default_rng(0).uniform(0, [39, 29], (70_000, 2))
    assert sample(flow, places) == pytest.approx(places, abs=1 / 32)  # px: what OpenCV rounds places to


def test_anchors_that_stand_still_are_seen_to_be_wrong(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Anchors, "update", lambda self, *arguments: None)
    row = tracked(frames=[12])["frames"][0]
    assert row["anchors_px"]["p90"] == pytest.approx(row["motion_px"]["p90"], rel=0.1)
    assert np.isfinite(row["gaussians_px"]["p90"])


def test_a_recording_that_is_too_short_is_named() -> None:
    with pytest.raises(SagsError, match="ends before frame 5000"):
        tracked(frames=[2, 5000])


# ---- methods that anchors stand beside: on an image that moves as a whole, all know where its poi------


POINTS = np.array([[60.0, 50], [100, 60], [80, 80]])
STEPS = np.array([[1.5, 0.5], [2.0, -1.0], [0.5, 2.5]])  # px


def picture(moved: np.ndarray) -> np.ndarray:
    rng = np.random.default_rng(0)
    sheet = sum(cv2.GaussianBlur(rng.normal(size=(160, 200)), (0, 0), s) * s for s in (1.5, 3.0, 6.0))
    shifted = cv2.warpAffine(sheet, np.float32([[1, 0, moved[0] - 20], [0, 1, moved[1] - 20]]), (160, 120))
    return np.repeat((120 + 60 * shifted).clip(0, 255).astype(np.uint8)[..., None], 3, axis=2)


@pytest.mark.parametrize(("follower", "most"), [(lucas_kanade, 0.2), (dense_flow, 0.3), (Csrt, 1.5)])
def test_they_follow(follower: Callable[[np.ndarray, np.ndarray], Follower], most: float) -> None:
    moved, following = np.zeros(2), follower(picture(np.zeros(2)), POINTS)
    for step in STEPS:
        moved = moved + step
        pixels, kept = following.follow(picture(moved))
    assert kept.all()
    assert np.linalg.norm(pixels - POINTS - moved, axis=1).max() < most


@pytest.mark.parametrize("follower", [lucas_kanade, dense_flow])
def test_what_was_lost_stays_lost(follower: Callable[[np.ndarray, np.ndarray], Follower]) -> None:
    """The last point leaves the image and comes back."""
    following = follower(picture(np.zeros(2)), np.array([*POINTS, [2.0, 50]]))
    assert following.follow(picture(np.array([-5.0, 0])))[1].tolist() == [True, True, True, False]
    assert following.follow(picture(np.zeros(2)))[1].tolist() == [True, True, True, False]


# ---- how the drift of a trajectory is told from what its scene does again and again --------------------


PERIOD, ROUNDS = 40, 5


# ---- `benchmarks ablation`: every variant is fitted and measured alike, on frames it never saw. ----


# ---- `benchmarks thin` on a small recording. ----


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
