"""Recorder, recovery and player: what was published is in the file, and what is missing is counted."""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
import yaml
import zmq
from click.testing import CliRunner
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader
from synthetic import HEIGHT, WIDTH, at_frame, plane_result, publisher, stream

from sags_node.apps.topic import topic_hz
from sags_node.cli import main
from sags_node.config import PublishConfig
from sags_node.errors import SagsError, UsageError
from sags_node.messaging import cdr
from sags_node.messaging.control import ControlClient
from sags_node.messaging.received import ReceivedCloud, ReceivedImage
from sags_node.messaging.rundir import read_connection
from sags_node.messaging.stream import listen
from sags_node.messaging.subscriber import Subscriber
from sags_node.messaging.topics import TOPICS
from sags_node.messaging.wire import Message, Meta, encode
from sags_node.recording.backlog import Arrived, Backlog
from sags_node.recording.bag import BagMessage, read_messages
from sags_node.recording.bag_writer import Limits
from sags_node.recording.info import bag_info
from sags_node.recording.pictures import decode_picture
from sags_node.recording.player import Options as PlayOptions
from sags_node.recording.player import Player
from sags_node.recording.recorder import Options, Recorder
from sags_node.recording.recover import recover
from sags_node.session import open_session

START_SECONDS = 120  # the first start on a machine compiles kernels
MS = 1_000_000


@contextmanager
def recording(options: Options) -> Iterator[tuple[Recorder, list[dict[str, Any]]]]:
    """A recorder on a thread, ready; the summary is the last thing that it says."""
    recorder, said = Recorder(options), []
    failed: list[BaseException] = []

    def run() -> None:
        try:
            said.append(recorder.run(said.append))
        except SagsError as error:
            failed.append(error)

    thread = threading.Thread(target=run)
    thread.start()
    until(lambda: said or failed)
    try:
        yield recorder, said
    finally:
        recorder.stop()
        thread.join(30)
    if failed:
        raise failed[0]


def until(done: Callable[[], object], seconds: float = 10.0) -> None:
    deadline = time.monotonic() + seconds
    while not done():
        assert time.monotonic() < deadline, "waited in vain"
        time.sleep(0.01)


def record_plane(tmp_path: Path, seconds: float = 1.0, **options: Any) -> tuple[Path, dict[str, Any]]:
    """A bag of the plane of `synthetic`, and the recorder's summary."""
    run_dir = tmp_path / "run"
    with publisher(run_dir, right=True) as running:
        running.publish_parameters({"seed": 5})
        with stream(running):
            time.sleep(0.1)  # the last values are there
            with recording(Options(tmp_path / "bag", run_dir=run_dir, **options)) as (_, said):
                time.sleep(seconds)
    return tmp_path / "bag", said[-1]


def by_topic(path: Path) -> dict[str, list[BagMessage]]:
    found: dict[str, list[BagMessage]] = {}
    for message in read_messages(path):
        found.setdefault(message.topic.removeprefix("/sags/"), []).append(message)
    return found


# ---- the file --------------------------------------------------------------------------------------------


def test_every_topic_is_recorded_as_it_was_published(tmp_path: Path) -> None:
    path, summary = record_plane(tmp_path)
    found, truth = by_topic(path), plane_result()
    assert set(found) == {topic.name for topic in TOPICS}
    assert summary["messages"] == sum(map(len, found.values())) > 15 * 10
    assert summary["dropped"] == summary["lost"] == summary["rejected"] == 0
    assert {name: row["messages"] for name, row in summary["topics"].items()} == {
        f"sags/{name}": len(messages) for name, messages in found.items()
    }
    picture = found["left/image_rect_color"][0]
    assert np.array_equal(decode_picture(picture.data, picture.type, ""), truth.pair.left)
    for messages in found.values():
        sequence = [message.sequence for message in messages]
        assert sequence == list(range(sequence[0], sequence[0] + len(messages)))
        assert all(0 <= message.log_ns - message.publish_ns < 5e9 for message in messages)
    stamp = cdr.decode(picture.data, picture.type).header.stamp
    assert stamp.sec * 10**9 + stamp.nanosec == picture.publish_ns  # the time of capture
    assert json.loads(cdr.decode(found["parameters"][0].data, "std_msgs/msg/String").data) == {"seed": 5}


