"""While nothing moves: what counts as still, what is left out then, and that nothing is lost by it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from typing import Any

import cv2
import numpy as np
import pytest
from flat_scene import camera_in_front, flat_scene
from places import SESSION

from sags_node.config.launch_file import load_launch
from sags_node.engine.rasterizer.rasterize import make_rasterizer, to_view
from sags_node.evaluation.metrics import as_float, psnr
from sags_node.mapping import motion
from sags_node.mapping.budget import FramePlan, StepBudget
from sags_node.mapping.densify import FRONT_FRAMES
from sags_node.mapping.devices import ALL_SKIPS, Skips
from sags_node.mapping.mapped import SETTLED, SETTLED_EVERY
from sags_node.mapping.mapper import TORN, Mapper
from sags_node.mapping.refiner import CpuRefiner
from sags_node.mapping.tissue_map import TissueMap
from sags_node.messaging.content import tells_of
from sags_node.pipeline.pipeline import Pipeline
from sags_node.pipeline.session import Session, open_session
from sags_node.rig import rectified_rig
from sags_node.types import F32, U8, Camera, FrameResult, RectifiedPair, RenderedView, StereoFrame
from sags_node.vision.change import REPEAT_RMS, StillScene, is_repeat
from sags_node.vision.flow import OpticalFlow
from sags_node.vision.scene_watch import NEW_SCENE_NS
from sags_node.vision.stereo import StereoDepth

NOISE = 2.0  # grey levels, standard deviation


def noisy(picture: F32 | np.ndarray, rng: np.random.Generator, sigma: float = NOISE) -> np.ndarray:
    return np.clip(picture + rng.normal(0, sigma, picture.shape), 0, 255).round().astype(np.uint8)


def texture(width: int, height: int, seed: int = 0) -> F32:
    """[H, W, 3] smooth random texture as of tissue, grey levels."""
    rng = np.random.default_rng(seed)
    smooth = cv2.GaussianBlur(rng.normal(0, 1, (height, width, 3)).astype(np.float32), (0, 0), 3)
    return np.asarray(128 + 25 * smooth / smooth.std(), np.float32)


# ---- what is still ---------------------------------------------------------------------------------------

SIZES = pytest.mark.parametrize(("width", "height"), [(320, 256), (640, 512)])


class Watched:
    """A `StillScene` that is shown pictures with fresh camera noise."""

    def __init__(self, width: int, height: int, sigma: float = NOISE, eyes: int = 2) -> None:
        self._scene = StillScene()
        self._rng = np.random.default_rng(1)
        self._sigma, self._eyes = sigma, eyes
        self._camera = Camera(width, height, np.eye(3), np.eye(4))

    def __call__(self, left: F32, right: F32 | None = None, T_world_cam: Any = None) -> int:
        camera = self._camera if T_world_cam is None else replace(self._camera, T_world_cam=T_world_cam)
        eyes = [noisy(eye, self._rng, self._sigma) for eye in (left, left if right is None else right)]
        return self._scene(RectifiedPair(0, 0, camera, 0.004, eyes[0], eyes[1] if self._eyes == 2 else None))


@SIZES
@pytest.mark.parametrize("eyes", [1, 2])
@pytest.mark.parametrize("sigma", [0.0, 3.0, 4.0])
def test_noise_is_no_motion(width: int, height: int, eyes: int, sigma: float) -> None:
    watched, picture = Watched(width, height, sigma, eyes), texture(width, height)
    assert [watched(picture) for _ in range(15)] == list(range(15))


@SIZES
@pytest.mark.parametrize("eyes", [1, 2])
@pytest.mark.parametrize("corner", [(0, 0), (100, 131), (-64, -64)])
def test_a_patch_that_shifts_by_a_pixel_moves(
    width: int, height: int, eyes: int, corner: tuple[int, int]
) -> None:
    watched, picture = Watched(width, height, eyes=eyes), texture(width, height)
    x, y = corner[0] % width, corner[1] % height
    shifted = picture.copy()
    shifted[y : y + 64, x : x + 64] = np.roll(picture, 1, axis=1)[y : y + 64, x : x + 64]
    assert watched(picture) == 0 and watched(picture) == 1
    assert watched(shifted) == 0
    assert watched(shifted) == 1  # and now it stays there


@SIZES
def test_what_only_the_right_eye_sees_moves_too(width: int, height: int) -> None:
    watched, picture = Watched(width, height), texture(width, height)
    assert [watched(picture, picture), watched(picture, picture)] == [0, 1]
    assert watched(picture, np.roll(picture, 2, axis=0)) == 0


@SIZES
@pytest.mark.parametrize("speed", [0.05, 0.1, -0.1])
def test_slow_drift_adds_up_and_is_seen(width: int, height: int, speed: float) -> None:
    """Each frame alone differs from its predecessor by less than the noise."""
    watched, picture = Watched(width, height), texture(width + 16, height)
    seen = []
    for i in range(41):
        shift = np.array([[1, 0, -8 + speed * i], [0, 1, 0]])
        shown = cv2.warpAffine(picture, shift, (width, height), flags=cv2.INTER_LANCZOS4)
        if watched(shown) == 0:
            seen.append(i)
    gaps = np.diff(seen) * abs(speed)
    assert len(seen) > 2 and gaps.max() <= 0.5, seen  # px


@SIZES
def test_an_instrument_that_enters_moves(width: int, height: int) -> None:
    watched, picture = Watched(width, height), texture(width, height)
    watched(picture)
    entered = []
    for reach in range(0, 80, 8):  # px
        shown = picture.copy()
        cv2.line(shown, (-20, height // 2), (reach - 20, height // 2), (60, 60, 60), 40)
        entered.append(watched(shown))
    assert 0 in entered[:7] and 0 in entered[7:]


@pytest.mark.parametrize("jump", [-5, 5])
def test_light_that_changes_moves(jump: int) -> None:
    watched, picture = Watched(320, 256), texture(320, 256)
    assert [watched(picture), watched(picture), watched(picture + jump)] == [0, 1, 0]


def test_a_camera_that_moves_before_an_even_wall_moves() -> None:
    """The picture does not show it, the pose does."""
    watched, picture, T = Watched(320, 256), np.full((256, 320, 3), 128, np.float32), np.eye(4)
    assert [watched(picture), watched(picture)] == [0, 1]
    T[0, 3] = 0.01
    assert [watched(picture, T_world_cam=T), watched(picture, T_world_cam=T)] == [0, 1]


def test_what_is_forgotten_and_other_eyes_are_no_predecessor() -> None:
    picture = np.full((64, 96, 3), 100, np.uint8)
    both = RectifiedPair(0, 0, Camera(96, 64, np.eye(3), np.eye(4)), 0.004, picture, picture)
    scene = StillScene()
    assert [scene(both), scene(both)] == [0, 1]
    scene.forget()
    assert [scene(both), scene(both), scene(replace(both, right=None))] == [0, 1, 0]


# ---- what is a repeat ------------------------------------------------------------------------------------


def shown(left: np.ndarray) -> RectifiedPair:
    height, width = left.shape[:2]
    return RectifiedPair(0, 0, Camera(width, height, np.eye(3), np.eye(4)), 0.004, left, left)


@pytest.mark.parametrize(("x", "y"), [(0, 0), (131, 100), (640 - 45, 512 - 45)])
def test_a_small_piece_that_moved_is_no_repeat(x: int, y: int) -> None:
    """A twentieth of the width, by a pixel, in a picture without noise: over all it is less than what a codec
    does to a repeat."""
    picture = texture(640, 512).round().astype(np.uint8)
    moved = picture.copy()
    moved[y : y + 32, x : x + 32] = np.roll(picture, 1, axis=1)[y : y + 32, x : x + 32]
    before, after = (cv2.cvtColor(each, cv2.COLOR_RGB2GRAY).astype(np.float32) for each in (picture, moved))
    assert 0.2 < np.sqrt(np.mean((after - before) ** 2)) < REPEAT_RMS
    assert not is_repeat(shown(moved), shown(picture))


@SIZES
def test_a_picture_coded_again_is_a_repeat_and_one_taken_again_is_not(width: int, height: int) -> None:
    picture, rng = texture(width, height), np.random.default_rng(0)
    coded = [noisy(picture, rng, 0.25) for _ in range(2)]
    assert is_repeat(shown(coded[0]), shown(coded[1])) and is_repeat(shown(coded[0]), shown(coded[0]))
    taken = [noisy(picture, rng, 1.0) for _ in range(2)]
    assert not is_repeat(shown(taken[0]), shown(taken[1]))


# ---- the pipeline while nothing moves --------------------------------------------------------------------


@pytest.fixture(scope="module")
def frames() -> list[StereoFrame]:
    with open_session(SESSION, ["source.pace:=step"]).source as source:
        return list(source)


def opened(*overrides: str) -> Session:
    return open_session(SESSION, ["source.pace:=step", "mapping.max_gaussians:=8000", *overrides])


class Player:
    """A pipeline that is given frames with fresh numbers and stamps."""

    def __init__(self, session: Session, skips: Skips = ALL_SKIPS, steps: int = 2) -> None:
        self.pipeline = Pipeline(session.config, session.rig, skips=skips)
        self._steps = steps
        self._number = 0
        self._rng = np.random.default_rng(3)

    def __call__(self, frame: StereoFrame) -> FrameResult:
        self._number += 1
        frame = replace(frame, frame_id=self._number, t_capture_ns=self._number * 100_000_000)
        return self.pipeline.process(frame, StepBudget(self._steps))

    def again(self, frame: StereoFrame) -> FrameResult:
        """The same scene, photographed once more."""
        assert frame.right is not None
        left, right = noisy(frame.left, self._rng), noisy(frame.right, self._rng)
        return self(replace(frame, left=left, right=right))


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> dict[str, int]:
    """How often depth was asked for, and the mapper's flow."""
    counts = {"depth": 0, "flow": 0}

    def count(owner: type, name: str) -> None:
        original = owner.__call__

        def counted(*arguments: Any) -> Any:
            counts[name] += 1
            return original(*arguments)

        monkeypatch.setattr(owner, "__call__", counted)

    class Flow(OpticalFlow):
        """That of the mapper; the watches have their own, of smaller pictures."""

    monkeypatch.setattr(motion, "OpticalFlow", Flow)
    count(StereoDepth, "depth")
    count(Flow, "flow")
    return counts


