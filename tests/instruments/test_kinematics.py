"""Tools whose tips a robot tells: alone, corrected by the image, and silent."""

from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from bag_files import ROS2, stereo_rows, write_rosbag2
from frames import Frames, told
from instrument_scenes import HEIGHT, WIDTH, filmed
from waiting import until

from sags_node.client import PoseSender
from sags_node.confidence import SURE, error_of
from sags_node.config.launch_file import load_launch
from sags_node.config.schema import LaunchConfig, PushRobot, RobotTool
from sags_node.errors import UsageError
from sags_node.findings import by_code
from sags_node.instruments.instruments import BY_PICTURE, BY_ROBOT, CORRECTED, Instruments
from sags_node.instruments.kinematics import Arm
from sags_node.mapping.budget import StepBudget
from sags_node.messaging import cdr
from sags_node.pipeline.pipeline import FrameRequest, Pipeline
from sags_node.rig.hand_eye import HandEye, save_hand_eye
from sags_node.sources.robot import Posed, open_robot, rectified
from sags_node.types import F64, InstrumentStates, ToolPose

S = 1_000_000_000
EVERYWHERE = np.ones((HEIGHT, WIDTH), np.bool_)
ERROR = 0.010  # m, stated


def pose(tip: F64, axis: F64) -> F64:
    """[4, 4]: z points out of the tip."""
    side = np.cross(axis, [0.0, 1.0, 0.0])
    side /= np.linalg.norm(side)
    T = np.eye(4)
    T[:3, :3] = np.stack([side, np.cross(axis, side), axis], -1)
    T[:3, 3] = tip
    return T


def moved(x: float, y: float, z: float, degrees: float = 0.0) -> F64:
    """A small motion before the camera, about a place 60 mm away."""
    E, middle = np.eye(4), np.array([0, 0, 0.06])
    E[:3, :3] = cv2.Rodrigues(np.radians([0.0, degrees, 0.0]))[0]
    E[:3, 3] = middle - E[:3, :3] @ middle + [x, y, z]
    return E


class Looking:
    """The filmed grasper, looked at again and again, five times a second."""

    def __init__(self) -> None:
        self.scene, self.found, self._now = filmed(), Instruments(EVERYWHERE), S
        self.truth = pose(self.scene.tip, self.scene.axis)

    def __call__(self, told: F64 | None, tools: bool = True, eyes: bool = True) -> InstrumentStates:
        pair = self.scene.pair
        gray = [cv2.cvtColor(eye, cv2.COLOR_RGB2GRAY) for eye in (pair.left, pair.right)]
        view, robot = replace(self.scene.surface, t_capture_ns=self._now), ToolPose("PSM1", ERROR, told)
        self._now += S // 5
        states = self.found.update(
            self.scene.tools if tools else None, gray[0], gray[1] if eyes else None, pair.camera,
            pair.baseline, view, robot=(robot,),
        )  # fmt: skip
        assert states is not None
        return states


def test_without_a_picture_it_is_where_the_robot_says_as_surely_as_it_says() -> None:
    look = Looking()
    states = look(look.truth, tools=False)
    assert states.sources.tolist() == [BY_ROBOT]
    np.testing.assert_allclose(states.tips[0], look.scene.tip, atol=1e-6)
    np.testing.assert_allclose(states.axes[0], look.scene.axis, atol=1e-5)
    assert error_of(states.confidence)[0] == pytest.approx(ERROR, rel=1e-3)
    assert np.isfinite(states.clearance[0]) and states.clearance_confidence[0] < SURE


