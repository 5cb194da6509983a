"""What peers of a bridge ask of the node: one after the other, in the background."""

import threading
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from sags_node.errors import SagsError
from sags_node.messaging.address import NodeAddress
from sags_node.messaging.control import ControlClient

MOST_WAITING = 32
ANSWER_TIME = 2.0  # s

Answer = Callable[[dict[str, Any] | None, str], None]  # the answer (None: refused), and the same in words


class Requests:
    """Asks the node; it may be restarted meanwhile."""

    def __init__(self, node: NodeAddress) -> None:
        self._node = node
        self._worker = ThreadPoolExecutor(1, "sags-bridge-requests")
        self._places = threading.Semaphore(MOST_WAITING)

    def ask(self, op: str, args: Mapping[str, Any], answer: Answer, seconds: float = ANSWER_TIME) -> None:
        """Ask without waiting. `answer` is called from another thread, at once when too many wait.

        Args:
            seconds: that the answer may take, counted from when it is this request's turn.
        """
        if not self._places.acquire(blocking=False):
            answer(None, f"{op}: too many requests are waiting for an answer; try again later")
            return
        self._worker.submit(self._ask, op, args, answer, seconds)

    def close(self) -> None:
        """Forget what waits, and wait for what has begun."""
        self._worker.shutdown(cancel_futures=True)

    def _ask(self, op: str, args: Mapping[str, Any], answer: Answer, seconds: float) -> None:
        try:
            result, words = self.now(op, args, seconds)
        finally:
            self._places.release()
        answer(result, words)

    def now(
        self, op: str, args: Mapping[str, Any], seconds: float = ANSWER_TIME
    ) -> tuple[dict[str, Any] | None, str]:
        """Ask, and wait for the answer for up to `seconds`; from any thread."""
        try:
            with ControlClient.at(self._node) as client:
                result = client.request(op, args, seconds)
        except SagsError as error:
            return None, str(error)
        return (result if isinstance(result, dict) else {}), f"{op}: {result}"
