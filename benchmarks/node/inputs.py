"""`benchmarks inputs`: what a live pair costs until the mapper can have it, for each way into the node."""

import os
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from functools import partial
from typing import Any

import numpy as np

from benchmarks import Advance
from benchmarks.node.processes import children, cpu_seconds, parent_lives, program
from sags_node.client import FrameSender
from sags_node.config.schema import GeometryConfig, GstSource, PushSource, Ros2Source, RosGraph
from sags_node.errors import SagsError, UsageError
from sags_node.messaging import cdr
from sags_node.messaging.topics import IMAGE
from sags_node.ros.graph import Graph
from sags_node.sources.push import PushedPictures
from sags_node.sources.source import Source, open_source
from sags_node.types import U8

WIDTH, HEIGHT, RATE = 1280, 1024, 30  # of an eye
WARM_UP_S = 1.0  # from the first pair on
SILENT_S = 30.0  # a source may give nothing for so long

Opener = Callable[[], AbstractContextManager[Source]]  # of a live source of that size and rate
Send = Callable[[U8, int], object]  # an image as both eyes', and its stamp (ns)


def _camera(height: int) -> str:
    """A black test image, which costs nothing; a moving one takes 18 ms of a core: too slow."""
    return (
        "videotestsrc is-live=true pattern=black "
        f"! video/x-raw,format=UYVY,width={WIDTH},height={height},framerate={RATE}/1"
    )


TWO = GstSource(launch=f"{_camera(HEIGHT)} ! tee name=t  t. ! left.  t. ! right.")
OVER_UNDER = GstSource(launch=_camera(2 * HEIGHT), geometry=GeometryConfig(layout="over_under"))


@contextmanager
def _push() -> Iterator[Source]:
    source = PushedPictures(PushSource(endpoint="tcp://127.0.0.1:*", rate=RATE), (WIDTH, HEIGHT))
    with source, program(_pushing, source.endpoint):
        yield source


@contextmanager
def _ros2() -> Iterator[Source]:
    domain = 70 + os.getpid() % 30  # away from a robot's own, and from another benchmark
    names = {"left": "/stereo/left/image_raw", "right": "/stereo/right/image_raw"}
    with open_source(Ros2Source(domain=domain, rate=RATE, **names)) as source:
        with program(_publishing, domain, *names.values()):
            yield source


def _pushing(endpoint: str) -> None:
    sender = FrameSender(endpoint)
    _send_always(lambda picture, stamp_ns: sender.send(picture, picture, stamp_ns))


def _publishing(domain: int, *names: str) -> None:
    graph = Graph(RosGraph(domain=domain))
    writers = [graph.writer(name, IMAGE) for name in names]

    def send(picture: U8, stamp_ns: int) -> None:
        for writer in writers:
            writer.write(cdr.image(picture, "rgb8", stamp_ns).cdr(), stamp_ns)

    _send_always(send)


def _send_always(send: Send) -> None:
    """Send the same image at the camera's rate, stamped just before, until the parent process ends."""
    picture: U8 = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    due = time.monotonic()
    while parent_lives():
        send(picture, time.time_ns())
        due += 1 / RATE
        time.sleep(max(0.0, due - time.monotonic()))


WAYS: dict[str, Opener] = {
    "gst, two branches": partial(open_source, TWO),
    "gst, over-under": partial(open_source, OVER_UNDER),
    "push": _push,
    "ros2": _ros2,
}


TABLES = ("way pairs unequal dropped node_ms sender_ms latency_ms_p50 latency_ms_p99",)


def measure_inputs(seconds: float, only: str | None, advance: Advance) -> list[dict[str, Any]]:
    """Measure a row for each way: `way`, `pairs`, `unequal` (pairs of unequal stamps), `dropped` (images
    lost or without a partner); `node_ms`, the CPU time of a pair in the node's process; `sender_ms`, that of
    the process that makes, converts and sends the images; `latency_ms_p50` and `_p99` from the stamp until
    the pair is there.

    Args:
        seconds: to measure each way.
        only: measure the ways whose names begin with this; None: all.

    Raises:
        UsageError: no way has such a name.
        SagsError: a source cannot be opened, or gives nothing.
    """
    ways = {name: opener for name, opener in WAYS.items() if name.startswith(only or "")}
    if not ways:
        raise UsageError(f"--only {only}: the ways are {', '.join(WAYS)}")
    rows = []
    for done, (name, opener) in enumerate(ways.items()):
        advance(done, len(ways), name)
        rows.append({"way": name, **_measure(opener, seconds)})
    return rows


def _measure(opener: Opener, seconds: float) -> dict[str, Any]:
    latencies, unequal = [], 0
    with opener() as source:
        timer = threading.Timer(WARM_UP_S + seconds + SILENT_S, source.stop)
        timer.daemon = True
        timer.start()
        warm = until = cpu = senders = 0.0
        dropped = 0
        for frame in source:
            now = time.monotonic()
            warm = warm or now + WARM_UP_S
            if now < warm:
                continue
            if not until:
                until, dropped = now + seconds, source.dropped
                cpu, senders = time.process_time(), _children_s()
            latencies.append(time.time_ns() - frame.t_capture_ns)
            unequal += frame.t_capture_ns != frame.t_capture_right_ns
            if now > until:
                break
        cpu, senders = time.process_time() - cpu, _children_s() - senders
        dropped = source.dropped - dropped
        timer.cancel()
    if not latencies:
        raise SagsError("the source gave no pair")
    p50, p99 = np.percentile(latencies, (50, 99)) * 1e-6
    return {
        "pairs": len(latencies),
        "unequal": unequal,
        "dropped": dropped,
        "node_ms": round(cpu * 1e3 / len(latencies), 2),
        "sender_ms": round(senders * 1e3 / len(latencies), 1),
        "latency_ms_p50": round(p50, 1),
        "latency_ms_p99": round(p99, 1),
    }


def _children_s() -> float:
    """CPU time of the processes that this one has started."""
    spent = 0.0
    for child in children():
        with suppress(OSError):  # it has ended meanwhile
            spent += cpu_seconds(child)
    return spent
