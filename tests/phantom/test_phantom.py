"""The phantom: its truth must be true, its sessions complete, repeatable and periodic."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from sags_node.config.launch_file import load_launch, section_of
from sags_node.config.schema import FoldersSource, PhantomSource
from sags_node.errors import UsageError
from sags_node.geometry import invert, transform
from sags_node.phantom import cached_session, write_session
from sags_node.phantom.motion import CENTRE, Clock, scope_pose
from sags_node.phantom.relief import make_relief
from sags_node.phantom.rig import phantom_rig, raw_rays
from sags_node.phantom.scene import Phantom, PhantomFrame, PhantomScene
from sags_node.phantom.tissue import LIFT, Tissue
from sags_node.rig import load_rig
from sags_node.types import F64, Eye

TINY = PhantomScene(seconds=0.1, width=96, height=80)
COUNT = 8
LIFTED = 4  # the frame of COUNT in which the fold is held up


@pytest.fixture(scope="module")
def swaying() -> Phantom:
    """A clean scene with a moving scope."""
    return Phantom(PhantomScene(width=320, height=256, noise=0, camera_motion="sway"))


@pytest.fixture(scope="module")
def frames(swaying: Phantom) -> list[PhantomFrame]:
    return [swaying.frame(index, COUNT) for index in range(COUNT)]


def pinhole(eye: Eye, points: F64) -> F64:
    """Rectified pixels [P, 2] of points [P, 3] in this eye's rectified axes."""
    homogeneous = points @ eye.P[:, :3].T
    return homogeneous[:, :2] / homogeneous[:, 2:]


def raw_pixels(eye: Eye, points: F64) -> F64:
    """Distorted pixels [P, 2] of points [P, 3] in this eye's rectified axes."""
    raw = points @ eye.R
    return cv2.projectPoints(raw, np.zeros(3), np.zeros(3), eye.K, eye.distortion)[0].reshape(-1, 2)


def sample(picture: np.ndarray, pixels: F64) -> np.ndarray:
    return cv2.remap(picture.astype(np.float32), pixels.astype(np.float32)[:, None], None, cv2.INTER_LINEAR)[
        :, 0
    ]


def in_camera(frame: PhantomFrame, points: F64) -> F64:
    return np.asarray(transform(invert(frame.T_world_cam), points))


# ---- truth -----------------------------------------------------------------------------------------------


def test_raw_rays_hit_their_own_pixels_and_rectification_is_real_work() -> None:
    rig = phantom_rig(640, 512)
    for eye in (rig.left, rig.right):
        u, v = np.meshgrid(np.arange(640), np.arange(512))
        pixels = raw_pixels(eye, raw_rays(eye).reshape(-1, 3))
        assert np.abs(pixels - np.stack([u, v], -1).reshape(-1, 2)).max() < 1e-4
        corner = np.array([[0.4, 0.3, 1.0]])
        assert np.linalg.norm(raw_pixels(eye, corner) - pinhole(eye, corner)) > 4
    assert 0.1 < np.degrees(np.linalg.norm(cv2.Rodrigues(rig.T_right_left[:3, :3])[0])) < 1.0
    assert rig.baseline == pytest.approx(0.0043, rel=1e-3)


def test_depth_is_the_depth_of_the_tracked_points(swaying: Phantom, frames: list[PhantomFrame]) -> None:
    errors = []
    for frame in frames:
        local = in_camera(frame, frame.points)[frame.visible]
        pixels = pinhole(swaying.rig.left, local)
        covered = sample(frame.depth == 0, pixels) > 0  # next to an instrument
        errors.append((sample(frame.depth, pixels) - local[:, 2])[~covered])
        assert (~covered).sum() > 120
    error = np.abs(np.concatenate(errors))
    assert np.median(error) < 2e-5  # m
    assert np.quantile(error, 0.95) < 2e-4  # interpolation over a pixel on the flanks of the loops


def test_both_eyes_show_the_same_surface(swaying: Phantom, frames: list[PhantomFrame]) -> None:
    """Colour at the true projections agrees between the raw eyes; with depth 10 % wrong it does not."""
    rig = swaying.rig
    right, wrong = [], []
    for frame in frames:
        local = in_camera(frame, frame.points)[frame.visible]
        left_colors = sample(frame.left, raw_pixels(rig.left, local))
        for scale, residuals in ((1.0, right), (1.1, wrong)):
            assumed = local * scale - [rig.baseline, 0, 0]
            right_colors = sample(frame.right, raw_pixels(rig.right, assumed))
            residuals.append(np.abs(left_colors - right_colors).mean(-1))
    assert np.median(np.concatenate(right)) < 3  # of 255
    assert np.median(np.concatenate(wrong)) > 2 * np.median(np.concatenate(right))


