"""What a client of Foxglove's WebSocket protocol gets, and what it may ask for."""

import base64
import json
import re
import struct
import sys
import threading
from collections.abc import Iterator
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bridging import FRAME_TOPICS, Pinned, anchored_at, asked, bridged, options_of, plane_bridged, sockets
from places import ROOT
from ports import free_port, is_free
from synthetic import HEIGHT, WIDTH, plane_result, stream
from waiting import until

from sags_node.messaging.sockets import Closes

pytest.importorskip("foxglove", reason="no Foxglove without: pip install '.[bridges]'")
pytest.importorskip("websockets", reason="no peer without the package websockets")

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from sags_node.clients.bridge.foxglove import CLICKED, FoxgloveOptions, clicked, outputs, run_foxglove
from sags_node.clients.bridge.foxglove_layout import layout_of
from sags_node.messaging import cdr, topics
from sags_node.messaging.publisher import Publisher
from sags_node.messaging.subscriber import Subscriber

pytestmark = pytest.mark.live

SUBPROTOCOL = "foxglove.sdk.v1"
MESSAGE_DATA = 1  # opcode
SEQUENCE_PARAMETERS = 7  # type of the H.264 unit that a key image begins with here
KEY_EVERY = 30  # images
RARE = ("/sags/status", "/sags/diagnostics")
options = partial(options_of, FoxgloveOptions, port=0)


class Client(Closes):
    """Speaks the protocol from its description alone: channel -> messages (log time ns, bytes)."""

    def __init__(self, port: int) -> None:
        self.info: dict[str, Any] = {}
        self.channels: dict[str, dict[str, Any]] = {}
        self.came: dict[str, list[tuple[int, bytes]]] = {}
        self.said: list[dict[str, Any]] = []  # status and removeStatus
        self.reading = threading.Event()
        self.reading.set()
        self._subscribed: dict[int, str] = {}
        self._socket = connect(
            f"ws://127.0.0.1:{port}", subprotocols=[SUBPROTOCOL], max_size=1 << 26, open_timeout=60
        )  # type: ignore[list-item]
        self._thread = threading.Thread(target=self._read)
        self._thread.start()

    def _read(self) -> None:
        try:
            while True:
                self.reading.wait(30)
                self._take(self._socket.recv())
        except ConnectionClosed:
            return

    def _take(self, message: str | bytes) -> None:
        if isinstance(message, bytes):
            if message[0] == MESSAGE_DATA:
                number, log_time = struct.unpack_from("<IQ", message, 1)
                self.came[self._subscribed[number]].append((log_time, message[13:]))
            return
        said = json.loads(message)
        if said["op"] == "serverInfo":
            self.info = said
        elif said["op"] == "advertise":
            self.channels |= {channel["topic"]: channel for channel in said["channels"]}
        elif said["op"] in ("status", "removeStatus"):
            self.said.append(said)

    def subscribe(self, *names: str) -> None:
        until(lambda: all(name in self.channels for name in names))
        new = {len(self._subscribed) + i: name for i, name in enumerate(names)}
        self._subscribed |= new
        self.came |= {name: [] for name in names}
        wanted = [{"id": number, "channelId": self.channels[name]["id"]} for number, name in new.items()]
        self._socket.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))

    def send(self, message: str | bytes) -> None:
        self._socket.send(message)

    def close(self) -> None:
        self.reading.set()
        self._socket.close()
        self._thread.join(60)


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("run")


@pytest.fixture(scope="module")
def plane(place: Path) -> Iterator[tuple[Publisher, int]]:
    """A node that sends the plane, and the port of a bridge to it."""
    with plane_bridged(run_foxglove, options(place)) as both:
        yield both


@pytest.fixture
def port(plane: tuple[Publisher, int]) -> int:
    return plane[1]


def ros(joined: Client, name: str) -> Any:
    """The newest ROS message of a channel, read by its own schema's name."""
    return cdr.decode(joined.came[name][-1][1], joined.channels[name]["schemaName"])


