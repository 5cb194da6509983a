"""The subscriber for asyncio: what waits, what ends a wait, and that nothing spins meanwhile."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from synthetic import publisher, stream

from sags_node.errors import SagsError
from sags_node.messaging.async_subscriber import AsyncSubscriber
from sags_node.messaging.freshness import StaleError
from sags_node.messaging.publisher import Publisher
from sags_node.messaging.received import Received, ReceivedImage, TopicName

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
                assert image is not None
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


class Counting(AsyncSubscriber):
    """Counts how often a waiting task looks whether its message has come."""

    looked = 0

    def _newer(self, name: str, after: Received | None) -> Received | None:
        self.looked += 1
        return super()._newer(name, after)


def test_a_waiting_task_sleeps(running: Publisher) -> None:
    async def wait() -> int:
        async with Counting([PICTURE], endpoint=running.connection.data[0]) as subscriber:
            assert await subscriber.wait(PICTURE, 0.5) is None
            return subscriber.looked

    assert asyncio.run(wait()) == 1


def test_a_cancelled_wait_leaves_the_others_alone(running: Publisher) -> None:
    async def cancel() -> None:
        async with subscribed(running, PICTURE) as subscriber:
            waiting = [asyncio.create_task(subscriber.wait(PICTURE, 30)) for _ in range(3)]
            await asyncio.sleep(0.05)
            waiting[1].cancel()
            with pytest.raises(asyncio.CancelledError):
                await waiting[1]
            assert len(subscriber._wakes) == 2
            with stream(running):
                assert None not in await asyncio.gather(waiting[0], waiting[2])
            assert not subscriber._wakes

    asyncio.run(cancel())


def test_cancelled_while_closing_it_still_closes(running: Publisher) -> None:
    async def cancel() -> AsyncSubscriber:
        subscriber = subscribed(running, PICTURE)
        closing = asyncio.create_task(subscriber.__aexit__(None, None, None))
        await asyncio.sleep(0)
        closing.cancel()
        with pytest.raises(asyncio.CancelledError):
            await closing
        return subscriber

    assert not asyncio.run(cancel())._thread.is_alive()


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
