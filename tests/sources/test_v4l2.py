"""Live cameras with a camera made of Python: pairing, unplugging, silence, frozen pictures.

tests/sources/test_v4l2_vivid.py checks the same source against a real kernel driver.
"""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import ClassVar

import cv2
import numpy as np
import pytest
from waiting import repeating, until

from sags_node import workers
from sags_node.config.schema import GeometryConfig, V4l2Source
from sags_node.errors import SagsError, UsageError
from sags_node.sources import live
from sags_node.sources.device import STRANGE, Device, Picture, Shot, wall_stamp
from sags_node.sources.live import LiveStereo
from sags_node.sources.pairing import QUEUE_LENGTH, Pairing
from sags_node.sources.v4l2 import open_cameras
from sags_node.types import StereoFrame

pytestmark = pytest.mark.live

MS = 1_000_000
CONFIG = V4l2Source(left="/dev/left", right="/dev/right", width=8, height=4, rate=50, deadline=60)


def shot(t_ms: float, value: int = 0, width: int = 8) -> Picture:
    return Picture(round(t_ms * MS), np.full((4, width, 3), value, np.uint8))


class FakeCamera:
    """Delivers what the test puts in; `None` unplugs it, silence is an empty queue."""

    rate = 50.0
    gone: type[Exception] = SagsError

    def __init__(self, size: tuple[int, int]) -> None:
        self.size = size
        self.pictures: queue.Queue[Picture | None] = queue.Queue()
        self.closed = False

    def read(self, timeout: float) -> Shot | None:
        try:
            picture = self.pictures.get(timeout=timeout)
        except queue.Empty:
            return None
        if picture is None:
            raise self.gone("camera is gone")
        return Shot(*picture)

    def close(self) -> None:
        self.closed = True


class Plugs:
    """Opens fake cameras by path and remembers each one; a path in `absent` cannot be opened."""

    def __init__(self) -> None:
        self.opened: dict[str, list[FakeCamera]] = {"/dev/left": [], "/dev/right": []}
        self.absent: set[str] = set()
        self.attempts = 0

    def __call__(self, path: str, config: V4l2Source) -> FakeCamera:
        self.attempts += 1
        if path in self.absent:
            raise SagsError(f"camera {path} does not exist")
        self.opened[path].append(FakeCamera((config.width, config.height)))
        return self.opened[path][-1]

    def put(self, t_ms: float, value: int = 0, skew_ms: float = 0.0) -> None:
        """One moment in front of both newest cameras."""
        self.opened["/dev/left"][-1].pictures.put(shot(t_ms, value))
        self.opened["/dev/right"][-1].pictures.put(shot(t_ms + skew_ms, value))


@pytest.fixture
def plugs(monkeypatch: pytest.MonkeyPatch) -> Plugs:
    monkeypatch.setattr(live, "FIRST_PAUSE_S", 0.01)
    monkeypatch.setattr(live, "LONGEST_PAUSE_S", 0.04)
    monkeypatch.setattr(workers, "PAUSE_S", 0.01)
    return Plugs()


class Collector:
    """Takes frames in a thread, as a node does."""

    def __init__(self, source: LiveStereo) -> None:
        self.frames: list[StereoFrame] = []
        self.thread = threading.Thread(target=self._take, args=(source,))
        self.thread.start()

    def _take(self, source: LiveStereo) -> None:
        for frame in source:
            self.frames.append(frame)

    def wait_for(self, count: int) -> None:
        until(lambda: len(self.frames) >= count)

    def values(self) -> list[int]:
        return [int(frame.left[0, 0, 0]) for frame in self.frames]


# ---- pairing ---------------------------------------------------------------------------------------------


def drain(pairing: Pairing) -> list[tuple[int, int, int]]:
    pairs = []
    while (pair := pairing.take()) is not None:
        pairs.append((pair[0], round(pair[1].t_ns / MS), round(pair[2].t_ns / MS)))
    return pairs


def test_pairs_by_nearest_stamp_and_counts_the_rest() -> None:
    pairing = Pairing(20 * MS)
    for t in (0, 33, 66):
        pairing.add_left(shot(t))
    for t in (30, 70, 101):
        pairing.add_right(shot(t))
    # Left 0 has right 30 only, which is too far and nearer to left 33.
    assert drain(pairing) == [(1, 33, 30), (2, 66, 70)]
    assert pairing.unpaired == 1
    pairing.add_left(shot(99))
    assert drain(pairing) == [(3, 99, 101)]


