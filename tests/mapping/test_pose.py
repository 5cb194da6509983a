"""The camera's pose from images: recovered where it is known, kept from outliers, found again when lost."""

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from places import SESSION
from recorded_session import Frames, both, frames_of, psnr

from sags_node.findings import by_code
from sags_node.geometry import invert, project
from sags_node.mapping.budget import StepBudget
from sags_node.mapping.camera_pose import exponential, fit_pose
from sags_node.mapping.first_views import FirstViews
from sags_node.phantom import PhantomScene, write_session
from sags_node.pipeline.pipeline import Pipeline
from sags_node.pipeline.session import open_session
from sags_node.tools.evaluation.measure import MeasureOptions
from sags_node.tools.evaluation.session import evaluate
from sags_node.tools.evaluation.trajectory import trajectory_errors
from sags_node.types import F32, F64, Camera, FrameResult, StereoFrame

BASELINE = 0.0043
MOTION = np.array([2e-3, -1e-3, 1.5e-3, 0.01, -0.02, 0.015])  # m and rad: 15 px in the image


def camera(T: F64 | None = None) -> Camera:
    K = np.array([[580.0, 0, 319.5], [0, 575.0, 255.5], [0, 0, 1]])
    return Camera(640, 512, K, np.eye(4) if T is None else T)


# ---- the fit ---------------------------------------------------------------------------------------------


def seen_points(T: F64, stray: float, noise: float = 0.0, measured: float = 0.7) -> tuple[F32, F32, F32]:
    """Points [M, 3] at rest, and pixels and disparities at which a camera at T sees them; the share `stray`
    of them, all on one side of the image, has moved by 5 mm as one."""
    rng = np.random.default_rng(0)
    pixels = rng.uniform([0, 0], [640, 512], (800, 2))
    pixels = pixels[np.argsort(pixels[:, 0])]
    depths = rng.uniform(0.06, 0.09, 800)
    rest = np.stack([(pixels[:, 0] - 319.5) / 580 * depths, (pixels[:, 1] - 255.5) / 575 * depths, depths], 1)
    now = rest.copy()
    now[: int(stray * len(now))] += [3e-3, 1e-3, -4e-3]
    found, z = project(camera(T), now)
    found = found + noise * rng.normal(size=found.shape)
    disparities = np.where(rng.random(800) < measured, 580 * BASELINE / z, 0)
    return rest.astype(np.float32), found.astype(np.float32), disparities.astype(np.float32)


def error_mm_deg(T: F64, true: F64) -> tuple[float, float]:
    error = invert(true) @ T
    return (
        float(np.linalg.norm(error[:3, 3])) * 1e3,
        float(np.degrees(np.linalg.norm(cv2.Rodrigues(error[:3, :3])[0]))),
    )


@pytest.mark.parametrize("measured", [0.0, 0.7])
@pytest.mark.parametrize("stray", [0.0, 0.3])
def test_a_planted_motion_is_recovered_exactly(stray: float, measured: float) -> None:
    true = invert(exponential(MOTION))
    fit = fit_pose(*seen_points(true, stray, measured=measured), camera(), BASELINE)
    mm, degrees = error_mm_deg(fit.T_world_cam, true)
    assert mm < 1e-3 and degrees < 1e-3
    assert fit.inliers == round(800 * (1 - stray))
    assert not (fit.weights[: int(800 * stray)] > 0.1).any()
    noisy = fit_pose(*seen_points(true, stray, 0.4, measured), camera(), BASELINE)  # px: it is averaged out
    mm, degrees = error_mm_deg(noisy.T_world_cam, true)
    assert mm < 0.1 and degrees < 0.05


def test_what_is_not_finite_or_behind_the_camera_has_no_say() -> None:
    true = invert(exponential(MOTION))
    points, pixels, disparities = seen_points(true, 0.0)
    points[0], points[1], points[2], points[3] = np.nan, np.inf, -1.0, 1e30
    pixels[4], disparities[5] = np.nan, np.inf
    fit = fit_pose(points, pixels, disparities, camera(), BASELINE)
    assert error_mm_deg(fit.T_world_cam, true)[0] < 1e-3
    assert fit.weights[:6].max() < 1e-9


