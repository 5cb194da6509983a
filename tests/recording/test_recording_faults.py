"""What a recorder could not keep is counted, and what it cannot do is named."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import msgspec
import numpy as np
import pytest
import zmq
from independent_client import zmq_socket
from made_messages import message_of
from recorded_plane import by_topic, recording
from synthetic import HEIGHT, WIDTH, at_frame, plane_camera, plane_result, publisher
from waiting import beside, until

from sags_node.bags.bag import BagMessage
from sags_node.bags.pictures import decode_picture
from sags_node.cli.bag import recorded_table
from sags_node.clients.recording import recorder as recorder_module
from sags_node.clients.recording.backlog import Arrived, Ring
from sags_node.clients.recording.bag_writer import BagWriter, Limits
from sags_node.clients.recording.info import bag_info
from sags_node.clients.recording.player import Player, PlayOptions
from sags_node.clients.recording.recorder import Recorder, RecordOptions
from sags_node.clients.recording.recover import recover
from sags_node.config.schema import PublishConfig
from sags_node.errors import SagsError, UsageError
from sags_node.findings import by_stage
from sags_node.messaging import cdr, topics
from sags_node.messaging.address import NodeAddress
from sags_node.messaging.cdr import Content
from sags_node.messaging.stream import listen_to
from sags_node.messaging.wire import Message, encode
from sags_node.node.recorder import LOW_SECONDS, SILENT_SECONDS, findings

pytestmark = pytest.mark.live


def text_message(seq: int, text: str = "x") -> Message:
    return message_of("status", cdr.string(text), seq, seq, frame_id=-1)


Send = Callable[..., None]


@contextmanager
def recorded(tmp_path: Path, **options: Any) -> Iterator[tuple[Send, Recorder, list[dict[str, Any]]]]:
    """What is sent goes into `bag`; and what the recorder says."""
    endpoint = f"ipc://{tmp_path / 'data'}"
    asked = RecordOptions(tmp_path / "bag", node=NodeAddress(endpoint=endpoint), **options)
    with zmq_socket(zmq.XPUB, endpoint, bind=True) as socket, recording(asked) as (recorder, said):
        socket.recv()  # the subscription

        def send(*messages: Message | list[bytes]) -> None:
            for message in messages:
                socket.send_multipart(encode(message) if isinstance(message, Message) else message)

        yield send, recorder, said


def both(tmp_path: Path) -> list[dict[str, list[BagMessage]]]:
    """What the bag holds, and what `recover` makes of it."""
    recover(tmp_path / "bag", tmp_path / "saved")
    return [by_topic(tmp_path / folder) for folder in ("bag", "saved")]


@contextmanager
def played(bag: Path, *names: str) -> Iterator[Iterator[Message]]:
    """The messages of these topics while a bag is played over and over."""
    run_dir = bag.parent / "run"
    player = Player(bag, PlayOptions(loop=True), PublishConfig(data=(), control=None, run_dir=run_dir))
    with beside(player.play, player.stop):
        until((run_dir / "sags.json").exists)
        heard = listen_to(NodeAddress(run_dir=run_dir), names, 60.0)
        yield (arrived[0] for arrived in heard if arrived is not None)


def test_gaps_repeats_and_strangers_are_counted(tmp_path: Path) -> None:
    with recorded(tmp_path) as (send, recorder, said):
        send(*map(text_message, (3, 4, 4, 7, 8, 3, 12)))
        of_own = msgspec.structs.replace(text_message(1).meta, type="my_msgs/msg/Own")
        send([b"sags/status", b"junk", b"junk"], Message("sags/own", of_own, (b"1234",)))
        until(lambda: recorder.summary()["rejected"])
    row = said[-1]["topics"]["sags/status"]
    assert row == {"messages": 5, "dropped": 0, "lost": 2 + 3} and said[-1]["rejected"] == 1
    (listed,) = bag_info(tmp_path / "bag")["topics"]
    assert listed["messages"] == 5 and listed["lost"] == 5


@pytest.mark.parametrize("error", [None, RuntimeError("of a library"), MemoryError()], ids=repr)
def test_what_cannot_be_written_ends_nothing_in_silence(
    error: Exception | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A damaged message is left out and counted. A bug, and no memory, end the recording with an error."""
    attach = Mock(side_effect=error)
    monkeypatch.setattr(BagWriter, "attach", attach)
    name, kind = ("left/camera_info", topics.CAMERA_INFO) if error is None else ("parameters", topics.STRING)
    body = Content(kind, (b"\0\1\0\0" + bytes(5),)) if error is None else cdr.string("{}")
    with (
        nullcontext() if error is None else pytest.raises(SagsError, match=r"cannot write .*bag: .*Error"),
        recorded(tmp_path) as (send, recorder, said),
    ):
        send(message_of(name, body, 1, 1, frame_id=1), *map(text_message, range(1, 9)))
        until(lambda: attach.called or recorder.summary()["messages"] == 8)
    if error is None:
        assert said[-1]["messages"] == 8 and said[-1]["rejected"] == 1
        assert bag_info(tmp_path / "bag")["messages"] == 8


