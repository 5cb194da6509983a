"""The overlay beside a node: on the tissue in both eyes, and blank when in any doubt."""

import ctypes
import json
import signal
import subprocess
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from bridging import sockets
from running_node import RunningNode
from synthetic import at_frame, plane_camera, plane_depth, plane_result, stream
from test_overlay_drawing import KEY, centre
from waiting import START_SECONDS, repeating, until

from sags_node.clients.overlay.draw import color_key
from sags_node.clients.overlay.run import UNSEEN, OverlayOptions, run_overlay
from sags_node.geometry import project, unproject
from sags_node.messaging.address import NodeAddress
from sags_node.messaging.control import ControlClient
from sags_node.messaging.node_clock import stamps
from sags_node.messaging.received import ReceivedCloud, ReceivedImage, ReceivedText
from sags_node.messaging.rundir import connection_path
from sags_node.messaging.subscriber import Subscriber
from sags_node.rig import load_rig
from sags_node.types import AnchorStates, Camera

pytestmark = pytest.mark.live

MAX_AGE = 0.5  # s
NOTICED = 0.1  # s more until it is noticed: what docs/wire.md promises
BUSY = 1.0  # s that a busy machine may take on top
TOPICS = [f"{eye}/overlay/{kind}" for eye in ("left", "right") for kind in ("image", "color_key")]
LEFT = TOPICS[0]


class Overlay(threading.Thread):
    """`sags overlay` in a thread."""

    def __init__(self, run_dir: Path, **options: Any) -> None:
        super().__init__(daemon=True)
        self.said: list[str] = []
        said = {"node": NodeAddress(run_dir=run_dir), "max_age": MAX_AGE}
        self._options = OverlayOptions(**said | options)
        self._summary: dict[str, Any] = {}

    def run(self) -> None:
        self._summary = run_overlay(self._options, self.said.append)

    def end(self) -> dict[str, Any]:
        """As Ctrl-C does; what it says in the end."""
        if self.is_alive():
            ctypes.pythonapi.PyThreadState_SetAsyncExc(
                ctypes.c_ulong(self.ident or 0), ctypes.py_object(KeyboardInterrupt)
            )
        self.join(30)
        assert not self.is_alive() and self._summary
        return self._summary


@pytest.fixture(scope="module")
def run_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("overlay") / "run"


@pytest.fixture(scope="module")
def node(phantom_session: Path, run_dir: Path) -> Iterator[subprocess.Popen[str]]:
    """A node that plays the phantom in a loop. The last test kills it."""
    with RunningNode(phantom_session, run_dir.parent) as running:
        yield running.process


class Watcher(Subscriber):
    """Keeps what an overlay publishes, in order."""

    def __init__(self, run_dir: Path) -> None:
        super().__init__(TOPICS, ns="overlay", run_dir=run_dir)

    def pictures(self, count: int, drawn: bool, seconds: float = 60) -> list[dict[str, ReceivedImage]]:
        """The next so many frames with (or without) an overlay in the left eye: all four topics of each."""
        found: list[dict[str, ReceivedImage]] = []
        deadline, last = time.monotonic() + seconds, None
        while len(found) < count:
            assert time.monotonic() < deadline, self.status()
            newest = self.wait(LEFT, 0.1, after=last)
            last = newest or last  # None: none came yet
            if not isinstance(newest, ReceivedImage) or bool(newest.array.any()) != drawn:
                continue
            whole = self.aligned(TOPICS, newest.stamp_ns, 0.2 if drawn else 0)
            found.append(dict(whole) if whole else {LEFT: newest})  # type: ignore[arg-type]  # images
        return found

    def newest_epoch(self) -> int:
        """Of the next frame with an overlay."""
        return self.pictures(1, drawn=True)[0][LEFT].meta.epoch

    def status(self) -> dict[str, Any]:
        said = self.latest("status")
        return json.loads(said.text) if isinstance(said, ReceivedText) else {}

    def blank_in_time(self) -> ReceivedImage:
        """Wait for an empty image, which must come in time; the last one that showed something."""
        is_running = self.status()["state"] == "running"
        last = self.pictures(1, drawn=True)[0][LEFT] if is_running else self.latest(LEFT)
        ticks: list[float] = []
        with repeating(lambda _: (ticks.append(time.monotonic()), time.sleep(0.01))):
            while True:
                newest = self.wait(LEFT, 30, after=last)
                assert isinstance(newest, ReceivedImage), "the last overlay was left standing"
                if not newest.array.any():
                    break
                last = newest
        assert isinstance(last, ReceivedImage) and newest.meta.frame_id == -1
        age = (newest.meta.publish_ns - last.stamp_ns) * 1e-9
        stood_still = sum(gap for gap in np.diff(ticks) if gap > 0.1)  # this process, and with it the overlay
        assert age < MAX_AGE + NOTICED + BUSY + stood_still
        assert self.wait("left/overlay/color_key", 60)
        until(lambda: str(self.status().get("reason")).startswith("stale"))
        return last