def test_neither_depth_nor_flow_is_asked_for_until_something_moves(
    frames: list[StereoFrame], calls: dict[str, int]
) -> None:
    play = Player(opened())
    for frame in frames[:5]:
        assert not play(frame).skipped
    assert calls == {"depth": 5, "flow": 4}
    settled = 0
    for turn in range(25):
        result = play.again(frames[4])
        assert set(result.skipped) == {"depth", "motion"}
        assert not result.snapshot.velocities.any()
        steps = result.snapshot.counts["iterations"]
        assert steps == 2 if turn < SETTLED else steps <= 1
        settled += steps if turn >= SETTLED else 0
    assert calls == {"depth": 5, "flow": 4} and settled - (25 - SETTLED) // SETTLED_EVERY in (0, 1)
    assert not play(frames[6]).skipped
    assert calls == {"depth": 6, "flow": 5}


def test_each_frame_is_mapped_where_still_scenes_are_not_wanted(
    frames: list[StereoFrame], calls: dict[str, int]
) -> None:
    play = Player(opened(), Skips(still=False))
    play(frames[0])
    assert not any(play.again(frames[0]).skipped for _ in range(3))
    assert calls == {"depth": 4, "flow": 3}


class Hurried(StepBudget):
    """There was no time for depth when things moved last."""

    hurry = False

    def start(self, waited: float = 0.0) -> FramePlan:
        self.plan = replace(super().start(waited), depth=not self.hurry)
        return self.plan


