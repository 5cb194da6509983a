"""Thin images over real sockets: what comes, how large and exact it is, and what wrong requests hear."""

import itertools
from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest
from independent_client import collect
from recorded_plane import by_topic, recording
from synthetic import HEIGHT, WIDTH, plane_result
from thin_sender import making, node_sockets
from waiting import heard, until

from sags_node.clients.recording.recorder import Recorder, RecordOptions
from sags_node.errors import SagsError, UsageError
from sags_node.messaging import content, topics
from sags_node.messaging.address import NodeAddress
from sags_node.messaging.introspection import topic_echo, topic_figures, topic_info
from sags_node.messaging.publisher import MAX_THIN, Publisher
from sags_node.messaging.received import ReceivedCompressed, ReceivedImage, TopicName
from sags_node.messaging.subscriber import Subscriber
from sags_node.messaging.thin import DEPTH_STEP, thin_pictures
from sags_node.node.recorder import findings

pytestmark = pytest.mark.live

IMAGE = TopicName("left/render/image", ReceivedImage)
DEPTH = TopicName("left/render/depth", ReceivedImage)
SURE = TopicName("left/render/depth_confidence", ReceivedImage)
MASK = TopicName("left/tissue_mask", ReceivedImage)
# Of the mean of 16 x 16 px, grey levels. At quality 80 means are stored in steps of 6/8 (luma) and 7/8
# (chroma): blue is at most 0.4 + 1.77 * 0.44 beside. The rest is rounding, and what decoders blend.
JPEG_ERROR = 3


def thin_name(name: str) -> TopicName[ReceivedCompressed]:
    return TopicName(name, ReceivedCompressed)


def frame_of(running: Publisher, *names: str) -> dict[str, np.ndarray]:
    """The arrays of one frame, as a subscriber decodes them."""
    with Subscriber(names, running.connection.data[-1]) as subscriber:
        leading = None
        for _ in range(50):
            leading = subscriber.wait(names[0], 60, after=leading)
            assert leading is not None, subscriber.problem(names[0])
            frame = subscriber.aligned(names, leading.stamp_ns, timeout=0.2)
            if frame is not None:
                until(lambda: all(subscriber.ok(name) for name in names))
                return {name: frame[name].array for name in names}  # type: ignore[attr-defined]
    raise AssertionError("no whole frame")


def smaller(picture: np.ndarray, every: int) -> np.ndarray:
    """Each pixel the mean of `every` x `every`."""
    return cv2.resize(picture, None, fx=1 / every, fy=1 / every, interpolation=cv2.INTER_AREA)


def test_depth_is_exact_to_half_a_step_and_unknown_stays_unknown(tmp_path: Path) -> None:
    result = plane_result()
    view = result.views["left"]
    depth = view.depth.copy()
    depth[5, 7] = 3.5  # further than 16 bit say
    result = replace(result, views={**result.views, "left": replace(view, depth=depth)})
    whole, half = thin_name("thin/full/left/render/depth/png"), thin_name("thin/half/left/render/depth/png")
    part = thin_name("thin/half/10,20,31,24/left/render/depth/png")
    measured = thin_name("thin/full/left/depth/png")
    with node_sockets(tmp_path, right=True) as running, making(running, result):
        said = frame_of(running, whole, half, part, measured, DEPTH)
    known = said[DEPTH].copy()
    known[5, 7] = np.nan
    for name, expected in ((whole, known), (half, known[::2, ::2]), (part, known[20:44:2, 10:40:2])):
        assert said[name].dtype == np.float32 and said[name].shape == expected.shape
        assert np.array_equal(np.isnan(said[name]), np.isnan(expected))
        assert np.nanmax(np.abs(said[name] - expected)) <= DEPTH_STEP / 2 + 1e-7  # 1e-7: of float32
    assert np.array_equal(np.isnan(said[measured]), plane_result().observation.depth == 0)


def test_pictures_masks_and_confidence_come_as_they_are(tmp_path: Path) -> None:
    names = {
        "camera": thin_name("thin/full/left/image_rect_color/jpeg"),
        "right": thin_name("thin/half/right/image_rect_color/jpeg"),
        "drawn": thin_name("thin/half/left/render/image/jpeg"),
        "alpha": thin_name("thin/half/left/render/image/alpha"),
        "sure": thin_name("thin/full/left/render/depth_confidence/png"),
        "mask": thin_name("thin/quarter/8,4,80,60/left/tissue_mask/png"),
    }
    result = plane_result()
    view = result.views["left"]
    ramp = np.linspace(0, 1, WIDTH, dtype=np.float32)[None].repeat(HEIGHT, 0)
    result = replace(result, views={**result.views, "left": replace(view, alpha=ramp)})
    with node_sockets(tmp_path, right=True) as running, making(running, result):
        said = frame_of(running, *names.values(), IMAGE, SURE, MASK)
    rgba = said[IMAGE].astype(np.float32)
    black = rgba[..., :3] * rgba[..., 3:] / 255
    halves = {"right": smaller(result.pair.right, 2), "drawn": smaller(black, 2)}
    for name, expected in {"camera": result.pair.left, **halves}.items():
        came = said[names[name]]
        assert came.shape == expected.shape and came.dtype == np.uint8
        beside = came.astype(np.float32) - expected
        assert np.abs(smaller(beside, 16)).max() < JPEG_ERROR
    mean_alpha = smaller(said[IMAGE][..., 3], 2)
    assert np.array_equal(said[names["alpha"]], mean_alpha)
    assert np.abs(said[names["sure"]] - said[SURE]).max() <= 0.5 / 255 + 1e-6
    assert np.array_equal(said[names["mask"]], said[MASK][4:64:4, 8:88:4])


