"""The consumer's library over real sockets, blocking and for asyncio: what is joined, stale or refused."""

import asyncio
import json
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from pathlib import Path
from typing import Any, Self

import numpy as np
import pytest
import zmq
from independent_client import zmq_socket
from made_messages import MS, damaged, message_of
from synthetic import HEIGHT, WIDTH, at_frame, health, plane_result, publisher, stream
from waiting import until

from sags_node.errors import SagsError, UsageError
from sags_node.messaging import cdr
from sags_node.messaging.async_subscriber import AsyncSubscriber
from sags_node.messaging.freshness import StaleError
from sags_node.messaging.publisher import Publisher
from sags_node.messaging.received import Received, ReceivedCloud, ReceivedImage, TopicName
from sags_node.messaging.subscriber import Subscriber
from sags_node.messaging.wire import encode
from sags_node.types import FrameResult

pytestmark = pytest.mark.live

PICTURE = TopicName("left/image_rect_color", ReceivedImage)


class Awaited(AsyncSubscriber):
    """The subscriber for asyncio, used as the blocking one: a loop for each wait."""

    def wait(self, *args: Any, **options: Any) -> Any:
        return asyncio.run(super().wait(*args, **options))

    def aligned(self, *args: Any, **options: Any) -> Any:
        return asyncio.run(super().aligned(*args, **options))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


of_both = pytest.mark.parametrize("kind", [Subscriber, Awaited], ids=["blocking", "asyncio"])


@pytest.fixture
def running(tmp_path: Path) -> Iterator[Publisher]:
    with publisher(tmp_path / "run") as one:
        yield one


def subscribed(running: Publisher, *names: str, kind: type[Any] = Subscriber, **options: Any) -> Any:
    return kind(names, endpoint=running.connection.data[0], **options)


# ---- what comes ------------------------------------------------------------------------------------------


@of_both
def test_typed_values_of_one_frame(kind: type[Subscriber], running: Publisher) -> None:
    names = ["left/image_rect_color", "left/render/depth", "left/camera_info", "splats", "tf", "parameters"]
    truth = plane_result()
    running.publish_parameters({"seed": 3})
    with stream(running), subscribed(running, *names, kind=kind) as subscriber:
        image = subscriber.wait("left/image_rect_color", 30)
        frame = subscriber.aligned(names[:4], image.stamp_ns, timeout=30)
        depth, info, cloud = (frame[name] for name in names[1:4])
        assert {message.meta.frame_id for message in frame.values()} == {image.meta.frame_id}
        assert np.array_equal(image.array, truth.pair.left)
        assert depth.array.shape == (HEIGHT, WIDTH) and np.isnan(depth.array[0]).all()
        assert np.allclose(info.K, truth.pair.camera.K) and (info.width, info.height) == (WIDTH, HEIGHT)
        assert np.allclose(cloud.xyz(), truth.snapshot.gaussians.means)
        assert np.array_equal(cloud.points["id"], truth.snapshot.gaussians.ids)
        assert json.loads(subscriber.wait("parameters", 30).text) == {"seed": 3}
        later = subscriber.wait("left/image_rect_color", 30, after=image)
        assert later is not None and later.meta.seq > image.meta.seq
        assert subscriber.aligned(names[:4], stamp_ns=1) is None
        for memory in (image.array, cloud.points):  # is not copied between ZeroMQ and the consumer
            assert not memory.flags.writeable
            while isinstance(memory, np.ndarray):
                memory = memory.base  # noqa: PLW2901
            assert isinstance(memory.obj, zmq.Frame)
        assert subscriber.lost("splats") == 0 and subscriber.rejected == 0


def test_a_paused_subscriber_costs_the_node_nothing_and_goes_on_with_what_is_new(running: Publisher) -> None:
    name = "left/render/depth"
    with stream(running), subscribed(running, name) as subscriber:
        assert subscriber.wait(name, 30)
        subscriber.pause()
        until(lambda: not running.wanted(name))
        newest, status = subscriber.latest(name), subscriber.latest("status")
        assert subscriber.wait("status", 30, after=status)
        assert subscriber.latest(name) is newest
        resumed, lost = time.time_ns(), subscriber.lost(name)
        subscriber.resume()
        until(lambda: subscriber.latest(name) is not newest)
        first = subscriber.latest(name)
        until(lambda: subscriber.latest(name).stamp_ns > resumed)
        assert first.meta.seq - newest.meta.seq > 1 and subscriber.lost(name) == lost
        until(lambda: subscriber.ok(name))