def test_a_rest_makes_up_for_the_depth_that_there_was_no_time_for(
    frames: list[StereoFrame], calls: dict[str, int]
) -> None:
    session, budget = opened(), Hurried(1)
    pipeline = Pipeline(session.config, session.rig)
    rng, results = np.random.default_rng(0), []
    for i, number in enumerate([0, 1, 2, 2, 2]):
        budget.hurry = i == 2
        left, right = frames[number].left, frames[number].right
        assert right is not None
        eyes = {"left": noisy(left, rng), "right": noisy(right, rng)}
        results.append(
            pipeline.process(
                replace(frames[number], frame_id=i, t_capture_ns=i * 100_000_000, **eyes), budget
            )
        )
    known = [result.observation.depth.any() for result in results]
    assert known == [True, True, False, True, True]
    assert calls["depth"] == 3


def test_one_wrong_depth_counts_once_while_nothing_moves(frames: list[StereoFrame]) -> None:
    """It is handed on from frame to frame, and three wrong ones in a row would take the tissue away. A tenth
    of the picture: so large a hole would be filled at the wrong depth at once."""
    play = Player(opened())
    for frame in frames[:5]:
        depth = play(frame).observation.depth
    model = play.pipeline.map.model
    assert not model.in_front.any()
    wrong = depth.copy()
    wrong[80:160, 100:200] *= 1.2
    play(replace(frames[5], depth=wrong))
    struck = model.ids[model.in_front == 1]
    assert len(struck) > TORN * model.count
    for _ in range(2 * FRONT_FRAMES):
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


