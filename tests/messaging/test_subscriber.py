"""The consumer's library over real sockets: what is joined, what is stale, what is refused."""

import json
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
import zmq
from independent_client import zmq_socket
from made_messages import MS, damaged, message_of
from places import ROOT
from synthetic import HEIGHT, WIDTH, at_frame, health, plane_result, publisher, stream
from waiting import until

from sags_node.errors import SagsError, UsageError
from sags_node.messaging import cdr
from sags_node.messaging import stream as data_stream
from sags_node.messaging.freshness import StaleError
from sags_node.messaging.received import (
    Received,
    ReceivedCameraInfo,
    ReceivedCloud,
    ReceivedImage,
    ReceivedText,
    TopicName,
)
from sags_node.messaging.subscriber import Subscriber
from sags_node.messaging.wire import encode

pytestmark = pytest.mark.live


# ---- what comes ------------------------------------------------------------------------------------------


def test_typed_values_of_one_frame(tmp_path: Path) -> None:
    names = ["left/image_rect_color", "left/render/depth", "left/camera_info", "splats", "tf", "parameters"]
    truth = plane_result()
    with publisher(tmp_path / "run") as running:
        running.publish_parameters({"seed": 3})
        with stream(running), Subscriber(names, run_dir=tmp_path / "run") as subscriber:
            assert subscriber.endpoint.startswith("ipc://")
            image = cast(ReceivedImage, subscriber.wait("left/image_rect_color", 30))
            frame = subscriber.aligned(names[:4], image.stamp_ns, timeout=30)
            cloud = cast(ReceivedCloud, frame["splats"])
            info = cast(ReceivedCameraInfo, frame["left/camera_info"])
            depth = cast(ReceivedImage, frame["left/render/depth"])
            assert {message.meta.frame_id for message in frame.values()} == {image.meta.frame_id}
            assert np.array_equal(image.array, truth.pair.left)
            assert depth.array.shape == (HEIGHT, WIDTH) and np.isnan(depth.array[0]).all()
            assert np.allclose(info.K, truth.pair.camera.K) and (info.width, info.height) == (WIDTH, HEIGHT)
            assert np.allclose(cloud.xyz(), truth.snapshot.gaussians.means)
            assert np.array_equal(cloud.points["id"], truth.snapshot.gaussians.ids)
            assert json.loads(cast(ReceivedText, subscriber.wait("parameters", 30)).text) == {"seed": 3}
            later = subscriber.wait("left/image_rect_color", 30, after=image)
            assert later is not None and later.meta.seq > image.meta.seq
            assert not image.array.flags.writeable
            assert subscriber.aligned(names[:4], stamp_ns=1) is None
            assert subscriber.lost("splats") == 0 and subscriber.rejected == 0


def test_a_paused_subscriber_costs_the_node_nothing_and_goes_on_with_what_is_new(tmp_path: Path) -> None:
    name = "left/render/depth"
    with publisher(tmp_path / "run") as running, stream(running):
        with Subscriber([name], run_dir=tmp_path / "run") as subscriber:
            assert subscriber.wait(name, 30)
            subscriber.pause()
            until(lambda: not running.wanted(name))
            newest, status = cast(Received, subscriber.latest(name)), subscriber.latest("status")
            assert subscriber.wait("status", 30, after=status)
            assert subscriber.latest(name) is newest
            resumed, lost = time.time_ns(), subscriber.lost(name)
            subscriber.resume()
            until(lambda: subscriber.latest(name) is not newest)
            first = cast(Received, subscriber.latest(name))
            until(lambda: cast(Received, subscriber.latest(name)).stamp_ns > resumed)
            assert first.meta.seq - newest.meta.seq > 1 and subscriber.lost(name) == lost
            until(lambda: subscriber.ok(name))


def _read_if_fresh(subscriber: Subscriber, name: str) -> Received | None:
    try:
        return subscriber.read(name)
    except StaleError:  # a busy machine may hold the sender up
        return None


def test_strict_read_raises_when_the_frames_stop(tmp_path: Path) -> None:
    with publisher(tmp_path / "run") as running:
        with Subscriber(["left/depth"], run_dir=tmp_path / "run") as subscriber:
            with pytest.raises(StaleError, match="sags/left/depth is stale: nothing received"):
                subscriber.read("left/depth")
            with stream(running):
                assert until(lambda: _read_if_fresh(subscriber, "left/depth")).age() >= 0
            until(lambda: not subscriber.ok("left/depth"))
            with pytest.raises(StaleError, match="too old"):
                subscriber.read("left/depth")
            assert subscriber.latest("left/depth") is not None  # the last content can still be looked at


