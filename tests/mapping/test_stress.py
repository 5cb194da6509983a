"""What no recording promises: damage in the model, in depth and in poses, odd sizes, long runs. The node goes
on, shows nothing that is not finite, and finds back."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from recorded_session import Frames, both, frames_of, fresh, noisy, opened, psnr

from sags_node.errors import UsageError
from sags_node.mapping.budget import StepBudget
from sags_node.pipeline.pipeline import Pipeline
from sags_node.processes import resident_mb
from sags_node.types import FrameResult

CAP = 8000
FEW = f"mapping.max_gaussians:={CAP}"
NUMBERS = itertools.count(1)  # of frames: a pipeline plays several times, and its time goes on
# What these tests damage goes through sums and products before it is found and taken out.
damaging = pytest.mark.filterwarnings("ignore:invalid value encountered:RuntimeWarning")


@pytest.fixture(scope="module")
def frames() -> Frames:
    return frames_of(opened())


def play(pipeline: Pipeline, frames: Frames) -> list[FrameResult]:
    """Process frames with fresh numbers and stamps, checking each result."""
    results = []
    for frame in frames:
        number = next(NUMBERS)
        stamp = number * 100_000_000
        results.append(pipeline.process(replace(frame, frame_id=number, t_capture_ns=stamp), StepBudget(1)))
        check(results[-1])
    return results


def qualities(results: list[FrameResult]) -> list[float]:
    return [psnr(result) for result in results]


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


ARRAYS = (
    "means", "quats", "log_scales", "scales", "smoothing", "opacities", "opacity_logits", "colors",
    "velocities", "contribution", "adam_m", "adam_v", "node_weight",
)  # fmt: skip
NODE_ARRAYS = ("nodes", "momentum", "variance")
NOT_NUMBERS = np.array([np.nan, np.inf, -np.inf, 1e30], np.float32)


def lasting(frames: Frames, still: bool) -> Frames:
    """Three frames and what follows: motion, or the third again and again with fresh noise."""
    if not still:
        return frames[:9]
    rng = np.random.default_rng(0)
    return [*frames[1:3], *(both(frames[2], lambda eye: noisy(eye, rng, 1.5)) for _ in range(7))]


@pytest.fixture(scope="module", params=["moving", "still"])
def scene(request: pytest.FixtureRequest, frames: Frames) -> tuple[Frames, list[float]]:
    """Frames, and what each looks like when nothing goes wrong, dB."""
    shown = lasting(frames, request.param == "still")
    results = play(fresh(FEW), shown)
    assert bool(results[-1].skipped) == (request.param == "still")
    return shown, qualities(results)


@pytest.mark.fault("memory: values of the model are overwritten with NaN or infinities")
@damaging
@pytest.mark.parametrize("array", ARRAYS + NODE_ARRAYS)
def test_damage_in_the_model_heals_within_three_frames(scene: tuple[Frames, list[float]], array: str) -> None:
    """Rows of one array are overwritten between two frames, in turn by NaN, infinities and a huge number: one
    in a hundred, and when that has healed, all."""
    shown, undamaged = scene
    pipeline = fresh(FEW)
    play(pipeline, shown[:3])
    for every, after in ((100, 3), (1, 6)):
        owner = pipeline.map.deformation if array in NODE_ARRAYS else pipeline.map.model
        rows = getattr(owner, array)[::every]
        rows[:] = np.resize(NOT_NUMBERS, len(rows)).reshape(-1, *[1] * (rows.ndim - 1))
        healed = play(pipeline, shown[after : after + 3])[-1]
        assert psnr(healed) > undamaged[after + 2] - 1.0


@pytest.fixture(scope="module")
def measured(frames: Frames) -> tuple[Frames, float]:
    """Frames that bring their own depth, and what the last one looks like when nothing goes wrong, dB."""
    results = play(fresh(FEW), frames[:8])
    shown = [replace(f, depth=each.observation.depth) for f, each in zip(frames, results, strict=False)]
    return shown, psnr(play(fresh(FEW), shown)[-1])


@pytest.mark.fault("depth: NaN, infinite, negative or huge in a recording")
@pytest.mark.parametrize("every", [10, 1])
def test_damage_in_a_session_s_own_depth_is_survived_and_left_behind(
    measured: tuple[Frames, float], every: int
) -> None:
    """Of every kind, in turn; in the middle, and from the first frame on."""
    (shown, undamaged), damaged, pipeline = measured, [], fresh(FEW)
    for frame in shown:
        depth = frame.depth.copy()
        pixels = depth.ravel()[::every]
        pixels[:] = np.resize([*NOT_NUMBERS, -0.1], len(pixels))
        damaged.append(replace(frame, depth=depth))
    found = qualities(play(pipeline, [*shown[:2], *damaged[2:5], *shown[5:]]))
    assert min(found[2:5]) > undamaged - 3.0 and found[-1] > undamaged - 1.0
    assert pipeline.map.restarts == 0
    assert psnr(play(fresh(FEW), [damaged[0], *shown[1:4]])[-1]) > 30


@pytest.mark.fault("robot: a frame's pose is not finite")
@damaging
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_pose_that_is_no_pose_is_refused_and_does_no_harm(frames: Frames, value: float) -> None:
    T = np.eye(4)
    T[0, 3] = value
    usual, pipeline = psnr(play(fresh(FEW), frames[:7])[-1]), fresh(FEW)
    play(pipeline, frames[:3])
    with pytest.raises(UsageError, match="pose"):
        play(pipeline, [replace(frames[3], T_world_cam=T)])
    assert psnr(play(pipeline, frames[4:7])[-1]) > usual - 1.0


def test_hours_in_small(frames: Frames) -> None:
    """Ten loops: no growth of N, nodes or memory, no drift of quality. Motion alone begins no new model."""
    pipeline = fresh(FEW)
    means, memory = [], []
    for _ in range(10):
        means.append(np.mean(qualities(play(pipeline, frames))))
        memory.append(resident_mb())
    assert means[-1] > means[1] - 0.5, means
    assert memory[-1] - memory[3] < 20, memory
    assert pipeline.map.restarts == 0


@pytest.mark.parametrize(("width", "height"), [(97, 71), (33, 41), (319, 255)])
def test_sizes_that_no_tile_divides(frames: Frames, width: int, height: int) -> None:
    pipeline = fresh(FEW, f"vision.width:={width}", f"vision.height:={height}")
    assert psnr(play(pipeline, frames[:4])[-1]) > 28