def test_a_mask_that_flickers_while_nothing_moves_takes_no_depth_away(frames: list[StereoFrame]) -> None:
    play, rng = Player(opened()), np.random.default_rng(0)
    first = play(frames[0]).observation.depth
    tissue = frames[0].tissue
    assert tissue is not None
    for _ in range(10):
        less = tissue & (rng.random(tissue.shape) > 0.01)
        flickering = play.again(replace(frames[0], tissue=less)).observation
        assert not flickering.depth_is_new and not flickering.depth[~flickering.tissue].any()
    last = play.again(frames[0]).observation
    assert (last.depth > 0).sum() >= 0.99 * (first > 0).sum() > 0  # a cell of specks may go


def test_a_repeated_frame_does_not_claim_depth_that_was_never_matched(frames: list[StereoFrame]) -> None:
    session, budget = opened(), Hurried(1)
    pipeline = Pipeline(session.config, session.rig)
    pipeline.process(frames[0], budget)
    budget.hurry = True
    hurried = pipeline.process(frames[4], budget)
    repeated = pipeline.process(replace(frames[4], frame_id=99), budget)
    assert "frame" in repeated.skipped
    assert not hurried.observation.depth.any()
    for result in (hurried, repeated):
        assert not tells_of(result, "left/depth")


def test_motion_is_followed_at_once_after_a_model_was_begun_while_nothing_moved(
    frames: list[StereoFrame], calls: dict[str, int]
) -> None:
    play = Player(opened())
    play(frames[0])
    play.pipeline.map.restart()
    play.again(frames[0])
    play(frames[3])
    assert calls["flow"] == 1