def test_the_clock_is_injected(tmp_path: Path) -> None:
    now = [time.time_ns()]
    with (
        publisher(tmp_path / "run") as running,
        Subscriber(["tf"], run_dir=tmp_path / "run", clock_ns=lambda: now[0]) as subscriber,
    ):
        _publish_until(running, subscriber, plane_result(stamp_ns=now[0]))
        assert subscriber.ok("tf")
        now[0] += 490 * MS
        assert subscriber.ok("tf")
        now[0] += 20 * MS
        assert not subscriber.ok("tf")


@pytest.mark.parametrize("state", ["waiting", "stopping", "starting"])
def test_the_sender_can_say_that_it_is_invalid(tmp_path: Path, state: str) -> None:
    now = time.time_ns()
    with (
        publisher(tmp_path / "run") as running,
        Subscriber(["tf"], run_dir=tmp_path / "run", clock_ns=lambda: now) as subscriber,
    ):
        _publish_until(running, subscriber, plane_result(stamp_ns=now))
        assert subscriber.ok("tf")
        running.publish_health(health(state))
        assert subscriber.wait("status", 30) is not None
        assert state in str(subscriber.problem("tf"))
        for again in ("running", "held"):  # while frames are held, what is sent is true
            before = subscriber.latest("status")
            running.publish_health(health(again))
            assert subscriber.wait("status", 30, after=before) is not None
            assert subscriber.ok("tf")


def test_content_of_an_earlier_epoch_is_stale(tmp_path: Path) -> None:
    now = time.time_ns()
    with (
        publisher(tmp_path / "run") as running,
        Subscriber(["tf", "splats"], run_dir=tmp_path / "run", clock_ns=lambda: now) as subscriber,
    ):
        result = plane_result(epoch=0, stamp_ns=now)
        _publish_until(running, subscriber, result)
        running.publish_health(health())
        subscriber.wait("status", 30)
        assert subscriber.ok("tf")
        subscriber.pause()
        until(lambda: running.poll(10) or not running.wanted("tf"))
        running.publish_result(at_frame(result, 6, now, epoch=1), dropped=0)  # its tf does not come
        before = subscriber.latest("status")
        running.publish_health(health())
        subscriber.wait("status", 30, after=before)
        assert "started anew" in str(subscriber.problem("tf"))


def test_gaps_in_seq_are_counted_as_lost() -> None:
    with _sender() as (socket, endpoint), Subscriber(["left/depth"], endpoint=endpoint) as subscriber:
        for seq in (1, 2, 5):
            _send(socket, subscriber, "sags/left/depth", seq)
        assert subscriber.lost("left/depth") == 2


@pytest.mark.fault("socket: messages that are none, at the consumer")
def test_hostile_messages_are_counted_and_nothing_more() -> None:
    said = cdr.image(np.zeros((4, 5), np.float32), "32FC1", 1)
    with _sender() as (socket, endpoint), Subscriber(["left/depth", "tf"], endpoint=endpoint) as subscriber:
        _send(socket, subscriber, "sags/left/depth", 1)
        good = [bytes(part) for part in encode(message_of("left/depth", said, 2))]
        colour = encode(message_of("left/depth", cdr.image(np.zeros((4, 5, 3), np.uint8), "rgb8", 1), 2))[1]
        bad = [
            *damaged(good, bytes(colour)),
            [b"sags/tf", *good[1:]],  # an image where a transform is due
            [*good, *[b"more"] * 40],
        ]
        unasked = [b"sags/left/depth/deeper", *good[1:]]  # which the prefix brings
        for frames in [*bad, unasked]:
            socket.send_multipart(frames)
        _send(socket, subscriber, "sags/left/depth", 3)
        assert subscriber.rejected == len(bad)
        assert subscriber.lost("left/depth") == 1


def test_mistakes_are_named(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="did you mean 'left/render/depth'"):
        Subscriber(["left/rendr/depth"], endpoint="tcp://127.0.0.1:9")
    with pytest.raises(SagsError, match="no node runs as 'sags'"):
        Subscriber(["tf"], run_dir=tmp_path, patience=0)
    with pytest.raises(SagsError, match="cannot connect to 127"):
        Subscriber(["tf"], endpoint="127.0.0.1:5556")


def test_a_subscriber_waits_for_a_node_that_is_not_there_yet(tmp_path: Path) -> None:
    """As programs that are started together need it; not for ever."""
    with ThreadPoolExecutor() as pool:
        waiting = pool.submit(Subscriber, ["tf"], run_dir=tmp_path / "run", patience=60)
        with publisher(tmp_path / "run") as running, waiting.result(60) as subscriber, stream(running):
            assert subscriber.wait("tf", 60) is not None
    began = time.monotonic()
    with pytest.raises(SagsError, match="no node runs as 'sags'"):
        Subscriber(["tf"], run_dir=tmp_path / "gone", patience=0.3)
    assert time.monotonic() - began >= 0.3


