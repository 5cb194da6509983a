"""Cameras of the kernel, made of Python: stamps of drivers, unplugging, silence, frozen images.

tests/sources/test_v4l2_vivid.py checks the same source against a real kernel driver.
"""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from waiting import beside, repeating, until

from sags_node import workers
from sags_node.config.schema import GeometryConfig, V4l2Source
from sags_node.errors import SagsError, UsageError
from sags_node.sources import live
from sags_node.sources.live import LiveStereo
from sags_node.sources.pairing import Shot
from sags_node.sources.v4l2 import STRANGE, Device, open_cameras
from sags_node.types import StereoFrame

pytestmark = pytest.mark.live

MS = 1_000_000
CONFIG = V4l2Source(left="/dev/left", right="/dev/right", width=8, height=4, rate=50, deadline=60)


class FakeCamera:
    """Delivers what the test puts in, and raises the errors among it; silence is an empty queue."""

    rate = 50.0

    def __init__(self, size: tuple[int, int]) -> None:
        self.size = size
        self.pictures: queue.Queue[Shot | Exception] = queue.Queue()
        self.closed = False

    def read(self, timeout: float) -> Shot | None:
        try:
            picture = self.pictures.get(timeout=timeout)
        except queue.Empty:
            return None
        if isinstance(picture, Exception):
            raise picture
        return picture

    def close(self) -> None:
        self.closed = True


GONE = SagsError("camera is gone")


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
        image = np.full((4, 8, 3), value, np.uint8)
        for path, t in (("/dev/left", t_ms), ("/dev/right", t_ms + skew_ms)):
            self.opened[path][-1].pictures.put(Shot(round(t * MS), image))


@pytest.fixture
def plugs(monkeypatch: pytest.MonkeyPatch) -> Plugs:
    monkeypatch.setattr(live, "FIRST_PAUSE_S", 0.01)
    monkeypatch.setattr(live, "LONGEST_PAUSE_S", 0.04)
    monkeypatch.setattr(workers, "PAUSE_S", 0.01)
    return Plugs()


@contextmanager
def taking(plugs: Plugs, config: V4l2Source = CONFIG) -> Iterator[tuple[LiveStereo, list[StereoFrame]]]:
    """A source and its frames, which a thread takes, as a node does."""
    frames: list[StereoFrame] = []
    with open_cameras(config, open_device=plugs) as source:
        with beside(lambda: frames.extend(source), source.stop):
            yield source, frames


def values(frames: list[StereoFrame]) -> list[int]:
    """What the left images show."""
    return [int(frame.left[0, 0, 0]) for frame in frames]


@pytest.mark.fault("camera: absent while the node stops")
def test_pairs_come_until_the_end_and_all_is_closed(plugs: Plugs) -> None:
    with taking(plugs) as (source, frames):
        for n in range(3):
            plugs.put(20 * n, value=n, skew_ms=3)
            until(lambda n=n: len(frames) == n + 1)
        plugs.absent.update(plugs.opened)
        plugs.opened["/dev/left"][0].pictures.put(GONE)
        until(lambda: plugs.opened["/dev/left"][0].closed)
    assert values(frames) == [0, 1, 2]
    assert {frame.t_capture_right_ns - frame.t_capture_ns for frame in frames} == {3 * MS}
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
        plugs.opened["/dev/right"][0].pictures.put(GONE)
        assert opening.wait(10)
        source.stop()
        ended.set()
    assert "camera is gone" in caplog.text and "broken it off" not in caplog.text


@pytest.mark.fault("camera: unplugged")
@pytest.mark.fault("camera: its driver raises what nobody foresaw")
@pytest.mark.parametrize("error", [SagsError, ValueError, MemoryError, ConnectionResetError, cv2.error])
def test_unplugged_camera_comes_back(error: Any, plugs: Plugs, caplog: pytest.LogCaptureFixture) -> None:
    with taking(plugs) as (_, frames):
        plugs.put(0, value=1)
        until(lambda: values(frames) == [1])
        plugs.absent.add("/dev/right")
        attempts = plugs.attempts
        plugs.opened["/dev/right"][0].pictures.put(error("camera is gone"))
        until(lambda: plugs.attempts >= attempts + 3)  # it tries again and again
        assert plugs.opened["/dev/right"][0].closed
        plugs.absent.clear()
        until(lambda: len(plugs.opened["/dev/right"]) == 2)
        plugs.put(5000, value=2)
        until(lambda: values(frames) == [1, 2])
    said = "it will be opened again" if error is SagsError else f"internal error: {error.__name__}: camera is"
    assert said in caplog.text and "/dev/right is open again" in caplog.text


