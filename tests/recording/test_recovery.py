"""Damaged recordings: what is whole is saved, and nothing that is wrong."""

import errno
import json
import random
import shutil
from itertools import pairwise
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest
import yaml
from command_line import refused, sags
from mcap.opcode import Opcode
from recorded_plane import content, record_plane

from sags_node.bags.bag import BagMessage, read_messages, records_of
from sags_node.bags.mcap_file import MAGIC, Entry, heads
from sags_node.clients.recording.bag_writer import BagWriter
from sags_node.clients.recording.info import bag_info
from sags_node.clients.recording.recover import recover
from sags_node.errors import SagsError


@pytest.fixture(scope="module")
def plane_bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A sound recording of three chunks or more."""
    return record_plane(tmp_path_factory.mktemp("plane"), seconds=0.5)[0]


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


def chunks(file: Path) -> list[tuple[int, int]]:
    """Where each chunk ends, and how many messages it holds: how many there are depends on the machine."""
    with file.open("rb") as opened:
        return [
            (head.end, sum(isinstance(record, Entry) for record in records_of(opened, head)))
            for head in heads(opened, file.stat().st_size, len(MAGIC))
            if head.opcode == Opcode.CHUNK
        ]


@pytest.mark.fault("file: a recording is cut off")
def test_recovery_after_a_cut_keeps_all_before_it(plane_bag: Path, tmp_path: Path) -> None:
    (file,) = plane_bag.glob("*.mcap")
    whole, original = file.read_bytes(), content(list(read_messages(plane_bag)))
    rng = random.Random(0)
    sizes = []
    for number, length in enumerate(sorted(rng.randrange(len(whole)) for _ in range(12))):
        done, kept = recovered(whole[:length], tmp_path, f"cut{number}")
        assert done is None or done["lost"] or len(kept) == len(original)  # cut off within the index
        assert content(kept) == original[: len(kept)]
        assert len(kept) >= sum(count for end, count in chunks(file) if end <= length)
        sizes.append(len(kept))
    assert sizes == sorted(sizes)


def test_recovery_from_flipped_bits_keeps_only_what_is_right(plane_bag: Path, tmp_path: Path) -> None:
    (file,) = plane_bag.glob("*.mcap")
    whole, original = file.read_bytes(), content(list(read_messages(plane_bag)))
    for seed in range(12):
        rng = random.Random(seed)
        data = bytearray(whole)
        for _ in range(1 + seed % 3):
            places = rng.randrange(len(data)), rng.randrange(2000), len(data) - 1 - rng.randrange(8000)
            data[places[seed % 3]] ^= 1 << rng.randrange(8)
        done, kept = recovered(bytes(data), tmp_path, f"flip{seed}")
        found = set(content(kept))
        assert done is not None and found <= set(original) and len(kept) == len(found)
        assert done["lost"] or len(found) == len(original)
        if seed % 3 == 0:  # one flip costs one chunk
            assert len(found) >= len(original) - max(count for _, count in chunks(file))


def test_recovery_finds_the_chunks_behind_a_hole(plane_bag: Path, tmp_path: Path) -> None:
    (file,) = plane_bag.glob("*.mcap")
    whole, original = file.read_bytes(), content(list(read_messages(plane_bag)))
    third = len(whole) // 3
    before, junk = whole[:third], b"\x06\xff" * 300
    for name, data in (
        ("hole", before + b"\x06" * 1000 + whole[third + 1000 :]),
        ("gone", before + whole[third + 500 :]),
        ("more", before + junk + whole[third:]),
    ):
        done, kept = recovered(data, tmp_path, name)
        assert done is not None and done["lost"] and set(content(kept)) <= set(original)
        counts = [count for _, count in chunks(file)]
        most = max(map(sum, pairwise([*counts, 0])))  # the damage may lie in two chunks
        assert content(kept)[-1] == original[-1] and len(kept) >= len(original) - most


def test_recovery_with_nothing_lost(plane_bag: Path, tmp_path: Path) -> None:
    (file,) = plane_bag.glob("*.mcap")
    whole, original = file.read_bytes(), content(list(read_messages(plane_bag)))
    for name, data in (("sound", whole), ("footer", whole[:-20]), ("index", whole[:-2000] + bytes(2000))):
        done, kept = recovered(data, tmp_path, name)
        assert done is not None and not done["lost"] and content(kept) == original
    described = yaml.safe_load((tmp_path / "sound/metadata.yaml").read_text())["rosbag2_bagfile_information"]
    topics = [each["topic_metadata"] for each in described["topics_with_message_count"]]
    latched = [each["name"] for each in topics if "transient_local" in str(each["offered_qos_profiles"])]
    assert "/sags/parameters" in latched and "/sags/left/depth" not in latched
    assert all(each["type_description_hash"].startswith("RIHS01_") for each in topics)


@pytest.mark.parametrize("content", [b"", b"no MCAP at all" * 100, b"\x89MCAP0\r\n"])
@pytest.mark.parametrize("there", [False, True], ids=["new", "empty"])
def test_recovery_of_nothing_leaves_nothing(content: bytes, there: bool, tmp_path: Path) -> None:
    damaged, out = tmp_path / "damaged.mcap", tmp_path / "out"
    damaged.write_bytes(content)
    if there:
        out.mkdir()
    refused(1, "bag", "recover", damaged, "-o", out, said=("holds no whole message",))
    assert out.exists() == there and (not there or not any(out.iterdir()))
    assert damaged.read_bytes() == content


@pytest.mark.fault("disk: full while a recording is recovered")
def test_recovery_that_is_broken_off_leaves_nothing(
    plane_bag: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A full disk, or Ctrl-C: half a copy would be taken for all that could be saved."""

    full = OSError(errno.ENOSPC, "No space left on device")
    monkeypatch.setattr(BagWriter, "write", Mock(side_effect=full))
    refused(1, "bag", "recover", plane_bag, "-o", tmp_path / "out", said=("No space left on device",))
    monkeypatch.setattr(BagWriter, "write", Mock(side_effect=KeyboardInterrupt))
    assert sags("bag", "recover", plane_bag, "-o", tmp_path / "out").exit_code == 130
    assert not any(tmp_path.iterdir())


