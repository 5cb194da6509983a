"""The plane of `synthetic`, recorded by a recorder of this process."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from synthetic import at_frame, losing_nothing, plane_result, publisher, stream
from waiting import beside, until

from sags_node.bags.bag import BagMessage, read_messages
from sags_node.clients.recording.recorder import Recorder, RecordOptions
from sags_node.messaging.address import NodeAddress
from sags_node.types import FrameResult

RATE = 30.0  # Hz


@contextmanager
def recording(options: RecordOptions) -> Iterator[tuple[Recorder, list[dict[str, Any]]]]:
    """A recorder on a thread, ready; the summary is the last thing that it says."""
    recorder, said = Recorder(options), []
    with beside(lambda: said.append(recorder.run(said.append)), recorder.stop) as failed:
        until(lambda: said or failed)
        yield recorder, said


def record_plane(tmp_path: Path, seconds: float = 1.0, **options: Any) -> tuple[Path, dict[str, Any]]:
    """A bag of the plane of `synthetic`, and the recorder's summary: as many frames as come in so long."""
    run_dir, plane, count = tmp_path / "run", plane_result(), 0

    def frame(number: int) -> FrameResult:
        nonlocal count
        count = number
        return at_frame(plane, number, time.time_ns())

    with losing_nothing(), publisher(run_dir, right=True) as running:
        running.publish_parameters({"seed": 5})
        with stream(running, frame, RATE):
            until(lambda: count > 2)  # the last values are there
            node = NodeAddress(run_dir=run_dir)
            with recording(RecordOptions(tmp_path / "bag", node=node, **options)) as (_, said):
                last = count + seconds * RATE
                until(lambda: count > last)
    return tmp_path / "bag", said[-1]


def by_topic(path: Path) -> dict[str, list[BagMessage]]:
    found: dict[str, list[BagMessage]] = {}
    for message in read_messages(path):
        found.setdefault(message.topic.removeprefix("/sags/"), []).append(message)
    return found


def content(messages: list[BagMessage]) -> list[tuple[str, int, int, bytes]]:
    return [(m.topic, m.log_ns, m.sequence, bytes(m.data)) for m in messages]