def test_other_readers_agree(tmp_path: Path) -> None:
    """`rosbags` reads the folder, `mcap` the file, checksums and all, `mcap_ros2` what the messages say."""
    path, summary = record_plane(tmp_path, seconds=0.5)
    ours = [(m.topic, m.log_ns, bytes(m.data)) for m in read_messages(path)]
    with AnyReader([path]) as reader:
        theirs = [(c.topic, t, bytes(raw)) for c, t, raw in reader.messages()]
        for connection, _, raw in reader.messages():
            reader.deserialize(raw, connection.msgtype)
        latched = {c.topic for c in reader.connections if c.ext.offered_qos_profiles[0].durability.value == 1}
    assert sorted(theirs) == sorted(ours) and len(ours) == summary["messages"]
    assert {"/sags/left/camera_info", "/sags/parameters"} <= latched and "/sags/left/depth" not in latched
    (file,) = path.glob("*.mcap")
    with file.open("rb") as opened:
        mcap = make_reader(opened, decoder_factories=[DecoderFactory()])
        said = {channel.topic: message for _, channel, _, message in mcap.iter_decoded_messages()}
    assert set(said) == {topic for topic, _, _ in ours}
    picture, splats = said["/sags/left/image_rect_color"], said["/sags/splats"]
    left = plane_result().pair.left
    assert np.array_equal(np.frombuffer(picture.data, np.uint8).reshape(left.shape), left)
    assert splats.width == len(plane_result().snapshot.gaussians) and splats.fields[0].name == "x"
    with file.open("rb") as opened:
        mcap = make_reader(opened, validate_crcs=True)
        assert mcap.get_header().profile == "ros2"
        read = [(c.topic, m.log_time, m.data) for _, c, m in mcap.iter_messages()]
        assert sorted(read) == sorted(ours)
        attached = {a.name: a.data.decode() for a in mcap.iter_attachments()}
        notes = {m.name: m.metadata for m in mcap.iter_metadata()}
    assert json.loads(attached["parameters.json"]) == {"seed": 5}
    P = yaml.safe_load(attached["calib/right.yaml"])["projection_matrix"]["data"]
    assert P[3] == pytest.approx(-90.0 * 0.0042)
    assert notes["sags"]["session"] == "session-1" and notes["sags"]["protocol"] == "1.0"
    described = yaml.safe_load((path / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    assert described["version"] == 9 and described["message_count"] == len(ours)
    assert yaml.safe_load(notes["rosbag2"]["serialized_metadata"]) == described


@pytest.mark.parametrize("compression", ["jpeg", "png"])
def test_compressed_pictures(compression: str, tmp_path: Path) -> None:
    path, _ = record_plane(tmp_path, seconds=0.4, compression=compression)
    found, truth = by_topic(path), plane_result()
    picture = found["left/image_rect_color/compressed"][0]
    assert picture.type == "sensor_msgs/msg/CompressedImage"
    worst = np.abs(decode_picture(picture.data, picture.type, "").astype(int) - truth.pair.left).max()
    assert (0 < worst < 40) if compression == "jpeg" else worst == 0
    mask = found["left/tissue_mask/compressed"][0]
    exact = decode_picture(mask.data, mask.type, "")[..., 0]
    assert np.array_equal(exact == 255, truth.observation.tissue) and set(np.unique(exact)) == {0, 255}
    assert "png" in cdr.decode(found["left/render/image/compressed"][0].data, picture.type).format
    assert "left/depth" in found and "left/depth/compressed" not in found  # metres stay exact
    stamp = cdr.decode(picture.data, picture.type).header.stamp
    assert stamp.sec * 10**9 + stamp.nanosec == picture.publish_ns


def test_only_the_topics_asked_for(tmp_path: Path) -> None:
    path, summary = record_plane(tmp_path, seconds=0.4, topics=("left/depth", "sags/tf"))
    assert set(by_topic(path)) == {"left/depth", "tf"} and set(summary["topics"]) == {
        "sags/left/depth",
        "sags/tf",
    }


# ---- in several files ------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def split_bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """More than ten files, so that their names do not sort as text."""
    path, summary = record_plane(tmp_path_factory.mktemp("split"), seconds=2.0, limits=Limits(bytes=600_000))
    assert summary["dropped"] == 0
    return path


def test_a_full_file_is_followed_by_the_next(split_bag: Path) -> None:
    whole = list(read_messages(split_bag))
    described = yaml.safe_load((split_bag / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    names = [f"bag_{number}.mcap" for number in range(len(list(split_bag.glob("*.mcap"))))]
    assert len(names) > 10
    assert described["relative_file_paths"] == names == [file["path"] for file in described["files"]]
    assert described["message_count"] == len(whole)
    assert sum(file["message_count"] for file in described["files"]) == len(whole)
    with AnyReader([split_bag]) as reader:
        assert reader.message_count == len(whole)
        assert [(c.topic, bytes(raw)) for c, _, raw in reader.messages()] == [
            (m.topic, bytes(m.data)) for m in whole
        ]
    for messages in by_topic(split_bag).values():
        sequence = [message.sequence for message in messages]
        assert sequence == list(range(sequence[0], sequence[0] + len(messages)))
    assert bag_info(split_bag)["files"] == names


def test_each_file_can_be_read_alone(split_bag: Path) -> None:
    """By two readers; calibration and parameters are in each, and its own description."""
    described = yaml.safe_load((split_bag / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    joined = []
    for said in described["files"]:
        file = split_bag / said["path"]
        alone = list(read_messages(file))
        joined += content(alone)
        assert len(alone) == said["message_count"] > 0
        assert alone[0].log_ns == said["starting_time"]["nanoseconds_since_epoch"]
        assert sum(len(message.data) for message in alone) <= 600_000
        with file.open("rb") as opened:
            mcap = make_reader(opened, validate_crcs=True, decoder_factories=[DecoderFactory()])
            assert sum(1 for _ in mcap.iter_decoded_messages()) == len(alone)
            attached = {a.name: a.data.decode() for a in mcap.iter_attachments()}
            notes = {m.name: m.metadata for m in mcap.iter_metadata()}
        own = yaml.safe_load(notes["rosbag2"]["serialized_metadata"])
        assert own["relative_file_paths"] == [file.name] and own["message_count"] == len(alone)
        counts = {t["topic_metadata"]["name"]: t["message_count"] for t in own["topics_with_message_count"]}
        assert counts["/sags/tf"] == sum(message.topic == "/sags/tf" for message in alone)
        if file.name != "bag_0.mcap":  # where they may come after the first pictures
            assert set(attached) == {"parameters.json", "calib/left.yaml", "calib/right.yaml"}
            assert notes["sags"]["session"] == "session-1"
    assert joined == content(list(read_messages(split_bag)))


def test_a_file_ends_after_its_time(tmp_path: Path) -> None:
    path, _ = record_plane(tmp_path, seconds=1.6, limits=Limits(seconds=0.5))
    files = sorted(path.glob("*.mcap"))
    assert 3 <= len(files) <= 4
    for file in files:
        times = [message.log_ns for message in read_messages(file)]
        assert times[-1] - times[0] <= 0.5e9
    assert bag_info(path)["messages"] == sum(bag_info(file)["messages"] for file in files)


def test_split_recordings_are_recovered_and_played(split_bag: Path, tmp_path: Path) -> None:
    """As a killed recorder leaves it: no metadata.yaml, and the last file cut off."""
    whole = content(list(read_messages(split_bag)))
    killed = tmp_path / "killed"
    shutil.copytree(split_bag, killed)
    (killed / "metadata.yaml").unlink()
    assert content(list(read_messages(killed))) == whole  # the files are in order all the same
    last = killed / f"bag_{len(list(killed.glob('*.mcap'))) - 1}.mcap"
    last.write_bytes(last.read_bytes()[: last.stat().st_size // 2])
    result = sags("bag", "info", killed)
    assert result.exit_code == 1 and last.name in result.stderr and "sags bag recover" in result.stderr
    result = sags("bag", "recover", killed, "-o", tmp_path / "saved", "--json")
    done = json.loads(result.stdout)
    assert result.exit_code == 3 and done["unclosed_files"] == 1
    saved = content(list(read_messages(tmp_path / "saved")))
    assert saved == whole[: len(saved)] and len(saved) > 0.9 * len(whole) - 40
    with (tmp_path / "saved/saved_0.mcap").open("rb") as opened:
        attached = [a.name for a in make_reader(opened).iter_attachments()]
    assert sorted(attached) == ["calib/left.yaml", "calib/right.yaml", "parameters.json"]  # once
    config = PublishConfig(data=("tcp://127.0.0.1:*",), control=None, run_dir=tmp_path / "run")
    assert Player(split_bag, PlayOptions(rate=50.0), config).play()["messages"] == len(whole)


# ---- what is missing -------------------------------------------------------------------------------------


def text_message(seq: int, text: str = "x") -> Message:
    content = cdr.string(text)
    meta = Meta(
        type=content.type, type_hash=cdr.type_hash(content.type), seq=seq, frame_id=-1, stamp_ns=seq * MS,
        publish_ns=seq * MS, session="s", epoch=0, step=0, encoding="", shape=[], dtype="", dropped=0,
    )  # fmt: skip
    return Message("sags/status", meta, content.parts)


def test_gaps_repeats_and_strangers_are_counted(tmp_path: Path) -> None:
    context = zmq.Context()
    socket = context.socket(zmq.XPUB)
    endpoint = f"ipc://{tmp_path / 'data'}"
    socket.bind(endpoint)
    try:
        with recording(Options(tmp_path / "bag", endpoint=endpoint)) as (_, said):
            socket.recv()  # the subscription
            for seq in (3, 4, 4, 7, 8, 3, 12):
                socket.send_multipart(encode(text_message(seq)))
            socket.send_multipart([b"sags/status", b"junk", b"junk"])
            unknown = text_message(1)
            meta = {
                **{f: getattr(unknown.meta, f) for f in Meta.__struct_fields__},
                "type": "my_msgs/msg/Own",
            }
            socket.send_multipart(encode(Message("sags/own", Meta(**meta), (b"1234",))))
            time.sleep(0.5)
    finally:
        context.destroy(linger=0)
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


def test_a_disk_that_is_too_slow_costs_messages_that_are_counted(tmp_path: Path) -> None:
    """Room for two depth pictures and no more: a burst cannot be kept."""
    run_dir = tmp_path / "run"
    most = 2.5 * 4 * WIDTH * HEIGHT / 1e6
    options = Options(tmp_path / "bag", ("left/depth",), "png", max_cache_mb=most, run_dir=run_dir)
    plane = plane_result()
    with publisher(run_dir) as running, recording(options) as (_, said):
        until(lambda: running.poll(10) or running.wanted("left/depth"))
        for i in range(300):
            running.publish_result(at_frame(plane, i, time.time_ns()), dropped=0)
        for i in range(300, 320):  # at a pace at which the last ones arrive
            running.publish_result(at_frame(plane, i, time.time_ns()), dropped=0)
            running.poll(30)
    row = said[-1]["topics"]["sags/left/depth"]
    assert row["messages"] + row["dropped"] + row["lost"] == 320 and row["dropped"] > 0
    assert row["messages"] == len(by_topic(tmp_path / "bag")["left/depth"]) > 0


def test_mistakes_are_named(tmp_path: Path) -> None:
    taken = tmp_path / "taken"
    taken.mkdir()
    (taken / "mine").write_text("mine")
    with publisher(tmp_path / "run"):
        with (
            pytest.raises(UsageError, match="taken exists already"),
            recording(Options(taken, run_dir=tmp_path / "run")),
        ):
            pass
        with (
            pytest.raises(SagsError, match="cannot write"),
            recording(Options(Path("/proc/nowhere/bag"), run_dir=tmp_path / "run")),
        ):
            pass
    with (
        pytest.raises(SagsError, match="no node runs as 'sags'"),
        recording(Options(tmp_path / "none", run_dir=tmp_path / "run")),
    ):
        pass
    assert not (tmp_path / "none").exists()


def test_a_full_disk_ends_with_one_message(tmp_path: Path) -> None:
    with publisher(tmp_path / "run") as running, stream(running):
        file = Path("/dev/full")
        recorder_folder = tmp_path / "bag"
        recorder_folder.mkdir()
        with pytest.raises(SagsError, match=r"cannot write .*: No space left on device; save what is there"):
            with recording(Options(recorder_folder, run_dir=tmp_path / "run")) as (_, _):
                # The file that is being written becomes a full disk.
                (written,) = recorder_folder.glob("*.mcap")
                descriptors = Path("/proc/self/fd")
                number = next(
                    int(d.name) for d in descriptors.iterdir() if os.path.realpath(d) == str(written)
                )
                with file.open("wb") as full:
                    os.dup2(full.fileno(), number)
                time.sleep(2)


# ---- the last seconds ------------------------------------------------------------------------------------


def test_snapshots_hold_the_last_seconds(tmp_path: Path) -> None:
    run_dir = tmp_path / "run"
    with publisher(run_dir) as running:
        running.publish_parameters({"seed": 6})
        options = Options(tmp_path / "ring", snapshot_seconds=0.6, run_dir=run_dir)
        with stream(running), recording(options) as (recorder, said):
            for number in range(2):
                time.sleep(1.2)
                recorder.snapshot()
                until(lambda: len(said) > 1 + number)  # noqa: B023, used at once
    summary = said.pop()
    assert [Path(s["snapshot"]).name for s in said[1:]] == ["snapshot_000", "snapshot_001"]
    assert summary["messages"] == sum(s["messages"] for s in said[1:]) and summary["dropped"] == 0
    for told in said[1:]:
        depth = by_topic(Path(told["snapshot"]))["left/depth"]
        span = (depth[-1].log_ns - depth[0].log_ns) * 1e-9
        assert 0 < span <= 0.6
        latched = by_topic(Path(told["snapshot"]))["parameters"]
        assert len(latched) == 1 and latched[0].log_ns < depth[0].log_ns  # older, and there all the same


# ---- recovery --------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A sound recording of some ten chunks."""
    path, _ = record_plane(tmp_path_factory.mktemp("recover"), seconds=2.0)
    return path


def recovered(file: bytes, tmp_path: Path, name: str) -> tuple[dict[str, Any] | None, list[BagMessage]]:
    """What `recover` makes of a file; None when it says that nothing is left."""
    damaged, out = tmp_path / f"{name}.mcap", tmp_path / name
    damaged.write_bytes(file)
    try:
        done = recover(damaged, out)
    except SagsError as error:
        assert "holds no whole message" in str(error)
        return None, []
    return done, list(read_messages(out))


def content(messages: list[BagMessage]) -> list[tuple[str, int, int, bytes]]:
    return [(m.topic, m.log_ns, m.sequence, bytes(m.data)) for m in messages]


def test_recovery_after_a_cut_keeps_all_before_it(bag: Path, tmp_path: Path) -> None:
    (file,) = bag.glob("*.mcap")
    whole, original = file.read_bytes(), content(list(read_messages(bag)))
    rng = random.Random(0)
    sizes = []
    for number, length in enumerate(sorted(rng.randrange(len(whole)) for _ in range(12))):
        done, kept = recovered(whole[:length], tmp_path, f"cut{number}")
        assert done is None or done["lost"]
        assert content(kept) == original[: len(kept)]
        assert len(kept) >= len(original) * (length / len(whole)) * 0.9 - 40  # nearly all that is there
        sizes.append(len(kept))
    assert sizes == sorted(sizes) and sizes[-1] > len(original) / 2


def test_recovery_from_flipped_bits_keeps_only_what_is_right(bag: Path, tmp_path: Path) -> None:
    (file,) = bag.glob("*.mcap")
    whole, original = file.read_bytes(), set(content(list(read_messages(bag))))
    for seed in range(24):
        rng = random.Random(seed)
        data = bytearray(whole)
        for _ in range(1 + seed % 3):
            place = (rng.randrange(len(data)), rng.randrange(2000), len(data) - 1 - rng.randrange(8000))[
                seed % 3
            ]
            data[place] ^= 1 << rng.randrange(8)
        done, kept = recovered(bytes(data), tmp_path, f"flip{seed}")
        found = set(content(kept))
        assert done is not None and found <= original and len(kept) == len(found)
        assert done["lost"] or len(found) == len(original)
        if seed % 3 == 0:  # one flip costs one chunk
            assert len(found) > 0.75 * len(original)


def test_recovery_finds_the_chunks_behind_a_hole(bag: Path, tmp_path: Path) -> None:
    (file,) = bag.glob("*.mcap")
    whole, original = file.read_bytes(), content(list(read_messages(bag)))
    hole = bytearray(whole)
    third = len(whole) // 3
    hole[third : third + 1000] = b"\x06" * 1000
    for name, data in (
        ("hole", hole),
        ("gone", whole[:third] + whole[third + 500 :]),
        ("more", whole[:third] + b"\x06\xff" * 300 + whole[third:]),
    ):
        done, kept = recovered(bytes(data), tmp_path, name)
        assert done is not None and done["lost"] and set(content(kept)) <= set(original)
        assert content(kept)[-1] == original[-1] and len(kept) > 0.6 * len(original)


def test_recovery_with_nothing_lost(bag: Path, tmp_path: Path) -> None:
    (file,) = bag.glob("*.mcap")
    whole, original = file.read_bytes(), content(list(read_messages(bag)))
    for name, data in (("sound", whole), ("footer", whole[:-20]), ("index", whole[:-2000] + bytes(2000))):
        done, kept = recovered(data, tmp_path, name)
        assert done is not None and not done["lost"] and content(kept) == original
    with (tmp_path / "sound").joinpath("metadata.yaml").open() as described:
        topics = yaml.safe_load(described)["rosbag2_bagfile_information"]["topics_with_message_count"]
    kept_for_late = [
        t for t in topics if "transient_local" in str(t["topic_metadata"]["offered_qos_profiles"])
    ]
    latched = [t["topic_metadata"]["name"] for t in kept_for_late]
    assert "/sags/parameters" in latched and "/sags/left/depth" not in latched
    assert all(t["topic_metadata"]["type_description_hash"].startswith("RIHS01_") for t in topics)


def test_recover_on_the_command_line(bag: Path, tmp_path: Path) -> None:
    (file,) = bag.glob("*.mcap")
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(file.read_bytes()[:-200_000])
    (tmp_path / "empty").mkdir()
    result = sags("bag", "info", cut)
    assert result.exit_code == 1 and "sags bag recover" in result.stderr
    result = sags("bag", "recover", cut, "-o", tmp_path / "saved", "--json")
    assert result.exit_code == 3 and json.loads(result.stdout)["lost"] is True
    result = sags("bag", "recover", file, "-o", tmp_path / "again")
    assert result.exit_code == 0 and "nothing was lost" in result.stdout
    assert sags("bag", "recover", file, "-o", tmp_path / "again").exit_code == 2
    for other in (tmp_path / "nowhere.mcap", tmp_path / "empty", __file__):
        assert sags("bag", "recover", other, "-o", tmp_path / "out").exit_code == 2
    listed = json.loads(sags("bag", "info", tmp_path / "again", "--json").stdout)
    assert listed["messages"] == bag_info(bag)["messages"] and {t["lost"] for t in listed["topics"]} == {0}


def sags(*arguments: object) -> Any:
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGUSR1)}
    try:
        result = CliRunner().invoke(main, [str(argument) for argument in arguments])
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result


# ---- playing again ---------------------------------------------------------------------------------------


@contextmanager
def playing(path: Path, run_dir: Path, paused: bool = True, **options: Any) -> Iterator[Player]:
    """A player on a thread, paused so that subscribers can come."""
    config = PublishConfig(data=("tcp://127.0.0.1:*",), control=None, run_dir=run_dir)
    player = Player(path, PlayOptions(**options), config, "sags", paused)
    outcome: list[Any] = []
    thread = threading.Thread(target=lambda: outcome.append(player.play()))
    thread.start()
    until((run_dir / "sags.json").exists)
    try:
        yield player
    finally:
        player.stop()
        thread.join(10)
    assert outcome


def test_a_consumer_sees_a_played_bag_as_a_node(bag: Path, tmp_path: Path) -> None:
    names = ["left/image_rect_color", "left/render/depth", "splats", "left/camera_info"]
    truth = plane_result()
    with (
        playing(bag, tmp_path / "run", loop=True) as player,
        Subscriber(names, run_dir=tmp_path / "run") as sub,
    ):
        time.sleep(0.3)
        player.toggle_pause()
        picture = sub.wait(names[0], 10)
        assert picture is not None
        frame = sub.aligned(names, picture.stamp_ns, timeout=5)
        assert frame is not None and len({message.meta.frame_id for message in frame.values()}) == 1
        assert np.array_equal(cast(ReceivedImage, frame[names[0]]).array, truth.pair.left)
        depth = cast(ReceivedImage, frame["left/render/depth"]).array
        assert np.array_equal(depth[1:], truth.views["left"].depth[1:]) and np.isnan(depth[0]).all()
        ids = cast(ReceivedCloud, frame["splats"]).points["id"]
        assert np.array_equal(ids, truth.snapshot.gaussians.ids)
        until(lambda: all(sub.ok(name) for name in names))  # fresh: a strict reader takes them
        stamp = cdr.decode(cdr_of(picture), picture.meta.type).header.stamp
        assert stamp.sec * 10**9 + stamp.nanosec == picture.stamp_ns
        player.toggle_pause()
        until(lambda: not sub.ok(names[0]))


def cdr_of(received: Any) -> bytes:
    """The message again, as its sender must have joined it."""
    body = cdr.image(received.array, received.meta.encoding, received.stamp_ns)
    return b"".join(bytes(part) for part in body.parts)


def test_compressed_pictures_are_played_raw(tmp_path: Path) -> None:
    path, _ = record_plane(tmp_path, seconds=0.6, compression="png")
    names = ["left/image_rect_color", "left/render/image", "left/tissue_mask"]
    with (
        playing(path, tmp_path / "again", loop=True) as player,
        Subscriber(names, run_dir=tmp_path / "again") as sub,
    ):
        player.toggle_pause()
        seen = {name: cast(ReceivedImage, sub.wait(name, 10)) for name in names}
    assert np.array_equal(seen[names[0]].array, plane_result().pair.left)
    assert seen[names[1]].meta.encoding == "rgba8" and seen[names[1]].array[..., 3].max() == 191
    assert seen[names[2]].array.shape == (HEIGHT, WIDTH)


def test_flags_of_play(bag: Path, tmp_path: Path) -> None:
    depth = by_topic(bag)["left/depth"]
    recorded = bag_info(bag)["duration_s"]
    config = PublishConfig(data=("tcp://127.0.0.1:*",), control=None, run_dir=tmp_path / "run")

    def outcome(**options: Any) -> dict[str, Any]:
        return Player(bag, PlayOptions(**options), config).play()

    all_of_it = outcome(rate=20.0, topics=("left/depth",))
    assert all_of_it["messages"] == len(depth)
    slow = outcome(topics=("left/depth",), start_offset=recorded - 0.8, rate=0.5)  # it cannot be quicker
    assert slow["seconds"] > 1.0 and 0 < slow["messages"] < len(depth)
    short = outcome(topics=("left/depth",), playback_duration=1.0, rate=10.0)
    assert 0 < short["messages"] < len(depth)
    without = outcome(rate=50.0, exclude=("left/depth",))
    assert without["messages"] == bag_info(bag)["messages"] - len(depth)
    with pytest.raises(SagsError, match="no message that was asked for"):
        outcome(topics=("left/dept",))
    with (
        playing(
            bag, tmp_path / "other", topics=("left/depth",), remap={"left/depth": "left/render/depth"}
        ) as player,
        Subscriber(["left/render/depth", "left/depth"], run_dir=tmp_path / "other") as subscriber,
    ):
        player.toggle_pause()
        assert subscriber.wait("left/render/depth", 10) is not None
        assert subscriber.latest("left/depth") is None
    assert sags("bag", "play", bag, "--remap", "a=b").exit_code == 2


def test_a_clock_tells_the_moment_of_the_recording(bag: Path, tmp_path: Path) -> None:
    """Half as fast, with a pause: by clock and stamp every message is found in the recording again."""
    recorded = {m.sequence: m.publish_ns for m in by_topic(bag)["left/depth"]}
    run_dir, rate = tmp_path / "run", 0.5
    clocks: list[tuple[float, int, int]] = []  # when it came (s), wall clock and recording (ns)
    depths: list[int] = []
    with playing(bag, run_dir, topics=("left/depth",), rate=rate, clock_hz=50.0) as player:
        began = time.monotonic()
        toggles = [0.0, 0.8, 1.5]
        for arrived in listen(["clock", "left/depth"], None, "sags", 2.4, run_dir=run_dir):
            at = time.monotonic() - began
            if toggles and at >= toggles[0]:
                toggles.pop(0)
                player.toggle_pause()
            if arrived is None:
                continue
            message, _ = arrived
            if message.topic == "sags/clock":
                said = cdr.parse(message).clock
                clocks.append((at, message.meta.stamp_ns, said.sec * 10**9 + said.nanosec))
            else:
                depths.append(message.meta.stamp_ns)
    ats, walls, told = (np.array(column) for column in zip(*clocks, strict=True))
    assert (np.diff(walls) >= 0).all() and (np.diff(told) >= 0).all()
    paused = (ats > 1.0) & (ats < 1.4)
    assert np.count_nonzero(paused) > 8 and np.ptp(told[paused]) < 2e6
    for playing_on in (ats < 0.7, ats > 1.7):
        steps, real = np.diff(told[playing_on]), np.diff(walls[playing_on])
        assert len(steps) > 12 and np.median(real) == pytest.approx(1e9 / 50, rel=0.2)
        assert steps.sum() / real.sum() == pytest.approx(rate, rel=0.02)
    for stamp in depths[5:]:
        nearest = int(np.argmin(np.abs(walls - stamp)))
        moment = told[nearest] + (stamp - walls[nearest]) * rate
        assert min(abs(moment - original) for original in recorded.values()) < 2e6


def test_without_being_asked_there_is_no_clock(bag: Path, tmp_path: Path) -> None:
    with (
        playing(bag, tmp_path / "run") as player,
        Subscriber(["clock", "tf"], run_dir=tmp_path / "run") as sub,
    ):
        player.toggle_pause()
        assert sub.wait("tf", 10) is not None
        time.sleep(0.2)
        assert sub.latest("clock") is None


def test_the_clock_on_the_command_line(bag: Path, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "sags_node", "bag", "play", str(bag), "--loop", "--clock"]
    command += ["--endpoint", "tcp://127.0.0.1:*"]
    environment = {**os.environ, "XDG_RUNTIME_DIR": str(tmp_path)}
    with subprocess.Popen(
        command, env=environment, stdin=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    ) as process:
        try:
            until((tmp_path / "sags/sags.json").exists, START_SECONDS)
            figures = topic_hz("clock", read_connection("sags", tmp_path / "sags").data[0], seconds=1.5)
        finally:
            process.send_signal(signal.SIGINT)
            assert process.wait(20) == 0
    assert 25 < figures["average_rate"] < 45
    assert sags("bag", "play", bag, "--clock", "0").exit_code == 2


# ---- a real node, a real recorder, and a real kill -------------------------------------------------------


@pytest.fixture(scope="module")
def node(phantom_session: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """`sags run` in its own process; its run directory."""
    home = tmp_path_factory.mktemp("node")
    command = [sys.executable, "-m", "sags_node", "run", str(phantom_session), "source.loop:=true"]
    command += [
        "publish.right:=true",
        "publish.data:=[tcp://127.0.0.1:*]",
        "publish.control:=tcp://127.0.0.1:*",
    ]
    command += ["mapping.budget_ms:=20"]
    environment = {**os.environ, "XDG_RUNTIME_DIR": str(home)}
    with subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL) as process:
        try:
            until((home / "sags/sags.json").exists, START_SECONDS)
            with Subscriber(["tf"], run_dir=home / "sags") as subscriber:
                assert subscriber.wait("tf", START_SECONDS) is not None
            yield home
        finally:
            process.send_signal(signal.SIGINT)
            process.wait(20)


def start_recorder(home: Path, *arguments: object) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "sags_node", "bag", "record", *map(str, arguments)]
    environment = {**os.environ, "XDG_RUNTIME_DIR": str(home)}
    return subprocess.Popen(
        command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


def test_a_killed_recording_is_recovered_and_replayed(node: Path, tmp_path: Path) -> None:
    seen: dict[int, dict[str, np.ndarray]] = {}
    eyes = ["left/image_rect_color", "right/image_rect_color"]
    with Subscriber(eyes, run_dir=node / "sags") as subscriber:
        process = start_recorder(node, "-o", tmp_path / "bag")
        bag_file = tmp_path / "bag/bag_0.mcap"
        deadline = time.monotonic() + 60
        newest = None
        while not (bag_file.exists() and bag_file.stat().st_size > 40e6):
            assert time.monotonic() < deadline
            newest = subscriber.wait(eyes[0], 1, after=newest)
            pair = newest and subscriber.aligned(eyes, newest.stamp_ns, timeout=0.5)
            if newest and pair:
                arrays = {name: cast(ReceivedImage, message).array.copy() for name, message in pair.items()}
                seen[newest.stamp_ns] = arrays
        process.kill()
        process.wait()
    assert not (tmp_path / "bag/metadata.yaml").exists()
    result = sags("bag", "recover", tmp_path / "bag", "-o", tmp_path / "saved", "--json")
    assert result.exit_code == 3
    done = json.loads(result.stdout)
    assert done["chunks_damaged"] <= 1 and done["messages_lost"] == 0
    with AnyReader([tmp_path / "saved"]) as reader:
        assert reader.message_count == done["messages"] > 50
        every_second = {"/sags/diagnostics"}  # may not have come yet
        wanted = {f"/sags/{topic.name}" for topic in TOPICS}
        assert {c.topic for c in reader.connections} | every_second == wanted
    with (tmp_path / "saved/saved_0.mcap").open("rb") as opened:
        reader2 = make_reader(opened, validate_crcs=True)
        assert sum(1 for _ in reader2.iter_messages()) == done["messages"]
    session = open_session(tmp_path / "saved", ["source.pace:=step"])
    compared = 0
    with session.source as source:
        for frame in source:
            published = seen.get(frame.t_capture_ns)
            if published is not None:
                assert np.array_equal(frame.left, published[eyes[0]])
                assert np.array_equal(frame.right, published[eyes[1]])
                compared += 1
    assert compared >= 5
    assert session.rig.baseline > 0 and session.rig.left.width == frame.left.shape[1]


def test_a_long_recording_in_several_files_is_a_session(node: Path, tmp_path: Path) -> None:
    """What `ros2 bag record -b` is for: a real node, a real recorder, and every command takes the folder."""
    process = start_recorder(node, "-o", tmp_path / "bag", "-b", 12_000_000, "--seconds", 4)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 0, errors
    files = list((tmp_path / "bag").glob("*.mcap"))
    assert len(files) > 3 and max(file.stat().st_size for file in files) < 12_400_000
    result = sags("bag", "info", tmp_path / "bag", "--json")
    assert result.exit_code == 0 and len(json.loads(result.stdout)["files"]) == len(files)
    result = sags("eval", tmp_path / "bag", "source.frames:=10", "--pace", "step", "--json", "-")
    assert result.exit_code == 0, result.output
    assert json.loads(result.stdout)["frames"] == 10  # out of three files


def test_ctrl_c_closes_the_file_and_a_signal_takes_a_snapshot(node: Path, tmp_path: Path) -> None:
    straight = start_recorder(
        node, "-o", tmp_path / "bag", "--json", "--topics", "left/depth", "--topics", "/sags/tf"
    )
    ring = start_recorder(node, "-o", tmp_path / "ring", "--json", "--snapshot-mode", "1")
    assert straight.stderr is not None and ring.stderr is not None
    for process in (straight, ring):
        assert process.stderr is not None and "recording" in process.stderr.readline()
    time.sleep(2)
    ring.send_signal(signal.SIGUSR1)
    assert "snapshot_000" in ring.stderr.readline()
    for process in (straight, ring):
        process.send_signal(signal.SIGINT)
        stdout, _ = process.communicate(timeout=20)
        assert process.returncode == 0
        summary = json.loads(stdout)
        assert summary["messages"] > 5 and summary["dropped"] == 0
    assert {m.topic for m in read_messages(tmp_path / "bag")} == {"/sags/left/depth", "/sags/tf"}
    assert (tmp_path / "bag/metadata.yaml").exists()
    assert bag_info(tmp_path / "ring/snapshot_000")["messages"] > 5


def test_recording_on_the_control_socket(node: Path, tmp_path: Path) -> None:
    with ControlClient(run_dir=node / "sags") as control:
        with pytest.raises(SagsError, match="nothing is being recorded"):
            control.request("stop_recording", timeout=10)
        for wrong in ({}, {"path": "x", "speed": 3}, {"path": "x", "compression": "gif"}):
            with pytest.raises(SagsError, match="start_recording takes path"):
                control.request("start_recording", wrong, timeout=10)
        args = {"path": str(tmp_path / "bag"), "topics": ["left/depth"]}
        assert control.request("start_recording", args, timeout=20) == {"recording": str(tmp_path / "bag")}
        with pytest.raises(SagsError, match="running already"):
            control.request("start_recording", args, timeout=10)
        time.sleep(1.5)
        summary = control.request("stop_recording", timeout=20)
        assert summary["messages"] == len(by_topic(tmp_path / "bag")["left/depth"]) > 3
        with pytest.raises(SagsError, match="exists already; name a new folder"):
            control.request("start_recording", args, timeout=20)
        args = {"path": str(tmp_path / "ring"), "snapshot_seconds": 1, "max_bag_size": 2_000_000}
        control.request("start_recording", args, timeout=20)
        time.sleep(1)
        taken = control.request("take_snapshot", timeout=20)
        saved = bag_info(Path(taken["snapshot"]))
        assert saved["messages"] == taken["messages"] > 5 and len(saved["files"]) > 1
        assert control.request("stop_recording", timeout=20)["messages"] == taken["messages"]
