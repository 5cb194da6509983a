"""A recording that is played again: for subscribers it is a node."""

import re
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any, cast

import bag_files
import cv2
import numpy as np
import pytest
from command_line import sags, start, stopped, wait_for
from recorded_plane import by_topic, record_plane
from synthetic import plane_result
from waiting import beside, heard, until

from sags_node.bags.bag import read_messages
from sags_node.bags.pictures import decode_picture, encode_file
from sags_node.clients.overlay.run import OverlayOptions, run_overlay
from sags_node.clients.recording.info import bag_info
from sags_node.clients.recording.player import PlayClock, Player, PlayOptions, outgoing
from sags_node.clients.recording.recover import recover
from sags_node.config.schema import PublishConfig
from sags_node.errors import SagsError
from sags_node.messaging import cdr
from sags_node.messaging.address import NodeAddress
from sags_node.messaging.control import ControlClient
from sags_node.messaging.introspection import topic_figures
from sags_node.messaging.publisher import Publisher
from sags_node.messaging.received import ReceivedCloud, ReceivedImage
from sags_node.messaging.stream import listen_to
from sags_node.messaging.subscriber import Subscriber

pytestmark = pytest.mark.live
EYES = ["left/image_rect_color", "right/image_rect_color"]
PHASE = 24  # times that a clock has gone on before the player is paused, stood still then, and gone on again


def served(run_dir: Path) -> PublishConfig:
    return PublishConfig(data=("tcp://127.0.0.1:*",), control=None, run_dir=run_dir)


@contextmanager
def playing(
    path: Path, run_dir: Path, paused: bool = True, wall_ns: Callable[[], int] = time.time_ns, **options: Any
) -> Iterator[Player]:
    """A player on a thread, paused so that subscribers can come."""
    player = Player(path, PlayOptions(**options), served(run_dir), "sags", paused, wall_ns)
    outcome: list[Any] = []
    with beside(lambda: outcome.append(player.play()), player.stop):
        until((run_dir / "sags.json").exists)
        yield player
    assert outcome


@pytest.mark.parametrize("compression", ["none", "png"])
def test_a_consumer_sees_a_played_bag_as_a_node(compression: str, plane_bag: Path, tmp_path: Path) -> None:
    path, run_dir, truth = plane_bag, tmp_path / "played", plane_result()
    if compression != "none":
        path, _ = record_plane(tmp_path, seconds=0.6, compression=compression)
    names = ["left/image_rect_color", "left/render/depth", "splats", "left/camera_info", "left/render/image"]
    with playing(path, run_dir, loop=True) as player, Subscriber([*names, "clock"], run_dir=run_dir) as sub:
        time.sleep(0.3)
        player.toggle_pause()
        picture = sub.wait(names[0], 30)
        frame = sub.aligned(names, picture.stamp_ns, timeout=30)
        assert frame is not None and len({message.meta.frame_id for message in frame.values()}) == 1
        assert np.array_equal(cast(ReceivedImage, frame[names[0]]).array, truth.pair.left)
        depth = cast(ReceivedImage, frame["left/render/depth"]).array
        assert np.array_equal(depth[1:], truth.views["left"].depth[1:]) and np.isnan(depth[0]).all()
        drawn = cast(ReceivedImage, frame["left/render/image"])
        assert drawn.meta.encoding == "rgba8" and drawn.array[..., 3].max() == 191
        ids = cast(ReceivedCloud, frame["splats"]).points["id"]
        assert np.array_equal(ids, truth.snapshot.gaussians.ids)
        until(lambda: all(sub.ok(name) for name in names))  # fresh: a strict reader takes them
        stamp = cdr.decode(cdr_of(picture), picture.meta.type).header.stamp
        assert stamp.sec * 10**9 + stamp.nanosec == picture.stamp_ns
        player.toggle_pause()
        until(lambda: not sub.ok(names[0]))
        assert sub.latest("clock") is None  # nobody asked for it


def test_who_asks_a_played_bag_for_something_is_told_what_it_is(plane_bag: Path, tmp_path: Path) -> None:
    """The overlay, and what the viewer asks for with a click."""
    run_dir = tmp_path / "run"
    told = f"a recording is played as 'sags': it takes no requests.*sags run {plane_bag}$"
    with playing(plane_bag, run_dir, paused=False, loop=True):
        with pytest.raises(SagsError, match=told):
            run_overlay(OverlayOptions(NodeAddress(run_dir=run_dir), "drawn", seconds=30))
        with pytest.raises(SagsError, match=told), ControlClient(run_dir=run_dir) as client:
            client.request("add_anchor", {"u": 10, "v": 10})