@contextmanager
def overlay(run_dir: Path, **options: Any) -> Iterator[tuple[Overlay, Watcher]]:
    running = Overlay(run_dir, **options)
    running.start()
    try:
        until(connection_path(run_dir, "overlay").exists)
        with Watcher(run_dir) as watcher:
            yield running, watcher
    finally:
        running.end()


def test_it_waits_for_a_node_that_is_started_later(run_dir: Path, request: pytest.FixtureRequest) -> None:
    """The first of these tests, before there is a node."""
    assert not connection_path(run_dir, "sags").exists()
    with overlay(run_dir) as (running, watcher):
        until(lambda: watcher.status().get("reason") == "waiting for the node")
        assert len(running.said) == 1 and "waiting (Ctrl-C ends)" in running.said[0]
        request.getfixturevalue("node")
        assert watcher.pictures(3, drawn=True, seconds=START_SECONDS)
        session = json.loads(connection_path(run_dir, "sags").read_text())["session"]
        until(lambda: watcher.status()["session"] == session)


@pytest.mark.usefixtures("node")
def test_on_the_phantom_both_eyes_follow_the_tissue(
    phantom_session: Path, run_dir: Path, tmp_path: Path
) -> None:
    """A ball pinned to a pixel goes where the true surface there goes, shifted by the true disparity."""
    rig, tracks = load_rig(phantom_session / "calib"), np.load(phantom_session / "tracks.npz")
    truth, seen = tracks["points"], tracks["visible"].all(0)  # [T, P, 3], [P]
    camera = Camera(320, 256, rig.left.P[:, :3], np.eye(4))
    pixels = np.stack([project(camera, points)[0] for points in truth])  # [T, P, 2]
    scene = tmp_path / "scene.yaml"  # at its pixel tissue moves far, as one with what surrounds it
    scene.write_text("objects: [{shape: sphere, color: [255, 40, 40], anchors: [{pixel: [163, 199]}]}]")
    began = time.monotonic()
    with overlay(run_dir, scene=scene) as (running, watcher):
        frames = watcher.pictures(45, drawn=True)  # once through the recording
        summary = running.end()
    seconds = time.monotonic() - began
    frames = [frame for frame in frames if len(frame) == 4]
    assert len(frames) > 20
    full = np.median([(frame[LEFT].array[..., 3] > 0).sum() for frame in frames])
    places, errors, disparities, first = [], [], [], None
    for frame in frames:
        left, right = frame[LEFT].array, frame["right/overlay/image"].array
        for eye, rgba in (("left", left), ("right", right)):
            keyed = frame[f"{eye}/overlay/color_key"].array
            assert np.array_equal(keyed, color_key(rgba, KEY))
            assert ((keyed == KEY).all(2) >= (rgba[..., 3] == 0)).all()
        if min((left[..., 3] > 0).sum(), (right[..., 3] > 0).sum()) < 0.9 * full:
            continue  # an instrument hides a part
        i, at = frame[LEFT].meta.frame_id % len(truth), centre(left)
        if first is None:
            distances = np.where(seen, np.linalg.norm(pixels[i] - at, axis=1), np.inf)
            around = np.argsort(distances)[:4]  # the surface points around it
            first = at - pixels[i, around].mean(0)
        places.append(pixels[i, around].mean(0))
        errors.append(np.linalg.norm(at - first - places[-1]))
        depth = project(camera, truth[i, around])[1].mean()
        shift = at - centre(right)
        disparities.append(shift[0] - camera.K[0, 0] * rig.baseline / depth)
        assert abs(shift[1]) < 0.5
    assert len(errors) > 20 and np.linalg.norm(np.array(places) - places[0], axis=1).max() > 3  # it does move
    assert np.median(errors) < 1 and np.percentile(errors, 90) < 2
    assert np.abs(np.median(disparities)) < 0.5
    latency = summary["latency_ms"]
    assert 0 < latency["p50"] <= latency["p99"] < 1000 * seconds  # ms, of this session
    assert summary["overlay"] >= 20 and len(summary["objects"][0]["anchors"]) == 1


