"""How near tissue may be follows the images: an organ at 15 mm gets its own depth, not the background's."""

from dataclasses import replace
from itertools import islice
from pathlib import Path

import cv2
import numpy as np
import pytest
from places import ROOT

from sags_node.confidence import SURE
from sags_node.config.schema import USUAL_NEAREST, LaunchConfig, StereoConfig
from sags_node.findings import by_code
from sags_node.mapping.budget import StepBudget
from sags_node.pipeline.pipeline import Pipeline
from sags_node.pipeline.session import open_session
from sags_node.rig import rectified_rig
from sags_node.sources.source import open_source
from sags_node.types import F32, RectifiedPair, StereoFrame, StereoRig
from sags_node.vision import near_limit
from sags_node.vision.near_limit import NearLimit
from sags_node.vision.pyramid import pyramids
from sags_node.vision.rectify import Rectifier
from sags_node.vision.stereo import StereoDepth

PHANTOM = ROOT / "replay/phantom_pull"
NEAREST = 0.010  # m, that is searched
PERIOD_NS = 500_000_000  # a look every half second
NEAR = 0.25  # of the phantom's true distance: its tissue then lies at 15 to 22 mm

Shown = list[tuple[RectifiedPair, F32 | None]]


def shown(source: Path, scale: float, count: int = 3, *overrides: str) -> Shown:
    """Pairs half a second apart, and their true depth: a rig whose baseline is `scale` times as long as it
    was sees the same images of tissue that is so much nearer."""
    session = open_session(source, ["source.pace:=step", *overrides])
    right = session.rig.right
    P = right.P.copy()
    P[0, 3] *= scale
    rig = StereoRig("scaled", session.rig.left, replace(right, P=P))
    rectify = Rectifier(rig, *session.working_size)
    pairs: Shown = []
    with open_source(session.config.source) as frames:
        for number, frame in enumerate(islice(frames, count)):
            truth = None if frame.reference is None else frame.reference.depth
            stamped = replace(frame, t_capture_ns=number * PERIOD_NS)
            pairs.append((rectify(stamped), None if truth is None else scale * rectify.depth(truth)))
    return pairs


def everywhere(pair: RectifiedPair) -> np.ndarray:
    return np.ones(pair.left.shape[:2], np.bool_)


def test_near_tissue_gets_its_own_depth() -> None:
    """As right as the same images are at their usual distance, from the first frame on."""
    errors, coverage = {}, {}
    for scale in (1.0, NEAR):
        (pair, truth), *_ = shown(PHANTOM, scale, 1)
        depth, _ = StereoDepth(StereoConfig(), pair.camera, pair.baseline)(pair, everywhere(pair))
        known = (depth > 0) & (truth > 0)
        errors[scale] = float(np.percentile(np.abs(depth - truth)[known] / truth[known], 90))
        coverage[scale] = float(known.mean())
    assert errors[NEAR] < 1.2 * errors[1.0] + 0.005
    assert coverage[NEAR] > coverage[1.0] - 0.03


def test_a_limit_that_is_set_stays_and_is_told_of() -> None:
    pairs = shown(PHANTOM, NEAR)
    pair, truth = pairs[0]
    assert truth is not None and np.percentile(truth[truth > 0], 10) < USUAL_NEAREST
    stereo = StereoDepth(StereoConfig(min_depth=USUAL_NEAREST), pair.camera, pair.baseline)
    for pair, _ in pairs:
        depth, _ = stereo(pair, everywhere(pair))
        assert np.all(depth[depth > 0] >= 0.99 * USUAL_NEAREST)
    (said,) = (found for found in stereo.findings if found.code == "tissue_too_near")
    assert "vision.stereo.min_depth" in said.text
    wide = StereoDepth(StereoConfig(min_depth=NEAREST), pair.camera, pair.baseline)
    wide(pair, everywhere(pair))
    assert "tissue_too_near" not in {found.code for found in wide.findings}


