"""`sags bridge ros2` and real ROS 2: nodes of rclpy with Fast DDS, where tests/ros2/prepare.sh was run."""

import json
import os
import signal
import subprocess
import time
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from bridging import anchored, bridged, options_of, sockets
from command_line import killed, start
from places import ROOT, SESSION
from ros_peers import DOMAIN, LARGE_BUFFERS, Listener, RosNode, rclpy_python, ros_node
from running_node import RunningNode
from synthetic import at_frame, stream
from waiting import until

from sags_node.clients.bridge.ros2 import Ros2Options, run_ros2
from sags_node.config.schema import RosGraph
from sags_node.messaging import cdr, topics
from sags_node.messaging.received import Received, ReceivedCloud, TopicName
from sags_node.messaging.subscriber import Subscriber

pytestmark = [pytest.mark.live, pytest.mark.alone]

WATCHED = 30  # messages
ANCHORS = TopicName("anchors", ReceivedCloud)
READ = [
    topic for topic in topics.TOPICS if topic.type in (topics.IMAGE, topics.CAMERA_INFO, topics.POINT_CLOUD)
]  # the wheels have no tf2_msgs and no diagnostic_msgs


@pytest.fixture(autouse=True)
def _rclpy() -> None:
    rclpy_python()


options = partial(options_of, Ros2Options, graph=RosGraph(domain=DOMAIN))


def checksum(message: Received) -> int:
    """As tests/ros2/peer.py makes it; DDS sends whole words."""
    body = bytearray(message.cdr())
    body[4:12] = bytes(8)
    return zlib.crc32(body + bytes(-len(body) % 4))


def words(*found: topics.Topic) -> list[str]:
    return [f"{topic.type}:/sags/{topic.name}" for topic in found]


def test_ros_reads_all_topics_bit_by_bit_and_a_slow_node_holds_nobody_up(tmp_path: Path) -> None:
    """The left image has 640x512 px; all that comes of it is what was sent."""
    result = anchored()
    large = np.random.default_rng(0).integers(0, 256, (512, 640, 3), np.uint8)
    result = replace(result, pair=replace(result.pair, left=large))
    with (
        sockets(tmp_path) as running,
        stream(running, lambda i: at_frame(result, i, time.time_ns())),
        bridged(run_ros2, options(tmp_path)),
        ros_node(*words(*READ), "std_msgs/msg/String:/sags/status:kept", **LARGE_BUFFERS) as node,
        ros_node("sensor_msgs/msg/CameraInfo:/sags/left/camera_info:reliable", *words(*READ)) as slow,
    ):
        names = [f"/sags/{topic.name}" for topic in READ]
        until(lambda: all(node.came[name] for name in names) and slow.came["/sags/left/camera_info"])
        until(lambda: node.came["/sags/status"])
        slow.process.send_signal(signal.SIGSTOP)
        before = {name: len(node.came[name]) for name in names}
        until(lambda: all(len(node.came[name]) >= before[name] + WATCHED for name in names))
        while_slow = {name: node.came[name][before[name] :] for name in names}
        with Subscriber([topic.name for topic in READ], run_dir=tmp_path) as beside:
            until(lambda: all(beside.latest(topic.name) for topic in READ))
            expected = {}
            for topic in READ:
                message = beside.latest(topic.name)
                assert message is not None
                expected[f"/sags/{topic.name}"] = checksum(message)
        seen = node.names()
        slow.process.send_signal(signal.SIGCONT)
    assert "sags" in seen["nodes"]
    for topic in READ:
        kind, type_hash, reliability = seen["topics"][f"/sags/{topic.name}"]
        assert (kind, type_hash) == (topic.type, cdr.type_hash(topic.type))
        small = topic.type == topics.CAMERA_INFO or topic.name == "anchors"
        assert reliability == ("RELIABLE" if small else "BEST_EFFORT")
    for name in names:
        assert {each.crc for each in while_slow[name]} == {expected[name]}, name
        stamps = [each.stamp for each in while_slow[name]]
        assert stamps == sorted(set(stamps)), name


@contextmanager
def bridge(run_dir: Path) -> Iterator[subprocess.Popen[str]]:
    with killed(start(["bridge", "ros2", "--json", "--run-dir", run_dir, "--domain", DOMAIN])) as process:
        assert json.loads(process.stdout.readline()) == {"domain": DOMAIN, "interface": "lo"}
        yield process


