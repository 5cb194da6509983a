"""Images of a ROS 2 graph: of a DDS process, and of real rclpy where tests/ros2/prepare.sh was run."""

import logging
import re
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from live_taking import Taker
from places import ROOT, SESSION
from ros_peers import DOMAIN, rclpy_python
from sending import sending, stereo_sender
from stereo_sender import paint_number
from waiting import until

from sags_node.config.schema import GeometryConfig, LaunchConfig, Ros2Robot, Ros2Source, RosGraph
from sags_node.errors import UsageError
from sags_node.messaging import cdr
from sags_node.messaging.topics import CAMERA_INFO, IMAGE, TF
from sags_node.rig import already_rectified, load_rig, rectified_rig, resized_rig
from sags_node.ros.graph import Graph, domain_of
from sags_node.sources import ros2
from sags_node.sources.robot import open_robot
from sags_node.sources.ros2 import RosCameras, read_rig
from sags_node.types import Eye, StereoRig

pytestmark = pytest.mark.live

SIZE = 1280, 1024


def config() -> Ros2Source:
    return Ros2Source(domain=DOMAIN, left="stereo/left/image_raw", right="/stereo/right/image_raw")


def test_calibration_tf_and_compressed_images_of_a_graph_are_taken() -> None:
    """No pair is mismatched or comes twice; raw ones are in `test_live_contract.py`."""
    robot = open_robot(LaunchConfig(robot=Ros2Robot(domain=DOMAIN, base="world", hand="left_optical_frame")))
    names = {eye: f"stereo/{eye}/image_raw/compressed" for eye in ("left", "right")}
    try:
        with sending(stereo_sender("dds", DOMAIN, "size=640x512", "jpeg=1")):
            rig = read_rig(config(), seconds=60)
            turned = config().model_copy(update={"geometry": GeometryConfig(flip="horizontal")})
            with pytest.raises(UsageError, match=r"flip: horizontal turns them: .* set rig"):
                read_rig(turned, seconds=60)
            stamp = until(lambda: robot.track.newest_ns)
            assert robot.track.at(stamp)[:3, 3] == pytest.approx([0.1, 0.2, 0.3])
            with Taker(RosCameras(Ros2Source(domain=DOMAIN, **names), (640, 512))) as taker:
                until(lambda: len(taker.numbers) >= 60)
    finally:
        robot.close()
    want = resized_rig(load_rig(SESSION / "calib"), 2)
    assert rig is not None and (rig.left.width, rig.left.height) == (640, 512)
    assert rig.baseline == pytest.approx(want.baseline)
    assert rig.left.distortion == pytest.approx(want.left.distortion)
    numbers = [left for left, _ in taker.numbers]
    assert taker.mismatched == 0 and numbers == sorted(set(numbers))
    assert taker.newest is not None and taker.newest.left.shape == (512, 640, 3)


