"""The consumer's library: what is stale, what is joined, what is refused."""

from __future__ import annotations

import json
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Self, cast

import msgspec
import numpy as np
import pytest
import zmq
from synthetic import HEIGHT, WIDTH, at_frame, health, plane_result, publisher, stream

from sags_node.errors import SagsError, UsageError
from sags_node.messaging import cdr
from sags_node.messaging import stream as data_stream
from sags_node.messaging.freshness import Freshness, StaleError
from sags_node.messaging.received import (
    ReceivedCameraInfo,
    ReceivedCloud,
    ReceivedImage,
    ReceivedText,
    TopicName,
)
from sags_node.messaging.subscriber import Subscriber
from sags_node.messaging.wire import Message, Meta, encode

MS = 1_000_000
ROOT = Path(__file__).parent.parent


def meta(seq: int, stamp_ms: float, **changes: Any) -> Meta:
    fields: dict[str, Any] = {
        "type": "sensor_msgs/msg/Image",
        "type_hash": "",
        "seq": seq,
        "frame_id": seq,
        "stamp_ns": int(stamp_ms * MS),
        "publish_ns": int(stamp_ms * MS),
        "session": "s",
        "epoch": 0,
        "step": 0,
        "encoding": "",
        "shape": [],
        "dtype": "",
        "dropped": 0,
    }
    return Meta(**{**fields, **changes})


def followed(sequence: list[int], period_ms: float = 33.0, **settings: Any) -> Freshness:
    """What follows messages `sequence` of a sender with that period."""
    fresh = Freshness(**settings)
    for seq in sequence:
        fresh.accept(meta(seq, seq * period_ms))
    return fresh


# ---- the rules, with a clock of our own ----------------------------------------------------------------


def test_stale_after_ten_periods() -> None:
    fresh = followed(list(range(1, 31)))
    newest = 30 * 33
    assert fresh.period == pytest.approx(0.033)
    assert fresh.problem((newest + 329) * MS) is None
    assert "too old" in str(fresh.problem((newest + 331) * MS))
    assert "too old" in str(fresh.problem((newest + 101) * MS, max_age=0.1))
    assert fresh.problem((newest + 99) * MS, max_age=0.1) is None
    assert "too old" in str(fresh.problem((newest + 331) * MS, max_age=10.0))  # it only tightens


def test_stale_before_the_period_is_known() -> None:
    assert Freshness().problem(0) == "nothing received yet"
    fresh = followed([4])
    assert fresh.problem((4 * 33 + 990) * MS) is None
    assert "too old" in str(fresh.problem((4 * 33 + 1010) * MS))


def test_losses_do_not_stretch_the_period_but_count() -> None:
    fresh = followed([1, 2, 3, 5, 6, 9])
    assert fresh.period == pytest.approx(0.033) and fresh.lost == 3


@pytest.mark.parametrize(("every", "stale"), [(12, False), (5, True)])
def test_stale_under_ninety_percent(every: int, stale: bool) -> None:
    """Every fifth lost is 80 %, every twelfth 92 %."""
    fresh = followed([seq for seq in range(1, 80) if seq % every])
    problem = fresh.problem(80 * 33 * MS)
    assert (problem is not None and "too few" in problem) == stale
    for seq in range(80, 110):  # it recovers
        fresh.accept(meta(seq, seq * 33.0))
    assert fresh.problem(110 * 33 * MS) is None


def test_a_declared_rate_must_be_kept() -> None:
    now = 30 * 33 * MS
    assert followed(list(range(1, 31)), rate_hz=30.0).problem(now) is None
    assert "too few" in str(followed(list(range(1, 31)), rate_hz=40.0).problem(now))


def test_repeats_and_late_ones_are_not_news() -> None:
    fresh = followed([1, 2, 3])
    assert not fresh.accept(meta(3, 99)) and not fresh.accept(meta(2, 99)) and fresh.lost == 0
    assert fresh.accept(meta(1, 50, session="restarted")) and fresh.lost == 0
    assert fresh.accept(meta(2, 1, session="restarted", epoch=1))  # the recording looped: stamps jump back
    assert not fresh.accept(meta(3, 2, session="restarted", epoch=0))


def test_a_clock_ahead_is_not_fresh() -> None:
    assert "ahead" in str(followed([1, 2, 3]).problem(-2000 * MS))


def test_an_event_topic_never_grows_old() -> None:
    assert followed([1], periodic=False).problem(10**18) is None


# ---- over real sockets ---------------------------------------------------------------------------------