@pytest.mark.parametrize("overrides", [(), ("publish.right:=true",)])
def test_what_is_drawn_in_parts_is_the_whole_model(
    frames: list[StereoFrame], overrides: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Wherever the picture was not drawn anew, the model does not look different either. The right eye's
    colours are more than the model's."""
    play = Player(opened(*overrides))
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


def against_clean(result: FrameResult, clean: U8) -> float:
    return psnr(as_float(result.views["left"].rgb), as_float(clean), result.observation.tissue)


def test_more_of_the_same_is_never_worse(frames: list[StereoFrame]) -> None:
    """Against the picture without the noise: neither the steps nor the noise spoil what is there."""
    play = Player(opened())
    for frame in frames[:6]:
        last = play(frame)
    clean = last.observation.image
    qualities = [against_clean(last, clean)]
    for _ in range(40):
        qualities.append(against_clean(play.again(frames[5]), clean))
    assert min(qualities) > qualities[0] - 0.1, qualities
    assert qualities[-1] > qualities[0] + 0.3, qualities


def test_motion_is_followed_at_once_after_a_rest_and_a_cut_when_it_lasts(frames: list[StereoFrame]) -> None:
    rested, unrested = Player(opened()), Player(opened())
    for frame in frames[:6]:
        rested(frame)
        unrested(frame)
    for _ in range(15):
        rested.again(frames[5])
    for frame in frames[6:10]:
        moved, usual = rested(frame), unrested(frame)
        assert not moved.skipped and moved.epoch == 0
        assert (
            against_clean(moved, moved.observation.image)
            > against_clean(usual, usual.observation.image) - 0.5
        )
    rested.again(frames[9])
    assert frames[12].right is not None
    negative = replace(frames[12], left=255 - frames[12].left, right=255 - frames[12].right)
    cut = [rested(negative) for _ in range(NEW_SCENE_NS // 100_000_000 + 1)]
    begun = len(cut) - 1
    assert [result.epoch for result in cut] == [0] * begun + [1]
    assert all(result.held for result in cut[:begun]) and not cut[begun].skipped
    assert against_clean(cut[begun], cut[begun].observation.image) > 30


def test_a_reset_while_nothing_moves_begins_anew(frames: list[StereoFrame]) -> None:
    play = Player(opened())
    play(frames[0])
    assert play.again(frames[0]).skipped
    play.pipeline.reset()
    fresh = play.again(frames[0])
    assert not fresh.skipped and fresh.snapshot.counts["inserted"] > 1000
    assert against_clean(fresh, fresh.observation.image) > 30


def test_the_same_frames_give_the_same_bits(frames: list[StereoFrame]) -> None:
    def run() -> Iterator[np.ndarray]:
        play = Player(opened())
        for number in (0, 1, 2):
            yield from arrays(play(frames[number]))
        for _ in range(SETTLED + 3):
            yield from arrays(play.again(frames[2]))
        for number in (3, 5):
            yield from arrays(play(frames[number]))

    def arrays(result: FrameResult) -> Iterator[np.ndarray]:
        view: RenderedView = result.views["left"]
        yield from (view.rgb.copy(), view.depth.copy(), result.snapshot.gaussians.means)

    assert all(np.array_equal(a, b) for a, b in zip(run(), run(), strict=True))


WIDTH, HEIGHT, FOCAL, DISPARITY = 320, 256, 300.0, 16


def test_tissue_that_creeps_is_followed() -> None:
    """A tenth of a pixel per frame: most frames look still, and yet the model keeps up. Noise in the picture
    that is compared makes least squares see less motion than there was (errors in variables), here a
    twentieth to a tenth less."""
    K = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
    config = load_launch(
        None, ["mapping.max_gaussians:=8000", f"vision.width:={WIDTH}", f"vision.height:={HEIGHT}"]
    )
    pipeline = Pipeline(config, rectified_rig("plane", WIDTH, HEIGHT, K, 0.0043))
    plane, rng = texture(WIDTH + 128, HEIGHT), np.random.default_rng(2)

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

    def column(means: F32) -> F32:
        return np.asarray(FOCAL * means[:, 0] / means[:, 2] + WIDTH / 2)

    start = column(first.means[a])
    moved = (column(last.means[b]) - start)[(start > 40) & (start < WIDTH - 40)]
    assert len(moved) > 1000
    assert abs(np.median(moved) - 6.0) < 0.1 * 6, np.median(moved)  # px
