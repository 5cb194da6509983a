"""The camera on the robot's hand, found again: by the phantom's poses, and in a bag with drawn boards."""

import runpy
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from bag_files import ROS2, Row, image, write_rosbag2
from command_line import figures_of, ran
from drawn_boards import charuco_print, known_rig
from places import ROOT

from sags_node.config.launch_file import load_launch
from sags_node.engine.rasterizer.rasterize import Drawer
from sags_node.errors import SagsError, UsageError
from sags_node.geometry import invert
from sags_node.messaging import cdr, topics
from sags_node.phantom.board import draw, fine_rays
from sags_node.phantom.motion import scope_pose
from sags_node.phantom.rig import phantom_rig
from sags_node.pipeline.session import Session, open_session
from sags_node.rig import save_rig
from sags_node.rig.hand_eye import HandEye, read_hand_eye, save_hand_eye
from sags_node.sources.pose_track import PoseTrack
from sags_node.sources.robot import open_robot
from sags_node.sources.source import open_source
from sags_node.tools.calibration.boards import StereoView
from sags_node.tools.calibration.hand_eye_solve import solve_hand_eye
from sags_node.tools.calibration.pictures import spread
from sags_node.tools.evaluation.measure import MeasureOptions
from sags_node.tools.evaluation.session import evaluate
from sags_node.tools.fitting.clip import read_clip
from sags_node.types import F32, F64, Camera, Gaussians

S, MS = 1_000_000_000, 1_000_000
START = 1_700_000_000 * S
RIG = phantom_rig(640, 512)
PERIOD = 4.0  # s, of the phantom's sway


def rigid(turn: tuple[float, float, float], place: tuple[float, float, float]) -> F64:
    T = np.eye(4)
    T[:3, :3] = cv2.Rodrigues(np.radians(turn))[0]
    T[:3, 3] = place
    return T


X = rigid((8, -25, 70), (0.012, -0.031, 0.22))  # the left raw camera on the hand: a scope of 22 cm
T_BASE_WORLD = rigid((30, 10, -50), (0.4, -0.2, 0.6))
T_RAW_RECTIFIED = np.eye(4)
T_RAW_RECTIFIED[:3, :3] = RIG.left.R.T


def camera_at(t: float, scale: float = 1.0) -> F64:
    """The left raw camera in the robot's base, where the phantom's scope is after t seconds.

    `scale`: of its sway; its own is 1.7 degrees."""
    sway = scope_pose((t / PERIOD) % 1.0, "sway")
    sway[:3, :3] = cv2.Rodrigues(scale * cv2.Rodrigues(sway[:3, :3])[0])[0]
    return T_BASE_WORLD @ sway @ invert(T_RAW_RECTIFIED)


def hand_at(t: float, scale: float = 1.0) -> F64:
    return camera_at(t, scale) @ invert(X)


def tracked(
    offset_ms: float,
    seconds: float,
    scale: float = 1.0,
    rate: int = 100,
    unit: float = 1.0,
    noise: float = 0.0,
) -> PoseTrack:
    """The robot's poses; its clock is `offset_ms` ahead of the images', its length 1 is 1 m / `unit`.

    `noise`: of each, degrees, and half as many mm; one standard deviation along each axis."""
    track, rng = PoseTrack(), np.random.default_rng(3)
    for number in range(round((seconds + 1) * rate)):
        t = number / rate - 0.5
        stamp = START + round((t * 1e3 + offset_ms) * MS)
        x, y, z, *place = rng.normal(0, noise, 6)
        hand = hand_at(t, scale) @ rigid((x, y, z), tuple(0.5e-3 * np.array(place)))
        hand[:3, 3] *= unit
        (part,) = cdr.pose(hand, stamp).parts
        track.add(bytes(part), cdr.POSE)
    return track


def grid() -> F32:
    x, y = np.meshgrid(np.arange(9), np.arange(6))
    return (np.stack([x - 4, y - 2.5, 0 * x], -1).reshape(-1, 3) * 0.0045).astype(np.float32)