def test_typed_values_of_one_frame(tmp_path: Path) -> None:
    names = ["left/image_rect_color", "left/render/depth", "left/camera_info", "splats", "tf", "parameters"]
    truth = plane_result()
    with publisher(tmp_path / "run") as running:
        running.publish_parameters({"seed": 3})
        with stream(running), Subscriber(names, run_dir=tmp_path / "run") as subscriber:
            assert subscriber.endpoint.startswith("ipc://")
            image = cast(ReceivedImage, subscriber.wait("left/image_rect_color", 10))
            frame = subscriber.aligned(names[:4], image.stamp_ns, timeout=5)
            assert frame is not None
            cloud = cast(ReceivedCloud, frame["splats"])
            info = cast(ReceivedCameraInfo, frame["left/camera_info"])
            depth = cast(ReceivedImage, frame["left/render/depth"])
            assert {message.meta.frame_id for message in frame.values()} == {image.meta.frame_id}
            assert np.array_equal(image.array, truth.pair.left)
            assert depth.array.shape == (HEIGHT, WIDTH) and np.isnan(depth.array[0]).all()
            assert np.allclose(info.K, truth.pair.camera.K) and (info.width, info.height) == (WIDTH, HEIGHT)
            assert np.allclose(cloud.xyz(), truth.snapshot.gaussians.means)
            assert np.array_equal(cloud.points["id"], truth.snapshot.gaussians.ids)
            assert json.loads(cast(ReceivedText, subscriber.wait("parameters", 5)).text) == {"seed": 3}
            later = subscriber.wait("left/image_rect_color", 10, after=image)
            assert later is not None and later.meta.seq > image.meta.seq
            assert not image.array.flags.writeable
            assert subscriber.aligned(names[:4], stamp_ns=1) is None
            assert subscriber.lost("splats") == 0 and subscriber.rejected == 0


def test_strict_read_raises_when_the_frames_stop(tmp_path: Path) -> None:
    with publisher(tmp_path / "run") as running:
        with Subscriber(["left/depth"], run_dir=tmp_path / "run") as subscriber:
            with pytest.raises(StaleError, match="sags/left/depth is stale: nothing received"):
                subscriber.read("left/depth")
            with stream(running):
                assert subscriber.wait("left/depth", 10) is not None
                _until(lambda: subscriber.ok("left/depth"))
                assert subscriber.read("left/depth").age() < 1
            _until(lambda: not subscriber.ok("left/depth"))
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
        now[0] += 990 * MS
        assert subscriber.ok("tf")
        now[0] += 20 * MS
        assert not subscriber.ok("tf")


@pytest.mark.parametrize("state", ["waiting", "stopping", "starting"])
def test_the_sender_can_say_that_it_is_invalid(tmp_path: Path, state: str) -> None:
    with publisher(tmp_path / "run") as running, Subscriber(["tf"], run_dir=tmp_path / "run") as subscriber:
        _publish_until(running, subscriber, plane_result())
        assert subscriber.ok("tf")
        running.publish_health(health(state))
        assert subscriber.wait("status", 5) is not None
        assert state in str(subscriber.problem("tf"))
        before = subscriber.latest("status")
        running.publish_health(health("running"))
        assert subscriber.wait("status", 5, after=before) is not None
        assert subscriber.ok("tf")


def test_content_of_an_earlier_epoch_is_stale(tmp_path: Path) -> None:
    with (
        publisher(tmp_path / "run") as running,
        Subscriber(["tf", "splats"], run_dir=tmp_path / "run") as subscriber,
    ):
        result = plane_result(epoch=0)
        _publish_until(running, subscriber, result)
        running.publish_health(health())
        subscriber.wait("status", 5)
        assert subscriber.ok("tf")
        running._last = at_frame(result, 6, time.time_ns(), epoch=1)  # a frame of epoch 1 whose tf got lost
        before = subscriber.latest("status")
        running.publish_health(health())
        subscriber.wait("status", 5, after=before)
        assert "started anew" in str(subscriber.problem("tf"))


def test_a_restarted_node_is_followed(tmp_path: Path) -> None:
    run_dir = tmp_path / "run"
    with publisher(run_dir) as running:
        port = running.connection.data[-1]
        subscriber = Subscriber(["tf"], endpoint=port)
        with stream(running):
            first = subscriber.wait("tf", 10)
        assert first is not None
    with publisher(run_dir, data=(port,)) as running:
        running.session = "session-2"
        with stream(running):
            deadline = time.monotonic() + 20
            newest = first
            while newest.meta.session != "session-2" and time.monotonic() < deadline:
                newest = subscriber.wait("tf", 1, after=newest) or newest
            assert newest.meta.session == "session-2"
            assert newest.meta.seq >= 1 and subscriber.lost("tf") == 0
    subscriber.close()