def test_it_says_where_it_publishes_and_how_to_choose_another_place(plane_bag: Path, tmp_path: Path) -> None:
    at = ("bag", "play", plane_bag, "--endpoint", "tcp://127.0.0.1:*", "--run-dir")
    played = sags(*at, tmp_path / "run")
    said = rf"on ipc://{tmp_path}/run/sags.ipc, tcp://127.0.0.1:\d+ as sags"
    assert played.exit_code == 0 and re.search(said, played.stderr)
    refused = sags(*at, plane_bag / "metadata.yaml")
    assert refused.exit_code == 2 and "--run-dir" in refused.stderr and "publishing" not in refused.stderr
    with Publisher(served(tmp_path / "run"), "sags", "session") as running:
        taken = running.connection.data[-1]
        refused = sags("bag", "play", plane_bag, "--endpoint", taken, "--ns", "played")
    assert refused.exit_code == 1 and "publishing" not in refused.output
    said = f"{taken} is already in use; choose another, e.g. --endpoint tcp://127.0.0.1:5560"
    assert said in refused.output


def cdr_of(received: Any) -> bytes:
    """The message again, as its sender must have joined it."""
    body = cdr.image(received.array, received.meta.encoding, received.stamp_ns)
    return b"".join(bytes(part) for part in body.parts)


