"""Poses of a robot: interpolated where they are known, and said where they are not."""

import threading
import time
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from bag_files import ROS2
from frames import Frames, told
from places import SESSION
from waiting import until

from sags_node.client import PoseSender
from sags_node.config.schema import LaunchConfig, PushRobot, PushSource, VisionConfig
from sags_node.errors import SagsError
from sags_node.findings import by_code
from sags_node.mapping.budget import StepBudget
from sags_node.messaging import cdr, topics
from sags_node.phantom.motion import scope_pose
from sags_node.phantom.rig import phantom_rig
from sags_node.pipeline.pipeline import Pipeline
from sags_node.pipeline.session import open_session
from sags_node.rig.hand_eye import HandEye, save_hand_eye
from sags_node.sources.pose_track import JUMP_HELD_NS, NoPoseError, PoseTrack
from sags_node.sources.robot import Posed, open_robot, rectified
from sags_node.types import F64, StereoFrame

MS, S = 1_000_000, 1_000_000_000


def shifted(x: float) -> F64:
    T = np.eye(4)
    T[0, 3] = x
    return T


def moving(seconds: float = 3.0, rate: int = 50, begun: int = 0) -> PoseTrack:
    """A scope that moves by 0.1 m/s."""
    track = PoseTrack()
    for number in range(round(seconds * rate)):
        told(track, shifted(0.1 * number / rate), begun + number * S // rate)
    return track


def problem(track: PoseTrack, t_ns: int) -> str:
    with pytest.raises(NoPoseError) as said:
        track.at(t_ns)
    return said.value.finding.code


def encoded(message: object, kind: str) -> bytes:
    return bytes(ROS2.serialize_cdr(message, kind))


def no_pose(t_ns: int, kind: str = "zeros") -> bytes:
    """What drivers send before the robot is homed, or of a joint that is not there."""
    message = cdr.decode(bytes(cdr.pose(shifted(0.0), t_ns).parts[0]), cdr.POSE)
    turn, place = message.pose.orientation, message.pose.position
    if kind == "zeros":
        turn = replace(turn, w=0.0)
    elif kind == "NaN":
        place = replace(place, x=float("nan"))
    else:
        turn = replace(turn, w=2.0)
    return encoded(replace(message, pose=replace(message.pose, orientation=turn, position=place)), cdr.POSE)


@pytest.mark.fault("robot: NaN, or a quaternion of zeros")
@pytest.mark.parametrize("kind", ["zeros", "NaN", "twice as long"])
def test_a_message_that_is_no_pose_is_none_at_its_time(kind: str) -> None:
    track = moving(1.0)
    with pytest.raises(SagsError, match="numbers that are no pose"):
        track.add(no_pose(S + 20 * MS, kind), cdr.POSE)
    told(track, shifted(0.102), S + 20 * MS)
    np.testing.assert_allclose(track.at(S + 10 * MS)[0, 3], 0.1, atol=2e-3)


def test_of_a_message_with_several_frames_only_the_wrong_one_is_left_out() -> None:
    track = PoseTrack("world", "scope")
    for number in range(3):
        message = cdr.decode(bytes(cdr.transform(shifted(0.1), number * 50 * MS).parts[0]), topics.TF)
        good = replace(
            message.transforms[0],
            header=replace(message.transforms[0].header, frame_id="world"),
            child_frame_id="scope",
        )
        zero = replace(good.transform.rotation, x=0.0, y=0.0, z=0.0, w=0.0)
        wrong = replace(good, child_frame_id="arm", transform=replace(good.transform, rotation=zero))
        with pytest.raises(SagsError, match="the pose of arm"):
            track.add(encoded(replace(message, transforms=[wrong, good]), topics.TF), topics.TF)
    assert track.at(60 * MS)[0, 3] == pytest.approx(0.1)


def test_a_message_that_was_overtaken_ends_nothing() -> None:
    track = PoseTrack()
    for number in (0, 1, 3, 2, 4, 4):
        told(track, shifted(0.002 * number), number * 20 * MS)
    for t_ns in (10 * MS, 50 * MS, 70 * MS):  # 0.1 m/s, from the first sample on
        assert track.at(t_ns)[0, 3] == pytest.approx(1e-10 * t_ns)


def test_a_pose_lies_between_its_neighbours() -> None:
    """The phantom's sway (0.02 m/s^2 and 0.31 rad/s^2) from samples 20 ms apart: a t^2 / 8 at most."""
    track = PoseTrack()
    for number in range(201):
        told(track, scope_pose(number / 200, "sway"), number * 20 * MS)
    straight = 0.02**2 / 8
    for t in np.linspace(0, 3.99, 57):
        off = np.linalg.inv(scope_pose(t / 4, "sway")) @ track.at(round(t * S))
        assert np.linalg.norm(off[:3, 3]) < 0.021 * straight
        assert np.linalg.norm(cv2.Rodrigues(off[:3, :3])[0]) < 0.35 * straight


def test_nothing_is_carried_on_beyond_what_is_known() -> None:
    track = moving(3.0, begun=S)
    newest = S + 149 * 20 * MS
    assert track.at(newest)[0, 3] == pytest.approx(0.298)
    assert problem(track, newest + 1) == "pose_stopped"
    assert problem(track, S - 1) == "pose_missing"
    assert problem(PoseTrack(), 0) == "pose_missing"


def test_a_gap_is_not_bridged() -> None:
    track = moving(1.0)
    told(track, shifted(0.1), 1_300 * MS)
    assert problem(track, 1_100 * MS) == "pose_missing"
    assert track.at(980 * MS)[0, 3] == pytest.approx(0.098)


@pytest.mark.fault("robot: its pose jumps by 10 cm")
def test_a_jump_is_said_until_a_second_after_it() -> None:
    track = moving(1.0)
    for number in range(100):
        told(track, shifted(0.2 + 0.002 * number), S + number * 20 * MS)  # 10 cm further at once
    assert track.at(970 * MS)[0, 3] == pytest.approx(0.097)
    assert problem(track, 990 * MS) == "pose_jumped"
    assert problem(track, S + 500 * MS) == "pose_jumped"
    after = S + JUMP_HELD_NS
    assert track.at(after)[0, 3] == pytest.approx(0.3)


@pytest.mark.fault("robot: two programs tell its pose on one topic")
def test_what_was_overtaken_jumps_too() -> None:
    """The other one's poses lie 30 cm aside, and come 15 ms late: between those that are there already."""
    track = PoseTrack()
    for number in range(100):
        told(track, shifted(0.1), S + 10 * number * MS)
        told(track, shifted(0.4), S + (10 * number - 15) * MS)
    assert problem(track, S + 500 * MS) == "pose_jumped"


@pytest.mark.fault("robot: it tells millimetres")
def test_poses_in_millimetres_are_told_also_at_rest() -> None:
    track = PoseTrack()
    for number in range(3):
        told(track, shifted(120.0), S + 20 * number * MS)
    assert problem(track, S + 10 * MS) == "pose_too_far"


@pytest.mark.fault("robot: started anew, its clock begins at zero")
def test_a_robot_that_was_started_anew_is_followed() -> None:
    track = moving(2.0, begun=100 * S)
    for number in range(10):
        told(track, shifted(0.5), number * 20 * MS)
    assert track.at(100 * MS)[0, 3] == pytest.approx(0.5)
    assert problem(track, 101 * S) == "pose_stopped"


def test_frames_of_tf_are_chained_also_across_branches() -> None:
    track = PoseTrack("camera_base", "/tip")

    def tell(parent: str, child: str, x: float, fixed: bool, stamp: int = 0) -> None:
        make = ROS2.types
        header = make["std_msgs/msg/Header"](make["builtin_interfaces/msg/Time"](0, stamp), parent)
        turn = make["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
        moved = make["geometry_msgs/msg/Transform"](make["geometry_msgs/msg/Vector3"](x, 0.0, 0.0), turn)
        one = make["geometry_msgs/msg/TransformStamped"](header, child, moved)
        track.add(encoded(make[topics.TF]([one]), topics.TF), topics.TF, fixed)

    tell("world", "/camera_base", 1.0, fixed=True)
    assert problem(track, 0) == "pose_missing"
    tell("world", "arm", 5.0, fixed=True)
    for number in range(3):
        tell("arm", "tip", 0.01 * number, False, number * 50 * MS)
    with pytest.raises(SagsError, match="world is in world itself"):
        tell("world", "world", 0.3, fixed=True)
    assert track.at(75 * MS)[0, 3] == pytest.approx(4.015)


# ---- with frames -----------------------------------------------------------------------------------------


@pytest.mark.fault("robot: it tells no pose")
def test_a_frame_without_a_pose_is_held_and_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Frames at 10 Hz; the robot tells its pose from the third to the sixth, and from the ninth on."""
    session = open_session(SESSION, ["source.pace:=step", "mapping.max_gaussians:=2000"])
    with session.source as source:
        frames = [replace(frame, T_world_cam=None) for frame, _ in zip(source, range(12), strict=False)]
    save_hand_eye(HandEye(shifted(0.01)), tmp_path, {})
    robot = PushRobot(endpoint="tcp://127.0.0.1:*", hand_eye=tmp_path / "hand_eye.yaml", offset_ms=0)
    posed = Posed(Frames(*frames), session.config.model_copy(update={"robot": robot}), session.rig)
    known = [*range(18, 57), *range(78, 130)]  # in 1/100 s
    for number in known:
        told(posed.robot.track, shifted(0.3), number * 10 * MS)
    monkeypatch.setattr("sags_node.sources.robot.WAIT_S", 0.0)
    with posed:
        came = list(posed)
    assert [frame.frame_id for frame in came] == list(range(2, 12)) and posed.dropped == 2
    codes = [None if frame.pose_problem is None else frame.pose_problem.code for frame in came]
    assert codes == [None] * 4 + ["pose_missing"] * 2 + [None] * 4
    exact = shifted(0.3) @ rectified(shifted(0.01), session.rig)
    assert all(np.allclose(frame.T_world_cam, exact) for frame in came)

    pipeline = Pipeline(session.config, session.rig)
    held, warned = [], []
    for frame in came:
        held.append(bool(pipeline.process(frame, StepBudget(1)).held))
        warned.append("pose_missing" in by_code(pipeline.warnings))
    assert held == warned == [code is not None for code in codes]
    assert pipeline.map.restarts == 0


def test_the_offset_is_to_the_stamp_before_its_latency_is_taken_off(tmp_path: Path) -> None:
    """The robot's clock is 30 ms ahead, and an image is stamped 40 ms after its exposure."""
    save_hand_eye(HandEye(np.eye(4), 30 * MS), tmp_path, {})
    rig = phantom_rig(64, 48)
    robot = PushRobot(endpoint="tcp://127.0.0.1:*", hand_eye=tmp_path / "hand_eye.yaml")
    config = LaunchConfig(source=PushSource(latency_ms=40), robot=robot)
    picture = np.zeros((48, 64, 3), np.uint8)
    frame = StereoFrame(0, S - 40 * MS, S - 40 * MS, picture, picture, t_device_ns=S)
    with Posed(Frames(frame), config, rig) as posed:
        for number in range(90, 111):
            told(posed.robot.track, shifted(0.001 * number), number * 10 * MS)
        (came,) = list(posed)
    assert came.T_world_cam is not None and came.T_world_cam[0, 3] == pytest.approx(0.103)


def test_two_who_say_where_the_scope_is_are_one_too_many() -> None:
    with pytest.raises(ValueError, match="choose one"):
        LaunchConfig(robot=PushRobot(), vision=VisionConfig(pose="estimate"))


@pytest.mark.live
def test_a_pose_on_its_way_is_waited_for() -> None:
    """Handed in over ZeroMQ, 60 ms after the image that it is asked for."""
    robot = open_robot(LaunchConfig(robot=PushRobot(endpoint="tcp://127.0.0.1:*")))
    try:
        with PoseSender(robot.endpoint) as sender:  # type: ignore[attr-defined]
            now = time.time_ns()
            for number in range(-10, 1):
                sender.send(shifted(0.001 * number), now + number * 20 * MS)
            until(lambda: _known(robot.track, now))
            later = threading.Timer(0.06, lambda: sender.send(shifted(0.002), now + 40 * MS))
            later.start()
            assert robot.track.at(now + 20 * MS, timeout=60.0)[0, 3] == pytest.approx(0.001)
            later.join()
            begun = time.monotonic()
            with pytest.raises(NoPoseError):  # the robot stands still for long: nothing is waited for
                robot.track.at(now + 2 * S, timeout=600.0)
            assert time.monotonic() - begun < 300.0
    finally:
        robot.close()


@pytest.mark.parametrize(
    "wrong",
    [
        shifted(0.1).T,
        np.diag([1.0, 1, -1, 1]),
        np.diag([1000.0, 1000, 1000, 1]),
        np.zeros((4, 4)),
        np.full((4, 4), np.nan),
        np.eye(4)[:3],
    ],
    ids=["transposed", "mirrored", "scaled", "zeros", "nan", "3x4"],
)
@pytest.mark.fault("robot: a program hands in a transposed, mirrored or scaled pose")
def test_a_matrix_that_is_no_pose_is_not_sent(wrong: F64) -> None:
    """A quaternion of it would be a good one, of another pose."""
    with PoseSender("tcp://127.0.0.1:1") as sender, pytest.raises(ValueError, match="is it transposed"):
        sender.send(wrong)


def _known(track: PoseTrack, t_ns: int) -> bool:
    try:
        track.at(t_ns)
    except NoPoseError:
        return False
    return True