def test_the_picture_corrects_it_and_what_was_learnt_lasts_where_the_picture_ends() -> None:
    """5 mm off. One row for one tool, also with its tip beyond the image, where no tissue is seen."""
    look, E = Looking(), moved(0.003, -0.004, 0.0)
    seen = look(None)
    assert seen.sources.tolist() == [BY_PICTURE] and seen.confidence[0] >= SURE
    for _ in range(20):
        states = look(E @ look.truth)
        assert states.sources.tolist() == [CORRECTED] and len(states) == 1
    off = np.linalg.norm(states.tips[0] - look.scene.tip)
    by_picture = np.linalg.norm(seen.tips[0] - look.scene.tip)
    assert off < by_picture + 0.0005 and off <= error_of(states.confidence)[0] < 0.003
    beyond = look.truth.copy()
    beyond[:3, 3] += [-0.05, 0, 0]
    outside = look(E @ beyond, tools=False)
    assert outside.sources.tolist() == [CORRECTED] and outside.ids.tolist() == states.ids.tolist()
    assert np.linalg.norm(outside.tips[0] - beyond[:3, 3]) < off + 0.002
    assert error_of(outside.confidence)[0] > error_of(states.confidence)[0]
    assert np.isnan(outside.clearance[0]) and outside.clearance_confidence[0] == 0


def test_where_the_robot_falls_silent_the_picture_goes_on_under_the_same_number() -> None:
    look = Looking()
    told = [look(look.truth), look(None), look(look.truth)]
    assert [states.sources.tolist() for states in told] == [[CORRECTED], [BY_PICTURE], [CORRECTED]]
    assert len({tuple(states.ids.tolist()) for states in told}) == 1


def test_one_that_is_told_in_plain_sight_and_not_seen_there_is_not_sure() -> None:
    """30 mm beside what the mask shows: two rows, of which the image's is sure."""
    look = Looking()
    for _ in range(4):
        assert look(look.truth).confidence[0] >= SURE
    states = look(moved(-0.03, -0.03, 0) @ look.truth)
    sure = dict(zip(states.sources.tolist(), (states.confidence >= SURE).tolist(), strict=True))
    assert sure == {BY_PICTURE: True, CORRECTED: False}
    assert len(set(states.ids.tolist())) == 2