def test_what_headers_say_stays_so_in_a_bag_and_when_it_is_played(tmp_path: Path) -> None:
    """That lengths have no unit, until the node is calibrated; that an image is ahead."""
    depth, info = cdr.image(np.ones((4, 4), np.float32), "32FC1", 1), cdr.camera_info(plane_camera(), 1)
    view = cdr.image(np.ones((4, 4), np.uint8), "mono8", 1)
    with recorded(tmp_path) as (send, recorder, _):
        for seq, units, ahead in ((1, "relative", msgspec.UNSET), (2, msgspec.UNSET, 93_400_000)):
            send(
                message_of("left/depth", depth, seq, seq, units=units),
                message_of("left/camera_info", info, seq, seq, units=units),
                message_of("view/a/image", view, seq, seq, ahead_ns=ahead),
            )
        until(lambda: recorder.summary()["messages"] == 6)
    for kept in both(tmp_path):
        assert [message.relative for message in kept["left/depth"]] == [True, False]
        assert [cdr.decode(m.data, m.type).k.any() for m in kept["left/camera_info"]] == [False, True]
        assert [message.ahead_ns for message in kept["view/a/image"]] == [0, 100_000_000]
    came: dict[str, set[object]] = {"sags/left/depth": set(), "sags/view/a/image": set()}
    with played(tmp_path / "saved", "left/depth", "view/a/image") as heard:
        while sum(map(len, came.values())) < 4:
            message = next(heard)
            came[message.topic].add((message.meta.units, message.meta.ahead_ns))
    no = msgspec.UNSET
    assert list(came.values()) == [{("relative", no), (no, no)}, {(no, no), (no, 100_000_000)}]


@pytest.mark.fault("node: started anew while it is recorded")
@pytest.mark.parametrize("limits", [Limits(), Limits(bytes=60)], ids=["one file", "many"])
def test_a_node_that_was_started_anew_is_played_as_such(limits: Limits, tmp_path: Path) -> None:
    """Anchors of one number are other points then; so are stamps and Gaussians in a new epoch."""
    sent = [("a", 0)] * 3 + [("a", 1)] * 2 + [("b", 0)] * 3
    with recorded(tmp_path, limits=limits) as (send, recorder, _):
        for seq, (session, epoch) in enumerate(sent, 1):
            said = cdr.string(f"{session}{epoch}")
            send(message_of("status", said, seq, session=session, epoch=epoch))
        until(lambda: recorder.summary()["messages"] == len(sent))
    for kept in both(tmp_path):
        assert [(m.session, m.epoch) for m in kept["status"]] == sent
    came: dict[tuple[str, int], str] = {}
    with played(tmp_path / "bag", "status") as heard:
        while len(came) <= 8:  # two passes
            message = next(heard)
            key = message.meta.session, message.meta.epoch
            assert came.setdefault(key, cdr.parse(message).data) == cdr.parse(message).data
    assert {"a0", "a1", "b0"} == set(came.values())
    of_session: dict[str, str] = {}
    assert all(of_session.setdefault(session, said[0]) == said[0] for (session, _), said in came.items())