@pytest.mark.fault("camera: neither delivers nor fails")
def test_silent_camera_is_opened_again(plugs: Plugs, caplog: pytest.LogCaptureFixture) -> None:
    """A camera that neither delivers nor fails, as unplugged USB cameras may do."""
    with taking(plugs, CONFIG.model_copy(update={"deadline": 0.15})) as (_, frames):
        plugs.put(0, value=1)
        until(lambda: all(len(cameras) >= 2 for cameras in plugs.opened.values()))
        assert plugs.opened["/dev/left"][0].closed

        def film(number: int) -> None:
            time.sleep(0.02)
            plugs.put(1000.0 + 20 * number, value=2)

        with repeating(film):
            until(lambda: 2 in values(frames))
    assert "no new image for" in caplog.text


@pytest.mark.parametrize(
    ("first", "width", "aspect"), [("left", 16, 1.0), ("right", 16, 1.0), ("left", 4, 2.0)]
)
def test_one_camera_shows_both_eyes_and_it_is_told_where_it_squeezes_them(
    first: str, width: int, aspect: float, plugs: Plugs, caplog: pytest.LogCaptureFixture
) -> None:
    halves = np.repeat(np.array([10, 20], np.uint8), width // 2)[None, :, None].repeat(4, 0).repeat(3, 2)
    said = {"geometry": GeometryConfig(layout="side_by_side", first=first), "right": None, "width": width}
    with open_cameras(CONFIG.model_copy(update=said), open_device=plugs) as source:
        plugs.opened["/dev/left"][0].pictures.put(Shot(7 * MS, halves))
        frame = next(iter(source))
        assert source.pixel_aspect == aspect
    assert frame.right is not None and frame.left.shape == frame.right.shape == (4, width // 2, 3)
    value = {"left": 10, "right": 20}[first]
    assert (frame.left == value).all() and (frame.right == 30 - value).all()
    assert frame.t_capture_ns == frame.t_capture_right_ns == 7 * MS and source.dropped == 0
    assert ("2 times as wide as high" in caplog.text) == (aspect == 2)


@pytest.mark.parametrize(
    ("said", "words"),
    [
        ({"right": None}, r"source\.right names no camera"),
        ({"right": "/dev/left"}, "same camera, /dev/left"),
        ({"geometry": GeometryConfig(layout="side_by_side"), "width": 9}, "9 px wide, which is odd"),
        ({}, "/dev/right does not exist"),
    ],
)
def test_mistakes_at_opening(said: dict[str, object], words: str, plugs: Plugs) -> None:
    plugs.absent.update({"/dev/right"} if not said else ())
    with pytest.raises(SagsError, match=words) as error:
        open_cameras(CONFIG.model_copy(update=said), open_device=plugs)
    assert isinstance(error.value, UsageError) or not said
    assert all(camera.closed for camera in plugs.opened["/dev/left"])  # also after a failed start


# ---- one device ------------------------------------------------------------------------------------------


class FakeCapture:
    """Stands for cv2.VideoCapture: one image per entry of `stamps_ms`, then silence or an error."""

    stamps_ms: list[float]
    gone_at_the_end = False
    set_by_driver: dict[int, float]

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


Build = Callable[..., Device]


@pytest.fixture
def device(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Build:
    def build(stamps_ms: list[float], gone: bool = False, driver: Any = None, **asked: object) -> Device:
        said = {"stamps_ms": stamps_ms, "gone_at_the_end": gone, "set_by_driver": driver or {}}
        monkeypatch.setattr(cv2, "VideoCapture", type("Capture", (FakeCapture,), said))
        (tmp_path / "video0").touch()
        return Device(str(tmp_path / "video0"), CONFIG.model_copy(update=asked))

    return build


@pytest.mark.fault("camera: images wait in its driver while the process is stopped")
@pytest.mark.parametrize(
    ("said", "age"),
    [
        # Four buffers of before a stop, also where they are the very first.
        *((before + [stopped_s] * 4, before + [stopped_s] * 4)
          for stopped_s in (0.9, 1.1, 3.0, 3600.0) for before in ([], [0.02])),
        # vivid stamps ahead; a stamp of the wall clock is ahead by years. Some drivers give none.
        ([-0.06, 0.02, -1e9, None, None], [0.0, 0.02, 0.0, 0.0, 0.0]),
        # A driver that counts from when it was plugged in: what it says is old is new.
        ([1000.0] * 60, [1000.0] * (STRANGE - 1) + [0.0] * (61 - STRANGE)),
    ],
)  # fmt: skip
def test_an_image_is_as_old_as_its_driver_says(
    said: list[float | None], age: list[float], device: Build, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where that can be believed; none is of the future."""
    wall_ns, monotonic_ns = 10**18, 10**14
    stamps = (  # each is another one
        0.0 if one is None else 1e-6 * (monotonic_ns + n - round(one * 1e9)) for n, one in enumerate(said)
    )
    camera = device([*stamps])
    monkeypatch.setattr(time, "time_ns", lambda: wall_ns)
    monkeypatch.setattr(time, "monotonic_ns", lambda: monotonic_ns)
    shots = [camera.read(1.0) for _ in said]
    assert [(wall_ns - shot.t_ns) * 1e-9 for shot in shots if shot] == pytest.approx(age, abs=1e-3)


@pytest.mark.fault("camera: the driver gives one image again and again")
def test_frozen_picture_is_no_picture(device: Build) -> None:
    now = time.monotonic() * 1e3
    camera = device([now, now, now, now + 1])
    pictures = [camera.read(0.1) for _ in range(5)]
    assert [picture is not None for picture in pictures] == [True, False, False, True, False]
    assert pictures[0] is not None and (pictures[0].image == (0, 0, 255)).all()  # RGB from OpenCV's BGR


@pytest.mark.parametrize(("fourcc", "bits"), [("Y10", 10), ("Y12", 12), ("Y16", 16)])
def test_deep_pictures_are_kept(
    device: Build, monkeypatch: pytest.MonkeyPatch, fourcc: str, bits: int
) -> None:
    """OpenCV hands such images over as bytes in a row when it is not to convert them."""
    counts = np.linspace(0, 2**bits - 1, 32).astype(np.uint16)

    def read(self: FakeCapture) -> tuple[bool, np.ndarray]:
        return self.values[cv2.CAP_PROP_CONVERT_RGB] == 0, counts.view(np.uint8)[None]

    monkeypatch.setattr(FakeCapture, "read", read)
    picture = device([0.0], fourcc=fourcc).read(0.1)
    assert picture is not None and picture.image.shape == (4, 8, 3)
    bright = picture.image[..., 1].ravel() / 65535
    assert np.abs(bright - counts / (2**bits - 1)).max() < 2.0**-bits


def test_device_says_what_fails(device: Build, caplog: pytest.LogCaptureFixture) -> None:
    with pytest.raises(SagsError, match="video0 stopped delivering images"):
        device([], gone=True).read(0.1)
    with pytest.raises(SagsError, match=r"camera /dev/video-none does not exist; (present: |there is no)"):
        Device("/dev/video-none", CONFIG)
    mjpg = float(int.from_bytes(b"MJPG", "little"))
    camera = device([], driver={cv2.CAP_PROP_FPS: 15.0, cv2.CAP_PROP_FOURCC: mjpg}, fourcc="YUYV")
    assert camera.rate == 15
    assert "wanted 50 frames/s, the driver gives 15" in caplog.text
    assert "wanted pixel format YUYV, the driver gives MJPG" in caplog.text