def test_a_subscriber_that_nobody_closed_lets_the_program_end_in_silence(tmp_path: Path) -> None:
    script = (
        "from sags_node.messaging.subscriber import Subscriber\n"
        f"Subscriber(['left/render/depth'], 'ipc://{tmp_path}/nobody')\n"
    )
    ended = subprocess.run(
        [sys.executable, "-c", script], check=False, capture_output=True, text=True, timeout=60
    )
    assert (ended.returncode, ended.stdout, ended.stderr) == (0, "", "")


# ---- typed names, and memory -----------------------------------------------------------------------------


def test_typed_names_need_no_cast(tmp_path: Path) -> None:
    """A program of a user who lets mypy check everything."""
    program = tmp_path / "program.py"
    program.write_text(
        """
from typing import assert_type
from sags_node.messaging.async_subscriber import AsyncSubscriber
from sags_node.messaging.received import Frame, Received, ReceivedCloud, ReceivedImage, TopicName
from sags_node.messaging.subscriber import Subscriber

depth, splats = TopicName("left/render/depth", ReceivedImage), TopicName("splats", ReceivedCloud)
with Subscriber([depth, splats]) as subscriber:
    assert_type(subscriber.wait(depth, 1.0), ReceivedImage | None)
    assert_type(subscriber.latest(splats), ReceivedCloud | None)
    assert_type(subscriber.read(splats), ReceivedCloud)
    assert_type(subscriber.read("splats"), Received)
    frame = subscriber.aligned([depth, splats], subscriber.read(depth).stamp_ns)
    assert_type(frame, Frame | None)
    if frame is not None:
        assert_type(frame[splats], ReceivedCloud)

async def follow() -> None:
    async with AsyncSubscriber([depth]) as subscriber:
        assert_type(await subscriber.wait(depth, 1.0), ReceivedImage | None)
        async for message in subscriber.messages(depth):
            assert_type(message, ReceivedImage)
"""
    )
    checked = subprocess.run(
        [sys.executable, "-m", "mypy", "--strict", program],
        cwd=ROOT, check=False, capture_output=True, text=True, timeout=300,
    )  # fmt: skip
    assert checked.returncode == 0, checked.stdout + checked.stderr


def test_a_typed_name_is_a_name_of_that_type() -> None:
    assert TopicName("left/render/depth", ReceivedImage) == "left/render/depth"
    assert TopicName("view/mine/depth", ReceivedImage) == "view/mine/depth"
    with pytest.raises(UsageError, match="'splats' brings ReceivedCloud, not ReceivedImage"):
        TopicName("splats", ReceivedImage)
    with pytest.raises(UsageError, match="did you mean 'splats'"):
        TopicName("splat", ReceivedCloud)


def test_arrays_are_the_received_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Images and clouds are not copied between ZeroMQ and the consumer."""
    parts: list[np.ndarray] = []

    def receive_frames(socket: zmq.Socket[bytes], most: int) -> list[zmq.Frame]:
        frames = receive(socket, most)
        parts.extend(np.frombuffer(frame.buffer, np.uint8) for frame in frames)
        return frames

    receive = data_stream.receive_frames
    monkeypatch.setattr(data_stream, "receive_frames", receive_frames)
    picture, splats = TopicName("left/image_rect_color", ReceivedImage), TopicName("splats", ReceivedCloud)
    with publisher(tmp_path / "run") as running, stream(running):
        with Subscriber([picture, splats], run_dir=tmp_path / "run") as subscriber:
            image, cloud = subscriber.wait(picture, 30), subscriber.wait(splats, 30)
    for array in (image.array, cloud.points):
        assert any(np.shares_memory(array, part) for part in parts)
        assert not array.flags.writeable


# ---- senders ---------------------------------------------------------------------------------------------


def _publish_until(running: Any, subscriber: Subscriber, result: Any) -> None:
    """Publish one frame once the subscriber is known; a frame sent before would not reach it."""
    until(lambda: running.poll(10) or (running.wanted("tf") and running.wanted("status")))
    running.publish_result(result, dropped=0)
    assert subscriber.wait("tf", 30) is not None


@contextmanager
def _sender() -> Iterator[tuple[zmq.Socket[bytes], str]]:
    """An XPUB socket that sends whatever a test likes."""
    with zmq_socket(zmq.XPUB, "tcp://127.0.0.1:*", bind=True) as socket:
        yield socket, socket.getsockopt_string(zmq.LAST_ENDPOINT)


def _send(socket: zmq.Socket[bytes], subscriber: Subscriber, topic: str, seq: int) -> None:
    """Send a good depth image and wait until it has come."""
    while socket.poll(60_000 if seq == 1 else 0):
        if socket.recv() == b"\x01" + topic.encode():
            break
    said = cdr.image(np.zeros((4, 5), np.float32), "32FC1", 1)
    name = topic.removeprefix("sags/")
    socket.send_multipart(encode(message_of(name, said, seq, seq * 33.0)))
    until(lambda: (newest := subscriber.latest(name)) is not None and newest.meta.seq == seq)