def told(joined: Client, words: str) -> bool:
    return any(words in said.get("message", "").lower() for said in joined.said)


def test_every_topic_comes_byte_for_byte_with_its_schema(port: int, place: Path) -> None:
    names = [f"/sags/{name}" for name in FRAME_TOPICS]
    with Client(port) as joined:
        joined.subscribe(*names)
        with Subscriber(FRAME_TOPICS, run_dir=place) as beside:
            until(lambda: all(len(joined.came[name]) > 8 * (name not in RARE) for name in names))
            until(lambda: all(beside.latest(name) is not None for name in FRAME_TOPICS))
            newest = {name: beside.latest(name) for name in FRAME_TOPICS}
            kept = {(name, m.stamp_ns): m.cdr() for name, m in newest.items() if m is not None}
            # what was just sent comes there too, or something newer
            until(lambda: all(joined.came[f"/sags/{name}"][-1][0] >= stamp for name, stamp in kept))
    assert joined.info["name"] == "SAGS sags" and joined.info["capabilities"] == []
    for topic in topics.TOPICS:
        channel = joined.channels[f"/sags/{topic.name}"]
        assert channel["encoding"] == "cdr" and channel["schemaEncoding"] == "ros2msg"
        assert channel["schemaName"] == topic.type and channel["schema"] == cdr.definition(topic.type)
    same = 0
    for name in FRAME_TOPICS:
        for log_time, data in joined.came[f"/sags/{name}"]:
            if (name, log_time) in kept:
                assert data == kept[name, log_time], name
                same += 1
    assert same >= len(FRAME_TOPICS) - 2  # of each topic the newest; status may have come between
    picture = ros(joined, "/sags/left/image_rect_color")
    assert np.array_equal(picture.data.reshape(HEIGHT, WIDTH, 3), plane_result().pair.left)


def test_only_what_is_looked_at_is_asked_of_the_node(plane: tuple[Publisher, int]) -> None:
    running, port = plane
    until(lambda: asked(running) == {"status"})
    with Client(port) as joined:
        joined.subscribe("/sags/anchors")
        until(lambda: asked(running) == {"anchors", "status"})
    until(lambda: asked(running) == {"status"})


def test_what_stops_is_empty_and_comes_back(tmp_path: Path) -> None:
    """An age that grows is told once a second."""

    def ages() -> list[float]:
        found = (re.search(r"too old: ([\d.]+) s", said.get("message", "")) for said in joined.said)
        return [float(age[1]) for age in found if age is not None]

    image, depth, anchors = "/sags/left/render/image", "/sags/left/render/depth", "/sags/anchors"
    with bridged(run_foxglove, options(tmp_path)) as port, Client(port) as joined:
        joined.subscribe(image, depth, anchors)
        until(lambda: told(joined, "no node"))
        with sockets(tmp_path) as running:
            with stream(running, anchored_at):
                until(lambda: all(joined.came[name] for name in (image, depth, anchors)))
            until(lambda: not ros(joined, image).data.any())
            until(lambda: np.isnan(ros(joined, depth).data.view(np.float32)).all())
            until(lambda: ros(joined, anchors).width == 0)
            counts = {name: len(joined.came[name]) for name in (image, depth, anchors)}
            before = len(ages())  # which one after the other has become too old
            until(lambda: len(ages()) > before + 2)
            assert np.diff(ages()[before:]).min() > 0.9
            assert counts == {name: len(joined.came[name]) for name in counts}, "nothing more comes"
        with sockets(tmp_path) as running, stream(running, anchored_at):  # another node, on other ports
            until(lambda: ros(joined, image).data.any() and ros(joined, anchors).width == 4)
            until(lambda: joined.said[-1]["op"] == "removeStatus")


