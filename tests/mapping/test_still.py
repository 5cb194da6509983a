"""While nothing moves: what is left out then, and that nothing is lost by it. What counts as still:
`tests/vision/test_change.py`."""

from dataclasses import replace
from functools import partial

import cv2
import numpy as np
import pytest
from flat_scene import camera_in_front, flat_scene
from recorded_session import Frames, both, frames_of, fresh, noisy, opened, psnr

from sags_node.config.launch_file import load_launch
from sags_node.engine.rasterizer.rasterize import make_rasterizer, to_view
from sags_node.mapping.budget import FramePlan, StepBudget
from sags_node.mapping.devices import ALL_SKIPS, Skips
from sags_node.mapping.mapper import Mapper
from sags_node.mapping.refiner import CpuRefiner
from sags_node.mapping.tissue_map import TissueMap
from sags_node.messaging.content import tells_of
from sags_node.pipeline.pipeline import Pipeline
from sags_node.rig import rectified_rig
from sags_node.types import FrameResult, StereoFrame

MODEL = "mapping.max_gaussians:=8000"


@pytest.fixture(scope="module")
def frames() -> Frames:
    return frames_of(opened())


class Player:
    """A pipeline that is given frames with fresh numbers and stamps."""

    def __init__(self, *overrides: str, skips: Skips = ALL_SKIPS, budget: StepBudget | None = None) -> None:
        self.pipeline = fresh(MODEL, *overrides, skips=skips)
        self._budget = StepBudget(2) if budget is None else budget
        self._number = 0
        self._rng = np.random.default_rng(3)

    def __call__(self, frame: StereoFrame) -> FrameResult:
        self._number += 1
        frame = replace(frame, frame_id=self._number, t_capture_ns=self._number * 100_000_000)
        return self.pipeline.process(frame, self._budget)

    def again(self, frame: StereoFrame) -> FrameResult:
        """The same scene, photographed once more."""
        return self(both(frame, lambda eye: noisy(eye, self._rng)))


def test_neither_depth_nor_motion_is_looked_for_until_something_moves(frames: Frames) -> None:
    play = Player()
    for frame in frames[:5]:
        assert not play(frame).skipped
    steps = []
    for _ in range(30):
        result = play.again(frames[4])
        assert set(result.skipped) == {"depth", "motion"} and not result.observation.depth_is_new
        assert not result.snapshot.velocities.any()
        steps.append(result.snapshot.counts["iterations"])
    assert steps[:5] == [2] * 5 and 0 < sum(steps[-10:]) < 5  # a model that has settled is refined rarely
    moved = play(frames[6])
    assert not moved.skipped and moved.observation.depth_is_new and moved.snapshot.velocities.any()


def test_each_frame_is_mapped_where_still_scenes_are_not_wanted(frames: Frames) -> None:
    play = Player(skips=Skips(still=False))
    results = [play.again(frames[0]) for _ in range(4)]
    assert all(not each.skipped and each.observation.depth_is_new for each in results)


class Hurried(StepBudget):
    """There was no time for depth when things moved last."""

    hurry = False

    def start(self, waited: float = 0.0) -> FramePlan:
        self.plan = replace(super().start(waited), depth=not self.hurry)
        return self.plan


def test_a_rest_makes_up_for_the_depth_that_there_was_no_time_for(frames: Frames) -> None:
    budget, known = Hurried(1), []
    play = Player(budget=budget)
    for i, number in enumerate([0, 1, 2, 2, 2]):
        budget.hurry = i == 2
        seen = play.again(frames[number]).observation
        known.append((bool(seen.depth.any()), seen.depth_is_new))
    assert [depth for depth, _ in known] == [True, True, False, True, True]
    assert [new for depth, new in known if depth] == [True, True, True, False]