@pytest.mark.fault("clock: set back while a robot's tool is corrected")
def test_what_is_seen_is_learnt_where_the_clock_was_set_back() -> None:
    arm, E, tip = Arm(1, ERROR), moved(0.003, 0, 0), np.array([0.02, 0.0, 0.06])
    for begin in (1000 * S, 0):
        E = E @ moved(0.003, 0, 0)
        for number in range(50):
            arm.move(E @ pose(tip, np.array([0.6, 0.0, 0.8])), begin + number * S // 10)
            arm.learn(tip, 0.001)
        assert np.linalg.norm(arm.tip - tip) < 0.001


@pytest.mark.parametrize("seed", range(6))
def test_false_tips_of_the_picture_are_passed_over(seed: int) -> None:
    """Kinematics 5 mm and 5 degrees off, of a tip that goes round for 20 s; it is seen to 1 mm, but one time
    of five 20 mm beside. What is told as its error holds for nine of ten, whatever the image shows."""
    rng, arm, E = np.random.default_rng(seed), Arm(1, ERROR), moved(0.003, 0.004, 0, 5)
    off, told = [], []
    for number in range(200):
        angle = 0.5 * number / 10
        tip = np.array([0.02 * np.cos(angle), 0.015 * np.sin(1.7 * angle), 0.06 + 0.01 * np.sin(angle)])
        arm.move(E @ pose(tip, np.array([0.6, 0.0, 0.8])), S + number * S // 10)
        wrong = rng.normal(size=3) if number >= 20 and rng.random() < 0.2 else np.zeros(3)
        seen = tip + rng.normal(0, 0.001 / 2.5, 3) + 0.02 * wrong / max(np.linalg.norm(wrong), 1e-9)
        arm.learn(seen, 0.001)
        off.append(np.linalg.norm(arm.tip - tip))
        told.append(arm.tip_error)
    assert np.mean(np.array(off) <= told) >= 0.9
    assert np.quantile(off[50:], 0.9) < 0.001  # no worse than what is seen, without what is wrong
    axis = (E @ pose(tip, np.array([0.6, 0.0, 0.8])))[:3, 2]
    assert np.degrees(np.arccos(axis @ [0.6, 0.0, 0.8])) > 4.9
    assert np.degrees(np.arccos(arm.axis @ [0.6, 0.0, 0.8])) < 2.5  # learnt from where it was off


# ---- from the robot's messages ---------------------------------------------------------------------------


def robot_of(folder: Path, *tools: RobotTool, topic: str | None = None) -> PushRobot:
    save_hand_eye(HandEye(moved(0.01, 0, 0)), folder, {})
    return PushRobot(
        endpoint="tcp://127.0.0.1:*", hand_eye=folder / "hand_eye.yaml", offset_ms=0, tools=tools, topic=topic
    )


@pytest.mark.fault("robot: a tool's pose stops")
def test_a_pose_comes_through_base_and_hand_eye_and_one_that_stopped_is_not_used(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The same place in the scope's base, and in the hand that carries the camera; the second one stops."""
    scene, rig = filmed(), filmed().phantom.rig
    T_base_hand, T_hand_tool = moved(0.1, 0.2, 0.3, 20), moved(0, 0.01, 0.1, 40)
    base = moved(-0.2, 0, 0, 90)
    T_told = np.linalg.inv(base) @ T_base_hand @ T_hand_tool
    rows = tuple(tuple(float(x) for x in row) for row in base)
    tools = RobotTool(topic="/PSM1/measured_cp", T_base=rows), RobotTool(topic="PSM2/cp", on_hand=True)
    first = replace(scene.frame, t_capture_ns=S)
    second = replace(first, frame_id=1, t_capture_ns=S + S // 2, left=first.left ^ 1)
    monkeypatch.setattr("sags_node.sources.robot.WAIT_S", 0.0)
    config = LaunchConfig(robot=robot_of(tmp_path, *tools))
    with Posed(Frames(first, second), config, rig) as posed:
        for number in range(80):
            t_ns = S // 2 + number * S // 50
            told(posed.robot.track, T_base_hand, t_ns)
            told(posed.robot.tools["/PSM1/measured_cp"], T_told, t_ns)
            if number < 30:
                told(posed.robot.tools["/PSM2/cp"], T_hand_tool, t_ns)
        came = list(posed)
    T = np.linalg.inv(rectified(moved(0.01, 0, 0), rig)) @ T_hand_tool
    for tool in (came[0].tools[0], came[0].tools[1], came[1].tools[0]):
        np.testing.assert_allclose(tool.T_cam_tool, T, atol=1e-9)
    assert came[1].tools[1].T_cam_tool is None

    vision = {"width": WIDTH, "height": HEIGHT}
    pipeline = Pipeline(LaunchConfig.model_validate({"vision": vision}), rig)
    sources, warned = [], []
    for frame in came:
        result = pipeline.process(frame, StepBudget(1), FrameRequest(instruments=True))
        sources.append(sorted(result.instruments.sources.tolist()))  # type: ignore[union-attr]
        warned.append(by_code(pipeline.warnings).get("tool_pose_missing", ""))
    assert [len([s for s in each if s != BY_PICTURE]) for each in sources] == [2, 1]
    assert not warned[0] and "PSM2/cp: its newest pose is older" in warned[1]


@pytest.mark.fault("robot: a tool's poses are in another frame than the scope's")
@pytest.mark.parametrize(
    ("keys", "frame", "taken"),
    [
        ({}, "ECM", False),
        ({}, "/Cart", True),
        ({}, "", True),
        ({"on_hand": True}, "ECM", True),
        ({"T_base": np.eye(4).tolist()}, "PSM1_base", True),  # who says that they are one place knows
    ],
)
def test_a_tool_whose_frame_nobody_has_placed_is_not_taken(
    tmp_path: Path, keys: dict[str, Any], frame: str, taken: bool
) -> None:
    scene = filmed()
    config = LaunchConfig(robot=robot_of(tmp_path, RobotTool(topic="/PSM1/measured_cp", **keys)))
    with Posed(Frames(replace(scene.frame, t_capture_ns=S)), config, scene.phantom.rig) as posed:
        for number in range(80):
            t_ns = S // 2 + number * S // 50
            for track, name in ((posed.robot.track, "Cart"), (*posed.robot.tools.values(), frame)):
                track.add(bytes(cdr.pose(np.eye(4), t_ns, name).parts[0]), cdr.POSE)
        (tool,) = next(iter(posed)).tools
    assert (tool.T_cam_tool is not None) == taken
    assert taken or "its poses are in 'ECM', the scope's in 'Cart'" in tool.problem


def test_a_bag_without_the_tools_topic_is_refused_and_says_what_there_is(tmp_path: Path) -> None:
    rows = stereo_rows(ROS2, 2)
    stamped = ROS2.deserialize_cdr(bytes(cdr.pose(np.eye(4), S).parts[0]), cdr.POSE)
    bag = write_rosbag2(tmp_path / "bag", [*rows, ("/ECM/measured_cp", stamped, S)])
    tool = "robot.tools:=[{topic: PSM1/cp}]"
    config = load_launch(None, [f"source.path:={bag}", "source.kind:=bag", "robot.kind:=bag", tool,
                                "robot.topic:=/ECM/measured_cp"])  # fmt: skip
    words = "no poses on /PSM1/cp; topics with poses: /ECM/measured_cp; set robot.tools"
    with pytest.raises(UsageError, match=words):
        open_robot(config)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ("{topic: a, base: 1}", "unknown key 'robot.tools.0.base'"),
        ("{topic: a, T_base: [[1,0,0,0],[0,1,0,0],[0,0,1,90],[0,0,0,1]]}", "translations are in metres"),
        ("{topic: a, T_base: [[1,0,0,0],[0,1,0,0],[0,0,-1,0],[0,0,0,1]]}", "should be a rotation"),
        ("{topic: a, error_mm: 0}", "greater than 0"),
    ],
)
def test_a_tool_that_cannot_be_is_refused(given: str, said: str) -> None:
    with pytest.raises(UsageError, match=r"robot\.tools\.0") as refused:
        load_launch(None, ["robot.kind:=push", f"robot.tools:=[{given}]"])
    assert said in str(refused.value)


@pytest.mark.live
def test_a_tool_is_handed_in_by_its_topic(tmp_path: Path) -> None:
    tools = [RobotTool(topic=f"/PSM{number}/measured_cp") for number in (1, 3)]
    with (
        closing(open_robot(LaunchConfig(robot=robot_of(tmp_path, *tools)))) as robot,
        PoseSender(robot.endpoint) as sender,
        PoseSender(robot.endpoint, ns="lab/dvrk") as other,
    ):
        scope, first, third = robot.track, *robot.tools.values()
        for number in range(3):
            sender.send(np.eye(4), S + number)
            sender.send(moved(0.1, 0, 0), S + number, "/PSM1/measured_cp")
        until(lambda: first.newest_ns == S + 2 and scope.newest_ns == S + 2)
        sender.send(moved(0.2, 0, 0), S + 3, "/PSM2/measured_cp")  # is nobody's: not the scope's either
        other.send(moved(0.1, 0, 0), S + 4, "PSM3/measured_cp")
        until(lambda: third.newest_ns == S + 4)
        sender.send(np.eye(4), S + 5)
        until(lambda: scope.newest_ns == S + 5)
    assert first.at(S + 1)[0, 3] == pytest.approx(0.1)
    assert scope.at(S + 1)[0, 3] == scope.at(S + 3)[0, 3] == 0


@pytest.mark.live
def test_a_named_topic_is_the_scopes_whoever_speaks_first(tmp_path: Path) -> None:
    tool = RobotTool(topic="/pose")  # the scope's topic ends with it
    with (
        closing(open_robot(LaunchConfig(robot=robot_of(tmp_path, tool, topic="ECM/pose")))) as robot,
        PoseSender(robot.endpoint, ns="dvrk") as sender,
    ):
        sender.send(moved(0.2, 0, 0), S, "PSM2/measured_cp")  # nobody's
        sender.send(moved(0.1, 0, 0), S)
        for number in range(3):
            sender.send(np.eye(4), S + number, "ECM/pose")
        until(lambda: robot.track.newest_ns == S + 2 and robot.tools["/pose"].newest_ns == S)
        assert robot.findings == ()  # what nobody asked for is no warning, and hides none
    assert robot.track.at(S)[0, 3] == 0
    assert robot.tools["/pose"].at(S)[0, 3] == pytest.approx(0.1)