@pytest.mark.fault("depth: tissue is nearer than 10 mm")
@pytest.mark.parametrize("depths", [(5,), (6.5,), (9,), (20, 6), (8, 15), (15,), (60,)])
@pytest.mark.parametrize("width", [320, 480])  # the second is searched in two sizes
def test_what_is_too_near_to_be_matched_is_told_and_never_surely_farther(
    width: int, depths: tuple[float, ...]
) -> None:
    """Planes below each other, mm; a scope that moves along them."""
    height, focal, baseline = width * 4 // 5, 0.9 * width, 4.3e-3
    K = np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]])
    config = LaunchConfig.model_validate({"vision": {"tissue": {"method": "none"}, "scale": 1.0}})
    pipeline = Pipeline(config, rectified_rig("planes", width, height, K, baseline))
    rng = np.random.default_rng(len(depths))
    texture = cv2.resize(rng.integers(60, 200, (34, 150, 3), np.uint8), (1200, height)).astype(np.float32)
    texture = cv2.GaussianBlur(texture, (0, 0), 2)  # so that it is as sharp between its pixels
    truth = np.repeat(1e-3 * np.array(depths, np.float32), height // len(depths))[:, None]
    columns, rows = np.meshgrid(*(np.arange(side, dtype=np.float32) for side in (width, height)))
    for number in range(4):
        stamp = number * PERIOD_NS
        seen = [
            cv2.remap(texture, columns + 400 + 2 * number + shift, rows, cv2.INTER_LINEAR)
            for shift in (np.zeros_like(columns), focal * baseline / truth + 0 * columns)
        ]
        left, right = (np.clip(eye + rng.normal(0, 1.5, eye.shape), 0, 255).astype(np.uint8) for eye in seen)
        result = pipeline.process(StereoFrame(number, stamp, stamp, left, right), StepBudget(1))
    view = result.views["left"]
    assert view.confidence is not None
    sure = (view.depth > 0) & (view.confidence >= SURE)
    assert np.mean(sure & (view.depth > 1.3 * truth)) < 0.01
    assert np.mean(sure[truth[:, 0] > NEAREST]) > 0.5 or max(depths) < 10
    assert ("tissue_too_near" in by_code(pipeline.warnings)) == (min(depths) < 10)


@pytest.mark.usefixtures("data_folder")
def test_on_a_usual_clip_nothing_changes() -> None:
    """Bit for bit what a limit of 30 mm gives."""
    pairs = shown(ROOT / "launch/d4d_pull.yaml", 1.0, 6, "source.stride:=30")
    pair, _ = pairs[0]
    found, usual = (
        StereoDepth(StereoConfig(min_depth=said), pair.camera, pair.baseline)
        for said in (None, USUAL_NEAREST)
    )
    for pair, _ in pairs:
        for one, other in zip(found(pair, everywhere(pair)), usual(pair, everywhere(pair)), strict=True):
            assert np.array_equal(one, other)
    assert not found.findings and not usual.findings


def test_the_limit_comes_at_once_and_goes_slowly(monkeypatch: pytest.MonkeyPatch) -> None:
    (pair, _), *_ = shown(PHANTOM, 1.0, 1)
    left, right = pyramids(pair)
    assert right is not None
    far, near = 0.06, 0.02
    limits = []
    limit = NearLimit(StereoConfig(), 1000.0)
    looks = [far, near, far, near, near, *[far] * 10]
    for number, nearest in enumerate(looks):
        monkeypatch.setattr(near_limit, "nearest_tissue", lambda *_, nearest=nearest: nearest)
        for part in range(3):  # of a period: only one look each
            limit.look(number * PERIOD_NS + part * PERIOD_NS // 3, left, right, everywhere(pair))
        limits.append(limit.limit)
    *before, came = limits[:5]
    assert before == [USUAL_NEAREST] * 4  # one look alone may be wrong
    assert 0.5 * near < came < near  # with room for tissue that moves
    assert limits[5:13] == [came] * 8 and limits[-1] == USUAL_NEAREST  # after five seconds


@pytest.mark.usefixtures("data_folder")
@pytest.mark.parametrize("source", [PHANTOM, ROOT / "launch/d4d_pull.yaml"])
def test_pictures_that_do_not_belong_together_move_nothing(source: Path) -> None:
    for pair, _ in shown(source, 1.0, 3):
        other = replace(pair, right=np.ascontiguousarray(pair.right[::-1]), gray=None)
        exchanged = replace(pair, left=pair.right, right=pair.left, gray=None)
        for wrong in (other, exchanged):
            left, right = pyramids(wrong)
            assert right is not None
            limit = NearLimit(StereoConfig(), float(pair.camera.K[0, 0]) * pair.baseline)
            limit.look(0, left, right, everywhere(pair))
            assert limit.limit == USUAL_NEAREST