def seen(scale: float) -> tuple[list[StereoView], list[int]]:
    """The corners of a board 70 mm before the scope, ten times a second, with noise of 0.1 px."""
    rng = np.random.default_rng(8)
    board = camera_at(0) @ rigid((12, -8, 3), (0, 0, 0.07))
    views, stamps = [], []
    for number in range(round(PERIOD * 10)):
        left = invert(camera_at(number / 10, scale)) @ board
        corners = []
        for eye, T in ((RIG.left, left), (RIG.right, RIG.T_right_left @ left)):
            drawn, _ = cv2.projectPoints(grid(), T[:3, :3], T[:3, 3], eye.K, eye.distortion)
            corners.append((drawn.reshape(-1, 2) + rng.normal(0, 0.1, (54, 2))).astype(np.float32))
        views.append(StereoView(str(number), np.arange(54), *corners))
        stamps.append(START + round(number / 10 * S))
    return views, stamps


def errors(found: F64) -> tuple[float, float]:
    """mm and degrees."""
    apart = invert(X) @ found
    turn = np.linalg.norm(cv2.Rodrigues(apart[:3, :3])[0])
    return float(np.linalg.norm(found[:3, 3] - X[:3, 3]) * 1e3), float(np.degrees(turn))


@pytest.mark.parametrize(("scale", "offset_ms"), [(1.0, 37.0), (6.0, -120.0), (6.0, 0.0)])
def test_it_is_found_on_the_phantoms_path(scale: float, offset_ms: float) -> None:
    """Also from its own sway of 1.7 degrees alone, with the corners' usual noise of 0.1 px."""
    track = tracked(offset_ms, PERIOD, scale)
    views, stamps = seen(scale)
    solution = solve_hand_eye(views, stamps, grid(), RIG, track.at)
    place, turn = errors(solution.hand_eye.T_hand_cam)
    assert place < 0.3 and turn < 0.2
    assert solution.hand_eye.offset_ns * 1e-6 == pytest.approx(offset_ms, abs=5)
    # What it says of itself: a deviation of 0.1 px along each axis, and its own error within four of them.
    assert np.sqrt(np.mean(solution.errors**2)) == pytest.approx(0.1 * np.sqrt(2), rel=0.1)
    assert place < 4e3 * solution.position_error
    assert turn < 4 * np.degrees(solution.rotation_error)


@pytest.mark.parametrize("noise", [0.02, 0.1])
def test_a_robot_that_is_not_exact_costs_no_more_than_its_own_error(noise: float) -> None:
    """Its error moves all corners of a view alike. Of 40 views that turn by 0.12 rad, root mean square, the
    turn follows to noise / 0.12 / sqrt(40) about each axis, to 2.3 times the noise in all: twice that holds.
    """
    views, stamps = seen(6.0)
    solution = solve_hand_eye(views, stamps, grid(), RIG, tracked(0, PERIOD, 6.0, noise=noise).at)
    place, turn = errors(solution.hand_eye.T_hand_cam)
    assert turn < 4.6 * noise
    assert turn < 4 * np.degrees(solution.rotation_error) and place < 4e3 * solution.position_error


def test_a_scope_that_turns_about_one_point_is_calibrated(monkeypatch: pytest.MonkeyPatch) -> None:
    """So it does in a trocar. Then lengths cannot be compared: a longer scope is seen alike."""

    def pivoted(t: float, scale: float = 1.0) -> F64:
        a = 2 * np.pi * t / PERIOD
        turn = rigid((180 + 10 * np.sin(a), 12 * np.cos(a), 15 * np.sin(2 * a)), (0, 0, 0))
        return turn @ rigid((0, 0, 0), (0, 0, 0.1)) @ X

    monkeypatch.setitem(globals(), "camera_at", pivoted)
    views, stamps = seen(1.0)
    place, _ = errors(solve_hand_eye(views, stamps, grid(), RIG, tracked(0, PERIOD).at).hand_eye.T_hand_cam)
    assert place < 0.3


