"""The subscriber for asyncio: what waits, what ends a wait, and that nothing spins meanwhile."""

import asyncio
import selectors
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from synthetic import publisher, stream
from waiting import until

from sags_node.errors import SagsError
from sags_node.messaging.async_subscriber import AsyncSubscriber
from sags_node.messaging.freshness import StaleError
from sags_node.messaging.publisher import Publisher
from sags_node.messaging.received import ReceivedImage, TopicName

pytestmark = pytest.mark.live

PICTURE = TopicName("left/image_rect_color", ReceivedImage)
DEPTH = TopicName("left/render/depth", ReceivedImage)


@pytest.fixture
def running(tmp_path: Path) -> Iterator[Publisher]:
    with publisher(tmp_path / "run") as one:
        yield one


def subscribed(running: Publisher, *names: str) -> AsyncSubscriber:
    return AsyncSubscriber(names, endpoint=running.connection.data[0])


def test_messages_are_new_ones_in_order_and_end_when_they_go_stale(running: Publisher) -> None:
    async def follow() -> list[ReceivedImage]:
        seen = []
        async with subscribed(running, PICTURE) as subscriber:
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


def test_topics_of_one_frame_are_joined(running: Publisher) -> None:
    async def join() -> None:
        async with subscribed(running, PICTURE, DEPTH) as subscriber:
            with stream(running):
                image = await subscriber.wait(PICTURE, 30)
                frame = await subscriber.aligned([PICTURE, DEPTH], image.stamp_ns, timeout=30)
                assert frame is not None and frame[DEPTH].meta.frame_id == image.meta.frame_id
                assert frame[DEPTH].array.shape == image.array.shape[:2]
                assert subscriber.read(PICTURE).array.flags.writeable is False
                later = await subscriber.wait(PICTURE, 30, after=image)
                assert later is not None and later.meta.seq > image.meta.seq
                assert await subscriber.aligned([PICTURE], stamp_ns=1) is None

    asyncio.run(join())


def test_silence_ends_a_wait_and_a_strict_read_raises(running: Publisher) -> None:
    async def listen() -> None:
        async with subscribed(running, PICTURE) as subscriber:
            assert await subscriber.wait(PICTURE, 0.05) is None
            assert await subscriber.wait(PICTURE, 0.0) is None
            with pytest.raises(StaleError, match="nothing received"):
                subscriber.read(PICTURE)
            with pytest.raises(StaleError, match="nothing new for"):
                await anext(subscriber.messages(PICTURE, timeout=0.05))

    asyncio.run(listen())


class Turns(selectors.DefaultSelector):
    """Counts how often a loop goes round."""

    count = 0

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        self.count += 1
        return super().select(timeout)


def test_a_waiting_task_sleeps(running: Publisher) -> None:
    """Its loop goes round for the wait that begins, for its time limit, and for its end."""
    turns = Turns()

    async def wait() -> int:
        async with subscribed(running, PICTURE) as subscriber:
            before = turns.count
            assert await subscriber.wait(PICTURE, 0.5) is None
            return turns.count - before

    with asyncio.Runner(loop_factory=lambda: asyncio.SelectorEventLoop(turns)) as runner:
        assert runner.run(wait()) <= 3


def test_a_cancelled_wait_leaves_the_others_alone(
    running: Publisher, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def cancel() -> None:
        async with subscribed(running, PICTURE) as subscriber:
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
        subscriber = subscribed(running, PICTURE)
        assert receiving()
        closing = asyncio.create_task(subscriber.__aexit__(None, None, None))
        await asyncio.sleep(0)
        closing.cancel()
        with pytest.raises(asyncio.CancelledError):
            await closing

    asyncio.run(cancel())
    assert not receiving()


def test_one_subscriber_serves_two_loops(running: Publisher) -> None:
    numbers: dict[str, list[int]] = {"a": [], "b": []}
    subscriber = subscribed(running, PICTURE)

    async def follow(name: str) -> None:
        async for image in subscriber.messages(PICTURE, timeout=30):
            numbers[name].append(image.meta.seq)
            if len(numbers[name]) == 8:
                return

    threads = [threading.Thread(target=lambda n=name: asyncio.run(follow(n))) for name in numbers]
    with stream(running):
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join(30)
    subscriber.close()
    for seen in numbers.values():
        assert len(seen) == 8 and seen == sorted(set(seen))


def test_a_loop_that_is_gone_does_not_end_the_receiver(running: Publisher) -> None:
    subscriber = subscribed(running, PICTURE)
    loop = asyncio.new_event_loop()
    left: Any = subscriber.wait(PICTURE, 60)  # never finished: its loop is closed over it
    task = loop.create_task(left)
    loop.run_until_complete(asyncio.sleep(0.05))
    loop.close()
    try:
        with stream(running):
            newest = asyncio.run(subscriber.wait(PICTURE, 30))
            assert newest is not None
            assert asyncio.run(subscriber.wait(PICTURE, 30, after=newest)) is not None
    finally:
        task._log_destroy_pending = False
        left.close()
        subscriber.close()


def test_mistakes_are_named_as_by_the_threaded_one(tmp_path: Path) -> None:
    with pytest.raises(SagsError, match="no node runs as 'sags'"):
        AsyncSubscriber(["tf"], run_dir=tmp_path)
