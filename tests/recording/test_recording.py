"""The recorder: what was published is in the file, and other readers find it there."""

import json
import shutil
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from command_line import refused, sags
from mcap.reader import make_reader
from mcap.records import Schema
from mcap_ros2.decoder import DecoderFactory
from recorded_plane import by_topic, content, record_plane
from rosbags.highlevel import AnyReader
from synthetic import plane_result

from sags_node.bags.bag import BagMessage, read_messages
from sags_node.bags.pictures import decode_picture
from sags_node.clients.recording.bag_writer import BagWriter, Limits
from sags_node.clients.recording.info import bag_info
from sags_node.clients.recording.player import Player, PlayOptions
from sags_node.clients.recording.recover import recover
from sags_node.config.schema import PublishConfig
from sags_node.errors import UsageError
from sags_node.messaging import cdr
from sags_node.messaging.topics import TOPICS

pytestmark = pytest.mark.live


@pytest.fixture(scope="module")
def plane(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    """A recording of a second, and what the recorder said of it."""
    return record_plane(tmp_path_factory.mktemp("plane"))


def in_order(messages: list[BagMessage]) -> bool:
    """None is missing, by the numbers of the sender."""
    first = messages[0].sequence
    return [message.sequence for message in messages] == list(range(first, first + len(messages)))


def test_every_topic_is_recorded_as_it_was_published(plane: tuple[Path, dict[str, Any]]) -> None:
    path, summary = plane
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
        assert in_order(messages)
        assert all(0 <= message.log_ns - message.publish_ns < 60e9 for message in messages)
    stamp = cdr.decode(picture.data, picture.type).header.stamp
    assert stamp.sec * 10**9 + stamp.nanosec == picture.publish_ns  # the time of capture
    assert json.loads(cdr.decode(found["parameters"][0].data, "std_msgs/msg/String").data) == {"seed": 5}


def test_other_readers_agree(plane: tuple[Path, dict[str, Any]]) -> None:
    """`rosbags` reads the folder, `mcap` the file, checksums and all, `mcap_ros2` what the messages say."""
    path, summary = plane
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


def test_played_topics_are_named_as_info_prints_them(tmp_path: Path) -> None:
    path, summary = record_plane(tmp_path, seconds=0.4, compression="jpeg")
    config = PublishConfig(data=(), control=None, run_dir=tmp_path / "played")
    name = "/sags/left/image_rect_color/compressed"
    pictures = len(by_topic(path)["left/image_rect_color/compressed"])

    def played(**options: Any) -> int:
        return Player(path, PlayOptions(rate=50.0, **options), config).play()["messages"]

    assert name in {row["topic"] for row in bag_info(path)["topics"]}
    for said in (name, "left/image_rect_color", "sags/left/image_rect_color/compressed"):
        assert played(topics=(said,)) == pictures
        assert played(exclude=(said,)) == summary["messages"] - pictures
        assert played(topics=(said,), remap={said: "left/depth/compressed"}) == pictures
    assert played(topics=(name, "clock"), clock_hz=50.0) == pictures
    (file,) = path.glob("*.mcap")
    for bag in (path, file):
        wrong = {"topics": (name, "left/dept"), "exclude": ("left/dept",), "remap": {"left/dept": "a"}}
        for option, value in wrong.items():
            with pytest.raises(UsageError, match=r"asked for as left/dept; it has .*left/depth"):
                Player(bag, PlayOptions(**{option: value}), config).play()


def test_a_bag_that_is_not_in_order_is_told_of(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """As converters write it, one topic after the other: the second one would come as a burst at the end."""
    kind, config = "std_msgs/msg/String", PublishConfig(data=(), control=None, run_dir=tmp_path / "played")
    schema = Schema(id=0, name=kind, encoding="ros2msg", data=cdr.definition(kind).encode())
    text = b"\0\1\0\0" + b"\2\0\0\0a\0"
    for name, topics in {"after": ("a", "b"), "beside": ("a",)}.items():
        with BagWriter(tmp_path / name) as bag:
            for topic in topics:
                channel = bag.add_topic(topic, kind, schema)
                for number in range(10):
                    stamp_ns = 10**18 + number * 100_000_000
                    bag.write(channel, stamp_ns, stamp_ns, number, text)
        caplog.clear()
        Player(tmp_path / name, PlayOptions(rate=50.0), config).play()
        told = [record.getMessage() for record in caplog.records]
        assert len(told) == (name == "after")
        assert all("b lies 0.9 s behind" in said and "ros2 bag convert" in said for said in told)


# ---- Recordings in several files: together they are one recording, and each can be read alone. ----


@pytest.fixture(scope="module")
def split_bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """More than ten files, so that their names do not sort as text."""
    path, summary = record_plane(tmp_path_factory.mktemp("split"), seconds=2.0, limits=Limits(bytes=600_000))
    assert summary["dropped"] == 0
    return path


def test_a_full_file_is_followed_by_the_next_and_each_can_be_read_alone(split_bag: Path) -> None:
    """By other readers too; calibration and parameters are in each, and its own description."""
    whole = list(read_messages(split_bag))
    described = yaml.safe_load((split_bag / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    names = [f"bag_{number}.mcap" for number in range(len(list(split_bag.glob("*.mcap"))))]
    assert len(names) > 10
    assert described["relative_file_paths"] == names == [file["path"] for file in described["files"]]
    assert described["message_count"] == len(whole) and bag_info(split_bag)["files"] == names
    with AnyReader([split_bag]) as reader:
        read = [(connection.topic, bytes(raw)) for connection, _, raw in reader.messages()]
        assert read == [(message.topic, bytes(message.data)) for message in whole]
    assert all(map(in_order, by_topic(split_bag).values()))
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
            attached = {a.name for a in mcap.iter_attachments()}
            notes = {m.name: m.metadata for m in mcap.iter_metadata()}
        own = yaml.safe_load(notes["rosbag2"]["serialized_metadata"])
        assert own["relative_file_paths"] == [file.name] and own["message_count"] == len(alone)
        counts = {t["topic_metadata"]["name"]: t["message_count"] for t in own["topics_with_message_count"]}
        assert counts["/sags/tf"] == sum(message.topic == "/sags/tf" for message in alone)
        if file.name != "bag_0.mcap":  # where they may come after the first images
            assert attached == {"parameters.json", "calib/left.yaml", "calib/right.yaml"}
            assert notes["sags"]["session"] == "session-1"
    assert joined == content(whole)


def test_a_file_ends_after_its_time(tmp_path: Path) -> None:
    path, _ = record_plane(tmp_path, seconds=1.6, limits=Limits(seconds=0.5))
    files = sorted(path.glob("*.mcap"))
    assert len(files) >= 3
    times = [[message.log_ns for message in read_messages(file)] for file in files]
    assert all(each[-1] - each[0] <= 0.5e9 for each in times)
    assert all(after[0] - before[0] > 0.5e9 for before, after in pairwise(times)), "and not before"
    assert bag_info(path)["messages"] == sum(bag_info(file)["messages"] for file in files)


@pytest.mark.fault("file: one of a recording's, in a folder without metadata.yaml, is missing")
def test_a_missing_file_is_told_of(split_bag: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Once; what is there is read."""
    torn = tmp_path / "torn"
    shutil.copytree(split_bag, torn)
    (torn / "metadata.yaml").unlink()
    (torn / "bag_1.mcap").unlink()
    assert sags("bag", "info", torn).exit_code == 0
    assert caplog.text.count(f"{torn} lacks 1 of its files") == 1


def test_split_recordings_are_recovered_and_played(split_bag: Path, tmp_path: Path) -> None:
    """As a killed recorder leaves it: no metadata.yaml, and the last file cut off."""
    whole = content(list(read_messages(split_bag)))
    killed = tmp_path / "killed"
    shutil.copytree(split_bag, killed)
    (killed / "metadata.yaml").unlink()
    assert content(list(read_messages(killed))) == whole  # the files are in order all the same
    last = killed / f"bag_{len(list(killed.glob('*.mcap'))) - 1}.mcap"
    last.write_bytes(last.read_bytes()[: last.stat().st_size // 2])
    refused(1, "bag", "info", killed, said=(last.name, "sags bag recover"))
    assert recover(killed, tmp_path / "saved")["unclosed_files"] == 1
    saved = content(list(read_messages(tmp_path / "saved")))
    assert saved == whole[: len(saved)] and len(saved) > 0.9 * len(whole) - 40
    with (tmp_path / "saved/saved_0.mcap").open("rb") as opened:
        attached = [a.name for a in make_reader(opened).iter_attachments()]
    assert sorted(attached) == ["calib/left.yaml", "calib/right.yaml", "parameters.json"]  # once
    config = PublishConfig(data=("tcp://127.0.0.1:*",), control=None, run_dir=tmp_path / "run")
    assert Player(split_bag, PlayOptions(rate=50.0), config).play()["messages"] == len(whole)
