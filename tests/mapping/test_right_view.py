"""The right eye of a stereo display: beside the left image warped there, and what may not come into it."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from engine_scenes import rasterize
from recorded_session import frames_of, opened, play

from sags_node.detail.show import Detail
from sags_node.engine.rasterizer.rasterize import make_rasterizer
from sags_node.mapping.budget import StepBudget
from sags_node.mapping.mapped import Mapped
from sags_node.mapping.right_eye import right_eye_mask
from sags_node.mapping.right_view import FADING, LEARN_EVERY, RightView
from sags_node.messaging import published
from sags_node.pipeline.pipeline import FrameRequest, Pipeline
from sags_node.quality import metrics
from sags_node.tools.evaluation.warp import warp_to_right
from sags_node.types import F32, U8, Bool, Camera, FrameResult, Gaussians

FRAMES = 10
FEW = "mapping.max_gaussians:=6000"


@pytest.fixture(scope="module")
def played() -> tuple[Pipeline, list[FrameResult]]:
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


def model_alone(result: FrameResult) -> U8:
    """Of the right eye."""
    camera = result.pair.camera.moved_right(result.pair.baseline)
    return rasterize(result.snapshot.gaussians, camera).rgb


def test_the_right_view_is_better_than_the_left_picture_warped_by_the_same_depth(
    played: tuple[Pipeline, list[FrameResult]],
) -> None:
    shown, warped = np.mean([qualities(result) for result in played[1][FRAMES // 2 :]], axis=0)
    assert shown > warped + 0.5, (shown, warped)


def test_it_is_drawn_while_somebody_looks_and_changes_nothing_else() -> None:
    """Nobody looks, then somebody does, goes, and comes again; beside it a run in which nobody ever does.
    The first image that is seen is better than the model alone."""
    looks = [False] * 4 + [True] * 4 + [False] * 2 + [True] * 2
    session = opened(f"source.frames:={len(looks)}", FEW)
    watched, alone = (Pipeline(session.config, session.rig) for _ in range(2))
    came, looked = 0, False
    for frame, look in zip(frames_of(session), looks, strict=True):
        first, looked = look and not looked, look
        result = watched.process(frame, StepBudget(1), FrameRequest(right=look))
        other = alone.process(frame, StepBudget(1))
        assert np.array_equal(result.views["left"].rgb, other.views["left"].rgb)
        assert ("right" in result.views) == look == (result.snapshot.right_colors is not None)
        assert "right" not in other.views
        if first:
            came += 1
            assert quality(result, shown(result)) > quality(result, model_alone(result))
    assert came == 2


def test_a_frame_is_drawn_before_its_right_picture_teaches(monkeypatch: pytest.MonkeyPatch) -> None:
    called: list[str] = []
    for kind, name in ((Detail, "view"), (Detail, "learn_aside"), (RightView, "draw"), (RightView, "learn")):
        inner = getattr(kind, name)

        def spied(*args: object, inner: Any = inner, name: str = name, **more: object) -> Any:
            called.append(name)
            return inner(*args, **more)

        monkeypatch.setattr(kind, name, spied)
    session = opened("source.frames:=3", FEW)
    pipeline = Pipeline(session.config, session.rig)
    for frame in frames_of(session):
        called.append("frame")
        pipeline.process(frame, StepBudget(1), FrameRequest(right=True))
    frames = " ".join(called).split("frame")[1:]
    assert all(calls.split()[:2] == ["draw", "view"] for calls in frames)
    assert "learn_aside" in called and "learn" in called


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


class Scene:
    """The last frame of the fixture, drawn for the right eye again."""

    def __init__(self, result: FrameResult) -> None:
        self.result, self.count = result, len(result.snapshot.gaussians)
        camera = result.pair.camera
        self._rasterizer = make_rasterizer("numba", camera.width, camera.height)

    def show(self, gaussians: Gaussians, camera: Camera) -> F32:
        planes: F32 = self._rasterizer.forward(gaussians, camera)
        return planes

    def mapped(self, right_colors: float = 0.0) -> Mapped:
        colors = np.full((self.count, 3), right_colors, np.float32)
        return Mapped(replace(self.result.snapshot, right_colors=colors), self.result.views["left"])


@pytest.fixture(scope="module")
def scene(played: tuple[Pipeline, list[FrameResult]]) -> Scene:
    return Scene(played[1][-1])


def test_what_the_right_eye_sees_more_is_learnt_where_it_is_tissue_for_certain(
    played: tuple[Pipeline, list[FrameResult]], scene: Scene
) -> None:
    """A right image that is brighter by 0.2 everywhere: Gaussians take over half of what lacks.
    What is hidden from the right eye learns nothing."""
    model, baseline = played[0].map.model, scene.result.pair.baseline
    tissue = scene.result.observation.tissue.copy()
    tissue[:100] = False
    view = RightView()
    drawn, mapped = view.draw(scene.mapped(), baseline, scene.show), scene.mapped()
    dim, bright = (np.full(drawn.rgb.shape, level, np.uint8) for level in (102, 153))  # 0.4, 0.6
    model.right_colors[:] = 0
    view.learn(drawn, dim, mapped, model, bright, tissue, baseline)
    same = model.ids[: scene.count] == scene.result.snapshot.gaussians.ids[: model.count]
    learnt = model.right_colors[: len(same)][same]
    taken = (learnt > 0).all(1)
    assert taken.mean() > 0.2
    np.testing.assert_allclose(learnt[taken], 0.1, atol=1e-4)
    pixels = drawn.camera.K @ (
        drawn.camera.viewmat[:3, :3] @ scene.result.snapshot.gaussians.means[: len(same)][same][taken].T
        + drawn.camera.viewmat[:3, 3:]
    )
    assert (pixels[1] / pixels[2]).min() > 100 - 4


def test_what_was_learnt_grows_old_while_nobody_looks(played: tuple[Pipeline, list[FrameResult]]) -> None:
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


def test_what_is_not_seen_again_is_gone_after_two_seconds(
    played: tuple[Pipeline, list[FrameResult]], scene: Scene
) -> None:
    """While the right eye is bad nothing is learnt from it, and what it saw before is less and less shown."""
    model, view = played[0].map.model, RightView()
    right, baseline = scene.result.pair.right, scene.result.pair.baseline
    drawn = view.draw(scene.mapped(), baseline, scene.show)
    assert right is not None
    model.right_colors[:] = 0.2
    nothing = np.zeros_like(scene.result.observation.tissue)
    for _ in range(60 // LEARN_EVERY):
        view.learn(drawn, drawn.rgb, scene.mapped(), model, right, nothing, baseline)
    same = model.ids[: scene.count] == scene.result.snapshot.gaussians.ids[: model.count]
    assert np.abs(model.right_colors[: len(same)][same]).max() < 0.04