def test_gaps_in_seq_are_counted_as_lost() -> None:
    with _sender() as (socket, endpoint), Subscriber(["left/depth"], endpoint=endpoint) as subscriber:
        for seq in (1, 2, 5):
            _send(socket, subscriber, "sags/left/depth", seq)
        assert subscriber.lost("left/depth") == 2


def test_hostile_messages_are_counted_and_nothing_more() -> None:
    said = cdr.image(np.zeros((4, 5), np.float32), "32FC1", 1)
    with _sender() as (socket, endpoint), Subscriber(["left/depth", "tf"], endpoint=endpoint) as subscriber:
        _send(socket, subscriber, "sags/left/depth", 1)
        good = encode(Message("sags/left/depth", _image_meta(said, 2), said.parts))
        bad = [
            [b"sags/left/depth"],
            [b"sags/left/depth", b"\xc1", b""],
            [b"sags/left/depth/deeper", *good[1:]],
            [b"sags/tf", *good[1:]],  # an image where a transform is due
            [*good[:3], b"short"],
            [*good, *[b"more"] * 40],
            encode(Message("sags/left/depth", _image_meta(said, 2, shape=[2**30, 2**30]), said.parts)),
        ]
        for frames in bad:
            socket.send_multipart(frames)
        _send(socket, subscriber, "sags/left/depth", 3)
        assert subscriber.rejected == len(bad)
        assert subscriber.lost("left/depth") == 1


def test_mistakes_are_named(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="did you mean 'left/render/depth'"):
        Subscriber(["left/rendr/depth"], endpoint="tcp://127.0.0.1:9")
    with pytest.raises(SagsError, match="no node runs as 'sags'"):
        Subscriber(["tf"], run_dir=tmp_path)
    with pytest.raises(SagsError, match="cannot connect to 127"):
        Subscriber(["tf"], endpoint="127.0.0.1:5556")


# ---- typed names, and memory ---------------------------------------------------------------------------


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
        cwd=ROOT, check=False, capture_output=True, text=True,
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
    """Pictures and clouds are not copied between ZeroMQ and the consumer."""
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
            image, cloud = subscriber.wait(picture, 10), subscriber.wait(splats, 10)
    assert image is not None and cloud is not None
    for array in (image.array, cloud.points):
        assert any(np.shares_memory(array, part) for part in parts)
        assert not array.flags.writeable


# ---- a node that dies ----------------------------------------------------------------------------------


@contextmanager
def _node(run_dir: Path, session: str, port: int, ipc: bool = False) -> Iterator[subprocess.Popen[bytes]]:
    """A publisher in its own process, which ends with SIGKILL and so leaves its files behind."""
    program = (
        "import time; from pathlib import Path; from synthetic import publisher, stream\n"
        f"data = ('tcp://127.0.0.1:{port or '*'}',)\n"
        f"with publisher(Path({str(run_dir)!r}), data=data, ipc={ipc}) as running:\n"
        f"    running.session = {session!r}\n"
        "    with stream(running):\n"
        "        time.sleep(60)\n"
    )
    process = subprocess.Popen([sys.executable, "-c", program], cwd=Path(__file__).parent)
    try:
        yield process
    finally:
        process.send_signal(signal.SIGKILL)
        process.wait()


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@pytest.mark.parametrize(
    ("by_file", "ipc", "moves"),
    [(False, False, False), (True, True, False), (True, False, True)],
    ids=["same port", "ipc", "another port"],
)
def test_a_killed_node_is_followed(tmp_path: Path, by_file: bool, ipc: bool, moves: bool) -> None:
    run_dir, port = tmp_path / "run", _free_port()
    where = {} if by_file else {"endpoint": f"tcp://127.0.0.1:{port}"}
    with _node(run_dir, "first", port, ipc):
        _until((run_dir / "sags.json").exists)
        subscriber = Subscriber(["tf"], run_dir=run_dir, **where)
        found = subscriber.wait("tf", 10)
        assert found is not None and found.meta.session == "first"
    with subscriber:
        _until(lambda: not subscriber.ok("tf"))
        before = subscriber.endpoint
        with _node(run_dir, "second", _free_port() if moves else port, ipc):
            _until(
                lambda: (newest := subscriber.latest("tf")) is not None and newest.meta.session == "second"
            )
            _until(lambda: subscriber.ok("tf"))
        assert (subscriber.endpoint != before) == moves
        assert subscriber.lost("tf") == 0


