"""ROS recordings as sources: every kind of file, which topics, which pairs, which calibration."""

import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import bag_files as files
import cv2
import numpy as np
import pytest
from bag_files import KINDS, MS, ROS1, ROS2, START, picture, play
from mcap.records import Schema
from mcap.writer import Writer as McapWriter
from rosbags.interfaces import Nodetype
from rosbags.typesys.store import Typestore

from sags_node.bags.bag import read_messages
from sags_node.bags.pictures import decode_picture
from sags_node.clients.recording.bag_writer import BagWriter, Limits
from sags_node.clients.recording.info import bag_info
from sags_node.clients.recording.recover import recover
from sags_node.config.launch_file import load_launch
from sags_node.config.schema import BagSource
from sags_node.errors import SagsError, UsageError
from sags_node.messaging import cdr
from sags_node.pipeline.session import open_session
from sags_node.rig import save_rig
from sags_node.sources.bag_stamps import judge_stamps
from sags_node.sources.bags import BagPairs, read_rig
from sags_node.sources.pairing import pair
from sags_node.sources.replay import Replay
from sags_node.tools.calibration.check import read_calibration
from sags_node.tools.importing.check import check_folder
from sags_node.types import StereoFrame

COUNT = 10


def assert_frames(frames: list[StereoFrame], numbers: list[int], tolerance: int = 0) -> None:
    """These images of `bag_files.picture`, with the stamps they were taken at."""
    assert [frame.t_capture_ns for frame in frames] == [START + number * 40 * MS for number in numbers]
    for frame, number in zip(frames, numbers, strict=True):
        assert frame.t_capture_right_ns - frame.t_capture_ns == 2 * MS
        for eye, seen in enumerate((frame.left, frame.right)):
            assert np.abs(seen.astype(int) - picture(number, eye)).max() <= tolerance


# ---- what can be read ------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_of_file(kind: str, tmp_path: Path) -> None:
    path = KINDS[kind](tmp_path)
    assert_frames(play(path), list(range(COUNT)))
    config = load_launch(path)  # given directly, as in `sags run recording.mcap`
    assert isinstance(config.source, BagSource) and config.source.path == path
    rig = read_rig(config.source)
    assert rig is not None and rig.baseline == pytest.approx(files.BASELINE)
    assert (rig.left.width, rig.left.height) == (files.WIDTH, files.HEIGHT)
    found = bag_info(path)
    rows = {row["topic"]: row for row in found["topics"]}
    assert rows["/rig/left/image_raw"]["messages"] == COUNT and found["messages"] == 4 * COUNT
    assert rows["/rig/left/image_raw"]["rate_hz"] == pytest.approx(25)
    assert rows["/rig/left/image_raw"]["type"] == "sensor_msgs/msg/Image"


def test_what_a_killed_recorder_leaves(tmp_path: Path) -> None:
    """A remedy, or all of it: nothing is left out without a word."""
    bag = files.write_rosbag2(tmp_path / "bag", files.stereo_rows(ROS2), "SQLITE3")
    (bag / "bag.db3-wal").write_bytes(b"messages")
    with pytest.raises(SagsError, match=r"bag\.db3-wal holds messages that bag\.db3 lacks: .*wal_checkpoint"):
        play(bag)
    folder = tmp_path / "folder"
    folder.mkdir()
    ros1 = files.write_rosbag1(folder / "case.bag", files.stereo_rows(ROS1))
    assert load_launch(folder).source == BagSource(path=ros1)  # a folder with one bag is that bag
    ros1 = ros1.rename(folder / "case.bag.active")
    for path in (ros1, folder):
        source = load_launch(path).source
        assert isinstance(source, BagSource)
        with pytest.raises(UsageError, match=r"not closed: .*rosbag reindex .*case\.bag\.active, then mv"):
            play(source.path)
        assert any("rosbag reindex" in finding.fix for finding in check_folder(path))


def test_a_ros1_message_of_another_form_than_in_ros2_keeps_no_pictures_back(tmp_path: Path) -> None:
    """Nor the others when all is read. It has its name in ROS 1, which promises no form of ROS 2."""
    rows = [*files.stereo_rows(ROS1), ("/tool", files.marker(START), START)]
    path = files.write_rosbag1(tmp_path / "a.bag", rows)
    assert_frames(play(path), list(range(COUNT)))
    kinds = {row["topic"]: row["type"] for row in bag_info(path)["topics"]}
    assert kinds["/tool"] == "visualization_msgs/Marker"
    assert {message.topic: message.type for message in read_messages(path)} == kinds


