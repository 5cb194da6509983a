"""A node that is only its sockets and makes thin images."""

import time
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path

from synthetic import at_frame, health, publisher
from waiting import repeating

from sags_node.messaging.publisher import Publisher
from sags_node.messaging.thin import thin_pictures
from sags_node.types import FrameResult


def node_sockets(run_dir: Path, right: bool = False) -> AbstractContextManager[Publisher]:
    """Those of a node."""
    return publisher(run_dir, thins=True, control=None, right=right)


@contextmanager
def making(running: Publisher, result: FrameResult, rate: float = 50.0) -> Iterator[list[frozenset[str]]]:
    """A node's publishing and thinning on one thread; gives what was made of each frame."""
    made: list[frozenset[str]] = []
    began = time.monotonic()

    def publish(number: int) -> None:
        frame = at_frame(result, number, time.time_ns())
        running.publish_result(frame, 0)
        pictures = thin_pictures(frame, running.thin)
        made.append(frozenset(pictures))
        running.publish_thin(frame, pictures)
        running.publish_health(health())
        running.poll(max(0, round(1000 * (began + (number + 1) / rate - time.monotonic()))))

    with repeating(publish):
        yield made