def test_a_connection_that_died_without_a_word_is_made_anew(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A machine that lost its power closes nothing: only a missing heartbeat tells."""
    monkeypatch.setattr(data_stream, "HEARTBEAT_MS", 100)
    monkeypatch.setattr(data_stream, "HEARTBEAT_TIMEOUT_MS", 300)
    with publisher(tmp_path / "run", ipc=False) as running, stream(running):
        with Cable(running.connection.data[0]) as cable:
            with Subscriber(["tf"], endpoint=cable.endpoint) as subscriber:
                assert subscriber.wait("tf", 10) is not None
                cable.cut()
                _until(lambda: not subscriber.ok("tf"))
                _until(lambda: subscriber.ok("tf"))
                assert cable.connections == 2


class Cable:
    """Passes connections on. Those that are open when it is cut stay open, and silent."""

    def __init__(self, endpoint: str) -> None:
        host, port = endpoint.removeprefix("tcp://").split(":")
        self._far = (host, int(port))
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.endpoint = f"tcp://127.0.0.1:{self._listener.getsockname()[1]}"
        self.connections = 0
        self._open: list[socket.socket] = []
        self._cut = threading.Event()
        self._threads = [threading.Thread(target=self._accept)]
        self._threads[0].start()

    def cut(self) -> None:
        self._cut.set()
        self._cut = threading.Event()

    def _accept(self) -> None:
        while True:
            try:
                near, _ = self._listener.accept()
            except OSError:
                return
            far = socket.create_connection(self._far)
            self.connections += 1
            self._open += [near, far]
            for source, target in ((near, far), (far, near)):
                passing = threading.Thread(target=self._pass, args=(source, target, self._cut))
                self._threads.append(passing)
                passing.start()

    @staticmethod
    def _pass(source: socket.socket, target: socket.socket, cut: threading.Event) -> None:
        try:
            while (data := source.recv(65536)) and not cut.is_set():
                target.sendall(data)
        except OSError:
            return

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        for one in (self._listener, *self._open):
            with suppress(OSError):
                one.shutdown(socket.SHUT_RDWR)
            one.close()
        for thread in self._threads:
            thread.join()


def test_a_node_that_wants_keys_after_its_restart_says_so(tmp_path: Path) -> None:
    run_dir = tmp_path / "run"
    with publisher(run_dir, ipc=False) as running:
        known, subscriber = running.connection, Subscriber(["tf"], run_dir=run_dir)
    with subscriber:
        with_keys = msgspec.json.encode(msgspec.structs.replace(known, public_key="k" * 40))
        (run_dir / "sags.json").write_bytes(with_keys)
        _until(lambda: "wants a key" in str(subscriber.problem("tf")))


def _until(condition: Any) -> None:
    deadline = time.monotonic() + 10
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.01)


def _publish_until(running: Any, subscriber: Subscriber, result: Any) -> None:
    """Publish one frame once the subscriber is known; a frame sent before would not reach it."""
    deadline = time.monotonic() + 10
    while not (running.wanted("tf") and running.wanted("status")):
        assert time.monotonic() < deadline
        running.poll(10)
    running.publish_result(result, dropped=0)
    assert subscriber.wait("tf", 10) is not None


@contextmanager
def _sender() -> Iterator[tuple[zmq.Socket[bytes], str]]:
    """An XPUB socket that sends whatever a test likes."""
    context = zmq.Context()
    socket = context.socket(zmq.XPUB)
    socket.bind("tcp://127.0.0.1:*")
    yield socket, socket.getsockopt_string(zmq.LAST_ENDPOINT)
    context.destroy(linger=0)


def _image_meta(said: cdr.Content, seq: int, **changes: Any) -> Meta:
    fields: dict[str, Any] = {
        "type": said.type,
        "type_hash": cdr.type_hash(said.type),
        "encoding": said.encoding,
        "shape": list(said.shape),
        "dtype": said.dtype,
        **changes,
    }
    return meta(seq, seq * 33.0, **fields)


def _send(socket: zmq.Socket[bytes], subscriber: Subscriber, topic: str, seq: int) -> None:
    """Send a good depth picture and wait until it has come."""
    while socket.poll(5000 if seq == 1 else 0):
        if socket.recv() == b"\x01" + topic.encode():
            break
    said = cdr.image(np.zeros((4, 5), np.float32), "32FC1", 1)
    socket.send_multipart(encode(Message(topic, _image_meta(said, seq), said.parts)))
    name = topic.removeprefix("sags/")
    _until(lambda: (newest := subscriber.latest(name)) is not None and newest.meta.seq == seq)


def test_a_subscriber_that_nobody_closed_lets_the_program_end_in_silence(tmp_path: Path) -> None:
    script = (
        "from sags_node.messaging.subscriber import Subscriber\n"
        f"Subscriber(['left/render/depth'], 'ipc://{tmp_path}/nobody')\n"
    )
    ended = subprocess.run(
        [sys.executable, "-c", script], check=False, capture_output=True, text=True, timeout=60
    )
    assert (ended.returncode, ended.stdout, ended.stderr) == (0, "", "")
