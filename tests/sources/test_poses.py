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
Sample = tuple[float, int]  # place along x, m; time, ns


def shifted(x: float) -> F64:
    T = np.eye(4)
    T[0, 3] = x
    return T


def moving(seconds: float, begun: int = 0) -> list[Sample]:
    """Of a scope that moves by 0.1 m/s."""
    return [(0.002 * number, begun + number * 20 * MS) for number in range(round(seconds * 50))]


def track_of(samples: list[Sample]) -> PoseTrack:
    track = PoseTrack()
    for x, t_ns in samples:
        told(track, shifted(x), t_ns)
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
    track = track_of(moving(1.0))
    with pytest.raises(SagsError, match="numbers that are no pose"):
        track.add(no_pose(S + 20 * MS, kind), cdr.POSE)
    told(track, shifted(0.102), S + 20 * MS)
    np.testing.assert_allclose(track.at(S + 10 * MS)[0, 3], 0.1, atol=2e-3)


def tf(*transforms: tuple[str, str, float, int], **wrong: float) -> bytes:
    """A message of transforms: parent, child, place along x in m, time in ns; `wrong`: parts of the first
    one's quaternion."""
    message, made = None, []
    for parent, child, x, t_ns in transforms:
        message = cdr.decode(bytes(cdr.transform(shifted(x), t_ns).parts[0]), topics.TF)
        (one,) = message.transforms
        made.append(replace(one, header=replace(one.header, frame_id=parent), child_frame_id=child))
    moved = made[0].transform
    made[0] = replace(made[0], transform=replace(moved, rotation=replace(moved.rotation, **wrong)))
    return encoded(replace(message, transforms=made), topics.TF)


def test_of_a_message_with_several_frames_only_the_wrong_one_is_left_out() -> None:
    track = PoseTrack("world", "scope")
    for t_ns in (0, 50 * MS, 100 * MS):
        with pytest.raises(SagsError, match="the pose of arm"):
            track.add(tf(("world", "arm", 0.1, t_ns), ("world", "scope", 0.1, t_ns), w=0.0), topics.TF)
    assert track.at(60 * MS)[0, 3] == pytest.approx(0.1)


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


Answers = dict[int, str | float]  # by time, ns: the place along x, m, or the code of the problem
KNOWN: dict[str, tuple[list[Sample], Answers]] = {
    "nothing": ([], {0: "pose_missing"}),
    "nothing is carried on beyond what is known": (
        moving(3.0, begun=S),
        {S - 1: "pose_missing", S + 2980 * MS: 0.298, S + 2980 * MS + 1: "pose_stopped"}),
    "a gap": ([*moving(1.0), (0.1, 1300 * MS)], {980 * MS: 0.098, 1100 * MS: "pose_missing"}),
    "a message that was overtaken": (
        [(0.002 * number, number * 20 * MS) for number in (0, 1, 3, 2, 4, 4)],
        {10 * MS: 0.001, 50 * MS: 0.005, 70 * MS: 0.007}),
    "10 cm further at once, said until a second after it": (
        [*moving(1.0), *((x + 0.2, t_ns + S) for x, t_ns in moving(2.0))],
        {970 * MS: 0.097, 990 * MS: "pose_jumped", S + 500 * MS: "pose_jumped", S + JUMP_HELD_NS: 0.3}),
    "another's poses 30 cm aside, and 15 ms late: between those that are there already": (
        [one for n in range(100) for one in ((0.1, S + 10 * n * MS), (0.4, S + (10 * n - 15) * MS))],
        {S + 500 * MS: "pose_jumped"}),
    "millimetres, at rest": ([(120.0, S + 20 * n * MS) for n in range(3)], {S + 10 * MS: "pose_too_far"}),
    "started anew": (
        [*moving(2.0, begun=100 * S), *((0.5, number * 20 * MS) for number in range(10))],
        {100 * MS: 0.5, 101 * S: "pose_stopped"}),
}  # fmt: skip


@pytest.mark.fault("robot: its pose jumps by 10 cm")
@pytest.mark.fault("robot: two programs tell its pose on one topic")
@pytest.mark.fault("robot: it tells millimetres")
@pytest.mark.fault("robot: started anew, its clock begins at zero")
@pytest.mark.parametrize("case", KNOWN)
def test_a_pose_is_told_where_it_is_known(case: str) -> None:
    samples, answers = KNOWN[case]
    track = track_of(samples)
    for t_ns, answer in answers.items():
        if isinstance(answer, str):
            assert problem(track, t_ns) == answer
        else:
            assert track.at(t_ns)[0, 3] == pytest.approx(answer)


def test_frames_of_tf_are_chained_also_across_branches() -> None:
    track = PoseTrack("camera_base", "/tip")
    track.add(tf(("world", "/camera_base", 1.0, 0)), topics.TF, True)
    assert problem(track, 0) == "pose_missing"
    track.add(tf(("world", "arm", 5.0, 0)), topics.TF, True)
    for number in range(3):
        track.add(tf(("arm", "tip", 0.01 * number, number * 50 * MS)), topics.TF, False)
    with pytest.raises(SagsError, match="world is in world itself"):
        track.add(tf(("world", "world", 0.3, 0)), topics.TF, True)
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
            until(lambda: robot.track.newest_ns == now)
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


WRONG = {
    "transposed": shifted(0.1).T,
    "mirrored": np.diag([1.0, 1, -1, 1]),
    "scaled": np.diag([1000.0, 1000, 1000, 1]),
    "zeros": np.zeros((4, 4)),
    "nan": np.full((4, 4), np.nan),
    "3x4": np.eye(4)[:3],
}


@pytest.mark.parametrize("name", WRONG)
@pytest.mark.fault("robot: a program hands in a transposed, mirrored or scaled pose")
def test_a_matrix_that_is_no_pose_is_not_sent(name: str) -> None:
    """A quaternion of it would be a good one, of another pose."""
    with PoseSender("tcp://127.0.0.1:1") as sender, pytest.raises(ValueError, match="is it transposed"):
        sender.send(WRONG[name])
