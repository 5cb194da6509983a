"""Recordings in several files: together they are one recording, and each can be read alone."""

from __future__ import annotations

import json
import shutil
from itertools import pairwise
from pathlib import Path

import pytest
import yaml
from command_line import sags
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from recorded_plane import by_topic, content, record_plane
from rosbags.highlevel import AnyReader

from sags_node.bags.bag import read_messages
from sags_node.clients.recording.bag_writer import Limits
from sags_node.clients.recording.info import bag_info
from sags_node.clients.recording.player import Player, PlayOptions
from sags_node.config.schema import PublishConfig


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
    assert len(files) >= 3
    times = [[message.log_ns for message in read_messages(file)] for file in files]
    assert all(each[-1] - each[0] <= 0.5e9 for each in times)
    assert all(after[0] - before[0] > 0.5e9 for before, after in pairwise(times)), "and not before"
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
