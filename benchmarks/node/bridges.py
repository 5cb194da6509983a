"""`benchmarks bridges`: what each bridge gives its peer, how old that is, and what it costs."""

import json
import socket
import struct
import subprocess
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect
from websockets.sync.connection import Connection

from benchmarks import Advance
from benchmarks.node.crowd import STATUS, node_beside, watched
from benchmarks.node.processes import (
    STARTING,
    STOPPING,
    cpu_seconds,
    first_said,
    own_run_dir,
    sags,
    wait_until,
)
from sags_node.bags.pictures import header_stamp
from sags_node.config.schema import RosGraph
from sags_node.errors import SagsError
from sags_node.messaging.cdr import COMPRESSED
from sags_node.messaging.subscriber import Subscriber
from sags_node.messaging.topics import IMAGE, POINT_CLOUD
from sags_node.processes import end
from sags_node.quality.metrics import percentiles
from sags_node.ros.graph import Graph

PICTURES = ("/sags/left/image_rect_color", "/sags/left/render/image")
LAYOUT = (*PICTURES, "/sags/points", "/sags/anchors", "/sags/tf", "/sags/figures")  # what the layout shows
WHOLE = ("sags/left/render/image", "sags/left/render/depth", "sags/anchors")
HALF = ("sags/thin/half/left/render/image/jpeg", "sags/thin/half/left/render/depth/png", "sags/anchors")
THIN = tuple(f"{picture}/h264" for picture in PICTURES)


@dataclass(slots=True)
class Heard:
    """What a peer got; ages by device or channel."""

    ages_ms: dict[str, list[float]] = field(default_factory=lambda: defaultdict(list))
    count: int = 0
    size: int = 0

    def note(self, name: str, stamp: float, size: int) -> None:
        self.ages_ms[name].append(1e3 * (time.time() - stamp))
        self.count += 1
        self.size += size


Said = dict[str, Any]  # what a bridge prints: where its peers find it
Listen = Callable[[Said, Heard, threading.Event], None]


@dataclass(frozen=True, slots=True)
class Case:
    """One bridge with one peer."""

    name: str
    command: tuple[str, ...]  # of `sags bridge`
    leading: str  # the device or channel whose age counts
    listen: Listen


def measure_bridges(launch: Sequence[str], seconds: float, advance: Advance) -> list[dict[str, Any]]:
    """Measure one row for the node alone, and one for each bridge.

    Raises:
        SagsError: a node or a bridge does not run, or a peer gets nothing.
    """
    with own_run_dir() as run_dir, node_beside(launch, run_dir) as node:
        with Subscriber([STATUS], run_dir=run_dir) as observer:
            alone = _node_figures(watched(observer, seconds, node, advance, "node alone"))
            rows: list[dict[str, Any]] = [{"bridge": "none", **alone}]
            for case in CASES:
                with _bridge(case, run_dir) as (process, heard):
                    began = time.monotonic()
                    before, frames = cpu_seconds(process.pid), _frames(observer)
                    seen = watched(observer, seconds, node, advance, case.name)
                    spent, shown = cpu_seconds(process.pid) - before, _frames(observer) - frames
                    took = time.monotonic() - began
                    ages = percentiles(heard.ages_ms[case.leading])
                    if ages is None or shown <= 0:
                        raise SagsError(f"{case.name}: its peer got no {case.leading}")
                rows.append(
                    {
                        "bridge": case.name,
                        "messages_hz": heard.count / took,
                        "pictures_hz": len(heard.ages_ms[case.leading]) / took,
                        "mb_per_s": heard.size / took * 1e-6,
                        "age_ms": ages,
                        "cpu_ms_per_frame": 1e3 * spent / shown,
                        **_node_figures(seen),
                    }
                )
    return rows


TABLES = (
    "bridge pictures_hz mb_per_s age_ms.p50 age_ms.p90 cpu_ms_per_frame node_rate_hz node_p50_ms node_p99_ms",
)


def _node_figures(seen: Sequence[dict[str, Any]]) -> dict[str, float]:
    return {
        "node_rate_hz": float(np.median([each["rate_hz"] for each in seen])),
        "node_p50_ms": float(np.median([each["latency_ms"]["p50"] for each in seen])),
        "node_p99_ms": float(np.median([each["latency_ms"]["p99"] for each in seen])),
    }


def _frames(observer: Subscriber) -> int:
    """The number of the node's last frame; a recording that loops goes on counting."""
    status = observer.latest(STATUS)
    return 0 if status is None else int(json.loads(status.text)["last_frame"].get("frame_id", 0))


# ---- a bridge and its peer ---------------------------------------------------------------------------------


@contextmanager
def _bridge(case: Case, run_dir: Path) -> Iterator[tuple[subprocess.Popen[str], Heard]]:
    """A bridge in its own process, and a peer on a thread."""
    arguments = ("bridge", *case.command, "--json", "--run-dir", str(run_dir))
    with sags(*arguments, stdout=subprocess.PIPE, stderr=None) as process:
        failed = f"{case.name}: the bridge did not start; try: sags bridge {' '.join(case.command)}"
        said, stop, heard = first_said(process, failed), threading.Event(), Heard()
        peer = threading.Thread(target=case.listen, args=(said, heard, stop))
        peer.start()
        try:
            failed = f"{case.name}: its peer got nothing within {STARTING:g} s"
            wait_until(lambda: heard.ages_ms.get(case.leading), process, failed)
            heard.ages_ms.clear()
            heard.count = heard.size = 0
            yield process, heard
        finally:
            stop.set()
            end(process, grace=STOPPING)  # which a peer that waits for a message sees
            peer.join(STOPPING)


