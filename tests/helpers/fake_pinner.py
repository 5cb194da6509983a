"""The overlay's anchors without a node."""

from concurrent.futures import Future
from typing import Any

from sags_node.clients.overlay.pinner import Pinner
from sags_node.errors import SagsError


class FakePinner(Pinner):
    """Gives ids at once, or refuses; remembers what was asked."""

    def __init__(self) -> None:
        self.asked: list[Any] = []
        self.removed: list[int] = []
        self.forgotten: list[int] = []
        self.refusal: SagsError | None = None
        self.places: dict[int, Any] = {}  # x y z of each anchor, as it was asked for

    def pin(self, requests: Any) -> Future[list[int]]:
        self.asked.append(requests)
        future: Future[list[int]] = Future()
        if self.refusal is not None:
            future.set_exception(self.refusal)
            return future
        first = len(self.places) + 1
        self.places |= dict(enumerate(([request.get(axis) for axis in "xyz"] for request in requests), first))
        future.set_result(list(self.places)[first - 1 :])
        return future

    def remove(self, ids: Any) -> None:
        self.removed += ids

    def forget(self, ids: Any) -> None:
        self.forgotten += ids