@pytest.mark.usefixtures("node")
def test_the_saved_video_is_whole_also_where_there_is_no_overlay_and_no_anchor_is_left_behind(
    run_dir: Path, tmp_path: Path
) -> None:
    video = tmp_path / "overlay.mp4"
    with Subscriber(["anchors"], run_dir=run_dir) as subscriber:

        def anchors() -> int:
            newest = subscriber.latest("anchors")
            return len(newest.points) if isinstance(newest, ReceivedCloud) else -1

        with overlay(run_dir, save=video) as (running, watcher):
            watcher.pictures(6, drawn=True)
            until(lambda: anchors() > 0)
            summary = running.end()
            until(lambda: anchors() == 0)
    assert summary["frames"] == summary["overlay"] + sum(summary["blanked"].values()) > 5
    assert summary["blanked"]["being pinned"] > 0
    capture = cv2.VideoCapture(str(video))
    assert capture.get(cv2.CAP_PROP_FRAME_WIDTH) == 320
    assert capture.get(cv2.CAP_PROP_FRAME_COUNT) >= summary["frames"] - 5


@pytest.mark.usefixtures("node")
def test_what_nobody_sees_is_not_counted_as_an_overlay(run_dir: Path, tmp_path: Path) -> None:
    """Its lowest edge begins 20 pixels above the image; the phantom moves there by 13."""
    scene = tmp_path / "aside.yaml"
    scene.write_text("objects: [{shape: sphere, anchors: [{pixel: [160, 2], at: [0, -0.016, 0]}]}]")
    with overlay(run_dir, scene=scene) as (running, watcher):
        until(lambda: watcher.status().get("state") == "running")
        watcher.pictures(20, drawn=False)
        summary = running.end()
    assert summary["overlay"] == 0 and summary["objects"][0]["reason"] is None
    assert summary["blanked"][UNSEEN] > 5


@pytest.mark.fault("process: the node is stopped (SIGSTOP), reset or killed under an overlay")
def test_it_goes_blank_when_the_node_stops_is_reset_or_dies(
    node: subprocess.Popen[str], run_dir: Path
) -> None:
    with overlay(run_dir) as (running, watcher), ControlClient(run_dir=run_dir) as client:
        watcher.pictures(3, drawn=True)
        node.send_signal(signal.SIGSTOP)
        watcher.blank_in_time()  # where the recording had just begun anew, because of that
        assert len(watcher.pictures(2, drawn=False)) == 2  # and it says so again
        node.send_signal(signal.SIGCONT)
        before = watcher.newest_epoch()
        client.request("reset_model", timeout=30)
        until(lambda: watcher.newest_epoch() > before)  # recognised there, or pinned anew
        running.end()
    with overlay(run_dir, repin=True) as (running, watcher), ControlClient(run_dir=run_dir) as client:
        watcher.pictures(3, drawn=True)
        client.request("reset_model", timeout=30)
        until(lambda: watcher.status()["objects"][0]["pinned"] > 1)
        watcher.pictures(3, drawn=True)
        node.kill()
        watcher.blank_in_time()
        assert running.is_alive() and watcher.status()["state"] == "blank"


@pytest.mark.fault("clock: the node's is set back by an hour as it falls silent, under an overlay")
def test_it_goes_blank_when_the_clock_is_set_back_as_the_node_falls_silent(tmp_path: Path) -> None:
    back_ns, camera, ones = 0, plane_camera(), np.ones(1, np.float32)
    pixel = np.array([[30.0, 30.0]])
    place = unproject(camera, pixel, plane_depth(camera)[30, 30:31].astype(float))
    anchor = AnchorStates(np.array([3]), place.astype(np.float32), pixel.astype(np.float32), *[ones] * 4)
    held = replace(plane_result(), anchors=anchor)
    handlers = {
        "add_anchor": lambda args: {"id": 3},
        "remove_anchor": lambda args: None,
        "get_clock": lambda args: {key: at_ns - back_ns for key, at_ns in stamps().items()},
    }
    with sockets(tmp_path, handlers) as node:
        address = NodeAddress("sags", node.connection.data[0], node.connection.control, tmp_path)
        with overlay(tmp_path, node=address, max_age=5.0) as (_, watcher):  # the clock is known before
            with stream(node, lambda i: at_frame(held, i, time.time_ns())):
                until(lambda: watcher.status().get("state") == "running")
            back_ns = 3_600_000_000_000
            with repeating(lambda i: node.poll(10)):
                until(lambda: watcher.status()["state"] == "blank")