def test_what_is_wrong_with_a_topic_is_said(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each in a line of its own, and no image gets through."""
    monkeypatch.setattr(ros2, "QUIET_S", 0.3)
    graph = Graph(RosGraph(domain=DOMAIN))
    kinds = {"encoding": IMAGE, "stamp": IMAGE, "size": IMAGE, "kind": TF}
    writers = {name: graph.writer(f"/wrong/{name}", kind) for name, kind in kinds.items()}
    picture = np.zeros((1024, 1280, 3), np.uint8)

    def send() -> None:
        now = time.time_ns()
        floats = picture[..., 0].astype(np.float32)
        writers["encoding"].write(cdr.image(floats, "32FC1", now).cdr(), now)
        writers["stamp"].write(cdr.image(picture, "rgb8", now - 86_400 * 10**9).cdr(), now)
        writers["size"].write(cdr.image(picture[:512, :640].copy(), "rgb8", now).cdr(), now)
        writers["kind"].write(cdr.transform(np.eye(4), now).cdr(), now)

    for left, right, *said in (
        # A day, and what the way took: less than the minute that is waited.
        ("encoding", "stamp", "/wrong/encoding: left out: an image encoded as '32FC1' is not read",
         r"/wrong/stamp: left out: an image's stamp is 864[0-5]\d\.\d s old"),
        ("size", "kind", "640x512 px, it must be 1280x1024",
         "/wrong/kind is tf2_msgs/msg/TFMessage, not an image topic; set source.right"),
        ("size", "naem", "nobody publishes /wrong/naem", f"domain {DOMAIN}, interface lo"),
    ):  # fmt: skip
        caplog.clear()
        topics = {"left": f"/wrong/{left}", "right": f"/wrong/{right}"}
        source = RosCameras(Ros2Source(domain=DOMAIN, **topics), SIZE)
        with caplog.at_level(logging.WARNING), Taker(source) as taker:
            until(lambda said=said: send() or all(re.search(words, caplog.text) for words in said))
        assert taker.numbers == [] and not any("\n" in line for line in caplog.messages)
    with pytest.raises(UsageError, match=r"no camera_info on /stereo/left/camera_info and .*set rig"):
        read_rig(config(), seconds=0.3)


@pytest.mark.fault("calibration: a live camera's zoom is turned, and turned back")
@pytest.mark.parametrize("taken", [lambda rig: rig, already_rectified])
def test_pictures_of_another_calibration_are_not_given(taken: Callable[[StereoRig], StereoRig]) -> None:
    K = np.array([[200.0, 0, 80], [0, 200, 60], [0, 0, 1]])
    rig = rectified_rig("scope", 160, 120, K, 0.004)
    rig = replace(rig, left=replace(rig.left, distortion=np.array([0.1, 0, 0, 0, 0])))
    zoomed = replace(rig.right, P=np.diag([1.5, 1.5, 1]) @ rig.right.P)
    graph = Graph(RosGraph(domain=DOMAIN))
    infos = [graph.writer(f"/stereo/{eye}/camera_info", CAMERA_INFO) for eye in ("left", "right")]
    pictures = [graph.writer(f"/stereo/{eye}/image_raw", IMAGE) for eye in ("left", "right")]

    def send(right: Eye, number: int) -> None:
        now, picture = time.time_ns(), np.zeros((120, 160, 3), np.uint8)
        paint_number(picture, number)
        for writer, eye in zip(infos, (rig.left, right), strict=True):
            writer.write(cdr.eye_info(eye, now).cdr(), now)
        for writer in pictures:
            writer.write(cdr.image(picture, "rgb8", now).cdr(), now)

    unknown = replace(rig.right, K=np.zeros((3, 3)))  # as drivers say that have not read it yet
    source = RosCameras(config(), (160, 120), taken(rig))
    with Taker(source) as taker:
        until(lambda: send(rig.right, 1) or (1, 1) in taker.numbers)
        until(lambda: send(unknown, 2) or (2, 2) in taker.numbers)
        assert source.findings == ()
        until(lambda: send(zoomed, 3) or source.findings)
        (finding,) = source.findings
        assert finding.code == "calibration_changed"
        assert "/stereo/right/camera_info has changed (f 200.0 to 300.0 px): zoom" in finding.text
        for _ in range(5):
            send(zoomed, 4)
            time.sleep(0.1)
        until(lambda: send(rig.right, 5) or (5, 5) in taker.numbers)
        assert source.findings == () and (4, 4) not in taker.numbers


def test_the_domain_is_that_of_the_launch_file_or_of_ros(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", "17")
    assert domain_of(RosGraph()) == 17
    assert domain_of(RosGraph(domain=3)) == 3
    monkeypatch.setenv("ROS_DOMAIN_ID", "many")
    with pytest.raises(UsageError, match="ROS_DOMAIN_ID"):
        domain_of(RosGraph())


def test_a_real_ros_node_is_heard() -> None:
    """Two 1280x1024 images at 30 Hz from rclpy and Fast DDS; a pose, one millimetre further with each."""
    camera = [rclpy_python(), ROOT / "tests/ros2/camera.py", 30, 30, *SIZE]
    robot = open_robot(LaunchConfig(robot=Ros2Robot(domain=DOMAIN, topic="scope/measured_cp")))
    try:
        with sending(camera, ROS_DOMAIN_ID=str(DOMAIN)):
            rig = read_rig(config(), seconds=60)
            with Taker(RosCameras(config(), SIZE)) as taker:
                until(lambda: len(taker.numbers) >= 60)
                number, stamp = taker.numbers[-1][0], taker.newest.t_device_ns
                place = robot.track.at(stamp, timeout=60.0)[0, 3]
    finally:
        robot.close()
    assert rig is not None and rig.baseline == pytest.approx(0.004)
    assert taker.mismatched == 0
    assert place == pytest.approx(0.001 * number, abs=0.0011)  # a frame may come between the two lines
