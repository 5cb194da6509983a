"""The subscriber for asyncio: the same receiver thread and rules, with `await` in place of blocking.

async with AsyncSubscriber(["left/render/depth"]) as subscriber:
    async for depth in subscriber.messages("left/render/depth"):
        ...
"""

import asyncio
from collections.abc import AsyncIterator, Callable, Iterable
from contextlib import suppress
from typing import Self, TypeVar, overload

from sags_node.messaging import topics
from sags_node.messaging.freshness import StaleError
from sags_node.messaging.received import Frame, R, Received, TopicName
from sags_node.messaging.subscriber import Receiver

T = TypeVar("T")


class AsyncSubscriber(Receiver):
    """Receives topics in the background; `latest` and `read` return what has come; `wait`, `aligned`
    and `messages` also wait for what is still to come.

    Arguments and errors: see `Receiver`. Any number of tasks may wait, in any number of event loops.
    """

    @overload
    async def wait(self, name: TopicName[R], timeout: float, after: Received | None = None) -> R | None: ...
    @overload
    async def wait(self, name: str, timeout: float, after: Received | None = None) -> Received | None: ...
    async def wait(self, name: str, timeout: float, after: Received | None = None) -> Received | None:
        """Wait for a message newer than `after`, and return the newest one; None after `timeout` s."""
        return await self._until(lambda: self._newer(name, after), timeout)

    async def aligned(self, names: Iterable[str], stamp_ns: int, timeout: float = 0.0) -> Frame | None:
        """The messages of several topics that show the frame captured at `stamp_ns`.

        None when one of them has not come within `timeout` seconds.
        """
        wanted = list(names)
        return await self._until(lambda: self._frame(wanted, stamp_ns), timeout)

    @overload
    def messages(self, name: TopicName[R], timeout: float = 1.0) -> AsyncIterator[R]: ...
    @overload
    def messages(self, name: str, timeout: float = 1.0) -> AsyncIterator[Received]: ...
    async def messages(self, name: str, timeout: float = 1.0) -> AsyncIterator[Received]:
        """Yield the newest message of a topic, again and again. A slow consumer misses some, but never lags.

        Raises:
            StaleError: nothing new came for `timeout` seconds, or what came must not be shown as new. The
                consumer blanks what it draws, and may begin again.
        """
        newest: Received | None = None
        while await self.wait(name, timeout, after=newest) is not None:
            newest = self.read(name)
            yield newest
        raise StaleError(f"{topics.full_name(self._ns, name)} is stale: nothing new for {timeout:g} s")

    async def _until(self, find: Callable[[], T | None], timeout: float) -> T | None:
        """Return the first result of `find`, called after each message; None after `timeout` s."""
        loop, arrived = asyncio.get_running_loop(), asyncio.Event()

        def wake() -> None:
            with suppress(RuntimeError):  # the loop was closed while a task still waited
                loop.call_soon_threadsafe(arrived.set)

        with self.notified(wake), suppress(TimeoutError):
            async with asyncio.timeout(timeout):
                while True:
                    with self._arrived:
                        found = find()
                    if found is not None:
                        return found
                    await arrived.wait()
                    arrived.clear()
        return None

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        await asyncio.to_thread(self.close)