NO_POSE = r"0 of 40 views .* Frame 2\d: the robot's .*"


@pytest.mark.parametrize(
    ("scale", "views", "late", "robot", "said"),
    [
        pytest.param(0.0, 40, 0, {}, "turn the scope about two different axes", id="it only shifts"),
        # A board that was printed to fit the page: the stereo calibration is wrong by as much.
        pytest.param(6.0, 40, 0, {"unit": 1.05}, "moved 0.952 times as far as the robot", id="large print"),
        pytest.param(6.0, 40, 0, {"unit": 0.97}, "moved 1.031 times as far as the robot", id="small print"),
        pytest.param(1.0, 40, 60, {}, "0 of 40 views .*; 20 are needed.* has stopped", id="of another time"),
        pytest.param(1.0, 9, 0, {}, r"9 of 9 views .* 10 are needed.* larger --views", id="few views"),
        # 1.5 s of poses, ten images a second
        pytest.param(1.0, 40, 0, {"seconds": 0.5}, r"15 of 40 views .* 20 are needed", id="few poses"),
        pytest.param(1.0, 40, 0, {"unit": 1e3}, NO_POSE + "are its lengths in metres", id="jumps, of mm"),
        pytest.param(1.0, 40, 0, {"rate": 5}, NO_POSE + "poses are 0.20 s apart", id="five poses a second"),
    ],
)
def test_why_it_cannot_be_found_is_said(scale: float, views: int, late: int, robot: Any, said: str) -> None:
    track = tracked(**({"offset_ms": 3, "seconds": PERIOD, "scale": scale} | robot))
    shown, stamps = seen(scale)
    with pytest.raises(SagsError, match=said):
        solve_hand_eye(shown[:views], [stamp + late * S for stamp in stamps[:views]], grid(), RIG, track.at)


# ---- the file --------------------------------------------------------------------------------------------


def test_the_file_says_what_was_saved(tmp_path: Path) -> None:
    save_hand_eye(HandEye(X, -12_345_678), tmp_path, {"views": 3})
    read = read_hand_eye(tmp_path / "hand_eye.yaml")
    assert np.allclose(read.T_hand_cam, X, atol=1e-12) and read.offset_ns == -12_345_678


SAME = f"T_hand_cam: {np.eye(4).tolist()}"


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (None, "sags calib hand-eye"),
        ("{}", "4 rows of 4"),
        ("T_hand_cam: [[1, 0], [0, 1]]", "no rotation"),
        (f"T_hand_cam: {(2 * np.eye(4)).tolist()}", "no rotation"),
        (f"T_hand_cam: {rigid((0, 0, 0), (0, 0, 220)).tolist()}", "220 m from the hand"),
        (f"{SAME}\noffset_ms: .inf", "offset_ms a number"),
        (f"{SAME}\noffset_ms: yes", "offset_ms a number"),
        (SAME.replace("1.0", "true"), "4 rows of 4 numbers"),
        (f"{SAME}\noffset_s: 0.04", "unknown key 'offset_s'; known: T_hand_cam, offset_ms"),
    ],
)
def test_a_missing_or_wrong_file_is_said(tmp_path: Path, content: str | None, said: str) -> None:
    file = tmp_path / "hand_eye.yaml"
    if content is not None:
        file.write_text(content)
    with pytest.raises(UsageError, match=said):
        read_hand_eye(file)


# ---- a recording -----------------------------------------------------------------------------------------