def test_another_language_and_sags_topic_read_them(tmp_path: Path) -> None:
    """By docs/wire.md alone: the file is part 1; `scale` and `window` are in the header."""
    name = "thin/half/10,20,30,24/left/render/depth/png"
    with node_sockets(tmp_path) as running, making(running, plane_result()):
        node = NodeAddress(endpoint=running.connection.data[-1])
        (message,) = collect(running.connection.data[-1], [name], 1, 60)[name]
        (said,) = topic_echo("thin/half/left/depth/png", node, count=1, seconds=60)
        assert heard(partial(topic_figures, "hz", "thin/half/left/depth/png", node))["window"] >= 2
    assert message.meta["type"] == "sensor_msgs/msg/CompressedImage"
    assert message.meta["window"] == [10, 20, 2] and message.meta["scale"] == DEPTH_STEP
    stored = cv2.imdecode(np.frombuffer(message.parts[1], np.uint8), cv2.IMREAD_UNCHANGED)
    assert stored.dtype == np.uint16 and stored.shape == (12, 15)
    store_reads = content.cdr.decode(message.cdr(), message.meta["type"])
    assert bytes(store_reads.data) == message.parts[1] and store_reads.format == message.meta["encoding"]
    assert store_reads.format == "16UC1; png compressed 16UC1"
    depth = plane_result().observation.depth[::2, ::2]
    assert said["content"]["shape"] == list(depth.shape)
    assert said["content"]["max"] == pytest.approx(depth.max(), abs=DEPTH_STEP)
    assert said["content"]["unknown"] == pytest.approx(np.mean(depth == 0))


def test_nothing_is_made_that_nobody_asks_for_by_its_name(tmp_path: Path) -> None:
    name = thin_name("thin/full/left/depth/png")
    with node_sockets(tmp_path) as running, making(running, plane_result()) as made:
        with Subscriber(["left/depth", "left/render/depth"], running.connection.data[-1]) as others:
            assert others.wait("left/depth", 60) is not None
            with Subscriber([name], running.connection.data[-1]) as one:
                assert one.wait(name, 60) is not None
            until(lambda: not running.thin)
            count = len(made)
            until(lambda: len(made) > count + 5)
            assert not set().union(*made[count + 1 :])
            assert {asked for frame in made for asked in frame} == {name}


def test_a_recording_of_everything_leaves_out_what_others_asked_for(tmp_path: Path) -> None:
    """It has the whole images."""
    name = thin_name("thin/quarter/left/depth/png")
    with node_sockets(tmp_path) as running, making(running, plane_result()):
        endpoint = running.connection.data[-1]
        options = RecordOptions(tmp_path / "bag", node=NodeAddress(endpoint=endpoint))
        with Subscriber([name], endpoint) as one, recording(options) as (_, summaries):
            for _ in range(5):
                assert one.wait(name, 60, after=one.latest(name)) is not None
    written = summaries[-1]["topics"]
    assert "sags/left/depth" in written and not [each for each in written if "/thin/" in each]


