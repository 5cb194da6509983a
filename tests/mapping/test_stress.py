"""What no recording promises: unusable pictures, damage in the model, cuts, long runs. The node goes on,
shows nothing that is not finite, and finds back."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from places import SESSION

from sags_node.errors import UsageError
from sags_node.evaluation.metrics import as_float
from sags_node.mapping.budget import StepBudget
from sags_node.pipeline.pipeline import Pipeline
from sags_node.pipeline.session import Session, open_session
from sags_node.processes import resident_mb
from sags_node.types import U8, FrameResult, StereoFrame

CAP = 8000
NUMBERS = itertools.count(1)  # of frames: a pipeline plays several times, and its time goes on
Spoil = Callable[[StereoFrame, np.random.Generator], StereoFrame]
# What these tests damage goes through sums and products before it is found and taken out.
damaging = pytest.mark.filterwarnings("ignore:invalid value encountered:RuntimeWarning")


@pytest.fixture(scope="module")
def session() -> Session:
    return open_session(SESSION, ["source.pace:=step", f"mapping.max_gaussians:={CAP}"])


@pytest.fixture(scope="module")
def frames(session: Session) -> list[StereoFrame]:
    with session.source as source:
        return list(source)


def play(pipeline: Pipeline, frames: list[StereoFrame]) -> list[FrameResult]:
    """Process frames with fresh numbers and stamps, checking each result."""
    results = []
    for frame in frames:
        number = next(NUMBERS)
        stamp = number * 100_000_000
        result = pipeline.process(replace(frame, frame_id=number, t_capture_ns=stamp), StepBudget(1))
        check(result)
        results.append(result)
    return results


def check(result: FrameResult) -> None:
    """Everything a consumer gets is finite and in its range."""
    gaussians, view = result.snapshot.gaussians, result.views["left"]
    for name in ("means", "quats", "scales", "opacities", "colors"):
        assert np.isfinite(getattr(gaussians, name)).all(), name
    assert np.isfinite(result.snapshot.velocities).all()
    assert len(gaussians) <= CAP and len(np.unique(gaussians.ids)) == len(gaussians)
    assert (gaussians.scales > 0).all()
    assert ((gaussians.opacities >= 0) & (gaussians.opacities <= 1)).all()
    assert view.rgb.dtype == np.uint8
    assert np.isfinite(view.depth).all() and view.depth.min() >= 0
    assert view.alpha.min() >= 0 and view.alpha.max() <= 1 + 1e-5


def psnr(result: FrameResult) -> float:
    tissue = result.observation.tissue
    error = (as_float(result.views["left"].rgb) - as_float(result.observation.image))[tissue]
    return float(-10 * np.log10(np.mean(np.square(error)) + 1e-12))


def _noise(frame: StereoFrame, rng: np.random.Generator) -> StereoFrame:
    return replace(
        frame,
        left=rng.integers(0, 256, frame.left.shape, np.uint8),
        right=rng.integers(0, 256, frame.right.shape, np.uint8),
    )


def _flat(value: int) -> Spoil:
    return lambda frame, rng: replace(
        frame, left=np.full_like(frame.left, value), right=np.full_like(frame.right, value)
    )


SPOILED: dict[str, Spoil] = {
    "black": _flat(0),
    "white": _flat(255),
    "grey": _flat(128),
    "noise": _noise,
    "all instrument": lambda frame, rng: replace(frame, tissue=np.zeros(frame.left.shape[:2], bool)),
}


@pytest.mark.parametrize("name", SPOILED)
def test_unusable_pictures_are_survived_and_left_behind(
    session: Session, frames: list[StereoFrame], name: str
) -> None:
    rng = np.random.default_rng(0)
    pipeline = Pipeline(session.config, session.rig)
    before = psnr(play(pipeline, frames[:8])[-1])
    play(pipeline, [SPOILED[name](frame, rng) for frame in frames[8:12]])
    after = [psnr(result) for result in play(pipeline, frames[12:22])]
    assert max(after[2:]) > before - 3.0, (before, after)


@pytest.mark.fault("picture: the first one is black, noise or all instrument")
@pytest.mark.parametrize("name", ["black", "noise", "all instrument"])
def test_an_unusable_first_picture_only_delays_the_start(
    session: Session, frames: list[StereoFrame], name: str
) -> None:
    pipeline = Pipeline(session.config, session.rig)
    play(pipeline, [SPOILED[name](frames[0], np.random.default_rng(0))])
    assert psnr(play(pipeline, frames[1:6])[-1]) > 28


@pytest.mark.fault("picture: another scene for three seconds")
def test_a_cut_begins_a_new_model_in_a_new_epoch(session: Session, frames: list[StereoFrame]) -> None:
    """Another scene in front of the same cameras: here, the negative of the first."""
    negative = [replace(f, left=255 - f.left, right=255 - f.right) for f in frames]
    pipeline = Pipeline(session.config, session.rig)
    before = play(pipeline, frames[:4])[-1]
    during = play(pipeline, [negative[4]] * 30)  # three seconds
    assert {result.epoch for result in during} == {before.epoch} and all(result.held for result in during)
    after = play(pipeline, negative[5:7])[-1]
    assert after.epoch == before.epoch + 1 and not after.held
    assert psnr(after) > 30
    assert before.snapshot.gaussians.ids.max() < after.snapshot.gaussians.ids.min()


def test_motion_alone_never_restarts_the_model(session: Session, frames: list[StereoFrame]) -> None:
    pipeline = Pipeline(session.config, session.rig)
    assert {result.epoch for result in play(pipeline, frames)} == {0}


ARRAYS = (
    "means", "quats", "log_scales", "scales", "smoothing", "opacities", "opacity_logits", "colors",
    "velocities", "contribution", "adam_m", "adam_v", "node_weight",
)  # fmt: skip
NODE_ARRAYS = ("nodes", "momentum", "variance")
NOT_NUMBERS = np.array([np.nan, np.inf, -np.inf, 1e30], np.float32)


def lasting(frames: list[StereoFrame], still: bool) -> list[StereoFrame]:
    """Three frames and what follows: motion, or the third again and again with fresh noise."""
    if not still:
        return frames[:9]
    rng = np.random.default_rng(0)

    def again(picture: U8 | None) -> U8:
        assert picture is not None
        return np.clip(picture + rng.normal(0, 1.5, picture.shape), 0, 255).round().astype(np.uint8)

    third = frames[2]
    repeats = [replace(third, left=again(third.left), right=again(third.right)) for _ in range(7)]
    return [*frames[1:3], *repeats]


@pytest.fixture(scope="module", params=["moving", "still"])
def scene(
    request: pytest.FixtureRequest, session: Session, frames: list[StereoFrame]
) -> tuple[list[StereoFrame], list[float]]:
    """Frames, and what each looks like when nothing goes wrong, dB."""
    shown = lasting(frames, request.param == "still")
    results = play(Pipeline(session.config, session.rig), shown)
    assert bool(results[-1].skipped) == (request.param == "still")
    return shown, [psnr(result) for result in results]


@pytest.mark.fault("memory: values of the model are overwritten with NaN or infinities")
@damaging
@pytest.mark.parametrize("array", ARRAYS + NODE_ARRAYS)
def test_damage_in_the_model_heals_within_three_frames(
    session: Session, scene: tuple[list[StereoFrame], list[float]], array: str
) -> None:
    """Rows of one array are overwritten between two frames, in turn by NaN, infinities and a huge number: one
    in a hundred, and when that has healed, all."""
    shown, undamaged = scene
    pipeline = Pipeline(session.config, session.rig)
    play(pipeline, shown[:3])
    for every, after in ((100, 3), (1, 6)):
        owner = pipeline.map.deformation if array in NODE_ARRAYS else pipeline.map.model
        rows = getattr(owner, array)[::every]
        rows[:] = np.resize(NOT_NUMBERS, len(rows)).reshape(-1, *[1] * (rows.ndim - 1))
        healed = play(pipeline, shown[after : after + 3])[-1]
        assert psnr(healed) > undamaged[after + 2] - 1.0


@pytest.fixture(scope="module")
def measured_frames(session: Session, frames: list[StereoFrame]) -> list[StereoFrame]:
    """Frames that bring their own depth."""
    results = play(Pipeline(session.config, session.rig), frames[:8])
    return [
        replace(frame, depth=result.observation.depth) for frame, result in zip(frames, results, strict=False)
    ]


@pytest.fixture(scope="module")
def undamaged(session: Session, measured_frames: list[StereoFrame]) -> float:
    """What the last of them looks like, dB."""
    return psnr(play(Pipeline(session.config, session.rig), measured_frames)[-1])


@pytest.mark.fault("depth: NaN, infinite, negative or huge in a recording")
@pytest.mark.parametrize("every", [10, 1])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, -0.1, 1e30])
def test_damage_in_a_session_s_own_depth_is_survived_and_left_behind(
    session: Session, measured_frames: list[StereoFrame], undamaged: float, value: float, every: int
) -> None:

    def spoil(frame: StereoFrame) -> StereoFrame:
        assert frame.depth is not None
        depth = frame.depth.copy()
        depth.ravel()[::every] = value
        return replace(frame, depth=depth)

    pipeline = Pipeline(session.config, session.rig)
    play(pipeline, measured_frames[:2])
    during = play(pipeline, [spoil(frame) for frame in measured_frames[2:5]])
    after = play(pipeline, measured_frames[5:])[-1]
    assert min(psnr(result) for result in during) > undamaged - 3.0
    assert psnr(after) > undamaged - 1.0
    assert pipeline.map.restarts == 0


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e30])
@pytest.mark.parametrize("every", [10, 1])
def test_a_first_frame_with_damaged_depth_makes_no_damaged_model(
    session: Session, measured_frames: list[StereoFrame], value: float, every: int
) -> None:
    depth = measured_frames[0].depth
    assert depth is not None
    depth = depth.copy()
    depth.ravel()[::every] = value
    pipeline = Pipeline(session.config, session.rig)
    results = play(pipeline, [replace(measured_frames[0], depth=depth), *measured_frames[1:4]])
    assert psnr(results[-1]) > 30


def test_a_mask_that_misses_the_instruments_for_a_while_does_no_lasting_harm(
    session: Session, frames: list[StereoFrame]
) -> None:
    undamaged = psnr(play(Pipeline(session.config, session.rig), frames[:9])[-1])
    pipeline = Pipeline(session.config, session.rig)
    play(pipeline, frames[:3])
    everything = np.ones(frames[0].left.shape[:2], bool)
    play(pipeline, [replace(frame, tissue=everything) for frame in frames[3:6]])
    assert psnr(play(pipeline, frames[6:9])[-1]) > undamaged - 1.0


@pytest.mark.fault("robot: a frame's pose is not finite")
@damaging
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_pose_that_is_no_pose_is_refused_and_does_no_harm(
    session: Session, frames: list[StereoFrame], value: float
) -> None:
    undamaged = psnr(play(Pipeline(session.config, session.rig), frames[:7])[-1])
    T = np.eye(4)
    T[0, 3] = value
    pipeline = Pipeline(session.config, session.rig)
    play(pipeline, frames[:3])
    with pytest.raises(UsageError, match="pose"):
        play(pipeline, [replace(frames[3], T_world_cam=T)])
    assert psnr(play(pipeline, frames[4:7])[-1]) > undamaged - 1.0


def test_hours_in_small(session: Session, frames: list[StereoFrame]) -> None:
    """Ten loops: no growth of N, nodes or memory, no drift of quality."""
    pipeline = Pipeline(session.config, session.rig)
    qualities, memory = [], []
    for _ in range(10):
        qualities.append(np.mean([psnr(result) for result in play(pipeline, frames)]))
        memory.append(resident_mb())
    assert qualities[-1] > qualities[1] - 0.5, qualities
    assert memory[-1] - memory[3] < 20, memory
    assert pipeline.map.restarts == 0


@pytest.mark.parametrize(("width", "height"), [(97, 71), (33, 41), (319, 255)])
def test_sizes_that_no_tile_divides(frames: list[StereoFrame], width: int, height: int) -> None:
    session = open_session(
        SESSION,
        [f"vision.width:={width}", f"vision.height:={height}", f"mapping.max_gaussians:={CAP}"],
    )
    pipeline = Pipeline(session.config, session.rig)
    assert psnr(play(pipeline, frames[:4])[-1]) > 28


@pytest.mark.fault("picture: the same one again")
def test_a_repeated_picture_is_not_mapped_again_but_keeps_its_own_stamp(
    session: Session, frames: list[StereoFrame]
) -> None:
    pipeline = Pipeline(session.config, session.rig)
    first, again, moved = play(pipeline, [frames[0], frames[0], frames[5]])
    assert again.skipped and not moved.skipped
    assert again.snapshot.step == first.snapshot.step
    assert again.views["left"].t_capture_ns == again.pair.t_capture_ns > first.pair.t_capture_ns
