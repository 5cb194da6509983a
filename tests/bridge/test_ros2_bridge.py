"""What `sags bridge ros2` sends into a graph, and what may be asked there: read by DDS alone."""

import json
import struct
import time
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from bridging import FRAME_TOPICS, anchored, anchored_at, asked, bridged, options_of, plane_bridged, sockets
from made_messages import message_of
from ros_peers import DOMAIN, KEPT, Listener
from synthetic import HEIGHT, WIDTH, plane_camera, plane_depth, stream
from waiting import until

from sags_node.clients.bridge import ros2
from sags_node.clients.bridge.compressed import LARGEST, Compressor
from sags_node.clients.bridge.ros2 import PACE, Pace, Ros2Options, offers, run_ros2
from sags_node.clients.bridge.ros2_requests import asks
from sags_node.config.schema import RosGraph
from sags_node.errors import SagsError
from sags_node.messaging import cdr, topics
from sags_node.messaging.received import ReceivedImage, interpret
from sags_node.messaging.subscriber import Subscriber
from sags_node.ros.graph import Delivery, kernel_buffer

pytestmark = pytest.mark.live

RARE = ("status", "diagnostics")
TEXT, TF, ARRAY = topics.STRING, topics.TF, topics.DIAGNOSTICS
options = partial(options_of, Ros2Options, graph=RosGraph(domain=DOMAIN))


def named(topic: str) -> str:
    return {"tf": "/tf", "diagnostics": "/diagnostics"}.get(topic, f"/sags/{topic}")


def stamp_of(data: bytes, at: int) -> int:
    seconds, nanoseconds = struct.unpack_from("<iI", data, at)
    return int(seconds) * 10**9 + int(nanoseconds)


def timeless(data: bytes, stamp_ns: int) -> bytes:
    """A message without its stamp, which is all that changes; in whole words, as DDS sends it."""
    assert struct.pack("<iI", *divmod(stamp_ns, 10**9)) in data
    whole = data + bytes(-len(data) % 4)
    return whole.replace(struct.pack("<iI", *divmod(stamp_ns, 10**9)), bytes(8))


def diagnostics(joined: Listener) -> list[list[Any]]:
    """The findings of each message."""
    return [cdr.decode(data, ARRAY).status for data in joined.came["/diagnostics"]]


def text(joined: Listener, name: str) -> str:
    return cdr.decode(joined.newest(name), TEXT).data


def test_every_topic_comes_byte_for_byte(tmp_path: Path) -> None:
    wanted = [(named(topic.name), topic.type) for topic in topics.TOPICS if topic.name in FRAME_TOPICS]

    def stages() -> set[str]:
        return {status.name for array in diagnostics(joined) for status in array}

    with plane_bridged(run_ros2, options(tmp_path)) as (_, _), Listener(*wanted) as joined:
        until(lambda: {"sags: node", "sags: map", "sags: bridge"} <= stages())  # the last once a second
        until(lambda: all(len(joined.came[name]) > (0 if kind == TEXT else 1) for name, kind in wanted))
        with Subscriber(FRAME_TOPICS, run_dir=tmp_path) as beside:
            until(lambda: all(beside.latest(name) for name in FRAME_TOPICS))
            sent = {name: beside.latest(name) for name in FRAME_TOPICS if name not in RARE}
    for name, message in sent.items():
        expected = timeless(message.cdr(), message.stamp_ns)
        for data in joined.came[named(name)]:
            at = 8 if name == "tf" else 4
            assert timeless(data, stamp_of(data, at)) == expected, name
    assert json.loads(text(joined, "/sags/status"))["state"] == "running"


@pytest.mark.fault("network: two nodes publish under one name in a ROS 2 graph")
def test_a_namesake_in_the_graph_is_said_until_it_goes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(ros2, "BEAT", 0.2)

    def said() -> str:
        return " ".join(status.message for array in diagnostics(joined)[-1:] for status in array)

    with bridged(run_ros2, options(tmp_path)), Listener(("/diagnostics", ARRAY)) as joined:
        until(lambda: "no node" in said().lower())
        shared = joined.graph.writer("/diagnostics", ARRAY)
        time.sleep(0.6)  # three beats
        assert "two nodes" not in said()  # all of ROS may publish there
        namesake = joined.graph.writer("/sags/left/depth", topics.IMAGE)
        until(lambda: "two nodes" in said())
        del namesake
        until(lambda: "two nodes" not in said())
        del shared
    assert sum("two nodes" in record.getMessage() for record in caplog.records) == 1


