"""Tissue masks from another process on this machine."""

from typing import Any

from numpy.typing import NDArray

from sags_node.errors import UsageError
from sags_node.messaging.received import ReceivedImage, TopicName
from sags_node.messaging.security import is_local
from sags_node.messaging.subscriber import Subscriber

MASK = TopicName("left/tissue_mask", ReceivedImage)


class MaskSubscriber:
    """Receives `left/tissue_mask` in the background. Its sender may come later, go, and come again.

    Args:
        ns: of the sender.

    Raises:
        UsageError: the sender is on another machine.
        SagsError: the endpoint is malformed.
    """

    def __init__(self, endpoint: str, ns: str) -> None:
        if not is_local(endpoint):
            raise UsageError(
                f"vision.tissue.endpoint: {endpoint} is not on this machine; write tcp://127.0.0.1:PORT or "
                "ipc:///PATH (masks from elsewhere: through a tunnel, e.g. ssh -L)"
            )
        self._subscriber = Subscriber([MASK], endpoint, ns)

    def nearest(self, stamp_ns: int) -> tuple[int, NDArray[Any]] | None:
        """The stamp (ns) and image of the recent mask nearest to `stamp_ns`; None before the first."""
        mask = self._subscriber.nearest(MASK, stamp_ns)
        return None if mask is None else (mask.stamp_ns, mask.array)

    def close(self) -> None:
        self._subscriber.close()
