"""The right eye of a stereo display: beside the left image warped there, and what may not come into it."""

from dataclasses import replace

import numpy as np
import pytest
from engine_scenes import rasterize
from recorded_session import frames_of, fresh, opened, play

from sags_node.engine.rasterizer.rasterize import make_rasterizer
from sags_node.geometry import project
from sags_node.mapping.budget import StepBudget
from sags_node.mapping.mapped import Mapped
from sags_node.mapping.right_eye import right_eye_mask
from sags_node.mapping.right_view import FADING, LEARN_EVERY, RightView
from sags_node.messaging import published
from sags_node.pipeline.pipeline import FrameRequest, Pipeline
from sags_node.quality import metrics
from sags_node.tools.evaluation.warp import warp_to_right
from sags_node.types import F32, U8, Bool, FrameResult

FRAMES = 10
FEW = "mapping.max_gaussians:=6000"
Played = tuple[Pipeline, list[FrameResult]]


@pytest.fixture(scope="module")
def played() -> Played:
    session = opened(f"source.frames:={FRAMES}", "publish.right:=true", FEW)
    results, _, pipeline = play(session, frames_of(session), steps=1)
    return pipeline, results


def quality(result: FrameResult, picture: F32 | U8, known: Bool | None = None) -> float:
    """PSNR of an image for the right eye, dB, where that eye sees tissue, and where it is `known`."""
    camera, right = result.pair.camera, result.pair.right
    assert right is not None
    depths = result.views["left"].depth[result.observation.tissue]
    mask = right_eye_mask(result.observation.tissue, depths[depths > 0], camera.K[0, 0], result.pair.baseline)
    truth, where = metrics.as_float(right), mask if known is None else mask & known
    return metrics.psnr(metrics.fit_gain_offset(picture.astype(np.float32), truth, where), truth, where)


def qualities(result: FrameResult) -> tuple[float, float]:
    """Of the right view and of the warped left image, where both are known."""
    focal_px = float(result.pair.camera.K[0, 0])
    warp, there = warp_to_right(
        metrics.as_float(result.observation.image), result.observation.depth, focal_px, result.pair.baseline
    )
    return quality(result, shown(result), there), quality(result, warp, there)


def shown(result: FrameResult) -> U8:
    return published.colours(result.views["right"], published.size_of(result.pair))


def test_the_right_view_is_better_than_the_left_picture_warped_by_the_same_depth(
    played: Played,
) -> None:
    shown, warped = np.mean([qualities(result) for result in played[1][FRAMES // 2 :]], axis=0)
    assert shown > warped + 0.5, (shown, warped)


def test_it_is_drawn_while_somebody_looks_and_changes_nothing_else() -> None:
    """Nobody looks, then somebody does, goes, and comes again; beside it a run in which nobody ever does.
    The first image that is seen is better than the model alone."""
    looks = [False] * 4 + [True] * 4 + [False] * 2 + [True] * 2
    watched, alone = fresh(FEW), fresh(FEW)
    came, looked = 0, False
    for frame, look in zip(frames_of(opened()), looks, strict=False):
        first, looked = look and not looked, look
        result = watched.process(frame, StepBudget(1), FrameRequest(right=look))
        other = alone.process(frame, StepBudget(1))
        assert np.array_equal(result.views["left"].rgb, other.views["left"].rgb)
        assert ("right" in result.views) == look == (result.snapshot.right_colors is not None)
        assert "right" not in other.views
        if first:
            came += 1
            camera = result.pair.camera.moved_right(result.pair.baseline)
            alone_there = rasterize(result.snapshot.gaussians, camera).rgb
            assert quality(result, shown(result)) > quality(result, alone_there)
    assert came == 2


def test_a_right_picture_teaches_later_frames_only() -> None:
    """The second of the right images is darker, and depth is given: it serves the right view alone."""
    runs = []
    for darker in (1.0, 0.9):
        pipeline, views = fresh(FEW), []
        for i, frame in enumerate(frames_of(opened("source.frames:=4"))):
            right = (frame.right * (darker if i == 1 else 1.0)).astype(np.uint8)
            depth = np.full(right.shape[:2], 0.07, np.float32)
            result = pipeline.process(
                replace(frame, right=right, depth=depth), StepBudget(1), FrameRequest(right=True)
            )
            views.append(shown(result))
        runs.append(views)
    assert [np.array_equal(*views) for views in zip(*runs, strict=True)] == [True, True, False, False]


def test_who_comes_while_the_input_is_frozen_sees_something() -> None:
    """Frames that equal their predecessor are not mapped again, and have nothing to learn the eye from."""
    session = opened("source.frames:=3", FEW)
    frames = frames_of(session)
    _, _, pipeline = play(session, frames, steps=1)
    assert "frame" in pipeline.process(replace(frames[-1], frame_id=7), StepBudget(1)).skipped
    came, after = (
        pipeline.process(replace(frames[-1], frame_id=n), StepBudget(1), FrameRequest(right=True))
        for n in (8, 9)
    )
    assert "right" in came.views
    assert "frame" in after.skipped and after.views["right"].frame_id == 9
    assert np.array_equal(shown(after), shown(came))


def test_what_the_right_eye_sees_more_is_learnt_where_it_is_tissue_for_certain_and_fades_elsewhere(
    played: Played,
) -> None:
    """A right image that is brighter by 0.2 everywhere: Gaussians take over half of what lacks. What is not
    seen again, as while the right eye is bad, is gone after two seconds."""
    model, result, view = played[0].map.model, played[1][-1], RightView()
    camera, baseline = result.pair.camera, result.pair.baseline
    rasterizer = make_rasterizer("numba", camera.width, camera.height)
    mapped = Mapped(result.snapshot, result.views["left"])
    drawn = view.draw(mapped, baseline, rasterizer.forward)
    dim, bright = (np.full(drawn.rgb.shape, level, np.uint8) for level in (102, 153))  # 0.4, 0.6
    tissue = result.observation.tissue.copy()
    tissue[:100] = False
    rows = min(len(result.snapshot.gaussians), model.count)
    same = np.flatnonzero(model.ids[:rows] == result.snapshot.gaussians.ids[:rows])
    model.right_colors[:] = 0.2
    view.learn(drawn, dim, mapped, model, bright, tissue, baseline)
    learnt = model.right_colors[same]
    taken = (learnt > 0.2).all(1)
    assert taken.mean() > 0.2
    np.testing.assert_allclose(learnt[taken], 0.3, atol=1e-4)
    np.testing.assert_allclose(learnt[~taken], 0.2 * FADING, atol=1e-4)
    pixels, _ = project(drawn.camera, result.snapshot.gaussians.means[same][taken])
    assert pixels[:, 1].min() > 100 - 4
    model.right_colors[:] = 0.2
    for _ in range(60 // LEARN_EVERY):
        view.learn(drawn, dim, mapped, model, bright, np.zeros_like(tissue), baseline)
    assert np.abs(model.right_colors[same]).max() < 0.04


def test_what_was_learnt_grows_old_while_nobody_looks(played: Played) -> None:
    """As it does where the eye sees nothing: who looks now and then keeps most, who comes after ten seconds
    begins anew."""
    model, view = played[0].map.model, RightView()
    model.right_colors[:] = 0.2
    view.wake(model)
    assert (model.right_colors == np.float32(0.2)).all()
    left = []
    for missed in (6, 300):
        for _ in range(missed):
            view.miss()
        view.wake(model)
        left.append(float(np.abs(model.right_colors).max()))
    assert left[0] == pytest.approx(0.2 * FADING**3, rel=1e-5) and 0.15 < left[0] and left[1] < 1e-4