def test_only_what_is_read_is_asked_of_the_node(tmp_path: Path) -> None:
    with plane_bridged(run_ros2, options(tmp_path)) as (running, _):
        until(lambda: running.wanted("status"))
        time.sleep(0.4)  # for others to arrive, if there are any
        assert asked(running) == {"status"}
        with Listener(("/sags/anchors", topics.POINT_CLOUD)) as joined:
            until(lambda: joined.came["/sags/anchors"])
            assert asked(running) == {"anchors", "status"}
        until(lambda: not running.wanted("anchors"))


def test_tf_knows_the_frame_of_the_right_eye(tmp_path: Path) -> None:
    """A stock tf2 listener reads `/tf_static` so, and cannot place right images without."""
    info = ("/sags/right/camera_info", topics.CAMERA_INFO)
    with (
        plane_bridged(run_ros2, options(tmp_path)),
        Listener(("/tf_static", TF, KEPT), info) as joined,
    ):
        until(lambda: joined.came["/tf_static"] and joined.came[info[0]])
        (told,) = cdr.decode(joined.newest("/tf_static"), TF).transforms
        right = cdr.decode(joined.newest(info[0]), topics.CAMERA_INFO)
    assert told.header.frame_id == cdr.LEFT_FRAME and told.child_frame_id == right.header.frame_id
    place, turn = told.transform.translation, told.transform.rotation
    assert (place.x, place.y, place.z) == (pytest.approx(-right.p[3] / right.p[0]), 0, 0) and place.x > 0
    assert (turn.w, turn.x, turn.y, turn.z) == (1, 0, 0, 0)


def stale(joined: Listener) -> list[str]:
    """The reasons in the newest message that calls something stale."""
    for array in reversed(diagnostics(joined)):
        if found := [f"{status.name}: {status.message}" for status in array if status.level == 3]:
            return found
    return []


def test_what_stops_is_not_sent_again_and_is_called_stale(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ros2, "BEAT", 0.2)
    wanted = [("/tf", TF), ("/sags/left/camera_info", topics.CAMERA_INFO), ("/diagnostics", ARRAY)]
    texts = [("/sags/status", TEXT, KEPT), ("/sags/parameters", TEXT, KEPT)]
    with bridged(run_ros2, options(tmp_path)), Listener(*wanted, *texts) as joined:
        until(lambda: any("sags: node: " in line and "no node" in line.lower() for line in stale(joined)))
        with sockets(tmp_path) as running:
            running.publish_parameters({"seed": 1})
            with stream(running, anchored_at):
                until(lambda: all(len(joined.came[name]) > 5 for name, _ in wanted[:2]))
                until(lambda: any(b"seed" in data for data in joined.came["/sags/parameters"]))
                until(lambda: json.loads(text(joined, "/sags/status"))["rate_hz"])
                until(lambda: any(b"map" in data for data in joined.came["/diagnostics"]))
            until(lambda: any("sags: map: " in line and "too old" in line for line in stale(joined)))
            for name, at in (("/tf", 8), ("/sags/left/camera_info", 4)):
                stamps = [stamp_of(data, at) for data in joined.came[name]]
                assert len(stamps) == len(set(stamps)), f"{name} was sent again"
            for name, *_ in texts:
                until(lambda name=name: "silent" in text(joined, name))
            with Listener(("/sags/status", TEXT, KEPT), (*wanted[1], KEPT)) as late:
                until(lambda: late.came["/sags/status"])
                time.sleep(0.3)
                assert len(late.came["/sags/status"]) == 1 and "silent" in text(late, "/sags/status")
                assert not late.came["/sags/left/camera_info"], "old is given as new"
        count = len(joined.came["/tf"])
        with sockets(tmp_path) as running, stream(running, anchored_at):  # another node, on other ports
            until(lambda: len(joined.came["/tf"]) > count + 5)


