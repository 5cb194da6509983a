"""A node that is only its sockets, and a bridge beside it in this process."""

import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from synthetic import at_frame, plane_result, stream
from waiting import beside, until

from sags_node.config.schema import PublishConfig
from sags_node.messaging import topics
from sags_node.messaging.address import NodeAddress
from sags_node.messaging.publisher import Publisher
from sags_node.types import AnchorStates, FrameResult

T = TypeVar("T")

FRAME_TOPICS = [topic.name for topic in topics.TOPICS if topic.name != "parameters"]
SEEN, HIDDEN, LOST, UNSURE = 3, 5, 8, 9  # numbers of the anchors in `anchored`


class Pinned:
    """A node's control operations for anchors, and what was asked of them."""

    def __init__(self, first: int = 1) -> None:
        self._first = first
        self.added: list[dict[str, Any]] = []
        self.removed: list[int] = []
        self.handlers = {"add_anchor": self._add, "remove_anchor": self._remove}

    def _add(self, args: dict[str, Any]) -> dict[str, Any]:
        self.added.append(args)
        return {"id": self._first + len(self.added) - 1, "frame_id": 7, "depth_confidence": 0.9}

    def _remove(self, args: dict[str, Any]) -> None:
        self.removed.append(args["id"])


def asked(running: Publisher) -> set[str]:
    """The topics that clients ask this node for."""
    return {name for name in FRAME_TOPICS if running.wanted(name)}


@contextmanager
def sockets(
    run_dir: Path,
    handlers: Mapping[str, Callable[[dict[str, Any]], Any]] | None = None,
    metric: bool = True,
) -> Iterator[Publisher]:
    """The sockets of a node named `sags`, on free ports."""
    config = PublishConfig(
        data=("tcp://127.0.0.1:*",), control="tcp://127.0.0.1:*", run_dir=run_dir, right=True
    )
    with Publisher(config, "sags", f"session-{time.time_ns()}", handlers, metric=metric) as running:
        yield running


def options_of(kind: Callable[..., T], run_dir: Path, **said: Any) -> T:
    """Those of a bridge to the node of `sockets`, and to an overlay."""
    node, overlay = NodeAddress(run_dir=run_dir), NodeAddress("overlay", run_dir=run_dir)
    return kind(**{"node": node, "overlay": overlay, **said})


def anchored() -> FrameResult:
    """The plane with four anchors on it: one seen, one hidden, one lost, one seen and not recognised."""
    places = np.array([[0.01, 0.02, 0.07], [-0.01, 0.0, 0.08], [np.nan] * 3, [0.0, 0.01, 0.08]], np.float32)
    pixels = np.array([[20, 20], [50, 30], [np.nan] * 2, [75, 45]], np.float32)
    seen, sure = np.array([1, 0, 0, 1], np.float32), np.array([1, 1, 1, 0.2], np.float32)
    numbers, ones = np.array([SEEN, HIDDEN, LOST, UNSURE]), np.ones(4, np.float32)
    return replace(plane_result(), anchors=AnchorStates(numbers, places, pixels, seen, sure, ones, ones))


def anchored_at(number: int) -> FrameResult:
    """A frame of `stream` that is captured now."""
    return at_frame(_ANCHORED, number, time.time_ns())


_ANCHORED = anchored()


@contextmanager
def bridged(
    run: Callable[[Any, Callable[[str, int], None], threading.Event], None], options: Any
) -> Iterator[int]:
    """A bridge on a thread; gives its port."""
    stop, ports = threading.Event(), []
    with beside(lambda: run(options, lambda _, port: ports.append(port), stop), stop.set) as failed:
        until(lambda: ports or failed)
        assert not failed, failed
        yield ports[0]


@contextmanager
def plane_bridged(
    run: Callable[..., None],
    options: Any,
    frame: Callable[[int], FrameResult] = anchored_at,
    handlers: Mapping[str, Callable[[dict[str, Any]], Any]] | None = None,
) -> Iterator[tuple[Publisher, int]]:
    """A node that sends the plane with its anchors, and the port of a bridge beside it."""
    with sockets(options.node.run_dir, handlers) as running, stream(running, frame):
        with bridged(run, options) as port:
            yield running, port
