"""The topics of one sender, a node or an overlay, that may come later, go and come back."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from contextlib import ExitStack

from sags_node.errors import UsageError
from sags_node.messaging.address import NodeAddress
from sags_node.messaging.received import Frame, Received
from sags_node.messaging.subscriber import Subscriber

LEAST_HZ = 0.5  # a bridge passes on the newest of what comes, so losing some of it is no fault; age is
EVERY_SECOND = ("status", "diagnostics")
SILENT_AFTER = 2.5  # s without one of these


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
        self._max_age, self._session = max_age, ""
        rates = dict.fromkeys(topics, LEAST_HZ)
        self._subscriber = Subscriber.at(sender, rates, rates=rates, paused=True, may_be_absent=True)
        self._resources = ExitStack()
        self._resources.callback(self._subscriber.close)
        self._resources.enter_context(self._subscriber.notified(wake))

    def ask(self, names: Iterable[str]) -> None:
        """Let the sender make and send these topics, and nothing else but `status`.

        Raises:
            UsageError: it has come, and wants keys that are not given, or the other way round.
        """
        if not self._subscriber.endpoint and self._subscriber.refusal is not None:
            raise UsageError(self._subscriber.refusal)
        self._subscriber.ask(names)

    def problem(self, name: str) -> str | None:
        """Why the newest message of a topic must not be shown as new; None when it may be."""
        limit = SILENT_AFTER if name in EVERY_SECOND else self._max_age
        return self._subscriber.problem(name, limit)

    def started_anew(self) -> bool:
        """Tell whether the sender is another one than when this was last asked."""
        status, before = self._subscriber.latest("status"), self._session
        self._session = before if status is None else status.meta.session
        return before not in ("", self._session)

    def latest(self, name: str) -> Received | None:
        """The newest message of a topic, however old it is."""
        return self._subscriber.latest(name)

    def frame(self, names: Iterable[str], stamp_ns: int) -> Frame | None:
        """The messages of these topics that show the frame captured at `stamp_ns`, if all have come."""
        return self._subscriber.aligned(names, stamp_ns)

    def close(self) -> None:
        self._resources.close()