def test_a_pause_loses_no_message_that_comes_after_it(tmp_path: Path) -> None:
    name = thin_name("thin/quarter/left/depth/png")
    with node_sockets(tmp_path) as running, making(running, plane_result()):
        with Subscriber([name], running.connection.data[-1], rates={name: 1.0}) as one:
            before = one.wait(name, 60)
            one.pause()
            until(lambda: not running.thin)
            one.resume()
            until(lambda: one.latest(name).stamp_ns > before.stamp_ns + 200_000_000)  # type: ignore[union-attr]


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("thin/third/left/render/image/jpeg", "no size 'third'; there are full, half, quarter"),
        ("thin/half/splats/png", "no thin form of 'splats'"),
        ("thin/half/left/depth/jpeg", "left/depth comes as png, not as jpeg"),
        ("thin/half/0,0,1,9/left/depth/png", "has no pixel"),
        ("thin/half", "no thin topic"),
        ("thin/full/right/image_rect_color/jpeg", "with publish.right:=false, has no right eye"),
        ("thin/full/90,0,10,10/left/depth/png", f"leaves the image, which has {WIDTH}x{HEIGHT} px"),
    ],
)
def test_a_wrong_request_hears_why(name: str, said: str, tmp_path: Path) -> None:
    """From the node, on the topic that was asked for; our own subscriber knows most of it before."""
    with node_sockets(tmp_path) as running, making(running, plane_result()) as made:
        (answer,) = collect(running.connection.data[-1], [name], 1, 60)[name]
        assert said in content.cdr.decode(answer.cdr(), "std_msgs/msg/String").data
        try:
            with Subscriber([name], running.connection.data[-1]) as subscriber:
                until(lambda: said in (subscriber.problem(name) or ""))
                assert not subscriber.ok(name)
        except UsageError as error:
            assert said in str(error)
        count = len(made)
        until(lambda: len(made) > count + 3)
    assert running.thin == {} or name in running.thin


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("thin/full/90,0,10,10/left/depth/png", "leaves the image"),  # said with each frame
        ("thin/half/right/render/image/jpeg", "no right eye"),  # said once
    ],
)
def test_why_there_is_no_picture_is_not_taken_for_one(name: str, said: str, tmp_path: Path) -> None:
    """It has neither a rate nor a place in a recording."""
    with node_sockets(tmp_path) as running, making(running, plane_result()):
        node = NodeAddress(endpoint=running.connection.data[-1])
        for listen in (
            partial(topic_figures, "hz"), partial(topic_figures, "bw"), topic_info,
            lambda name, node: list(topic_echo(name, node, count=1)),
        ):  # fmt: skip
            with pytest.raises(SagsError, match=said):
                listen(name, node=node)
        name = name.replace("left/depth/png", "left/image_rect_color/jpeg")
        with pytest.raises(SagsError, match=said):
            Recorder(RecordOptions(tmp_path / "none", topics=(name,), node=node)).run()
        options = RecordOptions(tmp_path / "bag", topics=("tf", name), node=node)
        with recording(options) as (recorder, summaries):
            until(lambda: min(recorder.summary()[key] for key in ("messages", "rejected")))
    assert list(summaries[-1]["topics"]) == ["sags/tf"] and list(by_topic(tmp_path / "bag")) == ["tf"]
    (told,) = (each.text for each in findings(summaries[-1]) if each.code == "recording_rejects")
    assert said in told and name in told


def test_a_thin_depth_is_not_recorded_without_its_scale(tmp_path: Path) -> None:
    """ROS takes 16-bit depth for millimetres."""
    for name in ("thin/half/left/render/depth/png", "/sags/thin/full/left/render/depth_confidence/png"):
        with pytest.raises(UsageError, match="record left/render/depth"):
            Recorder(RecordOptions(tmp_path / "bag", topics=(name,))).run()


def test_no_more_are_made_than_may_be(tmp_path: Path) -> None:
    names = [f"thin/full/{x},0,8,8/left/depth/png" for x in range(MAX_THIN + 1)]
    with node_sockets(tmp_path) as running, making(running, plane_result()) as made:
        with Subscriber(names[:-1], running.connection.data[-1]):
            until(lambda: len(running.thin) == MAX_THIN)
            with Subscriber(names[-1:], running.connection.data[-1]) as late:
                until(lambda: "made already" in (late.problem(names[-1]) or ""))
    assert max(len(frame) for frame in made) == MAX_THIN


def test_no_name_begins_with_another() -> None:
    forms = [f"{name}/{form}" for name, forms in topics.THIN_FORMS.items() for form in forms]
    parts = itertools.product(("full", "half", "quarter"), ("", "1,2,3,4/", "1,2,3,40/"), forms)
    thin = [f"thin/{size}/{region}{form}" for size, region, form in parts]
    for one, other in itertools.permutations(thin, 2):
        assert not one.startswith(other)
    assert not [name for name in topics.BY_NAME if name.startswith("thin/")]


@pytest.mark.fault("memory: none is left for a thin image")
def test_what_cannot_be_made_costs_its_topic_alone(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    names = "thin/half/left/depth/png", "thin/half/left/render/image/jpeg"
    asked, logged = {name: topics.thin_picture(name) for name in names}, set[str]()
    encode = cv2.imencode

    def full(kind: str, *arguments: object) -> object:
        if kind == ".png":
            raise MemoryError
        return encode(kind, *arguments)  # type: ignore[call-overload]

    monkeypatch.setattr(cv2, "imencode", full)
    for _ in range(3):
        made = thin_pictures(plane_result(), asked, logged)
        assert made[names[0]].type == topics.STRING and b"MemoryError" in b"".join(made[names[0]].parts)
        assert made[names[1]].type == topics.COMPRESSED_IMAGE
    assert [record.message for record in caplog.records] == [f"'{names[0]}' cannot be made"]
    monkeypatch.undo()
    assert thin_pictures(plane_result(), asked, logged)[names[0]].type == topics.COMPRESSED_IMAGE
