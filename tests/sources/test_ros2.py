"""Pictures of a ROS 2 graph: of a DDS process, and of real rclpy where tests/ros2/prepare.sh was run."""

from __future__ import annotations

import logging
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from live_taking import Taker
from places import HELPERS, ROOT
from ros_peers import DOMAIN, rclpy_python
from waiting import until

from sags_node.config import LaunchConfig, Ros2Robot, Ros2Source, RosGraph
from sags_node.errors import UsageError
from sags_node.ros.graph import domain_of
from sags_node.sources import ros2
from sags_node.sources.robot import open_robot
from sags_node.sources.ros2 import RosCameras, read_rig

pytestmark = pytest.mark.live

SIZE = 1280, 1024


@contextmanager
def publishing(command: list[object], **variables: str) -> Iterator[subprocess.Popen[bytes]]:
    process = subprocess.Popen(
        [str(word) for word in command], env={**os.environ, **variables}, stdout=subprocess.PIPE
    )
    try:
        assert (
            process.stdout is not None and process.stdout.readline() == b"sending\n"
        )  # imports take seconds
        yield process
    finally:
        process.kill()
        process.communicate()


def dds(session: Path, seconds: float, *settings: str) -> list[object]:
    return [sys.executable, HELPERS / "stereo_sender.py", "dds", DOMAIN, session, seconds, *settings]


def config(suffix: str = "") -> Ros2Source:
    return Ros2Source(
        domain=DOMAIN, left=f"stereo/left/image_raw{suffix}", right=f"/stereo/right/image_raw{suffix}"
    )


@pytest.mark.parametrize("suffix", ["", "/compressed"])
def test_no_pair_is_mismatched_and_nothing_is_lost_unseen(phantom_session: Path, suffix: str) -> None:
    settings = ("jpeg=1", "rate=15") if suffix else ()
    source = RosCameras(config(suffix), SIZE)
    with Taker(source) as taker, publishing(dds(phantom_session, 8, *settings)):
        due = 60
        until(lambda: len(taker.numbers) >= due, seconds=30)
    assert taker.mismatched == 0
    numbers = [left for left, _ in taker.numbers]
    assert numbers == sorted(set(numbers))
    assert taker.newest is not None and taker.newest.left.shape == (1024, 1280, 3)


def test_the_cameras_calibration_is_taken(phantom_session: Path) -> None:
    from sags_node.calibration import load_rig, resized_rig

    with publishing(dds(phantom_session, 30, "size=640x512")):
        rig = read_rig(config(), seconds=20)
    want = resized_rig(load_rig(phantom_session / "calib"), 2)
    assert rig is not None and (rig.left.width, rig.left.height) == (640, 512)
    assert rig.baseline == pytest.approx(want.baseline)
    assert rig.left.distortion == pytest.approx(want.left.distortion)


def test_a_missing_calibration_is_said() -> None:
    with pytest.raises(UsageError, match=r"no camera_info on /stereo/left/camera_info and .*set rig"):
        read_rig(config(), seconds=0.3)


def test_a_camera_that_was_killed_is_back_within_five_seconds(phantom_session: Path) -> None:
    source = RosCameras(config(), SIZE)
    with Taker(source) as taker:
        with publishing(dds(phantom_session, 60)):
            until(lambda: len(taker.numbers) > 5)
        count = len(taker.numbers)
        with publishing(dds(phantom_session, 60, "rate=15")):
            until(lambda: len(taker.numbers) > count + 5, seconds=5)
    assert taker.mismatched == 0


def test_a_wrong_size_and_a_wrong_name_are_said(
    phantom_session: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ros2, "QUIET_S", 0.5)
    said = config().model_copy(update={"right": "/stereo/rihgt/image_raw"})
    with caplog.at_level(logging.WARNING), Taker(RosCameras(said, SIZE)) as taker:
        with publishing(dds(phantom_session, 60, "size=640x512")):
            until(lambda: "640x512 px, it must be 1280x1024" in caplog.text)
            until(lambda: "nobody publishes /stereo/rihgt/image_raw" in caplog.text)
    assert f"domain {DOMAIN}, interface lo" in caplog.text
    assert taker.numbers == []


def test_the_domain_is_that_of_the_launch_file_or_of_ros(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", "17")
    assert domain_of(RosGraph()) == 17
    assert domain_of(RosGraph(domain=3)) == 3
    monkeypatch.setenv("ROS_DOMAIN_ID", "many")
    with pytest.raises(UsageError, match="ROS_DOMAIN_ID"):
        domain_of(RosGraph())


@pytest.fixture
def rclpy_camera() -> list[object]:
    return [rclpy_python(), ROOT / "tests/ros2/camera.py"]


def test_a_real_ros_node_is_heard(rclpy_camera: list[object]) -> None:
    """Two 1280x1024 pictures at 30 Hz from rclpy and Fast DDS."""
    with publishing([*rclpy_camera, 30, 30, *SIZE], ROS_DOMAIN_ID=str(DOMAIN)):
        rig = read_rig(config(), seconds=20)
        source = RosCameras(config(), SIZE)
        with Taker(source) as taker:
            until(lambda: len(taker.numbers) >= 60, seconds=20)
    assert rig is not None and rig.baseline == pytest.approx(0.004)
    assert taker.mismatched == 0


def test_the_pose_of_a_real_ros_node_is_heard(rclpy_camera: list[object]) -> None:
    """PoseStamped of rclpy, one millimetre further with each of its pictures."""
    robot = open_robot(LaunchConfig(robot=Ros2Robot(domain=DOMAIN, topic="scope/measured_cp")))
    source = RosCameras(config(), SIZE)
    try:
        with publishing([*rclpy_camera, 30, 30, *SIZE], ROS_DOMAIN_ID=str(DOMAIN)), Taker(source) as taker:
            until(lambda: len(taker.numbers) >= 30, seconds=20)
            assert taker.newest is not None
            number, stamp = taker.numbers[-1][0], taker.newest.t_device_ns
            place = robot.track.at(stamp, timeout=1.0)[0, 3]
    finally:
        robot.close()
    assert place == pytest.approx(0.001 * number, abs=0.0011)  # a frame may come between the two lines


def test_tf_of_a_graph_is_followed(phantom_session: Path) -> None:
    robot = open_robot(LaunchConfig(robot=Ros2Robot(domain=DOMAIN, base="world", hand="left_optical_frame")))
    try:
        with publishing(dds(phantom_session, 60, "size=64x48")):
            until(lambda: robot.track.newest_ns > 0, seconds=20)
            stamp = robot.track.newest_ns
            assert robot.track.at(stamp)[:3, 3] == pytest.approx([0.1, 0.2, 0.3])
    finally:
        robot.close()