def _read_if_fresh(subscriber: Subscriber, name: str) -> Received | None:
    try:
        return subscriber.read(name)
    except StaleError:  # a busy machine may hold the sender up
        return None


@of_both
def test_strict_read_raises_when_the_frames_stop(kind: type[Subscriber], running: Publisher) -> None:
    with subscribed(running, "left/depth", kind=kind) as subscriber:
        for timeout in (0.05, 0.0):
            assert subscriber.wait("left/depth", timeout) is None
        with pytest.raises(StaleError, match="sags/left/depth is stale: nothing received"):
            subscriber.read("left/depth")
        with stream(running):
            assert until(lambda: _read_if_fresh(subscriber, "left/depth")).age() >= 0
        until(lambda: not subscriber.ok("left/depth"))
        with pytest.raises(StaleError, match="too old"):
            subscriber.read("left/depth")
        assert subscriber.latest("left/depth") is not None  # the last content can still be looked at


def sent(running: Publisher, subscriber: Subscriber, result: FrameResult) -> None:
    """Publish one frame once the subscriber is known; a frame sent before would not reach it."""
    until(lambda: running.poll(10) or (running.wanted("tf") and running.wanted("status")))
    running.publish_result(result, dropped=0)
    assert subscriber.wait("tf", 30) is not None


def told(running: Publisher, subscriber: Subscriber, state: str) -> None:
    """Let the sender say this of itself, and the subscriber hear it."""
    before = subscriber.latest("status")
    running.publish_health(health(state))
    assert subscriber.wait("status", 30, after=before) is not None


@pytest.mark.parametrize("state", ["waiting", "stopping", "starting"])
def test_age_and_the_state_of_the_sender_make_content_stale(running: Publisher, state: str) -> None:
    """By the clock that is given. While frames are held, what is sent is true."""
    now = [time.time_ns()]
    with subscribed(running, "tf", clock_ns=lambda: now[0]) as subscriber:
        sent(running, subscriber, plane_result(stamp_ns=now[0]))
        for later_ms, fresh in ((0, True), (490, True), (20, False), (-510, True)):
            now[0] += later_ms * MS
            assert subscriber.ok("tf") == fresh
        told(running, subscriber, state)
        assert state in str(subscriber.problem("tf"))
        for valid in ("running", "held"):
            told(running, subscriber, valid)
            assert subscriber.ok("tf")


def test_content_of_an_earlier_epoch_is_stale(running: Publisher) -> None:
    now = time.time_ns()
    result = plane_result(epoch=0, stamp_ns=now)
    with subscribed(running, "tf", clock_ns=lambda: now) as subscriber:
        sent(running, subscriber, result)
        told(running, subscriber, "running")
        assert subscriber.ok("tf")
        subscriber.pause()
        until(lambda: running.poll(10) or not running.wanted("tf"))
        running.publish_result(at_frame(result, 6, now, epoch=1), dropped=0)  # its tf does not come
        told(running, subscriber, "running")
        assert "started anew" in str(subscriber.problem("tf"))


@pytest.mark.fault("socket: messages that are none, at the consumer")
def test_hostile_messages_are_counted_and_nothing_more() -> None:
    said = cdr.image(np.zeros((4, 5), np.float32), "32FC1", 1)
    with (
        zmq_socket(zmq.XPUB, "tcp://127.0.0.1:*", bind=True) as socket,
        Subscriber(["left/depth", "tf"], socket.getsockopt_string(zmq.LAST_ENDPOINT)) as subscriber,
    ):

        def send(seq: int) -> None:
            """A good one, which has come when this returns."""
            socket.send_multipart(encode(message_of("left/depth", said, seq, seq * 33.0)))
            until(lambda: (newest := subscriber.latest("left/depth")) is not None and newest.meta.seq == seq)

        while socket.recv() != b"\x01sags/left/depth":
            pass
        send(1)
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
        for seq in (3, 6):  # 2 was sent damaged
            send(seq)
        assert subscriber.rejected == len(bad)
        assert subscriber.lost("left/depth") == 1 + 2


@of_both
@pytest.mark.parametrize(
    ("name", "where", "error", "said"),
    [
        ("left/dept", {"endpoint": "tcp://127.0.0.1:9"}, UsageError, "did you mean 'left/depth'"),
        ("tf", {"run_dir": Path("/nowhere"), "patience": 0}, SagsError, "no node runs as 'sags'"),
        ("tf", {"endpoint": "127.0.0.1:5556"}, SagsError, "cannot connect to 127"),
    ],
    ids=["topic", "no node", "endpoint"],
)
def test_mistakes_are_named(
    kind: type[Subscriber], name: str, where: dict[str, Any], error: type[SagsError], said: str
) -> None:
    with pytest.raises(error, match=said):
        kind([name], **where)


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