def _listen_igtl(said: Said, heard: Heard, stop: threading.Event) -> None:
    """Read every OpenIGTLink message, and no more of it than its header."""
    header = struct.Struct(">H12s20sIIQQ")
    with socket.create_connection((said["host"], said["port"]), timeout=STOPPING) as joined:
        with joined.makefile("rb", buffering=1 << 20) as stream:
            while not stop.is_set():
                try:
                    _, _, device, seconds, fraction, size, _ = header.unpack(stream.read(header.size))
                    stream.read(size)
                except (TimeoutError, struct.error, OSError):
                    return
                name = device.rstrip(b"\0").decode()
                heard.note(name, seconds + fraction / 2**32, header.size + size)


def _messages(joined: Connection, stop: threading.Event) -> Iterator[str | bytes]:
    """What comes by WebSocket, until either side ends."""
    while not stop.is_set():
        try:
            yield joined.recv(timeout=1.0)
        except TimeoutError:
            continue
        except ConnectionClosed:
            return


def _listen_foxglove(names: Sequence[str]) -> Listen:
    """A client that looks at these channels."""

    def listen(where: Said, heard: Heard, stop: threading.Event) -> None:
        known: dict[str, int] = {}
        url, plain = f"ws://{where['host']}:{where['port']}", ["foxglove.sdk.v1"]
        with connect(url, subprotocols=plain, max_size=None) as joined:  # type: ignore[arg-type]  # its own str
            while not stop.is_set() and len(known) < len(names):
                said = joined.recv(timeout=STARTING)
                if isinstance(said, str):
                    known |= {each["topic"]: each["id"] for each in json.loads(said).get("channels", ())}
                    known = {name: number for name, number in known.items() if name in names}
            wanted = [{"id": i, "channelId": known[name]} for i, name in enumerate(names)]
            joined.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))
            for message in _messages(joined, stop):
                if isinstance(message, bytes) and message[0] == 1:
                    number, stamp_ns = struct.unpack_from("<IQ", message, 1)
                    heard.note(names[number], stamp_ns * 1e-9, len(message))

    return listen


def _listen_ros2(topics: Mapping[str, str]) -> Listen:
    """A DDS process that reads these topics, by name and type."""

    def listen(said: Said, heard: Heard, stop: threading.Event) -> None:
        graph = Graph(RosGraph(domain=said["domain"], interface=said["interface"]))
        readers = {name: graph.reader(name, kind) for name, kind in topics.items()}
        while not stop.is_set():
            graph.wait(0.1)
            for name, reader in readers.items():
                for data in reader.take():
                    heard.note(name, header_stamp(data) * 1e-9, len(data))

    return listen


def _listen_web(names: Sequence[str]) -> Listen:
    """A WebSocket client that asks for these topics, and reads no more of a message than its header."""

    def listen(said: Said, heard: Heard, stop: threading.Event) -> None:
        with connect(f"ws://127.0.0.1:{said['port']}/ws", max_size=None) as joined:
            joined.send(json.dumps({"subscribe": names}))
            for message in _messages(joined, stop):
                if isinstance(message, bytes):
                    head = json.loads(message[4 : 4 + struct.unpack_from("<I", message)[0]])
                    heard.note(head["topic"], head["stamp_ns"] * 1e-9, len(message))

    return listen


ANY_PORT = ("--port", "0")
RAW = {
    **dict.fromkeys((*PICTURES, "/sags/left/render/depth"), IMAGE),
    **dict.fromkeys(("/sags/points/all", "/sags/anchors"), POINT_CLOUD),
}
SMALL = {
    **dict.fromkeys((f"{picture}/compressed" for picture in PICTURES), COMPRESSED),
    **dict.fromkeys(("/sags/points", "/sags/anchors"), POINT_CLOUD),
}
SMALL_DEPTH = {"/sags/left/render/depth/compressedDepth": COMPRESSED}
IN_GRAPH = ("ros2", "--domain", "230")  # where nobody else is
CASES = (
    Case("openigtlink", ("openigtlink", *ANY_PORT), "SagsPicture", _listen_igtl),
    Case("foxglove", ("foxglove", *ANY_PORT), PICTURES[1], _listen_foxglove(LAYOUT)),
    Case("foxglove, H.264", ("foxglove", *ANY_PORT), THIN[1], _listen_foxglove(THIN)),
    Case("ros2, raw", IN_GRAPH, PICTURES[1], _listen_ros2(RAW)),
    Case("ros2, small", IN_GRAPH, f"{PICTURES[1]}/compressed", _listen_ros2(SMALL)),
    Case("ros2, small depth", IN_GRAPH, next(iter(SMALL_DEPTH)), _listen_ros2(SMALL_DEPTH)),
    Case("web", ("web", *ANY_PORT), WHOLE[0], _listen_web(WHOLE)),
    Case("web, half size", ("web", *ANY_PORT), HALF[0], _listen_web(HALF)),
)