def test_nothing_to_go_by_leaves_the_start() -> None:
    start = invert(exponential(MOTION))
    none = np.zeros((0, 3), np.float32), np.zeros((0, 2), np.float32), np.zeros(0, np.float32)
    assert np.allclose(fit_pose(*none, camera(start), BASELINE).T_world_cam, start, atol=1e-9)


# ---- errors of trajectories ------------------------------------------------------------------------------


def test_trajectories_are_aligned_at_the_first_frame_and_their_errors_are_those_planted() -> None:
    steps = [exponential(0.2 * k * MOTION) for k in range(6)]
    known = np.stack(steps)
    other_world = exponential(np.array([0.1, -0.2, 0.3, 0.5, -0.4, 0.3]))
    assert max(trajectory_errors(other_world @ known, known).values()) < 1e-5
    wrong = known.copy()
    wrong[3, :3, 3] += known[3, :3, 0] * 1e-3  # one place, by 1 mm
    errors = trajectory_errors(wrong, known)
    assert errors["ate_mm"] == pytest.approx(np.sqrt(1 / 6), rel=1e-6)
    assert errors["max_mm"] == pytest.approx(1, rel=1e-6)
    assert errors["rpe_mm"] == pytest.approx(np.sqrt(2 / 5), rel=1e-6)
    assert errors["rpe_deg"] == pytest.approx(0, abs=1e-6)


# ---- the moving phantom ----------------------------------------------------------------------------------

Followed = tuple[Frames, list[FrameResult]]
Given = tuple[Frames, Pipeline, list[FrameResult]]
RATE = 15.0  # frames per second: the scope moves by up to 0.6 mm and 0.5 degrees from frame to frame