def test_prefers_a_nearer_successor_within_the_tolerance() -> None:
    pairing = Pairing(20 * MS)
    pairing.add_left(shot(0))
    pairing.add_left(shot(16))
    pairing.add_right(shot(15))
    assert drain(pairing) == [(1, 16, 15)]
    assert pairing.unpaired == 1


def test_one_eye_alone_neither_pairs_nor_grows() -> None:
    pairing = Pairing(20 * MS)
    for n in range(100):
        pairing.add_left(shot(33 * n))
    assert drain(pairing) == []
    assert pairing.unpaired == 100 - QUEUE_LENGTH


@pytest.mark.parametrize("phase_ms", [-16.0, -7.0, 0.0, 9.0, 16.0])
def test_free_running_cameras_pair_from_the_first_moment(phase_ms: float) -> None:
    """Two 30 Hz cameras, any phase, some jitter: all but the odd picture at the start find a partner."""
    rng = np.random.default_rng(3)
    moments = [(1000 / 30 * n + rng.normal(0, 0.2), "left") for n in range(200)]
    moments += [(1000 / 30 * n + phase_ms + rng.normal(0, 0.2), "right") for n in range(200)]
    pairing = Pairing(20 * MS)
    pairs = []
    for t, eye in sorted(moments):
        (pairing.add_left if eye == "left" else pairing.add_right)(shot(t))
        pairs += drain(pairing)
    assert len(pairs) >= 199
    assert max(abs(left - right) for _, left, right in pairs) <= 20


@pytest.mark.fault("clock: set back by an hour between the eyes")
def test_recovers_when_the_wall_clock_is_set_back() -> None:
    pairing = Pairing(20 * MS)
    pairing.add_right(shot(3_600_000))  # its partner came after the clock was set back one hour
    pairs = []
    for n in range(10):
        pairing.add_left(shot(33 * n))
        pairing.add_right(shot(33 * n + 1))
        pairs += drain(pairing)
    assert len(pairs) >= 10 - QUEUE_LENGTH


@pytest.mark.parametrize(
    ("driver_ns", "expected"),
    [
        (95_000_000_000, 995_000_000_000),  # 5 s old: it waited in the driver
        (99_980_000_000, 999_980_000_000),  # 20 ms old
        (100_060_000_000, 1_000_000_000_000),  # ahead of its arrival
        (0, 1_000_000_000_000),  # the driver gives none
        (1_000_000_000_000, 1_000_000_000_000),  # a wall clock stamp
    ],
)
def test_wall_stamp(driver_ns: int, expected: int) -> None:
    assert wall_stamp(driver_ns, 100_000_000_000, 1_000_000_000_000) == expected


