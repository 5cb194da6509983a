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
from sags_node.messaging.address import NodeAddress
from sags_node.messaging.publisher import Publisher
from sags_node.types import AnchorStates, FrameResult

T = TypeVar("T")

SEEN, HIDDEN, LOST, UNSURE = 3, 5, 8, 9  # numbers of the anchors in `anchored`


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


def senders(run_dir: Path) -> dict[str, Any]:
    """The options of a bridge that say where `sockets` are, and an overlay."""
    return {"node": NodeAddress(run_dir=run_dir), "overlay": NodeAddress("overlay", run_dir=run_dir)}


def options_of(kind: Callable[..., T], run_dir: Path, **said: Any) -> T:
    return kind(**{**senders(run_dir), **said})


def anchored(result: FrameResult | None = None) -> FrameResult:
    """The plane with four anchors on it: one seen, one hidden, one lost, one seen and not recognised."""
    result = result or plane_result()
    places = np.array([[0.01, 0.02, 0.07], [-0.01, 0.0, 0.08], [np.nan] * 3, [0.0, 0.01, 0.08]], np.float32)
    pixels = np.array([[20, 20], [50, 30], [np.nan] * 2, [75, 45]], np.float32)
    ones = np.ones(4, np.float32)
    states = AnchorStates(
        np.array([SEEN, HIDDEN, LOST, UNSURE]),
        places,
        pixels,
        np.array([1, 0, 0, 1], np.float32),
        np.array([1, 1, 1, 0.2], np.float32),
        ones,
        ones,
    )
    return replace(result, anchors=states)


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
