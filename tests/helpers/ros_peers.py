"""Others in a ROS 2 graph: a DDS process of ours, and nodes of rclpy where tests/ros2/prepare.sh was run."""

import json
import os
import subprocess
import threading
from collections import defaultdict
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from places import ROOT
from waiting import until

from sags_node.config.schema import RosGraph
from sags_node.messaging.sockets import Closes
from sags_node.ros.graph import Delivery, Graph

pytest.importorskip("cyclonedds", reason="ROS 2 needs: pip install '.[ros2]'")

CACHE = Path(
    os.environ.get("SAGS_ROS_CACHE")
    or Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "sags/ros"
)
DOMAIN = 60 + os.getpid() % 40  # away from nodes of this machine, and from tests of another checkout
LARGE_BUFFERS = dict.fromkeys(
    ("FASTDDS_DEFAULT_PROFILES_FILE", "FASTRTPS_DEFAULT_PROFILES_FILE"),  # since Kilted; before
    str(ROOT / "examples/ros2/fastdds.xml"),
)
KEPT = Delivery(reliable=True, kept=True, depth=16)  # what was sent before, too
Wanted = tuple[str, str] | tuple[str, str, Delivery]


def rclpy_python() -> Path:
    """The interpreter that has rclpy; skips the test where there is none."""
    python = CACHE / "bin/python"
    if not python.exists():
        pytest.skip(f"no rclpy in {CACHE}; run tests/ros2/prepare.sh")
    return python


class Listener(Closes):
    """Reads topics by DDS alone: name, type, and how if not with best effort."""

    def __init__(self, *topics: Wanted) -> None:
        self.graph = Graph(RosGraph(domain=DOMAIN))
        self.came: dict[str, list[bytes]] = defaultdict(list)
        self._readers = {name: self.graph.reader(name, kind, *how) for name, kind, *how in topics}
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._listen)
        self._thread.start()

    def _listen(self) -> None:
        while not self._stop.is_set():
            self.graph.wait(0.05)
            for name, reader in self._readers.items():
                self.came[name] += reader.take()

    def newest(self, name: str) -> bytes:
        return self.came[name][-1]

    def close(self) -> None:
        """Leave the graph."""
        self._stop.set()
        self._thread.join(60)
        del self.graph, self._readers


@dataclass(frozen=True)
class Came:
    """A message that reached rclpy; see tests/ros2/peer.py."""

    stamp: int
    size: int
    crc: int
    data: str = ""


class RosNode(Closes):
    """tests/ros2/peer.py with these subscriptions."""

    def __init__(self, words: tuple[str, ...], variables: Mapping[str, str]) -> None:
        self.came: dict[str, list[Came]] = defaultdict(list)
        self.said: list[dict[str, Any]] = []
        self.process = subprocess.Popen(
            [rclpy_python(), ROOT / "tests/ros2/peer.py", *words],
            env={**os.environ, "ROS_DOMAIN_ID": str(DOMAIN), **variables},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        self._thread = threading.Thread(target=self._read)
        self._thread.start()

    def _read(self) -> None:
        for line in self.process.stdout:
            said = json.loads(line)
            topic = said.pop("topic", None)
            if topic is None:
                self.said.append(said)
            else:
                self.came[topic].append(Came(**said))

    def names(self) -> dict[str, Any]:
        """Which nodes and topics it sees."""
        count = len(self.said)
        self._order(do="names")
        until(lambda: len(self.said) > count)
        return self.said[-1]

    def publish(self, kind: str, topic: str, **fields: object) -> None:
        """`point_x=1` sets `point.x`."""
        paths = {name.replace("__", "."): value for name, value in fields.items()}
        self._order(do="publish", type=kind, topic=topic, fields=paths)

    def _order(self, **order: object) -> None:
        self.process.stdin.write(json.dumps(order) + "\n")
        self.process.stdin.flush()

    def close(self) -> None:
        self.process.kill()
        self.process.wait(10)
        self._thread.join(60)


@contextmanager
def ros_node(*words: str, **variables: str) -> Iterator[RosNode]:
    with RosNode(words, variables) as joined:
        until(lambda: joined.said)  # importing rclpy takes seconds
        yield joined
