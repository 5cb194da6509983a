"""ROS recordings that are cut off, flipped, forged or none at all: one clear message, and bounded memory."""

from __future__ import annotations

import random
import resource
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bag_files import KINDS, play

from sags_node.config.launch_file import load_launch
from sags_node.config.schema import BagSource
from sags_node.errors import SagsError, UsageError
from sags_node.recording.info import bag_info
from sags_node.sources.bags import read_rig


def consume(path: Path) -> bool:
    """Use a file in every way; True when all went well. Only our errors may come out."""
    try:
        load_launch(path)
        bag_info(path)
        read_rig(BagSource(path=path))
        play(path)
    except SagsError as error:
        assert str(error) and "\n" not in str(error)
        return False
    return True


@pytest.fixture
def bounded_memory() -> Any:
    """Address space for a gigabyte more than now: a forged size that is believed fails the test."""
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    before = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (used + (1 << 30), before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_AS, before)


HOSTILE = ("mcap file", "mcap zstd", "db3 file", "ros1", "ros1 lz4", "ros1 bz2")


@pytest.mark.fault("file: a ROS bag is cut off")
@pytest.mark.parametrize("kind", HOSTILE)
def test_cut_off_anywhere(kind: str, tmp_path: Path, bounded_memory: None) -> None:
    file = single_file(KINDS[kind](tmp_path))
    whole = file.read_bytes()
    rng = random.Random(1)
    cut = tmp_path / f"cut{file.suffix}"
    went_well = 0
    for length in [0, 1, 8, 20, len(whole) - 1, *(rng.randrange(len(whole)) for _ in range(20))]:
        cut.write_bytes(whole[:length])
        went_well += consume(cut)
    assert went_well == 0 or kind == "db3 file"  # sqlite can do without unused pages at its end


@pytest.mark.fault("file: bits of a ROS bag are flipped")
@pytest.mark.parametrize("kind", HOSTILE)
def test_flipped_bits(kind: str, tmp_path: Path, bounded_memory: None) -> None:
    file = single_file(KINDS[kind](tmp_path))
    whole = file.read_bytes()
    flipped = tmp_path / f"flipped{file.suffix}"
    for seed in range(120):
        rng = random.Random(seed)
        data = bytearray(whole)
        # Also in the first and last bytes, where the structure is: pictures are most of the file.
        place = (rng.randrange(len(data)), rng.randrange(400), len(data) - 1 - rng.randrange(3000))[seed % 3]
        data[place] ^= 1 << rng.randrange(8)
        flipped.write_bytes(data)
        consume(flipped)


@pytest.mark.fault("file: an MCAP claims to be huge")
@pytest.mark.parametrize("length", [2**60, 2**63, 2**64 - 1, 1 << 33, 300 << 20])
def test_forged_lengths_of_mcap_records(length: int, tmp_path: Path, bounded_memory: None) -> None:
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
def test_a_chunk_that_unpacks_to_too_much(size: int, tmp_path: Path, bounded_memory: None) -> None:
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
    with pytest.raises(UsageError, match="does not exist"):
        bag_info(tmp_path / "nowhere.mcap")
    with pytest.raises(UsageError, match=r"neither metadata\.yaml nor a \.mcap"):
        bag_info(tmp_path.parent)
    for text, said in [
        ("[", "not valid YAML"),
        ("a: 1", "rosbag2_bagfile_information"),
        ("rosbag2_bagfile_information: {relative_file_paths: 3}", "names no files"),
        (
            "rosbag2_bagfile_information: {relative_file_paths: [../../etc/passwd]}",
            "names passwd, which is not",
        ),
        ("rosbag2_bagfile_information: {relative_file_paths: [a.mcap], compression_mode: file}", "zstd -d"),
    ]:
        (tmp_path / "metadata.yaml").write_text(text)
        with pytest.raises(UsageError, match=said):
            bag_info(tmp_path)


def single_file(path: Path) -> Path:
    if path.is_file():
        return path
    (found,) = [file for file in path.iterdir() if file.name != "metadata.yaml"]
    return found