def test_types_of_another_form_in_ros1_are_known() -> None:
    """By the definitions of both that `rosbags` has."""

    def form(store: Typestore, node: Any) -> Any:
        kind, said = node
        if kind == Nodetype.BASE:
            return said[0]
        if kind == Nodetype.NAME:
            return said if said == header else [form(store, each) for _, each in store.fielddefs[said][1]]
        return kind, form(store, said[0]), said[1]

    header = "std_msgs/msg/Header"  # has a number more in ROS 1, which `rosbags` takes off
    named = {name: (Nodetype.NAME, name) for name in ROS1.fielddefs.keys() & ROS2.fielddefs.keys() - {header}}
    assert {name for name, of in named.items() if form(ROS1, of) != form(ROS2, of)} == cdr.OTHER_IN_ROS1


@pytest.mark.parametrize("named", [True, False])
def test_a_topic_of_json_keeps_no_pictures_back(named: bool, tmp_path: Path) -> None:
    """As Foxglove's programs write beside those of ROS, with a schema or without; recovered it stays JSON."""
    file = tmp_path / "bag.mcap"
    with file.open("wb") as opened:
        writer = McapWriter(opened)
        writer.start()
        schema = writer.register_schema("Notes", "jsonschema", b"{}") if named else 0
        notes = writer.register_channel("/notes", "json", schema)
        writer.add_message(notes, START, b'{"said": 1}', START)
        known: dict[str, int] = {}
        for topic, message, stamp in files.stereo_rows(ROS2):
            kind = message.__msgtype__
            if topic not in known:
                schema = writer.register_schema(kind, "ros2msg", b"")
                known[topic] = writer.register_channel(topic, "cdr", schema)
            writer.add_message(known[topic], stamp, bytes(ROS2.serialize_cdr(message, kind)), stamp)
        writer.finish()
    recover(file, tmp_path / "recovered")
    for path in (file, tmp_path / "recovered"):
        assert_frames(play(path), list(range(COUNT)))
        (row,) = (row for row in bag_info(path)["topics"] if row["topic"] == "/notes")
        assert (row["type"], row["messages"]) == ("Notes" if named else "", 1)
        with pytest.raises(UsageError, match=r"topic /notes is encoded as 'json'; only ROS 2 messages"):
            list(read_messages(path, ["/notes"]))


@pytest.mark.parametrize("encoding", ["rgb8", "bgr8", "rgba8", "bgra8", "mono8"])
@pytest.mark.parametrize("padding", [0, 5])
def test_raw_encodings(encoding: str, padding: int, tmp_path: Path) -> None:
    rows = files.stereo_rows(ROS2, 2, encoding=encoding, padding=padding)
    frames = play(files.write_rosbag2(tmp_path / "bag", rows))
    if encoding != "mono8":
        assert_frames(frames, [0, 1])
    else:
        grey = cv2.cvtColor(picture(1, 0), cv2.COLOR_RGB2GRAY)
        assert np.array_equal(frames[1].left, np.repeat(grey[..., None], 3, 2))


@pytest.mark.parametrize(("kind", "tolerance"), [("png", 0), ("jpg", 12)])
def test_compressed_pictures(kind: str, tolerance: int, tmp_path: Path) -> None:
    names = "/rig/left/image_raw/compressed", "/rig/right/image_raw/compressed"
    rows = files.stereo_rows(ROS2, 3, names, make=files.compressed, kind=kind)
    path = files.write_rosbag2(tmp_path / "bag", rows)
    assert_frames(play(path), [0, 1, 2], tolerance)
    assert_frames(play(path, left="rig/left/image_raw"), [0, 1, 2], tolerance)  # found by its raw name
    assert read_rig(BagSource(path=path)) is not None