def test_a_type_that_ros_2_has_not_is_left_out(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """ROS 1 has another `Marker`; what is beside it is played."""
    tool = ("/tool", bag_files.marker(bag_files.START), bag_files.START)
    rows = [*bag_files.stereo_rows(bag_files.ROS1, 2), tool]
    path = bag_files.write_rosbag1(tmp_path / "a.bag", rows)
    played = Player(path, PlayOptions(), served(tmp_path / "run")).play()
    assert played["messages"] == len(rows) - 1
    assert caplog.text.count("/tool is left out: its type visualization_msgs/Marker") == 1
    caplog.clear()
    Player(path, PlayOptions(exclude=("/tool",)), served(tmp_path / "run")).play()
    assert "/tool" not in caplog.text


COLOR = bag_files.picture(0, 0)
GREY = np.ascontiguousarray(COLOR[..., 1])
MOSAIC = cv2.cvtColor(GREY, cv2.COLOR_BayerRG2RGB)
ALPHA = np.dstack([COLOR, GREY])


@pytest.mark.fault("file: compressed images of other recorders are played")
@pytest.mark.parametrize(
    ("said", "stored", "encoding", "expected"),
    [
        ("bgr8; jpeg compressed bgr8", COLOR, "rgb8", COLOR),
        *((form, COLOR, "rgb8", COLOR) for form in ("jpeg", "png", "")),
        ("bgra8; png compressed bgra8", ALPHA, "rgba8", ALPHA),
        ("8UC1; png compressed ", GREY, "mono8", GREY),
        ("mono8; png compressed mono8", GREY, "mono8", GREY),
        ("bayer_bggr8; png compressed bayer_bggr8", GREY, "rgb8", MOSAIC),
    ],
)
def test_compressed_pictures_of_others_are_what_their_file_is(
    tmp_path: Path, said: str, stored: np.ndarray, encoding: str, expected: np.ndarray
) -> None:
    """As `sags run` reads them, whatever their recorder calls them."""
    file = encode_file(stored, "mono8" if stored is GREY else encoding, "png", ())
    head = bag_files.header(bag_files.ROS2, bag_files.START)
    picture = bag_files.ROS2.types[bag_files.COMPRESSED](head, said, np.frombuffer(file, np.uint8))
    rows = [("/cam/image/compressed", picture, bag_files.START)]
    (message,) = read_messages(bag_files.write_rosbag2(tmp_path / "bag", rows))
    name, content = outgoing(message, stamp_ns=5)
    assert (name, content.encoding) == ("cam/image", encoding)
    found = cdr.decode(b"".join(bytes(part) for part in content.parts), content.type)
    assert np.array_equal(found.data, expected.ravel()) and found.header.stamp.nanosec == 5
    read = decode_picture(message.data, message.type, "")
    assert np.array_equal(read, np.dstack([expected] * 3)[..., :3])


STAMPED: dict[str, Callable[[int], int]] = {  # the stamp of what was captured so long after the start, ns
    "late": lambda since: bag_files.START + since,
    "simulated": lambda since: 10**9 + since,
    "half as fast": lambda since: 10**9 + since // 2,
    "none": lambda since: 0,
    "hours ahead": lambda since: bag_files.START + since + 7 * 3600 * 10**9,
}


@pytest.mark.fault("stamp: of a simulator or of none, or latency in slow motion, in a bag that is played")
@pytest.mark.parametrize("rate", [1.0, 0.1])
@pytest.mark.parametrize("clock", STAMPED)
def test_what_is_played_is_new_whoever_stamped_it(tmp_path: Path, clock: str, rate: float) -> None:
    """Two topics of each frame, received 60 and 80 ms after it was captured."""
    ms, rows, run_dir = bag_files.MS, [], tmp_path / "run"
    for number in range(40):
        for eye, name in enumerate(EYES):
            shown = bag_files.picture(number, eye)
            message = bag_files.image(bag_files.ROS2, shown, STAMPED[clock](number * 40 * ms))
            received = bag_files.START + (number * 40 + 55 + 20 * eye) * ms  # and 5 ms later
            rows.append((f"/sags/{name}", message, received))
    path = bag_files.write_rosbag2(tmp_path / "bag", rows)
    with playing(path, run_dir, loop=True, rate=rate) as player, Subscriber(EYES, run_dir=run_dir) as sub:
        player.toggle_pause()
        until(lambda: all(sub.ok(name) for name in EYES))
        newest = sub.wait(EYES[0], 30)
        assert newest is not None and abs(newest.age(sub.now_ns())) < 60
        if clock != "none":
            assert sub.aligned(EYES, newest.stamp_ns, timeout=30) is not None


def test_stamps_keep_their_order_and_their_latency() -> None:
    """Frames of which some come late: as fast as recorded, faster, and in slow motion."""
    captured = np.arange(0, 3000, 33) * bag_files.MS + bag_files.START
    latencies = np.random.default_rng(0).choice([20, 60, 300], len(captured)) * bag_files.MS
    received = np.maximum.accumulate(captured + latencies)
    for rate in (0.02, 0.1, 0.5, 1.0, 3.0):
        clock = PlayClock(bag_files.START, rate, time.time_ns)
        pairs = [(int(log), int(stamp)) for log, stamp in zip(received, captured, strict=True)]
        stamps = np.array([clock.stamp_ns(log, stamp) for log, stamp in pairs])
        ages = np.array([clock.wall_ns(log) for log in received.tolist()]) - stamps
        assert (np.diff(stamps) > 0).all()
        late = (received - captured) / max(rate, 1)
        assert (ages > late - 3).all() and (ages < late + 100 * bag_files.MS + 3).all()  # ns of rounding


def test_flags_of_play(plane_bag: Path, tmp_path: Path) -> None:
    depth, info = by_topic(plane_bag)["left/depth"], bag_info(plane_bag)
    only = {"topics": ("left/depth",)}

    def outcome(**options: Any) -> dict[str, Any]:
        return Player(plane_bag, PlayOptions(**options), served(tmp_path / "run")).play()

    assert outcome(rate=20.0, **only)["messages"] == len(depth)
    slow = outcome(start_offset=info["duration_s"] - 0.8, rate=0.5, **only)  # it cannot be quicker
    assert slow["seconds"] > 1.0 and 0 < slow["messages"] < len(depth)
    assert 0 < outcome(playback_duration=1.0, rate=10.0, **only)["messages"] < len(depth)
    without = outcome(rate=50.0, exclude=("left/depth",))
    assert without["messages"] == info["messages"] - len(depth)
    with pytest.raises(SagsError, match="no message that was asked for"):
        outcome(topics=("left/dept",))
    other, told = "left/render/depth", tmp_path / "other"
    with (
        playing(plane_bag, told, remap={"left/depth": other}, loop=True, **only) as player,
        Subscriber([other, "left/depth"], run_dir=told) as subscriber,
    ):
        player.toggle_pause()
        assert subscriber.wait(other, 30) is not None and subscriber.latest("left/depth") is None
    for wrong in (("--remap", "a=b"), ("--clock", "0")):
        assert sags("bag", "play", plane_bag, *wrong).exit_code == 2


def test_another_namespace_takes_the_place_of_the_recorded_one(plane_bag: Path, tmp_path: Path) -> None:
    """As ROS would remap it, also of what `recover` saved; topics may be named as the bag has them."""
    saved, run_dir = tmp_path / "saved", tmp_path / "run"
    recover(plane_bag, saved)
    for bag in (plane_bag, saved):
        options = PlayOptions(topics=("sags/left/depth", "left/camera_info"), loop=True)
        player, came = Player(bag, options, served(run_dir), "other"), set()
        with beside(player.play, player.stop):
            until((run_dir / "other.json").exists)
            for arrived in listen_to(NodeAddress("other", run_dir=run_dir), [], 60.0):
                came |= {arrived[0].topic} if arrived else set()
                if len(came) > 1:
                    break
        assert came == {"other/left/depth", "other/left/camera_info"}


def test_a_clock_tells_the_moment_of_the_recording(plane_bag: Path, tmp_path: Path) -> None:
    """Half as fast, with a pause: by clock and stamp every message is found in the recording again."""
    recorded = np.array([m.publish_ns for m in by_topic(plane_bag)["left/depth"]])
    run_dir, rate, clock_hz = tmp_path / "run", 0.5, 50.0
    clocks: list[tuple[int, int]] = []  # wall clock and recording, ns
    depths: list[int] = []
    turns = [0, 0, 0]  # steps of the clock that were seen: on, none, on
    turn = 0
    with playing(plane_bag, run_dir, topics=("left/depth",), rate=rate, clock_hz=clock_hz) as player:
        player.toggle_pause()
        arriving = listen_to(NodeAddress(run_dir=run_dir), ["clock", "left/depth"], 60.0)
        for message, _ in filter(None, arriving):
            if message.topic != "sags/clock":
                depths.append(message.meta.stamp_ns)
                continue
            said = cdr.parse(message).clock
            clocks.append((message.meta.stamp_ns, said.sec * 10**9 + said.nanosec))
            stands = len(clocks) > 1 and clocks[-1][1] == clocks[-2][1]
            turns[turn] += stands == (turn == 1)
            if turns[turn] > PHASE:
                turn += 1
                if turn == len(turns):
                    break
                player.toggle_pause()
    walls, told = (np.array(column) for column in zip(*clocks, strict=True))
    steps, real = np.diff(told), np.diff(walls)
    assert (real >= 0).all() and (steps >= 0).all()
    begins = int(np.argmax(steps > 0))  # it may be paused still
    paused = begins + np.flatnonzero(steps[begins:] == 0)
    assert len(paused) > PHASE and np.ptp(paused) == len(paused) - 1, "one pause"
    for on in (slice(begins + 1, paused[0] - 1), slice(paused[-1] + 2, None)):
        assert len(steps[on]) > PHASE // 2
        assert real[on].mean() > 0.95e9 / clock_hz  # and later where the machine is busy
        assert steps[on].sum() / real[on].sum() == pytest.approx(rate, rel=0.02)
    for stamp in depths[5:]:
        after = int(np.searchsorted(walls, stamp))
        around = [k for k in (after - 1, after) if 0 <= k < len(walls)]  # a pause may lie before or after it
        moments = [told[k] + (stamp - walls[k]) * rate for k in around]
        assert min(np.abs(recorded - moment).min() for moment in moments) < 2e6


@pytest.mark.fault("clock: set while a bag is played")
def test_a_played_bag_is_stamped_by_the_wall_clock_of_now(plane_bag: Path, tmp_path: Path) -> None:
    """Set forward by a minute, and back: then messages are of another epoch."""
    said: list[tuple[int, int]] = []
    run_dir = tmp_path / "run"

    def wall_ns() -> int:
        return time.time_ns() + (60 * 10**9 if 3 <= len(said) < 6 else 0)

    with playing(plane_bag, run_dir, topics=("left/depth",), rate=0.1, wall_ns=wall_ns) as player:
        player.toggle_pause()
        for message, _ in filter(None, listen_to(NodeAddress(run_dir=run_dir), ["left/depth"], 60.0)):
            said.append((message.meta.stamp_ns, message.meta.epoch))
            if len(said) == 9:
                break
    stamps, epochs = np.diff(said, axis=0).T
    steps = np.round(stamps / 60e9)
    assert steps[steps != 0].tolist() == [1, -1]
    assert np.array_equal(epochs, steps < 0)


def test_the_clock_on_the_command_line(plane_bag: Path, tmp_path: Path) -> None:
    command = ["bag", "play", plane_bag, "--loop", "--clock", "--endpoint", "tcp://127.0.0.1:*"]
    process = start(command, XDG_RUNTIME_DIR=tmp_path)
    wait_for(process, (tmp_path / "sags/sags.json").exists)
    figures = heard(partial(topic_figures, "hz", "clock", NodeAddress(run_dir=tmp_path / "sags")), 0.5)
    stopped(process)
    assert process.returncode == 0 and figures["window"] >= 2