# ---- typed names ----------------------------------------------------------------------------------------


def test_a_typed_name_is_a_name_of_that_type() -> None:
    assert TopicName("left/render/depth", ReceivedImage) == "left/render/depth"
    assert TopicName("view/mine/depth", ReceivedImage) == "view/mine/depth"
    with pytest.raises(UsageError, match="'splats' brings ReceivedCloud, not ReceivedImage"):
        TopicName("splats", ReceivedImage)
    with pytest.raises(UsageError, match="did you mean 'splats'"):
        TopicName("splat", ReceivedCloud)


# ---- for asyncio ---------------------------------------------------------------------------------------


def test_messages_are_new_ones_in_order_and_end_when_they_go_stale(running: Publisher) -> None:
    async def follow() -> list[ReceivedImage]:
        seen = []
        async with subscribed(running, PICTURE, kind=AsyncSubscriber) as subscriber:
            with pytest.raises(StaleError, match="nothing new for"):
                await anext(subscriber.messages(PICTURE, timeout=0.05))
            publishing = stream(running)
            publishing.__enter__()
            with pytest.raises(StaleError, match="left/image_rect_color is stale"):
                async for image in subscriber.messages(PICTURE, timeout=5.0):
                    seen.append(image)
                    if len(seen) == 10:
                        await asyncio.to_thread(publishing.__exit__, None, None, None)
        return seen

    seen = asyncio.run(follow())
    numbers = [image.meta.seq for image in seen]
    assert len(seen) >= 10 and numbers == sorted(set(numbers))


def test_a_cancelled_wait_leaves_others_alone(running: Publisher, monkeypatch: pytest.MonkeyPatch) -> None:
    async def cancel() -> None:
        async with subscribed(running, PICTURE, kind=AsyncSubscriber) as subscriber:
            waiting = [asyncio.create_task(subscriber.wait(PICTURE, 30)) for _ in range(3)]
            await asyncio.sleep(0.05)
            waiting[1].cancel()
            with pytest.raises(asyncio.CancelledError):
                await waiting[1]
            with stream(running):
                newest = await asyncio.gather(waiting[0], waiting[2])
                assert None not in newest
                woken: list[object] = []
                monkeypatch.setattr(asyncio.get_running_loop(), "call_soon_threadsafe", woken.append)
                until(lambda: subscriber.latest(PICTURE).meta.seq > newest[0].meta.seq + 3)
                monkeypatch.undo()
            assert not woken  # nobody waits any more

    asyncio.run(cancel())


def test_cancelled_while_closing_it_still_closes(running: Publisher) -> None:
    def receiving() -> bool:
        return "sags-subscriber" in {thread.name for thread in threading.enumerate()}

    async def cancel() -> None:
        subscriber = subscribed(running, PICTURE, kind=AsyncSubscriber)
        assert receiving()
        closing = asyncio.create_task(subscriber.__aexit__(None, None, None))
        await asyncio.sleep(0)
        closing.cancel()
        with pytest.raises(asyncio.CancelledError):
            await closing

    asyncio.run(cancel())
    assert not receiving()


def test_one_subscriber_serves_two_loops_and_outlives_a_third(running: Publisher) -> None:
    numbers: dict[str, list[int]] = {"a": [], "b": []}
    gone = asyncio.new_event_loop()

    async def follow(name: str) -> None:
        async for image in subscriber.messages(PICTURE, timeout=30):
            numbers[name].append(image.meta.seq)
            if len(numbers[name]) == 8:
                return

    with closing(subscribed(running, PICTURE, kind=AsyncSubscriber)) as subscriber:
        left: Any = subscriber.wait(PICTURE, 60)  # never finished: its loop is closed over it
        task = gone.create_task(left)
        gone.run_until_complete(asyncio.sleep(0.05))
        gone.close()
        with stream(running), ThreadPoolExecutor() as pool:
            for ended in [pool.submit(lambda name=name: asyncio.run(follow(name))) for name in numbers]:
                ended.result(60)
        task._log_destroy_pending = False
        left.close()
    for seen in numbers.values():
        assert len(seen) == 8 and seen == sorted(set(seen))