def placed(node: RosNode) -> dict[int, tuple[float, ...]]:
    """Where rclpy sees the one anchor: capture time -> x, y, z."""
    found = {}
    for each in node.came["/sags/anchors"]:
        cloud = cdr.decode(bytes.fromhex(each.data), topics.POINT_CLOUD)
        if cloud.width:
            found[each.stamp] = tuple(cloud.data[:12].view(np.float32).tolist())
    return found


def stale(array: bytes) -> bool:
    return any(status.level == 3 for status in cdr.decode(array, topics.DIAGNOSTICS).status)


def test_ros_pins_an_anchor_and_outlives_a_killed_bridge_and_a_killed_node(tmp_path: Path) -> None:
    run_dir = tmp_path / "run"
    array = ("/diagnostics", topics.DIAGNOSTICS)
    heard = (
        "sensor_msgs/msg/PointCloud2:/sags/anchors:reliable",
        "std_msgs/msg/String:/sags/answer:reliable",
        "sensor_msgs/msg/CompressedImage:/sags/view/ros/image/compressed",
    )
    with RunningNode(SESSION, tmp_path, "source.pace:=realtime") as running:
        with ros_node(*heard) as node, Listener(array) as joined:
            with bridge(run_dir) as first, Subscriber([ANCHORS, "splats"], run_dir=run_dir) as beside:
                until(lambda: node.came["/sags/anchors"])
                until(lambda: beside.latest("splats"))
                node.publish("geometry_msgs/msg/Point", "/sags/request/add_anchor_at_pixel", x=150.0, y=120.0)
                until(lambda: node.came["/sags/answer"])
                begun = len(node.came["/sags/anchors"])
                same: dict[int, tuple[float, ...]] = {}

                def seen_for_a_second() -> bool:
                    newest = beside.latest(ANCHORS)
                    if newest is not None and len(newest.points) == 1:
                        same[newest.stamp_ns] = tuple(newest.xyz()[0].tolist())
                    return len(node.came["/sags/anchors"]) > begun + 30

                until(seen_for_a_second)
                seen = placed(node)
                both = seen.keys() & same.keys()
                assert len(both) > 5 and all(seen[stamp] == same[stamp] for stamp in both), "the node's own"
                path = np.array(list(seen.values()))
                assert np.ptp(path, axis=0).max() > 1e-3, "the phantom's tissue is pulled by millimetres"
                first.send_signal(signal.SIGKILL)
                first.wait(10)
            count = len(node.came["/sags/anchors"])
            with bridge(run_dir) as second:
                until(lambda: len(node.came["/sags/anchors"]) > count + 5)
                view = json.dumps({"name": "ros", "width": 64, "height": 48, "fov": 60})
                node.publish("std_msgs/msg/String", "/sags/request/open_view", data=view)
                until(lambda: node.came["/sags/view/ros/image/compressed"])
                os.kill(running.process.pid, signal.SIGKILL)
                until(lambda: any(b"too old" in data for data in joined.came["/diagnostics"]))
                stamps = [each.stamp for each in node.came["/sags/anchors"][count:]]
                assert stamps == sorted(set(stamps)), "sent again"
                until(lambda: stale(joined.newest("/diagnostics")))
                second.send_signal(signal.SIGINT)
                assert second.wait(30) == 0


def test_the_example_publishes_where_the_tissue_is(tmp_path: Path) -> None:
    """examples/ros2/follow_tissue.py, as its first lines say."""
    where = "geometry_msgs/msg/PointStamped:/tissue_point:reliable"
    command = [rclpy_python(), ROOT / "examples/ros2/follow_tissue.py"]
    command += ["--ros-args", "-p", "u:=150.0", "-p", "v:=120.0"]
    with RunningNode(SESSION, tmp_path, "source.pace:=realtime"):
        with ros_node(where) as node, bridge(tmp_path / "run"):
            environment = os.environ | {"ROS_DOMAIN_ID": str(DOMAIN)} | LARGE_BUFFERS
            with killed(subprocess.Popen(command, env=environment)) as example:
                until(lambda: len(node.came["/tissue_point"]) > 3)
                example.send_signal(signal.SIGINT)
                assert example.wait(60) == 0
    depths = [np.frombuffer(bytes.fromhex(each.data)[-8:], "<f8")[0] for each in node.came["/tissue_point"]]
    assert 0.03 < np.median(depths) < 0.2, "metres, of tissue"
