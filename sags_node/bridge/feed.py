"""The topics of one sender, a node or an overlay, that may come later, go and come back."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from contextlib import ExitStack

from sags_node.errors import SagsError, UsageError
from sags_node.messaging.address import NodeAddress
from sags_node.messaging.received import Frame, Received
from sags_node.messaging.subscriber import Subscriber

LEAST_HZ = 0.5  # a bridge passes on the newest of what comes, so losing some of it is no fault; age is
EVERY_SECOND = ("status", "diagnostics")
SILENT_AFTER = 2.5  # s without one of these
LOOK = 0.2  # s between looks for a sender that is not there


class Feed:
    """Follows one sender; used from one thread.

    Args:
        topics: all that may be asked for, without the namespace.
        max_age: s since capture, after which nothing is new any more.
        wake: called from another thread for each message that comes.

    Raises:
        UsageError: the node wants keys that are not given, or the other way round.
        SagsError: the endpoint is malformed. That nobody is there yet is no error.
    """

    def __init__(
        self, topics: Iterable[str], sender: NodeAddress, max_age: float, wake: Callable[[], None]
    ) -> None:
        self._topics = list(topics)
        self._sender, self._max_age, self._wake = sender, max_age, wake
        self._asked: frozenset[str] = frozenset()
        self._subscriber: Subscriber | None = None
        self._resources = ExitStack()
        self._absent = ""  # why there is no subscriber
        self._next_look = 0.0
        self._connect()

    def ask(self, names: Iterable[str]) -> None:
        """Let the sender make and send these topics, and nothing else but `status`."""
        self._asked = frozenset(names)
        if self._subscriber is None and time.monotonic() >= self._next_look:
            self._connect()
        if self._subscriber is not None:
            self._subscriber.ask(self._asked)

    def problem(self, name: str) -> str | None:
        """Why the newest message of a topic must not be shown as new; None when it may be."""
        if self._subscriber is None:
            return self._absent
        limit = SILENT_AFTER if name in EVERY_SECOND else self._max_age
        return self._subscriber.problem(name, limit)

    def latest(self, name: str) -> Received | None:
        """The newest message of a topic, however old it is."""
        return None if self._subscriber is None else self._subscriber.latest(name)

    def frame(self, names: Iterable[str], stamp_ns: int) -> Frame | None:
        """The messages of these topics that show the frame captured at `stamp_ns`, if all have come."""
        return None if self._subscriber is None else self._subscriber.aligned(names, stamp_ns)

    def close(self) -> None:
        self._resources.close()

    def _connect(self) -> None:
        try:
            rates = dict.fromkeys(self._topics, LEAST_HZ)
            subscriber = Subscriber.at(self._sender, self._topics, rates=rates, paused=True)
        except UsageError:
            raise
        except SagsError as error:
            if self._sender.endpoint is not None:  # where it is, is known: the endpoint is wrong
                raise
            self._absent, self._next_look = str(error), time.monotonic() + LOOK
            return
        self._subscriber = subscriber
        self._resources.callback(subscriber.close)
        self._resources.enter_context(subscriber.notified(self._wake))
