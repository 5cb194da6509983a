"""Asks the node for anchors, and gives them back."""

from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

from sags_node.messaging.control import ControlClient

ANSWER = 2.0  # s for the node to pin one
GOODBYE = 0.5  # s for it to take one back at the end
AT_ONCE = 16  # connections, of the 64 that a node takes

Request = dict[str, Any]


class Pinner:
    """Asks the node for anchors in the background: an answer takes a frame or longer.

    Args:
        connect: a new connection to the node's control socket; raises `SagsError`.
    """

    def __init__(self, connect: Callable[[], ControlClient]) -> None:
        self._connect = connect
        self._worker = ThreadPoolExecutor(1, "sags-pinner")
        self._held: dict[int, str | None] = {}  # our anchors -> session; for the worker's thread only

    def pin(self, requests: Sequence[Request]) -> Future[list[int]]:
        """Ask for anchors; the future gives their ids, all or none, or raises the node's `SagsError`."""
        return self._worker.submit(self._pin, requests)

    def remove(self, ids: Sequence[int]) -> None:
        """Give anchors back, as far as the node is still there."""
        self._worker.submit(self._remove, list(ids))

    def forget(self, ids: Sequence[int]) -> None:
        """Forget anchors of a node that is gone: in another node these ids may be somebody else's."""
        self._worker.submit(self._disown, list(ids))

    def close(self) -> None:
        """Give all anchors back, and wait for that."""
        self._worker.submit(lambda: self._remove(list(self._held)))
        self._worker.shutdown()

    def _pin(self, requests: Sequence[Request]) -> list[int]:
        answers, error = self._ask("add_anchor", requests, ANSWER)
        added = {int(answers[number]["id"]): answers[number].get("session") for number in sorted(answers)}
        self._held |= added
        if error is not None:
            self._remove(list(added))
            raise error
        return list(added)

    def _remove(self, ids: list[int]) -> None:
        named = [(anchor, self._held.pop(anchor, None)) for anchor in ids]
        requests = [{"id": anchor} | ({"session": session} if session else {}) for anchor, session in named]
        self._ask("remove_anchor", requests, GOODBYE)  # or the node is gone

    def _ask(
        self, op: str, requests: Sequence[Request], timeout: float
    ) -> tuple[dict[int, Any], BaseException | None]:
        """The answers by number, and the first error. Asks many at once: the node answers between frames."""
        answers: dict[int, Any] = {}

        def ask(first: int) -> None:
            with self._connect() as client:
                for number in range(first, len(requests), AT_ONCE):
                    answers[number] = client.request(op, requests[number], timeout)

        with ThreadPoolExecutor(AT_ONCE, "sags-pinner") as pool:
            asked = [pool.submit(ask, first) for first in range(min(AT_ONCE, len(requests)))]
        return answers, next(filter(None, (each.exception() for each in asked)), None)

    def _disown(self, ids: list[int]) -> None:
        for anchor in ids:
            self._held.pop(anchor, None)
