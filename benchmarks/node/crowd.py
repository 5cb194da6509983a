"""`benchmarks crowd`: whether slow, dead and many subscribers disturb a node."""

import json
import multiprocessing
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from multiprocessing.connection import Connection
from multiprocessing.synchronize import Event
from pathlib import Path
from typing import Any

import numpy as np
import zmq

from benchmarks import Advance
from benchmarks.node.neighbours import OWN_PORTS, everything, give_way, read_everything
from benchmarks.node.processes import STARTING, own_run_dir, parent_lives, program, sags, wait_until
from sags_node.errors import SagsError
from sags_node.messaging.address import NodeAddress, connect
from sags_node.messaging.received import ReceivedText, TopicName
from sags_node.messaging.stream import MAX_MESSAGE_BYTES
from sags_node.messaging.subscriber import Subscriber
from sags_node.quality.metrics import percentiles

PICTURES = ("left/render/image", "left/render/depth")
SMALL = ("tf", "anchors", "status")  # what each of the many listens to
STATUS = TopicName("status", ReceivedText)
MANY = 20
WARM_UP = 10.0  # s
SLOW = 0.2  # s that the slow subscriber takes for each frame
PHASE = *OWN_PORTS, "source.loop:=true"

Task = Callable[[Path, float, Event, Connection], None]  # what a subscriber does
Work = tuple[Task, float]  # a task and its argument


def measure_crowd(
    launch: Sequence[str], alone: float, crowded: float, advance: Advance, many: int = MANY
) -> Any:
    """Measure a node in its own process: with a quiet observer alone, with a reader of everything, with a
    crowd, and alone again. The reader makes the node compute and send all; the rest is the crowd's cost.

    The crowd: a fast subscriber that takes every image and depth; a slow one that takes `SLOW` seconds for
    each; a dead one that is connected to everything and never reads; and `many` more that listen to `SMALL`.
    They stand for other machines, and so take only what the node leaves of the cores.

    Args:
        launch: launch file and overrides of the node.
        alone, crowded: s for each phase.

    Raises:
        SagsError: the node does not run.
    """
    crowd: dict[str, Work] = {"fast": (_take, 0.0), "slow": (_take, SLOW), "dead": (_sleep, 0.0)}
    crowd[f"{many} more"] = (_listen, float(many))
    with own_run_dir() as run_dir, node_beside(launch, run_dir) as node:
        with Subscriber([STATUS], run_dir=run_dir) as observer:
            phases = []
            for name, seconds, work in (
                ("alone", alone, {}),
                ("one reader", alone, {"reader": (_read, 0.0)}),
                ("crowd", crowded, crowd),
                ("alone again", alone, {}),
            ):
                with peers_of(run_dir, work) as stop:
                    seen = watched(observer, seconds, node, advance, name)
                    peers = stop()
                phases.append({"phase": name, **_figures(seen), "peers": peers})
    return {"launch": list(launch), "many": many, "phases": phases}


TABLES = (
    "phase rate_hz.p50 latency_p50_ms latency_p99_ms rss_mb.start rss_mb.end rss_mb_per_minute",
    "phase messages",
    "phase rate_hz since_capture_ms.p50 since_sent_ms.p50",
)


@contextmanager
def node_beside(launch: Sequence[str], run_dir: Path) -> Iterator[subprocess.Popen[str]]:
    """Run a node in its own process, with its files in `run_dir`."""
    with tempfile.TemporaryFile("w+", errors="replace") as errors:  # a pipe that is full would stop the node
        with sags("run", *launch, *PHASE, f"publish.run_dir:={run_dir}", stderr=errors) as node:
            try:
                wait_until(lambda: any(run_dir.glob("*.json")), node, "the node did not start")
            except SagsError as error:
                errors.seek(0)
                raise SagsError(f"{error}: {errors.read().strip()}") from None
            yield node


def watched(
    observer: Subscriber, seconds: float, node: subprocess.Popen[str], advance: Advance, what: str
) -> list[dict[str, Any]]:
    """Return the node's own status once a second, without that of the first `WARM_UP` seconds."""
    seen: list[dict[str, Any]] = []
    begun = time.monotonic()
    newest: ReceivedText | None = None
    while (passed := time.monotonic() - begun) < WARM_UP + seconds:
        if node.poll() is not None:
            raise SagsError("the node ended before its time")
        newest = observer.wait(STATUS, timeout=5.0, after=newest) or newest
        if newest is not None and passed > WARM_UP:
            seen.append(json.loads(newest.text))
            advance(len(seen), None, what)
    if len(seen) < 3:
        raise SagsError("too little was heard of the node; measure longer")
    return seen


