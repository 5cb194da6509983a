"""Asks the node for anchors, and gives them back."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

from sags_node.errors import SagsError
from sags_node.messaging.control import ControlClient

GOODBYE = 0.5  # s for the node to take anchors back at the end

Request = dict[str, Any]


class Pinner:
    """Asks the node for anchors in the background: an answer takes a frame or longer.

    Args:
        connect: a new connection to the node's control socket; raises `SagsError`.
    """

    def __init__(self, connect: Callable[[], ControlClient]) -> None:
        self._connect = connect
        self._worker = ThreadPoolExecutor(1, "sags-pinner")
        self._held: list[int] = []  # ids of anchors that are ours; only the worker uses it

    def pin(self, requests: Sequence[Request]) -> Future[list[int]]:
        """Ids of new anchors, all or none; or the node's `SagsError`."""
        return self._worker.submit(self._pin, requests)

    def remove(self, ids: Sequence[int]) -> None:
        """Give anchors back, as far as the node is still there."""
        self._worker.submit(self._remove, list(ids))

    def forget(self, ids: Sequence[int]) -> None:
        """The node that had these anchors is gone; in another one they may be somebody else's."""
        self._worker.submit(self._disown, list(ids))

    def close(self) -> None:
        """Give all anchors back, and wait for that."""
        self._worker.submit(lambda: self._remove(self._held.copy()))
        self._worker.shutdown()

    def _pin(self, requests: Sequence[Request]) -> list[int]:
        added: list[int] = []
        with self._connect() as client:
            try:
                for request in requests:
                    added.append(int(client.request("add_anchor", request)["id"]))
            except SagsError:
                for anchor in added:
                    client.request("remove_anchor", {"id": anchor}, GOODBYE)
                raise
        self._held += added
        return added

    def _remove(self, ids: list[int]) -> None:
        self._disown(ids)
        if not ids:
            return
        try:
            with self._connect() as client:
                for anchor in ids:
                    client.request("remove_anchor", {"id": anchor}, GOODBYE)
        except SagsError:
            return  # the node is gone, and its anchors with it

    def _disown(self, ids: list[int]) -> None:
        self._held = [anchor for anchor in self._held if anchor not in ids]