def test_one_wrong_depth_counts_once_while_nothing_moves(frames: Frames) -> None:
    """It is handed on from frame to frame, and three wrong ones in a row would take the tissue away. A tenth
    of the image: so large a hole would be filled at the wrong depth at once."""
    play = Player()
    for frame in frames[:5]:
        depth = play(frame).observation.depth
    model = play.pipeline.map.model
    assert not model.in_front.any()
    wrong = depth.copy()
    wrong[80:160, 100:200] *= 1.2
    play(replace(frames[5], depth=wrong))
    struck = model.ids[model.in_front == 1]
    assert len(struck) > 0.05 * model.count
    for _ in range(6):
        play.again(replace(frames[5], depth=wrong))
        assert model.in_front.max() == 1 and np.isin(struck, model.ids).all()
    right = play(replace(frames[6], depth=depth))  # and one that is right takes the blame away
    assert right.observation.depth_is_new
    assert np.isin(struck, model.ids[model.in_front == 0]).mean() > 0.9


def test_a_depth_measured_in_a_still_frame_counts_once_where_holes_are_filled_too() -> None:
    """A model that is damaged while nothing moves is fixed in that frame, and its depth looked at twice."""
    camera, cells = camera_in_front(160, 128, 200.0), 16
    observation, _, _ = flat_scene(camera, np.zeros((0, 3), np.float32), np.zeros((128, 160), np.uint8), 0.08)
    model_of = Mapper(CpuRefiner(partial(make_rasterizer, "numba")), TissueMap(2000))
    model_of.update(observation, None, StepBudget(1))
    wrong = observation.depth.copy()
    wrong[:, : camera.width // 2] *= 1.2
    model = model_of.model
    model.means[: model.count // cells] = np.nan
    model_of.update(replace(observation, frame_id=1, depth=wrong), None, StepBudget(1), still=1)
    assert np.isfinite(model.means).all() and set(model.in_front.tolist()) == {0, 1}


def test_a_mask_that_flickers_while_nothing_moves_takes_no_depth_away(frames: Frames) -> None:
    play, rng = Player(), np.random.default_rng(0)
    first = play(frames[0]).observation.depth
    tissue = frames[0].tissue
    for _ in range(10):
        less = tissue & (rng.random(tissue.shape) > 0.01)
        flickering = play.again(replace(frames[0], tissue=less)).observation
        assert not flickering.depth_is_new and not flickering.depth[~flickering.tissue].any()
    last = play.again(frames[0]).observation
    assert (last.depth > 0).sum() >= 0.99 * (first > 0).sum() > 0  # a cell of specks may go


@pytest.mark.fault("image: the same one again")
def test_a_repeated_frame_is_not_mapped_again_and_claims_no_depth_that_was_never_matched(
    frames: Frames,
) -> None:
    """It keeps its own stamp."""
    budget = Hurried(1)
    play = Player(budget=budget)
    play(frames[0])
    budget.hurry = True
    hurried, repeated = play(frames[4]), play(frames[4])
    assert "frame" in repeated.skipped and repeated.snapshot.step == hurried.snapshot.step
    assert repeated.views["left"].t_capture_ns == repeated.pair.t_capture_ns > hurried.pair.t_capture_ns
    assert not hurried.observation.depth.any()
    for result in (hurried, repeated):
        assert not tells_of(result, "left/depth")


@pytest.mark.parametrize("overrides", [(), ("publish.right:=true",)])
def test_what_is_drawn_in_parts_is_the_whole_model(
    frames: Frames, overrides: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Wherever the image was not drawn anew, the model does not look different either. The right eye's
    colours are more than the model's."""
    play = Player(*overrides)
    for frame in frames[:4]:
        play(frame)
    whole = make_rasterizer("numba", 320, 256)
    wholes, draw = [], CpuRefiner.draw

    def watched(refiner: CpuRefiner, tiles: np.ndarray | None = None, share: float = 0.0) -> None:
        wholes.append(tiles is None)
        draw(refiner, tiles, share)

    monkeypatch.setattr(CpuRefiner, "draw", watched)
    for _ in range(25):
        result = play.again(frames[3])
        for eye, shown in result.views.items():
            planes = whole.forward(result.snapshot.gaussians, shown.camera)
            drawn = to_view(planes, shown.camera, shown.frame_id, shown.t_capture_ns)
            for part in ("rgb", "alpha", "depth") if eye == "left" else ("alpha", "depth"):
                difference = np.abs(getattr(shown, part).astype(float) - getattr(drawn, part)).max()
                assert difference <= (1 if part == "rgb" else 1e-6), (part, difference)
    assert sum(wholes) <= 5  # where one is removed, all is drawn
    assert len(result.views) == 1 + len(overrides)


def test_more_of_the_same_is_never_worse(frames: Frames) -> None:
    """Against the image without the noise: neither the steps nor the noise spoil what is there."""
    play = Player()
    for frame in frames[:6]:
        last = play(frame)
    clean = last.observation
    qualities = [psnr(last, clean), *(psnr(play.again(frames[5]), clean) for _ in range(40))]
    assert min(qualities) > qualities[0] - 0.1, qualities
    assert qualities[-1] > qualities[0] + 0.3, qualities


def test_motion_is_followed_at_once_after_a_rest(frames: Frames) -> None:
    rested, unrested = Player(), Player()
    for frame in frames[:6]:
        rested(frame)
        unrested(frame)
    for _ in range(15):
        rested.again(frames[5])
    for frame in frames[6:10]:
        moved, usual = rested(frame), unrested(frame)
        assert not moved.skipped and moved.epoch == 0
        assert psnr(moved) > psnr(usual) - 0.5


def test_a_reset_while_nothing_moves_begins_anew_and_motion_is_followed_at_once(
    frames: Frames,
) -> None:
    play = Player()
    play(frames[0])
    assert play.again(frames[0]).skipped
    play.pipeline.reset()
    fresh = play.again(frames[0])
    assert not fresh.skipped and fresh.snapshot.counts["inserted"] > 1000
    assert psnr(fresh) > 30
    moved = play(frames[3])
    assert not moved.skipped and moved.snapshot.velocities.any()


WIDTH, HEIGHT, FOCAL, DISPARITY = 320, 256, 300.0, 16


def test_tissue_that_creeps_is_followed() -> None:
    """A tenth of a pixel per frame: most frames look still, and yet the model keeps up. Noise in the image
    that is compared makes least squares see less motion than there was (errors in variables), here a
    twentieth to a tenth less."""
    K = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
    config = load_launch(None, [MODEL, f"vision.width:={WIDTH}", f"vision.height:={HEIGHT}"])
    pipeline = Pipeline(config, rectified_rig("plane", WIDTH, HEIGHT, K, 0.0043))
    rng = np.random.default_rng(2)
    plane = cv2.GaussianBlur(rng.normal(0, 1, (HEIGHT, WIDTH + 128, 3)).astype(np.float32), (0, 0), 3)
    plane = 128 + 25 * plane / plane.std()

    def seen(shift: float) -> np.ndarray:
        moved = np.array([[1, 0, -64 + shift], [0, 1, 0]])
        return noisy(cv2.warpAffine(plane, moved, (WIDTH, HEIGHT), flags=cv2.INTER_LANCZOS4), rng, 1.5)

    results = []
    for i in range(61):
        eyes = seen(0.1 * i), seen(0.1 * i - DISPARITY)
        stamp = i * 33_000_000
        frame = StereoFrame(i, stamp, stamp, *eyes, tissue=np.ones((HEIGHT, WIDTH), bool))
        results.append(pipeline.process(frame, StepBudget(2)))
    assert sum(bool(result.skipped) for result in results) > 20
    first, last = results[0].snapshot.gaussians, results[-1].snapshot.gaussians
    _, a, b = np.intersect1d(first.ids, last.ids, return_indices=True)
    start, end = (FOCAL * each[:, 0] / each[:, 2] + WIDTH / 2 for each in (first.means[a], last.means[b]))
    moved = (end - start)[(start > 40) & (start < WIDTH - 40)]
    assert len(moved) > 1000
    assert abs(np.median(moved) - 6.0) < 0.1 * 6, np.median(moved)  # px
