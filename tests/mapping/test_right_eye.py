"""Learning from both eyes: what it gives the right one, what it costs the left one, and what stays out."""

from dataclasses import replace

import numpy as np
import pytest
from places import SESSION

from sags_node.engine.rasterizer.rasterize import make_rasterizer
from sags_node.evaluation.metrics import psnr
from sags_node.mapping.budget import StepBudget
from sags_node.mapping.right_eye import WEIGHT, right_eye_loss, right_eye_mask
from sags_node.pipeline import Pipeline
from sags_node.session import open_session
from sags_node.types import FrameResult, StereoFrame


@pytest.fixture(scope="module")
def frames() -> list[StereoFrame]:
    with open_session(SESSION, ["source.pace:=step"]).source as source:
        return [frame for frame, _ in zip(source, range(12), strict=False)]


def play(frames: list[StereoFrame], right_eye: bool) -> list[FrameResult]:
    overrides = ["mapping.max_gaussians:=12000", f"mapping.right_eye:={str(right_eye).lower()}"]
    session = open_session(SESSION, overrides)
    pipeline = Pipeline(session.config, session.rig)
    return [pipeline.process(frame, StepBudget(2)) for frame in frames]


def qualities(result: FrameResult) -> tuple[float, float]:
    """PSNR of the left and of the right eye, dB, where both show tissue."""
    camera, right = result.pair.camera, result.pair.right
    assert right is not None
    known = result.views["left"].depth[result.observation.tissue]
    mask = right_eye_mask(result.observation.tissue, known[known > 0], camera.K[0, 0], result.pair.baseline)
    rasterizer = make_rasterizer("numba", camera.width, camera.height)
    planes = rasterizer.forward(result.snapshot.gaussians, [camera.moved_right(result.pair.baseline)])[0]
    drawn = (planes[:3] / np.maximum(planes[4], 1e-3)).transpose(1, 2, 0)
    left = psnr(result.views["left"].rgb, result.observation.image, result.observation.tissue)
    return left, psnr(drawn, right.astype(np.float32) / 255, mask)


def test_the_right_eye_gains_and_the_left_one_loses_little(frames: list[StereoFrame]) -> None:
    one, both = (
        np.mean([qualities(result) for result in play(frames, right_eye)[6:]], axis=0)
        for right_eye in (False, True)
    )
    assert both[1] > one[1] + 0.5, (one, both)
    assert both[0] > one[0] - 0.5, (one, both)


def test_the_gain_of_the_right_camera_is_not_learnt(frames: list[StereoFrame]) -> None:
    """A right camera that is a fifth darker must not darken the tissue."""
    darker = []
    for frame in frames:
        assert frame.right is not None
        darker.append(replace(frame, right=(0.8 * frame.right).round().astype(np.uint8)))
    usual, dark = play(frames, right_eye=True), play(darker, right_eye=True)
    for a, b in zip(usual[4:], dark[4:], strict=True):
        assert abs(qualities(a)[0] - qualities(b)[0]) < 0.5


def test_what_is_no_tissue_for_certain_pulls_at_nothing(frames: list[StereoFrame]) -> None:
    result = play(frames[:2], right_eye=True)[-1]
    camera, baseline = result.pair.camera, result.pair.baseline
    rasterizer = make_rasterizer("numba", camera.width, camera.height)
    planes = rasterizer.forward(result.snapshot.gaussians, [camera, camera.moved_right(baseline)])
    tissue = result.observation.tissue.copy()
    tissue[:, 100:140] = False  # an instrument
    v_planes, weight = np.ones((5, *tissue.shape), np.float32), np.ones(tissue.shape, np.float32)
    right_eye_loss(planes, replace(result.observation, tissue=tissue), v_planes, weight)
    known = result.views["left"].depth[tissue]
    mask = right_eye_mask(tissue, known[known > 0], camera.K[0, 0], baseline)
    assert 0 < mask.sum() < 0.9 * tissue.sum()
    assert not v_planes[:, ~mask].any() and not weight[~mask].any()
    assert weight[mask].max() > 0.9 * WEIGHT and v_planes[:3, mask].any()
    assert not v_planes[3].any()  # its depth is not measured