def test_two_recordings_are_not_joined(plane_bag: Path, tmp_path: Path) -> None:
    """As `info` refuses them; also where metadata.yaml names one. If it names all, names may be any."""
    (file,), both, out = plane_bag.glob("*.mcap"), tmp_path / "both", tmp_path / "out"
    both.mkdir()
    for name in ("case1_0.mcap", "case2_0.mcap"):
        (both / name).write_bytes(file.read_bytes())
    described = (plane_bag / "metadata.yaml").read_text()
    for names in (None, "- case1_0.mcap", "- gone_0.mcap"):
        if names is not None:
            (both / "metadata.yaml").write_text(described.replace(f"- {file.name}", names))
        said = ("2 recordings", "case1, case2", "one of its files")
        refused(2, "bag", "recover", both, "-o", out, said=said)
        assert not out.exists()
    both_named = described.replace(f"  - {file.name}", "  - case1_0.mcap\n  - case2_0.mcap")
    (both / "metadata.yaml").write_text(both_named)
    assert recover(both, out)["messages"] == 2 * bag_info(plane_bag)["messages"]


@pytest.mark.parametrize(
    ("names", "missing"),
    [("case_0 case_2", 1), ("case_1", 1), ("case_0 case_1", 0), ("case_20260102", 0), ("case", 0)],
)
def test_a_file_that_is_missing_is_lost(names: str, missing: int, plane_bag: Path, tmp_path: Path) -> None:
    (file,) = plane_bag.glob("*.mcap")
    (tmp_path / "case").mkdir()
    for name in names.split():
        shutil.copy(file, tmp_path / "case" / f"{name}.mcap")
    done = recover(tmp_path / "case", tmp_path / "saved")
    assert (done["files_missing"], done["lost"]) == (missing, missing > 0)


def test_recover_on_the_command_line(plane_bag: Path, tmp_path: Path) -> None:
    (file,) = plane_bag.glob("*.mcap")
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(file.read_bytes()[:-200_000])
    (tmp_path / "empty").mkdir()
    refused(1, "bag", "info", cut, said=("sags bag recover",))
    result = sags("bag", "recover", cut, "-o", tmp_path / "saved", "--json")
    assert result.exit_code == 3 and json.loads(result.stdout)["lost"] is True
    result = sags("bag", "recover", file, "-o", tmp_path / "again")
    assert result.exit_code == 0 and "nothing was lost" in result.stdout
    assert sags("bag", "recover", file, "-o", tmp_path / "again").exit_code == 2
    for other in (tmp_path / "nowhere.mcap", tmp_path / "empty", __file__):
        assert sags("bag", "recover", other, "-o", tmp_path / "out").exit_code == 2
    listed = json.loads(sags("bag", "info", tmp_path / "again", "--json").stdout)
    assert listed["topics"] == bag_info(plane_bag)["topics"]