def test_who_looks_at_everything_is_told_at_once_what_is_missing_and_stays(tmp_path: Path) -> None:
    """So is who comes later. The server disconnects a client for which more statuses wait than there are
    channels."""
    with bridged(run_foxglove, options(tmp_path)) as port, ExitStack() as stack:
        both = []
        for _ in range(2):
            both.append(joined := stack.enter_context(Client(port)))
            joined.subscribe("/sags/figures")  # waits for the channels
            joined.subscribe(*joined.channels.keys() - {"/sags/figures"})
            until(lambda: told(both[-1], "no node"))
        with sockets(tmp_path) as running, stream(running, anchored_at):
            until(lambda: all(each.came["/sags/tf"] for each in both))


def test_without_pyav_there_is_no_video(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("av", reason="no H.264 without PyAV")
    assert any(output.name.endswith("/h264") for output in outputs(options(tmp_path)))
    monkeypatch.setitem(sys.modules, "av", None)
    assert not any(output.name.endswith("/h264") for output in outputs(options(tmp_path)))


def test_a_bridge_that_is_started_anew_goes_on_on_the_same_port(tmp_path: Path) -> None:
    with sockets(tmp_path) as running, stream(running, anchored_at):
        port = free_port()
        for _ in range(2):
            with bridged(run_foxglove, options(tmp_path, port=port)), Client(port) as joined:
                joined.subscribe("/sags/tf")
                until(lambda: joined.came["/sags/tf"])
            until(lambda: is_free(port))  # a server of the SDK ends a moment after it was stopped


def test_a_client_that_does_not_read_holds_nobody_up_and_goes_on_with_what_is_new(port: int) -> None:
    name = "/sags/left/render/image"
    with Client(port) as quick, Client(port) as slow:
        for each in (quick, slow):
            each.subscribe(name)
            until(lambda each=each: each.came[name])
        slow.reading.clear()
        before = len(quick.came[name])
        until(lambda: len(quick.came[name]) > before + 60)
        newest = quick.came[name][-1][0]
        slow.reading.set()
        until(lambda: slow.came[name][-1][0] > newest)


def video(joined: Client, name: str) -> list[Any]:
    """What came, read by the schema that the channel names."""
    pool, channel = descriptor_pool.DescriptorPool(), joined.channels[name]
    for file in descriptor_pb2.FileDescriptorSet.FromString(base64.b64decode(channel["schema"])).file:
        pool.Add(file)
    kind = message_factory.GetMessageClass(pool.FindMessageTypeByName(channel["schemaName"]))
    return [kind.FromString(message) for _, message in joined.came[name]]


def test_pictures_come_as_h264_that_anybody_can_begin_with(port: int) -> None:
    av = pytest.importorskip("av", reason="no H.264 without PyAV")
    name, right = (f"/sags/{eye}/image_rect_color/h264" for eye in ("left", "right"))
    with Client(port) as first, Client(port) as second:
        first.subscribe(name)
        until(lambda: len(first.came[name]) > 5)
        second.subscribe(name, right)
        until(lambda: len(second.came[name]) > KEY_EVERY and second.came[right])
        assert second.channels[name]["schemaName"] == "foxglove.CompressedVideo"
    fields = video(second, name)
    assert {each.frame_id for each in fields} == {"left_optical_frame"}
    assert video(second, right)[0].frame_id == "right_optical_frame"
    assert all(each.format == "h264" and each.data.startswith(b"\x00\x00\x00\x01") for each in fields)
    # An image may go out while the server is still telling that somebody came.
    began = next(n for n, each in enumerate(fields) if each.data[4] & 31 == SEQUENCE_PARAMETERS)
    assert began < KEY_EVERY / 3, "it is not left to wait for the next key image"
    decoder, pictures = av.CodecContext.create("h264", "r"), []
    for each in fields[began : began + 6]:
        pictures += decoder.decode(av.Packet(each.data))
    assert len(pictures) == 6, "an image for each message from then on"
    error = np.abs(pictures[-1].to_ndarray(format="rgb24").astype(int) - plane_result().pair.left)
    assert np.median(error) <= 12  # colour at half size, in an image whose colour changes with every pixel
    raw = WIDTH * HEIGHT * 3
    assert np.mean([len(each.data) for each in fields[began + 1 : began + 6]]) < raw / 10


@pytest.mark.fault("image: what is unsure, or not drawn, in H.264")
def test_h264_shows_what_has_alpha_over_black() -> None:
    """As the node's JPEG, and OpenIGTLink: what is unsure is faint, and what is not drawn is not there."""
    av = pytest.importorskip("av", reason="no H.264 without PyAV")
    from sags_node.clients.bridge.h264 import Encoder

    color, alphas = np.array([255, 220, 0]), (0, 0.35, 1)
    stripes = [np.full((65, 64, 4), [*color, round(255 * alpha)], np.uint8) for alpha in alphas]
    (decoded,) = av.CodecContext.create("h264", "r").decode(av.Packet(Encoder().encode(np.hstack(stripes))))
    for n, alpha in enumerate(alphas):
        middle = decoded.to_ndarray(format="rgb24")[16:48, 64 * n + 16 : 64 * n + 48]
        assert np.abs(middle - alpha * color).max() <= 6  # of 255: coding


def test_status_comes_as_figures_for_plots(port: int) -> None:
    with Client(port) as joined:
        joined.subscribe("/sags/figures")
        until(lambda: joined.came["/sags/figures"])
    said = json.loads(joined.came["/sags/figures"][-1][1])
    assert said["rate_hz"] == 30.0 and said["latency_ms"]["p50"] == 40.0 and said["gaussians"] == 384


# ---- requests --------------------------------------------------------------------------------------------


def click(joined: Client, frame: str = "world") -> None:
    channel = {"id": 1, "topic": CLICKED, "encoding": "json", "schemaName": "geometry_msgs/PointStamped"}
    joined.send(json.dumps({"op": "advertise", "channels": [channel]}))
    point = {
        "header": {"stamp": {"sec": 0, "nsec": 0}, "frame_id": frame},
        "point": {"x": 0.01, "y": 0.02, "z": 0.07},
    }
    joined.send(struct.pack("<BI", 1, 1) + json.dumps(point).encode())


def test_a_click_pins_an_anchor_where_that_is_allowed(tmp_path: Path) -> None:
    pinned = Pinned()
    with sockets(tmp_path, pinned.handlers) as running, stream(running):
        with bridged(run_foxglove, options(tmp_path, pin=True)) as port, Client(port) as joined:
            until(lambda: joined.info)
            assert joined.info["capabilities"] == ["clientPublish"]
            click(joined, frame="left_optical_frame")
            until(lambda: told(joined, "'world'"))
            click(joined)
            until(lambda: pinned.added)
            until(lambda: told(joined, "depth_confidence"))
        assert pinned.added == [{"x": 0.01, "y": 0.02, "z": 0.07}]
        with bridged(run_foxglove, options(tmp_path)) as port, Client(port) as joined:
            click(joined)
            joined.subscribe("/sags/tf")
            until(lambda: len(joined.came["/sags/tf"]) > 10)
    assert len(pinned.added) == 1, "nobody may without --pin"


@pytest.mark.parametrize(
    "data",
    [
        *(b"", b"{}", b"[1]", b"\xff", b'{"header": 3}', b"[" * 100_000),
        b'{"header": {"frame_id": "world"}, "point": {"x": NaN, "y": 0, "z": 0}}',
    ],
)
def test_what_is_no_point_pins_nothing(data: bytes) -> None:
    assert clicked(data) is None


def test_the_layout_that_is_kept_names_the_channels_there_are(tmp_path: Path) -> None:
    text = (ROOT / "examples/foxglove/sags.json").read_text()
    assert text == layout_of("sags", "overlay"), (
        "write it again: sags bridge foxglove --layout examples/foxglove/sags.json"
    )
    named = set(re.findall(r'"(/(?:sags|overlay)/[^".]*)', text))
    with bridged(run_foxglove, options(tmp_path)) as port, Client(port) as joined:
        until(lambda: named <= joined.channels.keys())
    shown = ("left/image_rect_color", "left/render/image", "points", "anchors", "figures")
    assert {f"/sags/{name}" for name in shown} <= named