def test_points_are_thinned_and_pictures_are_small_files(tmp_path: Path) -> None:
    wanted = [
        ("/sags/points", topics.POINT_CLOUD), ("/sags/points/all", topics.POINT_CLOUD),
        ("/sags/left/image_rect_color/compressed", cdr.COMPRESSED),
        ("/sags/left/tissue_mask/compressed", cdr.COMPRESSED),
        ("/sags/left/depth/compressedDepth", cdr.COMPRESSED),
    ]  # fmt: skip
    with plane_bridged(run_ros2, options(tmp_path, points=100)) as (_, _), Listener(*wanted) as joined:
        until(lambda: all(len(joined.came[name]) > 1 for name, _ in wanted))
    few, every = (
        cdr.decode(joined.newest(name), topics.POINT_CLOUD) for name in ("/sags/points", "/sags/points/all")
    )
    rows = every.data.reshape(every.width, every.point_step)
    assert every.width > 300 and 50 < few.width <= 100
    assert few.fields == every.fields
    assert {row.tobytes() for row in few.data.reshape(few.width, -1)} <= {row.tobytes() for row in rows}

    def file(name: str) -> Any:
        return cdr.decode(joined.newest(f"/sags/left/{name}"), cdr.COMPRESSED)

    picture = file("image_rect_color/compressed")
    assert picture.format == "rgb8; jpeg compressed bgr8"
    assert cv2.imdecode(picture.data, cv2.IMREAD_COLOR).shape == (HEIGHT, WIDTH, 3)
    mask = cv2.imdecode(file("tissue_mask/compressed").data, cv2.IMREAD_UNCHANGED)
    assert np.array_equal(mask, np.where(anchored().observation.tissue, 255, 0))
    depth = file("depth/compressedDepth")
    truth = plane_depth(plane_camera())
    assert depth.format == "32FC1; compressedDepth png"
    decoded = as_ros_decodes(depth.data)
    assert np.isnan(decoded[0]).all(), "what is not known"
    # Half a count, and more.
    assert np.abs(decoded[1:] - truth[1:]).max() < 0.02e-3 * (truth.max() / 0.1) ** 2


def as_ros_decodes(data: np.ndarray) -> np.ndarray:
    """As compressed_depth_image_transport does, from its source: codec.cpp."""
    form, a, b = struct.unpack_from("<iff", data)
    assert form == 0
    counts = cv2.imdecode(data[12:], cv2.IMREAD_UNCHANGED).astype(np.float32)
    with np.errstate(divide="ignore"):
        return np.where(counts > 0, np.float32(a) / (counts - np.float32(b)), np.float32(np.nan))


@pytest.mark.parametrize(
    "name", ["left/image_rect_color", "left/render/image", "left/depth", "left/render/depth_confidence"]
)
def test_what_compresses_badly_is_made_coarser_until_it_fits(name: str) -> None:
    """Noise of 1280x1024 px, which no codec makes small without loss."""
    topic = topics.find(name)
    rng = np.random.default_rng(0)
    if topic.content.startswith("32FC1"):
        smooth = 0.1 * np.ones((256, 320), np.float32)
        noisy = smooth * (1 + 0.01 * rng.standard_normal(smooth.shape, np.float32))
    else:
        channels = 4 if topic.content.startswith("rgba8") else 3
        smooth = np.full((480, 640, channels), 200, np.uint8)
        noisy = rng.integers(0, 256, smooth.shape, np.uint8)
    compress = Compressor(topic)
    first = len(compress(received(name, smooth)))
    assert len(compress(received(name, noisy))) < LARGEST + 200  # and the message around it
    later = [len(compress(received(name, smooth))) for _ in range(10)]
    assert later[-1] == first, "fine again"


def received(name: str, array: np.ndarray) -> ReceivedImage:
    encoding = {3: "rgb8", 4: "rgba8"}[array.shape[2]] if array.ndim == 3 else "32FC1"
    body = cdr.image(array, encoding, 1)
    found = interpret(message_of(name, body), 0)
    assert isinstance(found, ReceivedImage)
    return found