@contextmanager
def peers_of(folder: Path, work: Mapping[str, Work]) -> Iterator[Callable[[], dict[str, Any]]]:
    """Run subscribers in processes of their own. The function given ends them and returns what they saw."""
    spawn = multiprocessing.get_context("spawn")
    ending = spawn.Event()
    members: dict[str, Connection] = {}

    def stop() -> dict[str, Any]:
        ending.set()
        return {name: here.recv() for name, here in members.items() if here.poll(STARTING)}

    with ExitStack() as running:
        for name, (target, argument) in work.items():
            members[name], there = spawn.Pipe()
            running.enter_context(program(_with_what_is_left, target, folder, argument, ending, there))
        for name, here in members.items():
            if not here.poll(STARTING):
                raise SagsError(f"{name}: the subscribers did not start")
            here.recv()
        yield stop


def _with_what_is_left(work: Task, folder: Path, argument: float, ending: Event, there: Connection) -> None:
    """Work at the lowest priority: a subscriber stands for another machine."""
    there.send(None)  # it runs
    give_way()
    work(folder, argument, ending, there)


def is_over(ending: Event) -> bool:
    """Tell whether the phase has ended or the benchmark was killed."""
    return ending.is_set() or not parent_lives()


def _take(folder: Path, seconds: float, ending: Event, there: Connection) -> None:
    """Take image and depth of the newest frame again and again, and sleep for `seconds` after each."""
    since_capture, since_sent = [], []
    with Subscriber(PICTURES, run_dir=folder) as subscriber:
        newest = subscriber.wait(PICTURES[0], timeout=STARTING)
        begun = time.monotonic()
        while not is_over(ending):
            newest = subscriber.wait(PICTURES[0], timeout=1.0, after=newest) or newest
            if newest is None or subscriber.aligned(PICTURES, newest.stamp_ns, timeout=0.1) is None:
                continue
            now = time.time_ns()
            since_capture.append((now - newest.stamp_ns) * 1e-6)
            since_sent.append((now - newest.meta.publish_ns) * 1e-6)
            time.sleep(seconds)
    rate = len(since_sent) / (time.monotonic() - begun)
    ages = {"since_capture_ms": percentiles(since_capture), "since_sent_ms": percentiles(since_sent)}
    there.send({"rate_hz": rate, **ages})


def _read(folder: Path, _: float, ending: Event, there: Connection) -> None:
    """Take everything there is, as fast as it comes."""
    there.send({"messages": read_everything(folder, lambda: not is_over(ending))})


def _sleep(folder: Path, _: float, ending: Event, there: Connection) -> None:
    """Be connected to everything and never read."""
    with everything(folder):
        while not is_over(ending):
            ending.wait(1.0)
    there.send({})


def _listen(folder: Path, count: float, ending: Event, there: Connection) -> None:
    """Many subscribers of small topics in one process."""
    context, poller = zmq.Context(), zmq.Poller()
    address = NodeAddress(run_dir=folder).data()
    for _ in range(int(count)):
        socket = context.socket(zmq.SUB)
        for name in SMALL:
            socket.subscribe(f"sags/{name}")
        connect(socket, address, MAX_MESSAGE_BYTES)
        poller.register(socket, zmq.POLLIN)
    heard = 0
    while not is_over(ending):
        for socket, _event in poller.poll(100):
            socket.recv_multipart()
            heard += 1
    there.send({"messages": heard})
    context.destroy(linger=0)


def _figures(seen: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Medians over a phase, and how the memory grew in it."""
    rss = np.array([each["rss_mb"] for each in seen])
    minutes = np.arange(len(rss)) / 60
    return {
        "seconds": len(seen),
        "rate_hz": percentiles([each["rate_hz"] for each in seen]),
        "latency_p50_ms": float(np.median([each["latency_ms"]["p50"] for each in seen])),
        "latency_p99_ms": float(np.median([each["latency_ms"]["p99"] for each in seen])),
        "rss_mb": {"start": float(rss[0]), "end": float(rss[-1]), "max": float(rss.max())},
        "rss_mb_per_minute": float(np.polyfit(minutes, rss, 1)[0]),
        "connections": seen[-1]["connections"],
    }