def test_colors_stick_to_the_material(swaying: Phantom, frames: list[PhantomFrame]) -> None:
    """Between frames a tracked point keeps its chroma, though it moves over the image by several pixels."""

    def chroma(frame: PhantomFrame, points: F64) -> np.ndarray:
        colors = sample(frame.left, raw_pixels(swaying.rig.left, in_camera(frame, points)))
        return colors[:, :2] / colors.sum(-1, keepdims=True)

    first, lifted = frames[0], frames[LIFTED]
    both = first.visible & lifted.visible
    before = chroma(first, first.points[both])
    followed = np.abs(chroma(lifted, lifted.points[both]) - before).mean()
    not_followed = np.abs(chroma(lifted, first.points[both]) - before).mean()
    assert followed < 0.7 * not_followed


def test_tool_mask_marks_the_pixels_without_tissue_depth(
    swaying: Phantom, frames: list[PhantomFrame]
) -> None:
    eye = swaying.rig.left
    size = (eye.width, eye.height)
    maps = cv2.initUndistortRectifyMap(eye.K, eye.distortion, eye.R, eye.P, size, cv2.CV_32FC1)
    for frame in frames[1:]:
        tool = cv2.remap(frame.tool.astype(np.float32), *maps, cv2.INTER_LINEAR) > 0.5
        no_depth = frame.depth == 0
        assert tool.sum() > 500
        assert (tool & no_depth).sum() > 0.97 * (tool | no_depth).sum()


def test_points_behind_an_instrument_or_a_fold_are_not_visible(
    swaying: Phantom, frames: list[PhantomFrame]
) -> None:
    eye = swaying.rig.left
    hidden_by_tool = hidden_by_fold = 0
    for frame in frames:
        local = in_camera(frame, frame.points)
        pixels = np.round(pinhole(eye, local)).astype(int)
        inside = ((pixels >= 1) & (pixels < [eye.width - 1, eye.height - 1])).all(-1)
        depth = frame.depth[pixels[inside, 1], pixels[inside, 0]]
        hidden, behind = ~frame.visible[inside], (depth > 0) & (depth < local[inside, 2] - 1e-3)
        hidden_by_tool += int((hidden & (depth == 0)).sum())
        hidden_by_fold += int((hidden & behind).sum())
        assert not (behind & (depth < local[inside, 2] - 3e-3) & ~hidden).any()
    assert hidden_by_tool > 10
    assert hidden_by_fold > 0


# ---- motion ----------------------------------------------------------------------------------------------


def test_grip_is_pulled_by_the_designed_amount_and_let_back() -> None:
    relief = make_relief(np.random.default_rng(0), (0.56, 0.45))
    tissue = Tissue(relief, Clock(4.0))
    at_rest, lifted, back = (tissue.grip(tissue.vertices(phase)) for phase in (0.0, 0.5, 1.0))
    assert 0.010 < np.linalg.norm(LIFT) < 0.015
    assert np.linalg.norm(lifted - at_rest - LIFT) < 0.004  # breathing and heartbeat go on meanwhile
    assert np.abs(back - at_rest).max() < 1e-7


def test_tracks_move_and_the_loop_closes(swaying: Phantom, frames: list[PhantomFrame]) -> None:
    motion = np.linalg.norm(frames[LIFTED].points - frames[0].points, axis=-1)
    assert 0.008 < motion.max() < 0.018
    assert np.median(motion) < 0.004
    again = swaying.frame(COUNT, COUNT)
    assert np.abs(again.points - frames[0].points).max() < 1e-7
    assert np.abs(again.left.astype(int) - frames[0].left).mean() < 0.1


def test_still_tissue_stays_where_the_scope_and_the_instruments_move() -> None:
    phantom = Phantom(TINY.model_copy(update={"still_tissue": True, "camera_motion": "sway"}))
    first, later = phantom.frame(0, 3), phantom.frame(1, 3)
    assert np.array_equal(first.points, later.points)
    assert not np.array_equal(first.T_world_cam, later.T_world_cam)
    assert not np.array_equal(first.tool, later.tool)


def test_a_blackout_takes_the_light_for_its_time_and_smoke_veils_it() -> None:
    phantom = Phantom(TINY.model_copy(update={"blackout": (0.03, 0.06)}))  # of 0.1 s
    clear, dark, lit = Phantom(TINY).frame(1, 3), phantom.frame(1, 3), phantom.frame(2, 3)
    assert dark.left.max() < 30 < lit.left.mean()
    assert dark.right.max() < 30
    assert np.array_equal(dark.T_world_cam, np.eye(4))  # as that of each scope that is to stand still
    assert np.array_equal(dark.depth, clear.depth)
    smoky = Phantom(TINY.model_copy(update={"smoke": 0.8})).frame(1, 3)
    assert smoky.left.std() < 0.8 * clear.left.std()


# ---- sessions --------------------------------------------------------------------------------------------


def session_bytes(folder: Path) -> dict[str, bytes]:
    return {str(f.relative_to(folder)): f.read_bytes() for f in sorted(folder.rglob("*")) if f.is_file()}