@pytest.mark.fault("network: two nodes send under one name while it is recorded")
@pytest.mark.parametrize("sessions", ["aaabbb", "ababab"])
def test_two_nodes_are_told_of(sessions: str, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """One that is started anew is not."""
    with recorded(tmp_path) as (send, recorder, _):
        for seq, session in enumerate(sessions, 1):
            send(message_of("status", cdr.string(session), seq, session=session))
        until(lambda: recorder.summary()["messages"] == len(sessions))
    assert caplog.text.count("two nodes send under this name") == (sessions == "ababab")


def test_a_key_colour_stays_exact(tmp_path: Path) -> None:
    """A display shows the camera where the pixel is the key, and nowhere else."""
    picture = np.full((32, 32, 3), (0, 0, 255), np.uint8)
    picture[10:20, 11:21] = 255, 120, 0
    with recorded(tmp_path, compression="jpeg") as (send, recorder, _):
        send(message_of("left/overlay/color_key", cdr.image(picture, "rgb8", 1)))
        until(lambda: recorder.summary()["messages"])
    (kept,) = by_topic(tmp_path / "bag")["left/overlay/color_key/compressed"]
    assert np.array_equal(decode_picture(kept.data, kept.type, ""), picture)


def test_what_a_person_should_know_of_a_recording() -> None:
    good = {"folder": "bag", "silent_s": 0.1, "dropped": 0, "lost": 0, "rejected": 0, "mb_per_s": 100.0}
    good |= {"snapshot_seconds": None, "kept_s": None}
    assert not list(findings({**good, "free_bytes": None}))
    assert not list(findings({**good, "free_bytes": 100e6 * LOW_SECONDS}))
    codes = {
        "recording_silent": {"silent_s": SILENT_SECONDS + 0.1}, "recording_loses": {"lost": 1},
        "recording_rejects": {"rejected": 1, "rejected_why": "it is damaged"},
        "recording_disk_low": {"free_bytes": 1e9},
    }  # fmt: skip
    for code, wrong in codes.items():
        (told,) = findings({**good, "free_bytes": 1e15, **wrong})
        assert told.code == code and by_stage([told])
    assert "full in 10 s at 100.0 MB/s" in told.text
    ring = {**good, "free_bytes": None, "snapshot_seconds": 20.0, "dropped": 7}
    (told,) = findings({**ring, "kept_s": 0.96})
    assert "the last 20 s do not fit" in told.text and "0.96 s are kept" in told.text
    assert "--max-cache" in told.text and "jpeg" not in told.text and "slow" not in told.text
    assert not list(findings({**ring, "kept_s": 19.97}))  # they did not fit for a moment


@pytest.mark.fault("memory: too little for the seconds of a snapshot")
def test_a_ring_says_how_much_it_holds(tmp_path: Path) -> None:
    with recorded(tmp_path, snapshot_seconds=60, max_cache_mb=0.005) as (send, recorder, said):
        send(*(text_message(seq, "y" * 1000) for seq in range(1, 20)))
        until(lambda: recorder.summary()["dropped"] >= 15)
        recorder.snapshot()
        until(lambda: "snapshot" in said[-1])
        summary = recorder.summary()
    (taken,) = (each for each in said if "snapshot" in each)
    times = [arrived.log_ns for arrived in by_topic(Path(taken["snapshot"]))["status"]]
    assert taken["seconds"] == summary["kept_s"] == pytest.approx((times[-1] - times[0]) * 1e-9, abs=1e-3)
    assert summary["snapshot_seconds"] == 60


def test_snapshots_hold_the_last_seconds(tmp_path: Path) -> None:
    """And the last message of a latched topic, however old it is."""
    with recorded(tmp_path, snapshot_seconds=0.3) as (send, recorder, said):
        for number, name in enumerate(("parameters", "health", "tf")):
            send(message_of(name, cdr.string("{}"), 1, 1, frame_id=-1))
            until(lambda: f"sags/{name}" in recorder.summary()["topics"])  # noqa: B023, used at once
            recorder.snapshot()
            until(lambda: len(said) > 1 + number)  # noqa: B023, used at once
            time.sleep(0.4)  # longer than it is kept
    summary, taken = said.pop(), said[1:]
    assert [Path(told["snapshot"]).name for told in taken] == ["snapshot_000", "snapshot_001", "snapshot_002"]
    assert [list(by_topic(Path(told["snapshot"]))) for told in taken] == [
        ["parameters"], ["parameters", "health"], ["parameters", "tf"],
    ]  # fmt: skip
    assert summary["messages"] == sum(told["messages"] for told in taken) == 5 and summary["dropped"] == 0


def test_a_snapshot_that_is_asked_for_just_before_the_end_is_taken(tmp_path: Path) -> None:
    """As `echo | sags bag record --stdin` asks for one, or a signal right before Ctrl-C."""
    with recorded(tmp_path, snapshot_seconds=60) as (send, recorder, said):
        send(text_message(1))
        until(lambda: recorder.summary()["topics"])
        recorder.snapshot()
        recorder.stop()
    assert [told["messages"] for told in said if "snapshot" in told] == [1]


@pytest.mark.parametrize("set_by", [3600, -3600])
def test_a_ring_keeps_its_seconds_where_the_wall_clock_is_set(set_by: int) -> None:
    """A message a second, 10 s of 30 are kept; and the camera_info of the beginning."""
    now = 0.0
    ring = Ring(10.0, 10**9, clock=lambda: now)
    for second in range(31):
        now = float(second)
        wall_s = 10**9 + second + (set_by if second >= 25 else 0)
        name = "left/camera_info" if second == 0 else "status"
        message = message_of(name, cdr.string("x"), second + 1)
        assert ring.add(Arrived(message, wall_s * 10**9), latched=second == 0) == []
    assert ring.seconds == 10.0
    assert [arrived.message.meta.seq for arrived in ring.content()] == [1, *range(21, 32)]


@pytest.mark.fault("node: killed while it is recorded")
def test_a_recorder_says_that_nothing_comes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """And its rate is that of the time in which something came."""
    endpoint, told = f"ipc://{tmp_path / 'data'}", []
    recorder = Recorder(RecordOptions(tmp_path / "bag", node=NodeAddress(endpoint=endpoint)))
    monkeypatch.setattr(recorder_module, "TELL_PERIOD", 0.01)
    with beside(lambda: recorder.run(lambda said: None, told.append), recorder.stop):
        with zmq_socket(zmq.XPUB, endpoint, bind=True) as socket:
            socket.recv()
            socket.send_multipart(encode(text_message(1, "y" * 100_000)))
            until(lambda: told and told[-1]["bytes"] > 0)
        rate = told[-1]["mb_per_s"]
        until(lambda: told[-1]["silent_s"] > 1)
    assert told[-1]["mb_per_s"] == rate
    assert "nothing came in the last" in str(recorded_table({**recorder.summary(), "silent_s": 12.3}).caption)


@pytest.mark.fault("disk: too slow for the recorder")
def test_a_disk_that_is_too_slow_costs_messages_that_are_counted(tmp_path: Path) -> None:
    """Room for two depth images and no more: a burst cannot be kept."""
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
    node = NodeAddress(run_dir=tmp_path / "run")

    def refused(folder: Path, kind: type[SagsError], said: str) -> None:
        with pytest.raises(kind, match=said), recording(RecordOptions(folder, node=node)):
            pass

    with publisher(tmp_path / "run"):
        refused(taken, UsageError, "taken exists already")
        refused(Path("/proc/nowhere/bag"), SagsError, "cannot write")
    refused(tmp_path / "none", SagsError, "no node runs as 'sags'")
    assert not (tmp_path / "none").exists()


def test_a_recorder_that_is_refused_leaves_no_empty_bag(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def heard(*_: object) -> Iterator[None]:
        yield None  # a refusal takes some handshakes
        raise SagsError("this key is refused")

    monkeypatch.setattr("sags_node.clients.recording.recorder.listen_to", heard)
    with pytest.raises(SagsError, match="this key is refused"):
        Recorder(RecordOptions(tmp_path / "bag")).run()
    assert list(tmp_path.iterdir()) == []
