"""What no recording promises: unusable images, damage in the model, cuts, long runs. The node goes on,
shows nothing that is not finite, and finds back."""

import itertools
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from recorded_session import both, frames_of, noisy, opened, psnr

from sags_node.errors import UsageError
from sags_node.mapping.budget import StepBudget
from sags_node.pipeline.pipeline import Pipeline
from sags_node.pipeline.session import Session
from sags_node.processes import resident_mb
from sags_node.types import FrameResult, StereoFrame

CAP = 8000
NUMBERS = itertools.count(1)  # of frames: a pipeline plays several times, and its time goes on
# What these tests damage goes through sums and products before it is found and taken out.
damaging = pytest.mark.filterwarnings("ignore:invalid value encountered:RuntimeWarning")


@pytest.fixture(scope="module")
def session() -> Session:
    return opened(f"mapping.max_gaussians:={CAP}")


@pytest.fixture(scope="module")
def frames(session: Session) -> list[StereoFrame]:
    return frames_of(session)


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


def _noise(picture: np.ndarray) -> np.ndarray:
    return np.random.default_rng(0).integers(0, 256, picture.shape)


SPOILED: dict[str, Callable[[StereoFrame], StereoFrame]] = {
    "black": lambda frame: both(frame, lambda eye: 0 * eye),
    "white": lambda frame: both(frame, lambda eye: 0 * eye + 255),
    "grey": lambda frame: both(frame, lambda eye: 0 * eye + 128),
    "noise": lambda frame: both(frame, _noise),
    "all instrument": lambda frame: replace(frame, tissue=np.zeros(frame.left.shape[:2], bool)),
}


@pytest.mark.parametrize("name", SPOILED)
def test_unusable_pictures_are_survived_and_left_behind(
    session: Session, frames: list[StereoFrame], name: str
) -> None:
    pipeline = Pipeline(session.config, session.rig)
    before = psnr(play(pipeline, frames[:8])[-1])
    play(pipeline, [SPOILED[name](frame) for frame in frames[8:12]])
    after = [psnr(result) for result in play(pipeline, frames[12:22])]
    assert max(after[2:]) > before - 3.0, (before, after)


@pytest.mark.fault("image: the first one is black, noise or all instrument")
@pytest.mark.parametrize("name", ["black", "noise", "all instrument"])
def test_an_unusable_first_picture_only_delays_the_start(
    session: Session, frames: list[StereoFrame], name: str
) -> None:
    pipeline = Pipeline(session.config, session.rig)
    play(pipeline, [SPOILED[name](frames[0])])
    assert psnr(play(pipeline, frames[1:6])[-1]) > 28


@pytest.mark.fault("image: another scene for three seconds")
def test_a_cut_begins_a_new_model_in_a_new_epoch(session: Session, frames: list[StereoFrame]) -> None:
    """Another scene in front of the same cameras: here, the negative of the first."""
    negative = [both(frame, lambda eye: 255 - eye) for frame in frames]
    pipeline = Pipeline(session.config, session.rig)
    before = play(pipeline, frames[:4])[-1]
    during = play(pipeline, [negative[4]] * 30)  # three seconds
    assert {result.epoch for result in during} == {before.epoch} and all(result.held for result in during)
    after = play(pipeline, negative[5:7])[-1]
    assert after.epoch == before.epoch + 1 and not after.held
    assert psnr(after) > 30
    assert before.snapshot.gaussians.ids.max() < after.snapshot.gaussians.ids.min()


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
    return [*frames[1:3], *(both(frames[2], lambda eye: noisy(eye, rng, 1.5)) for _ in range(7))]


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


def with_damaged_depth(frame: StereoFrame, value: float, every: int) -> StereoFrame:
    depth = frame.depth.copy()
    depth.ravel()[::every] = value
    return replace(frame, depth=depth)


@pytest.mark.fault("depth: NaN, infinite, negative or huge in a recording")
@pytest.mark.parametrize("every", [10, 1])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, -0.1, 1e30])
def test_damage_in_a_session_s_own_depth_is_survived_and_left_behind(
    session: Session, measured_frames: list[StereoFrame], undamaged: float, value: float, every: int
) -> None:
    pipeline = Pipeline(session.config, session.rig)
    play(pipeline, measured_frames[:2])
    during = play(pipeline, [with_damaged_depth(frame, value, every) for frame in measured_frames[2:5]])
    after = play(pipeline, measured_frames[5:])[-1]
    assert min(psnr(result) for result in during) > undamaged - 3.0
    assert psnr(after) > undamaged - 1.0
    assert pipeline.map.restarts == 0


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e30])
@pytest.mark.parametrize("every", [10, 1])
def test_a_first_frame_with_damaged_depth_makes_no_damaged_model(
    session: Session, measured_frames: list[StereoFrame], value: float, every: int
) -> None:
    shown = [with_damaged_depth(measured_frames[0], value, every), *measured_frames[1:4]]
    assert psnr(play(Pipeline(session.config, session.rig), shown)[-1]) > 30


@pytest.fixture(scope="module")
def usual(session: Session, frames: list[StereoFrame]) -> list[float]:
    """What each of the first frames looks like when nothing goes wrong, dB."""
    return [psnr(result) for result in play(Pipeline(session.config, session.rig), frames[:9])]


def test_a_mask_that_misses_the_instruments_for_a_while_does_no_lasting_harm(
    session: Session, frames: list[StereoFrame], usual: list[float]
) -> None:
    everything = np.ones(frames[0].left.shape[:2], bool)
    shown = [replace(f, tissue=everything) if i in (3, 4, 5) else f for i, f in enumerate(frames[:9])]
    assert psnr(play(Pipeline(session.config, session.rig), shown)[-1]) > usual[8] - 1.0


@pytest.mark.fault("robot: a frame's pose is not finite")
@damaging
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_pose_that_is_no_pose_is_refused_and_does_no_harm(
    session: Session, frames: list[StereoFrame], usual: list[float], value: float
) -> None:
    T = np.eye(4)
    T[0, 3] = value
    pipeline = Pipeline(session.config, session.rig)
    play(pipeline, frames[:3])
    with pytest.raises(UsageError, match="pose"):
        play(pipeline, [replace(frames[3], T_world_cam=T)])
    assert psnr(play(pipeline, frames[4:7])[-1]) > usual[6] - 1.0


def test_hours_in_small(session: Session, frames: list[StereoFrame]) -> None:
    """Ten loops: no growth of N, nodes or memory, no drift of quality. Motion alone begins no new model."""
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
    session = opened(f"vision.width:={width}", f"vision.height:={height}", f"mapping.max_gaussians:={CAP}")
    assert psnr(play(Pipeline(session.config, session.rig), frames[:4])[-1]) > 28


@pytest.mark.fault("image: the same one again")
def test_a_repeated_picture_is_not_mapped_again_but_keeps_its_own_stamp(
    session: Session, frames: list[StereoFrame]
) -> None:
    pipeline = Pipeline(session.config, session.rig)
    first, again, moved = play(pipeline, [frames[0], frames[0], frames[5]])
    assert again.skipped and not moved.skipped
    assert again.snapshot.step == first.snapshot.step
    assert again.views["left"].t_capture_ns == again.pair.t_capture_ns > first.pair.t_capture_ns