def mosaic(rgb: np.ndarray, pattern: str) -> np.ndarray:
    """One channel [H, W]: of each pixel the one that the pattern names, row by row."""
    made = np.empty(rgb.shape[:2], np.uint8)
    for at, channel in enumerate(pattern):
        made[at // 2 :: 2, at % 2 :: 2] = rgb[at // 2 :: 2, at % 2 :: 2, "rgb".index(channel)]
    return made


@pytest.mark.parametrize("kind", ["png", "jpeg"])
@pytest.mark.parametrize("pattern", ["rggb", "bggr", "gbrg", "grbg"])
def test_compressed_mosaics_are_taken_apart(pattern: str, kind: str) -> None:
    """A plain colour stays what it was; a file that was taken apart before it was packed is left as it is."""
    rgb = np.full((32, 48, 3), (153, 73, 66), np.uint8)
    file = cv2.imencode(f".{kind}", mosaic(rgb, pattern), [cv2.IMWRITE_JPEG_QUALITY, 100])[1].ravel()
    for said, taken_apart in (
        (f"bayer_{pattern}8; {kind} compressed ", True),
        (f"bayer_{pattern}8; {kind} compressed bayer_{pattern}8", True),
        (f"bayer_{pattern}8", True),
        (f"bayer_{pattern}8; {kind} compressed mono8", False),
        (f"mono8; {kind} compressed mono8", False),
        (kind, False),
    ):
        message = ROS2.types[files.COMPRESSED](files.header(ROS2, START), said, file)
        shown = decode_picture(bytes(ROS2.serialize_cdr(message, files.COMPRESSED)), files.COMPRESSED, "")
        assert (np.abs(shown.mean((0, 1)) - rgb[0, 0]).max() < 3) == taken_apart
        assert (np.ptp(shown.mean((0, 1))) < 1) == (not taken_apart)


@pytest.mark.parametrize("said", ["h264", "hevc", "H.265", "av1"])
def test_a_stream_in_compressed_messages_is_named(said: str) -> None:
    body = np.frombuffer(b"\0\0\0\1\x67" + bytes(99), np.uint8)
    message = ROS2.types[files.COMPRESSED](files.header(ROS2, START), said, body)
    with pytest.raises(SagsError, match=rf"left: '{said}' is a stream of images.*; make a video"):
        decode_picture(bytes(ROS2.serialize_cdr(message, files.COMPRESSED)), files.COMPRESSED, "left")


def test_playing_from_anywhere_again_and_again(tmp_path: Path) -> None:
    path = files.write_rosbag2(tmp_path / "bag", files.stereo_rows(ROS2, 60, infos=False))
    numbers = list(range(60))
    with Replay(BagSource(path=path, pace="step", start=1.0)) as source:
        assert source.frame_count == 35 and source.rate == pytest.approx(25)
        for _ in range(2):
            assert_frames(list(source), numbers[25:])
    assert_frames(play(path, stride=7), numbers[::7])
    looped = play(path, loop=True, frames=70)
    steps = np.diff([frame.t_capture_ns for frame in looped])
    assert (steps == 40 * MS).all() and [frame.epoch for frame in looped] == [0] * 60 + [1] * 10
    assert np.array_equal(looped[61].left, picture(1, 0))


def test_a_schema_that_stands_only_in_a_chunk_that_is_passed_over(tmp_path: Path) -> None:
    """A channel that begins late may use the schema of an early one."""
    file = tmp_path / "bag.mcap"
    with file.open("wb") as opened:
        writer = McapWriter(opened, chunk_size=1)  # a chunk for every message
        writer.start()
        schema = writer.register_schema("std_msgs/msg/Byte", "ros2msg", b"byte data")
        for turn, topic in enumerate(("/early", "/late")):
            channel = writer.register_channel(topic, "cdr", schema)
            writer.add_message(channel, turn * MS, b"\0\1\0\0\7", turn * MS)
        writer.finish()
    found = [(message.topic, message.type) for message in read_messages(file, start_ns=MS)]
    assert found == [("/late", "std_msgs/msg/Byte")]


def test_the_recordings_own_clock_and_a_gap_in_it(tmp_path: Path) -> None:
    """A camera that paused for a second is played with that pause."""
    rows = files.stereo_rows(ROS2, 6, infos=False)
    late = [row for row in rows if not 60 * MS < row[2] - START < 140 * MS]
    path = files.write_rosbag2(tmp_path / "bag", late)
    assert_frames(play(path), [0, 1, 4, 5])
    now = [0.0]
    clocks: dict[str, Any] = {"clock": lambda: now[0], "wall_ns": lambda: round(now[0] * 1e9)}
    clocks["sleep"] = lambda s: now.__setitem__(0, now[0] + s)
    with Replay(BagSource(path=path, pace="realtime"), **clocks) as source:
        assert [frame.t_capture_ns // MS for frame in source] == [0, 40, 160, 200]
    assert now[0] == pytest.approx(0.2)


def test_opening_a_large_bag_takes_little_memory(tmp_path: Path) -> None:
    """Of 65 MB in two files no more is ever held than a few chunks."""
    big = np.zeros((600, 720, 3), np.uint8)
    schema = Schema(id=0, name=files.IMAGE, encoding="ros2msg", data=cdr.definition(files.IMAGE).encode())
    with BagWriter(tmp_path / "bag", Limits(bytes=40_000_000)) as writer:
        channels = [
            writer.add_topic(f"/rig/{eye}/image_raw", files.IMAGE, schema) for eye in ("left", "right")
        ]
        for number in range(25):
            stamp = START + number * 40 * MS
            data = b"".join(bytes(part) for part in cdr.image(big, "rgb8", stamp).parts)
            for channel in channels:
                writer.write(channel, stamp, stamp, number, data)
    config = BagSource(path=tmp_path / "bag")
    tracemalloc.start()
    count = BagPairs(config).count
    read_rig(config)
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert count == 25 and most < 40e6


def test_a_ros1_bag_that_has_changed_is_checked_again(tmp_path: Path) -> None:
    path = KINDS["ros1 lz4"](tmp_path)
    assert len(play(path, loop=True, frames=3 * COUNT)) == 3 * COUNT
    path.unlink()
    files.write_rosbag1(path, files.stereo_rows(ROS1, 2 * COUNT), "LZ4")
    assert len(play(path)) == 2 * COUNT
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(SagsError, match="damaged"):
        play(path)


# ---- which topics ----------------------------------------------------------------------------------------


def test_topics_can_be_named(tmp_path: Path) -> None:
    names = "/endo/A", "/endo/B"
    path = files.write_rosbag2(tmp_path / "bag", files.stereo_rows(ROS2, 3, names, infos=False))
    assert_frames(play(path, left="/endo/A", right="endo/B"), [0, 1, 2])
    for named, said in (
        ({}, r"set source\.left and source\.right.*/endo/A, /endo/B.*both eyes"),
        ({"left": "/endo/A"}, r"source\.right is missing"),
        ({"left": "/endo/AA", "right": "/endo/B"}, r"has no topic /endo/AA; did you mean '/endo/A'"),
    ):
        with pytest.raises(UsageError, match=said):
            play(path, **named)


def test_the_usual_names_are_found_among_others(tmp_path: Path) -> None:
    rows = files.stereo_rows(ROS2, 3, ("/sags/left/image_rect_color", "/sags/right/image_rect_color"))
    for name in ("render/image", "depth"):
        rows += files.stereo_rows(ROS2, 3, (f"/sags/left/{name}", f"/sags/right/{name}"), infos=False)
    path = files.write_rosbag2(tmp_path / "bag", sorted(rows, key=lambda row: row[2]))
    assert_frames(play(path), [0, 1, 2])
    two = files.stereo_rows(ROS2, 3) + files.stereo_rows(ROS2, 3, ("/b/left/image_raw", "/b/right/image_raw"))
    path = files.write_rosbag2(tmp_path / "two", sorted(two, key=lambda row: row[2]))
    with pytest.raises(UsageError, match=r"/b/left/image_raw and .*; /rig/left/image_raw .*set source\.left"):
        play(path)
    assert_frames(play(path, left="/rig/left/image_raw"), [0, 1, 2])


def test_a_topic_of_the_wrong_type_or_an_encoding_that_is_not_read(tmp_path: Path) -> None:
    rows = files.stereo_rows(ROS2, 2)
    for _, message, _ in rows:
        if message.__msgtype__ == files.IMAGE:
            object.__setattr__(message, "encoding", "16UC1")
    path = files.write_rosbag2(tmp_path / "bag", rows)
    with pytest.raises(SagsError, match=r"/rig/left/image_raw at \d+ ns: .*'16UC1' is not read; known: rgb8"):
        play(path)
    with pytest.raises(UsageError, match=r"camera_info in .* is sensor_msgs/msg/CameraInfo, not an image"):
        play(path, left="/rig/left/camera_info", right="/rig/right/image_raw")
    with pytest.raises(UsageError, match=r"left_info: .* is sensor_msgs/msg/Image, not a camera_info"):
        read_rig(BagSource(path=path, left_info="/rig/left/image_raw"))


# ---- pairing ---------------------------------------------------------------------------------------------


def test_pairs_are_mutual_nearest_and_near_enough() -> None:
    left = np.array([0, 40, 80, 120, 160]) * MS
    right = np.array([43, 3, 300, 84, 79]) * MS
    assert pair(left, right, 0.01).tolist() == [[0, 1], [1, 0], [2, 4]]  # 79 is nearer to 80 than 84 is
    assert pair(left, right, 0.002).tolist() == [[2, 4]]
    shuffled = np.random.default_rng(0).permutation(5)
    pairs = pair(left[shuffled], right, 0.01)
    assert sorted(shuffled[pairs[:, 0]]) == [0, 1, 2] and pairs[:, 1].tolist() == [1, 0, 4]


def test_a_picture_without_partner_is_left_out_and_poses_are_of_the_left_pictures(tmp_path: Path) -> None:
    rows = files.stereo_rows(ROS2, infos=False)
    del rows[7], rows[4]  # the right image 3 and the left image 2
    bag = files.write_rosbag2(tmp_path / "bag", rows)
    assert_frames(play(bag), [0, 1, 4, 5, 6, 7, 8, 9])
    poses = np.tile(np.eye(4), (9, 1, 1))
    poses[:, 0, 3] = np.array([0, 1, 3, 4, 5, 6, 7, 8, 9]) * 1e-3  # of the left images that are there
    np.savez(tmp_path / "poses.npz", T_world_cam=poses)
    came = [frame.T_world_cam[0, 3] for frame in play(bag, poses=tmp_path / "poses.npz")]  # type: ignore[index]
    np.testing.assert_allclose(came, np.array([0, 1, 4, 5, 6, 7, 8, 9]) * 1e-3)


def test_nothing_pairs(tmp_path: Path) -> None:
    path = files.write_rosbag2(tmp_path / "bag", files.stereo_rows(ROS2, skew_ms=17.0))
    said = r"left 10 .*, right 10 .*, pairs 0: the median skew is 17 ms, source\.tolerance 5 ms.*0255"
    with pytest.raises(UsageError, match=said):
        play(path, tolerance=0.005)
    frames = play(path, tolerance=0.018)
    assert len(frames) == COUNT and frames[0].t_capture_right_ns - frames[0].t_capture_ns == 17 * MS


# ---- calibration -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("unit", "told"), [(10**9, 2), (10**18, 2), (10**19, 0)], ids=["whole seconds", "one for all", "none"]
)
def test_stamps_that_repeat_give_way_to_the_time_of_recording(unit: int, told: int, tmp_path: Path) -> None:
    rows = files.stereo_rows(ROS2, 30)
    for _, message, stamp in rows:
        message.header.stamp.sec, message.header.stamp.nanosec = stamp // unit * unit // 10**9, 0
    bag = files.write_rosbag2(tmp_path / "bag", rows)
    frames = play(bag)
    assert [frame.t_capture_ns for frame in frames] == [START + (40 * n + 5) * MS for n in range(30)]
    said = [each.what for each in Replay(BagSource(path=bag)).pairs.judged]
    assert len(said) == told and all("when they were recorded counts instead" in each for each in said)


def clocked(path: Path, stamp_of: Callable[[int], int], log_of: Callable[[int], int]) -> Path:
    """30 pairs, 40 ms apart, with these stamps and times of recording (ms); image n is `picture(n)`."""
    names = "/rig/left/image_raw", "/rig/right/image_raw"
    return files.write_rosbag2(path, [
        (name, files.image(ROS2, picture(n, eye), stamp_of(n) * MS), log_of(n) * MS)
        for n in range(30) for eye, name in enumerate(names)
    ])  # fmt: skip


@pytest.mark.fault("clock: set back under the cameras of a bag, or a bag was recorded that played twice")
@pytest.mark.parametrize(
    ("stamp_of", "said"),
    [
        (lambda n: START // MS + 40 * n - 130 * (n >= 15), "left images go back by up to 0.09 s"),
        (lambda n: START // MS + 40 * n - 3_600_000 * (n >= 15), "left images go back by up to 3.6e+03 s"),
        (lambda n: START // MS + 40 * (n % 15), "left images go back by up to 0.56 s"),
        (lambda n: START // MS + 40 * n + 3_600_000 * (n >= 15), "jump by 3600 s after pair 14"),
        (lambda n: 40 * n, ""),  # a simulator's clock begins at zero
        (lambda n: (START // MS + 40 * n) * (n > 0), ""),  # one that was not stamped
        (lambda n: START // MS + 40 * n, ""),
    ],
)
def test_pictures_are_played_in_the_order_in_which_they_came(
    tmp_path: Path, stamp_of: Callable[[int], int], said: str
) -> None:
    bag = clocked(tmp_path / "bag", stamp_of, lambda n: START // MS + 40 * n + 5)
    frames = play(bag)
    assert [int(frame.left[0, 0, 0]) for frame in frames] == [*range(30)]
    assert [int(frame.right[0, 0, 0]) for frame in frames if frame.right is not None] == [*range(30)]
    told = [each.what for each in Replay(BagSource(path=bag)).pairs.judged]
    assert any(said in each for each in told) if said else not told


def test_a_recorder_whose_clock_was_set_back_is_told_of(tmp_path: Path) -> None:
    def set_back(n: int) -> int:
        return START // MS + 40 * n - 130 * (n >= 15)

    judged = Replay(BagSource(path=clocked(tmp_path / "bag", set_back, set_back))).pairs.judged
    assert [each.what.split()[0] for each in judged] == ["left", "right"]
    assert all("not in the order of the times at which they were recorded" in each.what for each in judged)


def test_two_pictures_that_a_network_exchanged_are_put_right(tmp_path: Path) -> None:
    def exchanged(n: int) -> int:
        return START // MS + 40 * (n + (n == 10) - (n == 11))

    bag = clocked(tmp_path / "bag", exchanged, lambda n: START // MS + 40 * n + 5)
    shown = [int(frame.left[0, 0, 0]) for frame in play(bag)]
    assert shown == [*range(10), 11, 10, *range(12, 30)]
    assert Replay(BagSource(path=bag)).pairs.judged == ()


def test_messages_that_were_recorded_twice_count_once(tmp_path: Path) -> None:
    rows = [row for row in files.stereo_rows(ROS2) for _ in (0, 1)]
    bag = files.write_rosbag2(tmp_path / "bag", rows)
    assert_frames(play(bag), list(range(COUNT)))
    assert Replay(BagSource(path=bag)).pairs.judged == ()


def test_a_rig_that_is_given_wins_and_one_is_needed(tmp_path: Path) -> None:
    bare = files.write_rosbag2(tmp_path / "bare", files.stereo_rows(ROS2, 2, infos=False))
    with pytest.raises(UsageError, match="no calibration: set rig"):
        open_session(bare)
    calibrated = files.write_rosbag2(tmp_path / "bag", files.stereo_rows(ROS2, 2))
    session = open_session(calibrated)
    assert session.rig.name == "bag" and session.name == "bag"
    save_rig(session.rig, tmp_path / "mine")
    for path in (bare, calibrated):
        assert open_session(path, [f"rig:={tmp_path / 'mine'}"]).rig.name == "mine"


def test_one_eye_calibrated_or_nonsense_is_refused(tmp_path: Path) -> None:
    rows = [row for row in files.stereo_rows(ROS2, 2) if row[0] != "/rig/right/camera_info"]
    with pytest.raises(UsageError, match="calibrates one eye only, the right one is missing; set rig"):
        read_rig(BagSource(path=files.write_rosbag2(tmp_path / "one", rows)))
    rows = files.stereo_rows(ROS2, 2)
    for _, message, _ in rows:
        if message.__msgtype__ == files.INFO:
            message.p[3] *= 1000
    in_mm = files.write_rosbag2(tmp_path / "mm", rows)
    with pytest.raises(UsageError, match=r"looks like millimetres.*--unit mm"):
        read_rig(BagSource(path=in_mm))
    assert read_calibration(in_mm, None, 1e-3).baseline == pytest.approx(files.BASELINE)  # sags calib convert
    for _, message, _ in rows:
        if message.__msgtype__ == files.INFO:
            message.k[:] = 0  # ROS: not calibrated
    assert read_rig(BagSource(path=files.write_rosbag2(tmp_path / "zero", rows))) is None


@pytest.mark.parametrize(
    ("stamps_ms", "told"),
    [
        ([230 * (i // 3) + 5 * (i % 3) for i in range(30)], "mostly 5 ms from one to the next, 71.7 ms"),
        ([77 * i for i in range(30)], ""),
        ([77 * i + (5000 if i > 15 else 0) for i in range(30)], ""),  # a pause
    ],
)
def test_stamps_that_come_in_bursts_are_told(stamps_ms: list[int], told: str) -> None:
    keys = [(1_000_000 * ms, 1_000_000 * ms) for ms in stamps_ms]
    stamps = np.array([[own, own] for _, own in keys], np.int64)
    found = judge_stamps([(key, key) for key in keys], stamps, None, (keys, keys))
    assert [told in finding.what for finding in found] == ([True] if told else [])
