"""ROS recordings that are cut off, forged or none at all: one clear message, and bounded memory."""

import random
import struct
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from bag_files import KINDS
from fuzzing import BAGS, TARGETS, bounded_memory

from sags_node.clients.recording.info import bag_info
from sags_node.errors import SagsError, UsageError


@pytest.fixture(autouse=True)
def bounded() -> Iterator[None]:
    """A forged size that is believed fails the test."""
    with bounded_memory(1 << 30):
        yield


@pytest.mark.fault("file: a ROS bag is cut off")
@pytest.mark.parametrize("kind", BAGS)
def test_cut_off_anywhere(kind: str, tmp_path: Path) -> None:
    """sqlite can do without unused pages at its end."""
    (whole,) = TARGETS[kind].sound(tmp_path)
    rng = random.Random(1)
    for length in [0, 1, 8, 20, len(whole) - 1, *(rng.randrange(len(whole)) for _ in range(20))]:
        assert not TARGETS[kind].try_out(whole[:length], tmp_path / "cut") or kind == "db3 file"


@pytest.mark.fault("file: an MCAP claims to be huge")
@pytest.mark.parametrize("length", [2**60, 2**63, 2**64 - 1, 1 << 33, 300 << 20])
def test_forged_lengths_of_mcap_records(length: int, tmp_path: Path) -> None:
    file = KINDS["mcap zstd"](tmp_path) / "bag.mcap"
    whole = file.read_bytes()
    position, forged = 8, 0
    while position < len(whole) - 8:
        (record,) = struct.unpack_from("<Q", whole, position + 1)
        forged_file = tmp_path / "forged.mcap"
        forged_file.write_bytes(whole[: position + 1] + struct.pack("<Q", length) + whole[position + 9 :])
        with pytest.raises(SagsError, match=f"damaged at byte {position}: a record of {length} bytes"):
            bag_info(forged_file)
        position, forged = position + 9 + record, forged + 1
    assert forged > 5


@pytest.mark.parametrize("size", [2**60, 257 << 20, 5])
def test_a_chunk_that_unpacks_to_too_much(size: int, tmp_path: Path) -> None:
    """A bomb: a gigabyte of zeros in a few kB. It may say so, or lie."""
    import zstandard

    packer = zstandard.ZstdCompressor().compressobj()
    bomb = b"".join(packer.compress(bytes(1 << 20)) for _ in range(1 << 10)) + packer.flush()
    chunk = struct.pack("<QQQI", 0, 1, size, 0) + b"\x04\0\0\0zstd" + struct.pack("<Q", len(bomb)) + bomb
    file = tmp_path / "bomb.mcap"
    header = b"\x04\0\0\0ros2" + bytes(4)
    body = b"\x01" + struct.pack("<Q", len(header)) + header + b"\x06" + struct.pack("<Q", len(chunk)) + chunk
    file.write_bytes(b"\x89MCAP0\r\n" + body)
    with pytest.raises(SagsError, match="unpack"):
        bag_info(file)


def test_what_is_no_bag(tmp_path: Path) -> None:
    for name in ("a.mcap", "a.db3", "a.bag"):
        file = tmp_path / name
        file.write_bytes(np.random.default_rng(0).bytes(5000))
        with pytest.raises(SagsError, match=f"{name} is damaged"):
            bag_info(file)
    (tmp_path / "two").mkdir()
    for name in ("a_0.mcap", "a_1.mcap", "b_0.db3"):
        (tmp_path / "two" / name).touch()
    for path, said in (
        (tmp_path / "nowhere.mcap", "does not exist"),
        (tmp_path.parent, r"neither metadata\.yaml nor a \.mcap"),
        (tmp_path / "two", r"holds 2 recordings .*: a, b; give one of its files"),
    ):
        with pytest.raises(UsageError, match=said):
            bag_info(path)
    of_bag = "rosbag2_bagfile_information: {relative_file_paths: %s}"
    for text, said in (
        ("[", "not valid YAML"),
        ("a: 1", "rosbag2_bagfile_information"),
        (of_bag % "3", "names no files"),
        (of_bag % "[../../etc/passwd]", "names passwd, which is not"),
        (of_bag % "[a.mcap], compression_mode: file", "zstd -d"),
    ):
        (tmp_path / "metadata.yaml").write_text(text)
        with pytest.raises(UsageError, match=said):
            bag_info(tmp_path)