@pytest.mark.fault("camera: pictures wait in its driver while the process is stopped")
@pytest.mark.parametrize("first", [True, False])
@pytest.mark.parametrize("stopped_s", [0.9, 1.1, 3.0, 3600.0])
def test_what_waited_in_the_driver_keeps_its_age(
    stopped_s: float, first: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Four buffers of before a stop, also where they are the very first."""
    old = [stopped_s] * 4
    for age, told in zip(
        [0.02] * (not first) + old, taken_at(monkeypatch, [0.02] * (not first) + old), strict=True
    ):
        assert told == pytest.approx(age, abs=0.01)


def test_stamps_of_a_clock_of_its_own_are_found_out(monkeypatch: pytest.MonkeyPatch) -> None:
    """A driver that counts from when it was plugged in: what it says is old is new."""
    told = taken_at(monkeypatch, [1000.0] * 60)
    assert told[STRANGE:] == [0.0] * (60 - STRANGE)


def taken_at(monkeypatch: pytest.MonkeyPatch, ages: list[float]) -> list[float]:
    """How old pictures are said to be of which a driver says `ages`, s."""
    wall_ns, monotonic_ns = 10**18, 10**14

    class Capture:
        waitAny = staticmethod(lambda captures, timeout: (True, [0]))
        isOpened = set = release = lambda self, *_: True

        def __init__(self, *_: object) -> None:
            self.count = 0

        def read(self) -> tuple[bool, np.ndarray]:
            self.count += 1
            return True, np.zeros((4, 8, 3), np.uint8)

        def get(self, what: int) -> float:
            if what == cv2.CAP_PROP_POS_MSEC:  # each is another one
                return 1e-6 * (monotonic_ns + self.count - round(ages[self.count - 1] * 1e9))
            return {cv2.CAP_PROP_FRAME_WIDTH: 8.0, cv2.CAP_PROP_FRAME_HEIGHT: 4.0}.get(what, 0.0)

    monkeypatch.setattr(cv2, "VideoCapture", Capture)
    monkeypatch.setattr(time, "time_ns", lambda: wall_ns)
    monkeypatch.setattr(time, "monotonic_ns", lambda: monotonic_ns)
    camera = Device("/dev/null", CONFIG)
    return [(wall_ns - camera.read(1.0).t_ns) * 1e-9 for _ in ages]  # type: ignore[union-attr]


# ---- the source ------------------------------------------------------------------------------------------


def test_delivers_pairs_with_both_stamps(plugs: Plugs) -> None:
    with open_cameras(CONFIG, open_device=plugs) as source:
        collector = Collector(source)
        for n in range(5):
            plugs.put(20 * n, value=n, skew_ms=3)
            collector.wait_for(n + 1)
    collector.thread.join(30)
    assert not collector.thread.is_alive()
    assert collector.values() == [0, 1, 2, 3, 4]
    assert [frame.frame_id for frame in collector.frames] == [0, 1, 2, 3, 4]
    assert [frame.t_capture_ns for frame in collector.frames] == [20 * MS * n for n in range(5)]
    assert {f.t_capture_right_ns - f.t_capture_ns for f in collector.frames} == {3 * MS}
    assert source.dropped == 0 and source.frame_count is None and source.rate == 50
    assert all(camera.closed for cameras in plugs.opened.values() for camera in cameras)


def test_what_fails_because_all_ends_is_not_told_of(plugs: Plugs, caplog: pytest.LogCaptureFixture) -> None:
    opening, ended = threading.Event(), threading.Event()

    def open_device(path: str, config: V4l2Source) -> FakeCamera:
        if plugs.opened["/dev/right"]:  # it is opened again: until the end
            opening.set()
            assert ended.wait(10)
            raise SagsError("the end has broken it off")
        return plugs(path, config)

    with open_cameras(CONFIG, open_device=open_device) as source:
        plugs.opened["/dev/right"][0].pictures.put(None)
        assert opening.wait(10)
        source.stop()
        ended.set()
    assert "camera is gone" in caplog.text and "broken it off" not in caplog.text


@pytest.mark.fault("camera: unplugged")
@pytest.mark.fault("camera: its driver raises what nobody foresaw")
@pytest.mark.parametrize("error", [SagsError, ValueError, MemoryError, ConnectionResetError, cv2.error])
def test_unplugged_camera_comes_back(
    error: type[Exception], plugs: Plugs, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(FakeCamera, "gone", error)
    with open_cameras(CONFIG, open_device=plugs) as source:
        collector = Collector(source)
        plugs.put(0, value=1)
        collector.wait_for(1)

        plugs.absent.add("/dev/right")
        attempts = plugs.attempts
        plugs.opened["/dev/right"][0].pictures.put(None)
        until(lambda: plugs.attempts >= attempts + 3)  # it tries again and again
        assert plugs.opened["/dev/right"][0].closed

        plugs.absent.clear()
        until(lambda: len(plugs.opened["/dev/right"]) == 2)
        plugs.put(5000, value=2)
        collector.wait_for(2)
    assert collector.values() == [1, 2]
    said = "it will be opened again" if error is SagsError else f"internal error: {error.__name__}: camera is"
    assert said in caplog.text and "/dev/right is open again" in caplog.text


@pytest.mark.fault("camera: neither delivers nor fails")
def test_silent_camera_is_opened_again(plugs: Plugs, caplog: pytest.LogCaptureFixture) -> None:
    """A camera that neither delivers nor fails, as unplugged USB cameras may do."""
    with open_cameras(CONFIG.model_copy(update={"deadline": 0.15}), open_device=plugs) as source:
        collector = Collector(source)
        plugs.put(0, value=1)
        until(lambda: all(len(cameras) >= 2 for cameras in plugs.opened.values()))
        assert plugs.opened["/dev/left"][0].closed

        def film(number: int) -> None:
            time.sleep(0.02)
            plugs.put(1000.0 + 20 * number, value=2)

        with repeating(film):
            until(lambda: 2 in collector.values())
    assert "no new picture for" in caplog.text


@pytest.mark.fault("camera: absent while the node stops")
def test_stop_ends_the_wait_for_absent_cameras(plugs: Plugs) -> None:
    with open_cameras(CONFIG, open_device=plugs) as source:
        collector = Collector(source)
        source.stop()
        collector.thread.join(30)
        assert not collector.thread.is_alive()
    assert collector.frames == []


@pytest.mark.fault("clock: set forward by an hour under a camera")
def test_clock_set_forward_goes_on(plugs: Plugs) -> None:
    with open_cameras(CONFIG, open_device=plugs) as source:
        collector = Collector(source)
        for n, t in enumerate((10_000, 10_020, 3_610_000, 3_610_020)):
            plugs.put(t)
            collector.wait_for(n + 1)
    assert [frame.epoch for frame in collector.frames] == [0, 0, 0, 0]
    assert [frame.t_capture_ns // MS for frame in collector.frames] == [10_000, 10_020, 3_610_000, 3_610_020]


@pytest.mark.fault("clock: set back under a camera")
def test_clock_set_back_grows_the_epoch(plugs: Plugs) -> None:
    with open_cameras(CONFIG, open_device=plugs) as source:
        collector = Collector(source)
        for n, t in enumerate((10_000, 10_020, 5_000, 5_020)):
            plugs.put(t)
            collector.wait_for(n + 1)
    assert [frame.epoch for frame in collector.frames] == [0, 0, 1, 1]


@pytest.mark.parametrize(("first", "left_value"), [("left", 10), ("right", 20)])
def test_side_by_side(plugs: Plugs, first: str, left_value: int) -> None:
    geometry = GeometryConfig(layout="side_by_side", first=first)
    config = CONFIG.model_copy(update={"geometry": geometry, "right": None, "width": 16})
    halves = np.concatenate([shot(0, 10).image, shot(0, 20).image], axis=1)
    with open_cameras(config, open_device=plugs) as source:
        collector = Collector(source)
        plugs.opened["/dev/left"][0].pictures.put(Picture(7 * MS, halves))
        collector.wait_for(1)
    frame = collector.frames[0]
    assert frame.left.shape == frame.right.shape == (4, 8, 3)
    assert (frame.left == left_value).all() and (frame.right == 30 - left_value).all()
    assert frame.t_capture_ns == frame.t_capture_right_ns == 7 * MS
    assert source.dropped == 0


def test_mistakes_at_opening(plugs: Plugs) -> None:
    with pytest.raises(UsageError, match=r"source\.right names no camera"):
        open_cameras(CONFIG.model_copy(update={"right": None}), open_device=plugs)
    with pytest.raises(UsageError, match="same camera, /dev/left"):
        open_cameras(CONFIG.model_copy(update={"right": "/dev/left"}), open_device=plugs)
    with pytest.raises(UsageError, match="9 px wide, which is odd"):
        halves = GeometryConfig(layout="side_by_side")
        open_cameras(CONFIG.model_copy(update={"geometry": halves, "width": 9}), open_device=plugs)
    plugs.absent.add("/dev/right")
    with pytest.raises(SagsError, match="/dev/right does not exist"):
        open_cameras(CONFIG, open_device=plugs)
    assert plugs.opened["/dev/left"][-1].closed  # nothing stays open after a failed start


# ---- one device ------------------------------------------------------------------------------------------


class FakeCapture:
    """Stands for cv2.VideoCapture: one picture per entry of `stamps_ms`, then silence or an error."""

    stamps_ms: ClassVar[list[float]] = []
    gone_at_the_end: ClassVar[bool] = False
    set_by_driver: ClassVar[dict[int, float]] = {}

    def __init__(self, path: str, backend: int) -> None:
        assert backend == cv2.CAP_V4L2
        self.values: dict[int, float] = {}
        self.shots = list(self.stamps_ms)
        self.stamp = 0.0

    def isOpened(self) -> bool:
        return True

    def set(self, key: int, value: float) -> bool:
        self.values[key] = self.set_by_driver.get(key, value)
        return key not in self.set_by_driver

    def get(self, key: int) -> float:
        return self.stamp if key == cv2.CAP_PROP_POS_MSEC else self.values.get(key, 0.0)

    @staticmethod
    def waitAny(streams: list[FakeCapture], timeout_ns: int) -> tuple[bool, list[int]]:
        if streams[0].shots:
            return True, [0]
        if streams[0].gone_at_the_end:
            raise cv2.error("Error is reported for camera stream")
        return False, []

    def read(self) -> tuple[bool, np.ndarray]:
        self.stamp = self.shots.pop(0)
        return True, np.full((4, 8, 3), (255, 0, 0), np.uint8)

    def release(self) -> None:
        pass

    @staticmethod
    def fourcc(*letters: str) -> int:
        return int.from_bytes("".join(letters).encode(), "little")


@pytest.fixture
def device(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Callable[..., Device]:
    def build(stamps_ms: list[float], gone: bool = False, **asked: object) -> Device:
        monkeypatch.setattr(FakeCapture, "stamps_ms", stamps_ms)
        monkeypatch.setattr(FakeCapture, "gone_at_the_end", gone)
        monkeypatch.setattr(cv2, "VideoCapture", FakeCapture)
        (tmp_path / "video0").touch()
        return Device(str(tmp_path / "video0"), CONFIG.model_copy(update=asked))

    return build


@pytest.mark.fault("camera: the driver gives one picture again and again")
def test_frozen_picture_is_no_picture(device: Callable[..., Device]) -> None:
    now = time.monotonic() * 1e3
    camera = device([now, now, now, now + 1])
    pictures = [camera.read(0.1) for _ in range(5)]
    assert [picture is not None for picture in pictures] == [True, False, False, True, False]
    assert pictures[0] is not None and (pictures[0].image == (0, 0, 255)).all()  # RGB from OpenCV's BGR


@pytest.mark.parametrize(("fourcc", "bits"), [("Y10", 10), ("Y12", 12), ("Y16", 16)])
def test_more_than_eight_bits_are_kept(
    device: Callable[..., Device], monkeypatch: pytest.MonkeyPatch, fourcc: str, bits: int
) -> None:
    """OpenCV hands such pictures over as bytes in a row when it is not to convert them."""
    counts = np.linspace(0, 2**bits - 1, 32).astype(np.uint16)

    def read(self: FakeCapture) -> tuple[bool, np.ndarray]:
        return self.values[cv2.CAP_PROP_CONVERT_RGB] == 0, counts.view(np.uint8)[None]

    monkeypatch.setattr(FakeCapture, "read", read)
    picture = device([0.0], fourcc=fourcc).read(0.1)
    assert picture is not None and picture.image.shape == (4, 8, 3)
    bright = picture.image[..., 1].ravel() / 65535
    assert np.abs(bright - counts / (2**bits - 1)).max() < 2.0**-bits


def test_driver_without_stamps_gets_the_arrival_time(device: Callable[..., Device]) -> None:
    camera = device([0.0, 0.0])
    before = time.time_ns()
    first, second = camera.read(0.1), camera.read(0.1)
    assert first is not None and second is not None
    assert before <= first.t_ns <= second.t_ns <= time.time_ns()


def test_device_that_fails_says_so(device: Callable[..., Device]) -> None:
    camera = device([], gone=True)
    with pytest.raises(SagsError, match="video0 stopped delivering pictures"):
        camera.read(0.1)


def test_refused_controls_warn_but_do_not_stop(
    device: Callable[..., Device], monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    mjpg = float(FakeCapture.fourcc(*"MJPG"))
    monkeypatch.setattr(FakeCapture, "set_by_driver", {cv2.CAP_PROP_FPS: 15.0, cv2.CAP_PROP_FOURCC: mjpg})
    camera = device([], fourcc="YUYV")
    assert camera.rate == 15
    assert "wanted 50 frames/s, the driver gives 15" in caplog.text
    assert "wanted pixel format YUYV, the driver gives MJPG" in caplog.text


def test_missing_device_is_named_with_what_is_there() -> None:
    with pytest.raises(SagsError, match=r"camera /dev/video-none does not exist; (present: |there is no)"):
        Device("/dev/video-none", CONFIG)