@pytest.fixture(scope="module")
def still(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """2 s in which the scope and the instruments move."""
    return rendered(tmp_path_factory, still_tissue=True)


@pytest.fixture(scope="module")
def deforming(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """2 s in which the tissue moves too: all of it with the breath, by 1.2 mm; some is pulled by 12 mm."""
    return rendered(tmp_path_factory, still_tissue=False)


def rendered(factory: pytest.TempPathFactory, still_tissue: bool) -> Path:
    folder = factory.mktemp("moving") / "session"
    shape = PhantomScene(seconds=2, width=320, height=256, camera_motion="sway", still_tissue=still_tissue)
    write_session(shape, folder, RATE)
    return folder


def opened(folder: Path, pose: str = "estimate") -> tuple[Pipeline, Frames]:
    session = open_session(folder, ["source.pace:=step", f"vision.pose:={pose}"])
    return Pipeline(session.config, session.rig), frames_of(session)


def play(pipeline: Pipeline, frames: Iterable[StereoFrame]) -> list[FrameResult]:
    return [pipeline.process(frame, StepBudget(1)) for frame in frames]


@pytest.fixture(scope="module")
def followed(still: Path) -> Followed:
    """All of `still`, with the pose estimated."""
    pipeline, frames = opened(still)
    return frames, play(pipeline, frames)


@pytest.fixture(scope="module")
def given(still: Path) -> Given:
    """Its first frames, with the poses of the session."""
    pipeline, frames = opened(still, "session")
    return frames[:7], pipeline, play(pipeline, frames[:7])


def errors(results: list[FrameResult], frames: Frames) -> dict[str, float]:
    shown = np.stack([result.pair.camera.T_world_cam for result in results])
    return trajectory_errors(shown, np.stack([frame.T_world_cam for frame in frames]))


def test_over_still_tissue_the_path_is_true_to_a_fraction_of_a_millimetre(
    still: Path, followed: Followed
) -> None:
    frames, results = followed
    found = errors(results, frames)
    assert found["ate_mm"] < 0.2 and found["rpe_mm"] < 0.08 and found["rpe_deg"] < 0.06, found
    fixed, _ = opened(still, "fixed")
    assert errors(play(fixed, frames), frames)["ate_mm"] > 2


def test_deforming_tissue_costs_no_more_than_the_motion_it_shares(deforming: Path) -> None:
    pipeline, frames = opened(deforming)
    results = play(pipeline, frames)
    found = errors(results, frames)
    assert found["ate_mm"] < 2.0 and found["max_mm"] < 3.5, found
    assert {result.epoch for result in results} == {0}
    assert not any("pose" in result.skipped for result in results)


def test_eval_gives_the_errors_of_the_path_and_measures_all_else_in_the_estimated_world(still: Path) -> None:
    options = MeasureOptions(hold_out=4, every=100)
    runs = {
        pose: evaluate(still, [f"vision.pose:={pose}", "source.frames:=14"], options, iterations=1).summary
        for pose in ("session", "estimate", "fixed")
    }
    estimated, fixed = runs["estimate"]["pose"], runs["fixed"]["pose"]
    assert runs["session"]["pose"] is None
    assert estimated["ate_mm"] < 0.2 and estimated["rigid_ate_mm"] < 0.5
    assert fixed["ate_mm"] > 1 and fixed["rigid_ate_mm"] == estimated["rigid_ate_mm"]
    for group, figure, tolerance in (("heldout", "psnr", 1.0), ("track", "median_mm", 0.1)):
        given, found = (runs[pose][group][figure] for pose in ("session", "estimate"))
        assert abs(found - given) < tolerance, (group, given, found)


def test_instruments_in_nearly_half_of_the_picture_do_not_pull_the_pose(still: Path) -> None:
    pipeline, frames = opened(still)
    rng = np.random.default_rng(0)
    texture = cv2.GaussianBlur(rng.normal(0, 1, (256, 640, 3)).astype(np.float32), (0, 0), 3)
    sliding = (128 + 200 * texture).clip(0, 255).astype(np.uint8)

    def covered(k: int, frame: StereoFrame) -> StereoFrame:
        """The left 40 % are a textured instrument that slides by 4 px a frame, beside those there."""
        left, right, tissue = frame.left.copy(), frame.right.copy(), frame.tissue.copy()
        left[:, :128] = right[:, :128] = sliding[:, 4 * k : 4 * k + 128]
        tissue[:, :128] = False
        return replace(frame, left=left, right=right, tissue=tissue)

    found = errors(play(pipeline, (covered(k, frame) for k, frame in enumerate(frames))), frames)
    assert found["ate_mm"] < 0.45 and found["rpe_deg"] < 0.08, found


@pytest.mark.fault("image: black for a second, scope moving")
def test_after_a_blackout_of_a_second_the_same_model_goes_on(deforming: Path) -> None:
    pipeline, frames = opened(deforming)
    first, last = 4, 4 + round(RATE)
    dark = [both(frame, np.zeros_like) for frame in frames[first:last]]
    results = play(pipeline, [*frames[:first], *dark])
    held = results[first:]
    assert all("black" in result.held for result in held) and "left_eye_black" in by_code(pipeline.warnings)
    for result in held:
        assert np.array_equal(result.pair.camera.T_world_cam, results[first - 1].pair.camera.T_world_cam)
        assert np.array_equal(result.snapshot.gaussians.means, results[first - 1].snapshot.gaussians.means)
        assert not result.observation.depth.any() and not result.snapshot.velocities.any()
        assert result.snapshot.frame_id == result.pair.frame_id
    back = play(pipeline, frames[last:])
    after = [result for result in back if not result.held]
    assert len(back) - len(after) <= RATE / 2  # half a second: it may have to be verified first
    assert {result.epoch for result in back} == {0} and "pose" not in pipeline.warnings
    assert np.isin(after[0].snapshot.gaussians.ids, held[0].snapshot.gaussians.ids).mean() > 0.9
    assert max(psnr(result) for result in after) > psnr(results[first - 1]) - 1
    shown = results[:first] + after
    taken = [frame for frame, result in zip(frames[last:], back, strict=True) if not result.held]
    assert errors(shown, [*frames[:first], *taken])["max_mm"] < 3.5


@pytest.mark.parametrize("gap", [0.0, 5.0])
def test_another_scene_begins_a_new_model_at_the_last_pose(still: Path, gap: float) -> None:
    """A second of a gap counts: nobody knows what was to be seen in the rest of it."""
    pipeline, frames = opened(still)
    tissue = np.ones(frames[0].left.shape[:2], bool)
    other = replace(both(frames[0], lambda eye: 255 - eye), tissue=tissue)
    before = play(pipeline, frames[:4])
    # The first frame finds the camera lost, the next is the first of those that show something else.
    stamps = frames[4].t_capture_ns + np.arange(0, 3e9 + 2e9 / RATE, 1e9 / RATE).astype(np.int64)
    stamps[5:] += round(gap * 1e9)
    watched = np.cumsum(np.minimum(np.diff(stamps, prepend=stamps[0]), 1e9))
    shown = (replace(other, frame_id=4 + k, t_capture_ns=int(stamp)) for k, stamp in enumerate(stamps))
    results = play(pipeline, shown)
    given_up = int(np.searchsorted(watched - watched[1], 3e9))
    assert all("pose" in result.skipped and result.epoch == 0 for result in results[:given_up])
    new = results[given_up]
    assert new.epoch == 1 and "pose" not in new.skipped and psnr(new) > 25
    assert np.array_equal(new.pair.camera.T_world_cam, before[-1].pair.camera.T_world_cam)


def test_how_the_tissue_was_seen_first_says_where_the_camera_is_though_places_at_rest_crept(
    given: Given,
) -> None:
    frames, pipeline, results = given
    for frame, result in zip(frames, results, strict=True):  # as nobody asked for an estimate
        assert np.array_equal(result.pair.camera.T_world_cam, frame.T_world_cam)
    first, last = results[0].observation, results[-1].observation
    views = FirstViews(pipeline.map)
    assert views.pose(first, first.camera.T_world_cam) is None
    views.offer(first, first.camera.T_world_cam)
    true = last.camera.T_world_cam
    crept = exponential(np.array([1e-3, 0.5e-3, 0, 0, 0.01, 0]))  # 1.1 mm, 0.6 degrees
    found = views.pose(last, crept @ true)
    assert found is not None and error_mm_deg(crept @ true, true)[0] > 1
    mm, degrees = error_mm_deg(found, true)
    assert mm < 0.3 and degrees < 0.2, (mm, degrees)
    upside_down = replace(last, gray=np.ascontiguousarray(last.gray[::-1]))
    assert views.pose(upside_down, true) is None  # other tissue tells no pose


def test_of_several_pictures_the_oldest_says_where_the_camera_is(given: Given) -> None:
    _, pipeline, results = given
    seen = results[-1].observation
    pose, aside, drifted = (seen.camera.T_world_cam.copy() for _ in range(3))
    aside[0, 3] += 0.012  # m: so far that the next image is kept beside it
    drifted[1, 3] += 0.001  # m: what a later image may have taken over
    first, later = (seen, aside), (replace(seen, camera=replace(seen.camera, T_world_cam=drifted)), pose)
    errors = []
    for offered in ([first, later], [later]):
        views = FirstViews(pipeline.map)
        for each in offered:
            views.offer(*each)
        errors.append(error_mm_deg(views.pose(seen, pose), pose)[0])
    assert errors[0] < 0.3 and errors[1] > 0.7


def test_places_at_rest_that_lost_their_shape_do_not_move_the_camera(still: Path) -> None:
    pipeline, frames = opened(still)
    results = play(pipeline, frames[:7])
    deformation = pipeline.map.deformation
    rest = deformation.rest
    rest += np.float32(0.02) * (rest - rest.mean(0))  # as a camera sees it that is 1.5 mm nearer
    results += play(pipeline, frames[7:22])
    assert errors(results, frames[:22])["max_mm"] < 0.3


def test_a_scope_known_to_be_fixed_changes_nothing_where_it_is() -> None:
    """The same numbers, bit for bit, as with the poses of a session whose scope stands still."""
    runs = []
    for pose in ("session", "fixed"):
        pipeline, frames = opened(SESSION, pose)
        runs.append(play(pipeline, frames[:8]))
    for given, fixed in zip(*runs, strict=True):
        assert np.array_equal(given.pair.camera.T_world_cam, fixed.pair.camera.T_world_cam)
        assert np.array_equal(given.snapshot.gaussians.means, fixed.snapshot.gaussians.means)
        assert np.array_equal(given.views["left"].rgb, fixed.views["left"].rgb)
