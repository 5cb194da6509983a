"""What a recorder could not keep is counted, and what it cannot do is named."""

from __future__ import annotations

import os
import time
from pathlib import Path

import msgspec
import pytest
import zmq
from independent_client import zmq_socket
from made_messages import message_of
from recorded_plane import by_topic, recording
from synthetic import HEIGHT, WIDTH, at_frame, plane_result, publisher, stream
from waiting import until

from sags_node.errors import SagsError, UsageError
from sags_node.messaging import cdr
from sags_node.messaging.address import NodeAddress
from sags_node.messaging.wire import Message, encode
from sags_node.recording.backlog import Arrived, Backlog
from sags_node.recording.info import bag_info
from sags_node.recording.recorder import RecordOptions

pytestmark = pytest.mark.live


def text_message(seq: int, text: str = "x") -> Message:
    return message_of("status", cdr.string(text), seq, seq, frame_id=-1)


def test_gaps_repeats_and_strangers_are_counted(tmp_path: Path) -> None:
    endpoint = f"ipc://{tmp_path / 'data'}"
    options = RecordOptions(tmp_path / "bag", node=NodeAddress(endpoint=endpoint))
    with zmq_socket(zmq.XPUB, endpoint, bind=True) as socket:
        with recording(options) as (recorder, said):
            socket.recv()  # the subscription
            for seq in (3, 4, 4, 7, 8, 3, 12):
                socket.send_multipart(encode(text_message(seq)))
            socket.send_multipart([b"sags/status", b"junk", b"junk"])
            unknown = text_message(1)
            of_own = msgspec.structs.replace(unknown.meta, type="my_msgs/msg/Own")
            socket.send_multipart(encode(Message("sags/own", of_own, (b"1234",))))
            until(lambda: recorder.summary()["rejected"])
    row = said[-1]["topics"]["sags/status"]
    assert row == {"messages": 5, "dropped": 0, "lost": 2 + 3} and said[-1]["rejected"] == 1
    (listed,) = bag_info(tmp_path / "bag")["topics"]
    assert listed["messages"] == 5 and listed["lost"] == 5


def test_the_backlog_is_bounded() -> None:
    backlog = Backlog(100)
    arrived = Arrived(text_message(1, "y" * 50), 1)
    assert backlog.put(arrived) and not backlog.put(arrived)
    assert backlog.take(0.1) is arrived and backlog.put(arrived)
    backlog.close()
    assert not backlog.finished and backlog.take(0.1) is arrived and backlog.finished
    assert backlog.take(5.0) is None  # at once


@pytest.mark.fault("disk: too slow for the recorder")
def test_a_disk_that_is_too_slow_costs_messages_that_are_counted(tmp_path: Path) -> None:
    """Room for two depth pictures and no more: a burst cannot be kept."""
    run_dir = tmp_path / "run"
    most = 2.5 * 4 * WIDTH * HEIGHT / 1e6
    options = RecordOptions(
        tmp_path / "bag", ("left/depth",), "png", max_cache_mb=most, node=NodeAddress(run_dir=run_dir)
    )
    plane = plane_result()
    with publisher(run_dir) as running, recording(options) as (recorder, said):
        until(lambda: running.poll(10) or running.wanted("left/depth"))
        sent = 0

        def send() -> int:
            nonlocal sent
            sent += 1
            running.publish_result(at_frame(plane, sent, time.time_ns()), dropped=0)
            return sent

        def counted() -> int:
            """The messages sent of which the recorder knows."""
            return sum(recorder.summary()[what] for what in ("messages", "dropped", "lost"))

        while send() < 300:
            pass
        until(lambda: running.poll(30) or counted() == sent or send() < 0)  # until the newest one arrives
    row = said[-1]["topics"]["sags/left/depth"]
    assert row["messages"] + row["dropped"] + row["lost"] == sent and row["dropped"] > 0
    assert row["messages"] == len(by_topic(tmp_path / "bag")["left/depth"]) > 0


@pytest.mark.fault("disk: cannot be written to")
def test_mistakes_are_named(tmp_path: Path) -> None:
    taken = tmp_path / "taken"
    taken.mkdir()
    (taken / "mine").write_text("mine")
    with publisher(tmp_path / "run"):
        with (
            pytest.raises(UsageError, match="taken exists already"),
            recording(RecordOptions(taken, node=NodeAddress(run_dir=tmp_path / "run"))),
        ):
            pass
        with (
            pytest.raises(SagsError, match="cannot write"),
            recording(RecordOptions(Path("/proc/nowhere/bag"), node=NodeAddress(run_dir=tmp_path / "run"))),
        ):
            pass
    with (
        pytest.raises(SagsError, match="no node runs as 'sags'"),
        recording(RecordOptions(tmp_path / "none", node=NodeAddress(run_dir=tmp_path / "run"))),
    ):
        pass
    assert not (tmp_path / "none").exists()


@pytest.mark.fault("disk: full while recording")
def test_a_full_disk_ends_with_one_message(tmp_path: Path) -> None:
    with publisher(tmp_path / "run") as running, stream(running):
        file = Path("/dev/full")
        recorder_folder = tmp_path / "bag"
        recorder_folder.mkdir()
        with pytest.raises(SagsError, match=r"cannot write .*: No space left on device; save what is there"):
            with recording(RecordOptions(recorder_folder, node=NodeAddress(run_dir=tmp_path / "run"))) as (
                _,
                _,
            ):
                # The file that is being written becomes a full disk.
                (written,) = recorder_folder.glob("*.mcap")
                descriptors = Path("/proc/self/fd")
                number = next(
                    int(d.name) for d in descriptors.iterdir() if os.path.realpath(d) == str(written)
                )
                with file.open("wb") as full:
                    os.dup2(full.fileno(), number)
                time.sleep(2)