def test_same_seed_same_bytes_other_seed_other_pictures(tmp_path: Path) -> None:
    for name, seed in (("a", 3), ("c", 4), ("b", 3)):  # only the last tissue is remembered
        write_session(TINY.model_copy(update={"seed": seed}), tmp_path / name)
    a, b, c = (session_bytes(tmp_path / name) for name in "abc")
    assert a == b
    assert a.keys() == c.keys()
    assert a["left/0001.jpg"] != c["left/0001.jpg"]
    assert a["depth/0001.png"] != c["depth/0001.png"]


def test_session_loads_as_a_launch_file_and_holds_what_it_says(tmp_path: Path) -> None:
    folder = tmp_path / "session"
    seen: list[tuple[int, int]] = []
    write_session(TINY, folder, rate=40.0, progress=lambda done, count: seen.append((done, count)))
    assert seen == [(1, 4), (2, 4), (3, 4), (4, 4)]

    launch = load_launch(folder)
    source = launch.source
    assert isinstance(source, FoldersSource)
    assert source.rate == 40.0
    assert source.tools and source.poses and source.reference.depth and source.reference.tracks
    assert launch.rig and (launch.vision.width, launch.vision.height) == (96, 80)

    truth = Phantom(TINY).frame(2, 4)
    for pictures, expected in ((source.left, truth.left), (source.right, truth.right)):
        files = sorted(pictures.iterdir())
        assert len(files) == 4
        picture = cv2.imread(str(files[2]))[..., ::-1]
        assert np.abs(picture.astype(int) - expected).mean() < 4  # JPEG
    tool = cv2.imread(str(source.tools / "0002.png"), cv2.IMREAD_UNCHANGED)
    assert np.array_equal(tool, np.where(truth.tool, 255, 0))
    depth = cv2.imread(str(source.reference.depth / "0002.png"), cv2.IMREAD_UNCHANGED)
    assert depth.dtype == np.uint16
    assert np.abs(depth * source.reference.depth_unit - truth.depth).max() <= 1.3e-6
    tracks = np.load(source.reference.tracks, allow_pickle=False)
    assert np.array_equal(tracks["points"][2], truth.points)
    assert np.array_equal(tracks["visible"][2], truth.visible)
    assert tracks["points"].shape[0] == len(np.load(source.poses, allow_pickle=False)["T_world_cam"]) == 4
    rig = load_rig(launch.rig)
    assert np.allclose(rig.left.P, phantom_rig(96, 80).left.P, rtol=1e-9)
    assert np.allclose(rig.right.R, phantom_rig(96, 80).right.R, atol=1e-9)


def test_cache_renders_once_and_keys_on_what_shapes_the_pictures(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    rendered: list[int] = []
    first = cached_session(TINY, progress=lambda done, _count: rendered.append(done))
    assert first.parent == tmp_path / "sags"
    assert rendered == [1, 2, 3]
    looped = TINY.model_copy(update={"loop": True})  # replayed differently, drawn the same
    assert cached_session(looped, progress=lambda done, _count: rendered.append(done)) == first
    assert rendered == [1, 2, 3]
    assert cached_session(TINY.model_copy(update={"smoke": 0.5})) != first
    assert cached_session(PhantomSource(seconds=TINY.seconds, width=TINY.width, height=TINY.height)) == first


def test_a_scene_has_keys_that_a_launch_file_lacks() -> None:
    assert section_of(PhantomScene, ["seconds:=2", "smoke:=0.5"]) == PhantomScene(seconds=2, smoke=0.5)
    with pytest.raises(UsageError, match="unknown key 'smok'; did you mean 'smoke'"):
        section_of(PhantomScene, ["smok:=0.5"])
    with pytest.raises(UsageError, match=r"unknown key 'source\.smoke'"):
        load_launch(None, ["source.smoke:=0.5"])


def test_the_scope_zooms_along_its_axis_and_orbits_round_what_it_looks_at() -> None:
    for phase in (0.1, 0.25, 0.6):
        zoomed, orbiting = scope_pose(phase, "zoom"), scope_pose(phase, "orbit")
        assert np.array_equal(zoomed[:3, :3], np.eye(3)) and zoomed[0, 3] == zoomed[1, 3] == 0
        before = transform(invert(orbiting), CENTRE)
        assert before == pytest.approx(CENTRE, abs=1e-12)
        assert np.linalg.norm(orbiting[:3, 3]) > 5e-3
    sways = [np.linalg.norm(scope_pose(phase, "sway")[:3, 3]) for phase in np.linspace(0, 1, COUNT)]
    assert 0.002 < max(sways) < 0.010
    for motion in ("sway", "zoom", "orbit"):
        for end in (0.0, 1.0):
            assert np.allclose(scope_pose(end, motion), np.eye(4))
    assert PhantomSource.model_validate({"camera_motion": True}).camera_motion == "sway"
    assert PhantomSource.model_validate({"camera_motion": False}).camera_motion == "none"


def test_the_scope_goes_round_again_in_a_long_session_and_once_in_a_short_one() -> None:
    assert Clock(120).scope(1 / 17) == pytest.approx(0, abs=1e-9)  # 17 rounds of 7.06 s
    assert Clock(4).scope(0.3) == pytest.approx(0.3)