def test_requests_are_passed_on_and_answered(tmp_path: Path) -> None:
    calls: list[tuple[str, dict[str, Any]]] = []

    def note(name: str) -> Any:
        def handle(args: dict[str, Any]) -> dict[str, Any]:
            calls.append((name, args))
            if name == "reset_model":
                raise SagsError("not now")
            return {"id": 7}

        return handle

    handlers = {ask.op: note(ask.op) for ask in asks(["ros"]).values()}
    bridge = plane_bridged(run_ros2, options(tmp_path), handlers=handlers)
    with bridge, Listener(("/sags/answer", TEXT)) as joined:

        def ask(name: str, content: bytes) -> dict[str, Any]:
            kind = asks(["ros"])[name].kind
            count = len(joined.came["/sags/answer"])
            writer = joined.graph.writer(f"/sags/request/{name}", kind, Delivery(reliable=True))
            until(lambda: writer.readers)
            writer.write(content, time.time_ns())
            until(lambda: len(joined.came["/sags/answer"]) > count)
            said = json.loads(text(joined, "/sags/answer"))
            assert said.pop("request") == name
            if calls:  # each of those who hear it knows by that whether it is the answer to its own
                assert said["args"] == calls[-1][1]
            return said

        for name, content, op, args in (
            ("add_anchor", point("world", 0.01, 0.02, 0.07), "add_anchor", {"x": 0.01, "y": 0.02, "z": 0.07}),
            ("add_anchor_at_pixel", HEAD + struct.pack("<ddd", 12.5, 3.0, 0.0), "add_anchor",
             {"u": 12.5, "v": 3.0}),
            ("remove_anchor", HEAD + struct.pack("<I", 7), "remove_anchor", {"id": 7}),
            ("open_view", string('{"name": "ros", "width": 64, "height": 48}'), "open_view",
             {"name": "ros", "width": 64, "height": 48}),
            ("start_recording", string("case_1"), "start_recording", {"path": "case_1"}),
            ("pause", HEAD + b"\0", "pause", {}),
        ):  # fmt: skip
            assert ask(name, content) == {"args": args, "result": {"id": 7}}
            assert calls.pop() == (op, args)
        assert "not now" in ask("reset_model", HEAD + b"\0")["error"]
        calls.clear()
        for name, content, reason in (
            ("add_anchor", point("tool", 0.0, 0.0, 0.0), "frame 'world'"),
            ("add_anchor", point("world", float("nan"), 0.0, 0.0), "finite"),
            ("add_anchor", HEAD, "damaged"),
            ("open_view", string('{"name": "other"}'), "--view: ros"),
            ("open_view", string("[" * 100_000), "JSON object"),
            ("start_recording", string("../../etc"), "letters"),
        ):
            assert reason in ask(name, content)["error"]
        assert calls == []


HEAD = b"\0\1\0\0"  # of CDR, little-endian


def string(text: str) -> bytes:
    return cdr.string(text).cdr()


def point(frame: str, x: float, y: float, z: float) -> bytes:
    """A `geometry_msgs/PointStamped`, written from the description of CDR alone."""
    name = frame.encode() + b"\0"
    head = struct.pack("<iII", 0, 0, len(name)) + name
    return HEAD + head + b"\0" * (-len(head) % 8) + struct.pack("<ddd", x, y, z)


def test_who_asks_for_more_than_a_topic_gives_is_told(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with bridged(run_ros2, options(tmp_path)):
        with Listener(("/sags/left/depth", topics.IMAGE, KEPT)):  # reliable, and kept
            until(lambda: "/sags/left/depth: somebody reads it with stricter settings" in caplog.text)
    assert "net.core.rmem_default" in caplog.text or kernel_buffer("default") >= 4 << 20


def test_small_messages_of_a_frame_are_kept_apart() -> None:
    pace = Pace()
    begun = time.monotonic()
    for _ in range(4):
        pace.wait(150_000)
    assert time.monotonic() - begun >= 3 * 150_000 / PACE


def test_views_have_topics_of_their_own(tmp_path: Path) -> None:
    names = {offer.output.name for offer in offers(options(tmp_path, views=("a", "b")))}
    assert {"/sags/view/a/image", "/sags/view/b/left/depth/compressedDepth"} <= names