VIEWS, RATE = 24, 10
ROBOT = ["robot.kind:=bag", "robot.topic:=/ECM/measured_cp"]
CHESS = "--squares 10x7 --square-mm 4.5".split()
BOARD = [*CHESS, *"--board charuco --marker-mm 3.375 --dictionary 4X4_50".split()]


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A board drawn through the exact model of a rig, and the robot's poses, 60 ms ahead, in two ways."""
    rig = known_rig()
    left, right, printed = fine_rays(rig.left), fine_rays(rig.right), charuco_print()
    board = camera_at(0) @ rigid((12, -8, 3), (-0.018, -0.012, 0.065))
    rows: list[Row] = []
    for number in range(VIEWS):
        view = invert(camera_at(number / RATE, 5.0)) @ board
        stamp = START + round(number * S / RATE)
        for eye, rays, T in (("left", left, view), ("right", right, rig.T_right_left @ view)):
            rows.append((f"/rig/{eye}/image_raw", image(ROS2, draw(printed, rays, T), stamp), stamp))
    turned_arm = rigid((0, 0, 90), (0.1, 0.2, 0.3))
    for number in range(-50, 100 * VIEWS // RATE + 50):
        stamp, hand = START + number * 10 * MS + 60 * MS, hand_at(number / 100, 5.0)
        rows.append(("/ECM/measured_cp", pose_message(hand, stamp), stamp))
        rows.append(("/tf", transform_message("base", "arm", hand @ invert(turned_arm), stamp), stamp))
    rows.append(("/tf_static", transform_message("arm", "tip", turned_arm, START), START))
    rows.sort(key=lambda row: row[2])
    folder = tmp_path_factory.mktemp("hand_eye")
    save_rig(rig, folder / "rig")
    return write_rosbag2(folder / "bag", rows)


def pose_message(T: F64, stamp: int) -> Any:
    return ROS2.deserialize_cdr(bytes(cdr.pose(T, stamp).parts[0]), cdr.POSE)


def transform_message(parent: str, child: str, T: F64, stamp: int) -> Any:
    types, told = ROS2.types, pose_message(T, stamp)
    place, turn = told.pose.position, told.pose.orientation
    moved = types["geometry_msgs/msg/Transform"](
        types["geometry_msgs/msg/Vector3"](place.x, place.y, place.z), turn
    )
    head = types["std_msgs/msg/Header"](told.header.stamp, parent)
    return types[topics.TF]([types["geometry_msgs/msg/TransformStamped"](head, child, moved)])


def exact_pose(number: int, session: Session) -> F64:
    """Of the rectified camera in that frame of the recording."""
    exact = camera_at(number / RATE, 5.0)
    exact[:3, :3] = exact[:3, :3] @ session.rig.left.R.T
    return exact


def test_from_a_bag_to_poses_of_the_camera(recording: Path) -> None:
    """`sags calib hand-eye` writes what makes each frame's pose right, from `measured_cp` and from `tf`."""
    rig = recording.parent / "rig"
    summary = figures_of("calib", "hand-eye", recording, f"rig:={rig}", *ROBOT, *BOARD, "-o", rig, "--json")
    assert summary["views"] >= VIEWS - 2 and summary["error_px"] < 0.3
    hand_eye = read_hand_eye(rig / "hand_eye.yaml")
    place, turn = errors(hand_eye.T_hand_cam)
    assert place < 0.3 and turn < 0.2
    assert hand_eye.offset_ns * 1e-6 == pytest.approx(60, abs=5)

    for robot in (ROBOT, ["robot.kind:=bag", "robot.base:=base", "robot.hand:=tip"]):
        session = open_session(recording, [f"rig:={rig}", *robot, "source.pace:=step", "source.rate:=5"])
        with session.source as source:
            frames = list(source)
        assert len(frames) == VIEWS
        for number, frame in enumerate(frames):
            assert frame.pose_problem is None and frame.T_world_cam is not None
            exact = exact_pose(number, session)
            assert np.linalg.norm(frame.T_world_cam[:3, 3] - exact[:3, 3]) < 0.3e-3
            assert np.abs(frame.T_world_cam[:3, :3] - exact[:3, :3]).max() < np.radians(0.2)


@pytest.mark.parametrize(("start", "frames"), [(0.0, 13), (0.5, 13), (0.7, None), (1.1, 13)])
def test_views_are_spread_over_what_is_played(recording: Path, start: float, frames: int | None) -> None:
    """Before and after it the board may have been moved."""
    config = load_launch(recording, [f"source.start:={start}", f"source.frames:={frames or 'null'}"])
    whole = range(VIEWS)[round(start * RATE) :][:frames]
    for count in (2, 3, 5, 10, 40):
        with open_source(spread(config.source, count), references=False) as source:
            numbers = [frame.recorded_number for frame in source]
        assert set(numbers) <= set(whole) and len(numbers) >= min(count, len(whole))
        steps = set(np.diff(numbers))
        assert steps == {max(1, len(whole) // count)}


def test_the_example_gives_what_it_says(tmp_path: Path) -> None:
    """examples/record_board.py, and the command that its first lines name."""
    example = runpy.run_path(str(ROOT / "examples/record_board.py"))
    example["record"](tmp_path / "board", seconds=2.0)
    bag, rig = tmp_path / "board/bag", tmp_path / "board/rig"
    code, stdout, stderr = ran("calib", "hand-eye", bag, f"rig:={rig}", *ROBOT, *CHESS, "-o", rig)
    assert code == 0, stdout + stderr
    found = read_hand_eye(rig / "hand_eye.yaml")
    assert np.linalg.norm(found.T_hand_cam[:3, 3] - example["T_HAND_CAMERA"][:3, 3]) < 0.3e-3
    assert found.offset_ns * 1e-9 == pytest.approx(example["AHEAD_S"], abs=0.005)


def test_fits_and_figures_know_where_the_robot_says_the_scope_is(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    save_hand_eye(HandEye(X, 60 * MS), tmp_path, {})
    played = [
        f"rig:={recording.parent / 'rig'}", *ROBOT, f"robot.hand_eye:={tmp_path / 'hand_eye.yaml'}",
        "source.pace:=step", "source.rate:=5", "mapping.max_gaussians:=2000",
        "vision.width:=160", "vision.height:=120",
    ]  # fmt: skip
    drawn: list[Camera] = []  # from where the figures' images were

    forward = Drawer.forward

    def noting(drawer: Drawer, gaussians: Gaussians, camera: Camera) -> F32:
        drawn.append(camera)
        return forward(drawer, gaussians, camera)

    monkeypatch.setattr(Drawer, "forward", noting)
    session = open_session(recording, [*played, "source.frames:=4"])
    clip = read_clip(session, lambda number: number == 1)
    measured = evaluate(recording, [*played, "source.frames:=4"], MeasureOptions(hold_out=4), iterations=0)
    held_out = [row.frame_id for row in measured.rows if "heldout" in row.figures]
    assert held_out == [frame.frame_id for frame in clip.test] == [1] and len(clip.train) == 3

    def off(number: int, camera: Camera) -> float:
        """m, from where the camera was in that frame."""
        return float(np.linalg.norm((camera.T_world_cam - exact_pose(number, session))[:3, 3]))

    for frame in (*clip.train, *clip.test):
        assert off(frame.frame_id, frame.camera) < 0.1e-3
        assert (off(1, frame.camera) < 0.1e-3) == (frame.frame_id == 1)
    assert min(off(1, camera) for camera in drawn) < 0.1e-3

    # The poses end 2.95 s after the first image: a second later there is none for the last four.
    late = open_session(recording, [*played, "robot.offset_ms:=1000"])
    assert len(read_clip(late, lambda number: False).train) == 20
    assert "4 frames are left out, since the robot tells no pose of them" in caplog.text


def test_topics_that_hold_no_pose_are_named(recording: Path) -> None:
    config = load_launch(recording, ["robot.kind:=bag", "robot.topic:=/ECM/measured_js"])
    with pytest.raises(UsageError, match="on /ECM/measured_js; topics with poses: /ECM/measured_cp, /tf"):
        open_robot(config)
