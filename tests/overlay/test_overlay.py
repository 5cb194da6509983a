"""The overlay beside a node: on the tissue in both eyes, and blank when in any doubt."""

import ctypes
import itertools
import json
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from bridging import sockets
from command_line import RUN_HERE, killed, start
from places import ROOT
from ports import free_port
from synthetic import at_frame, plane_camera, plane_depth, plane_result, stream
from test_overlay_drawing import KEY, centre
from waiting import START_SECONDS, repeating, until

from sags_node.client import FrameSender
from sags_node.clients.overlay.draw import color_key
from sags_node.clients.overlay.frame import NEEDED
from sags_node.clients.overlay.run import UNSEEN, OverlayOptions, run_overlay
from sags_node.config.schema import PublishConfig
from sags_node.geometry import project, unproject
from sags_node.messaging.address import NodeAddress
from sags_node.messaging.control import ControlClient
from sags_node.messaging.node_clock import stamps
from sags_node.messaging.publisher import Publisher
from sags_node.messaging.received import ReceivedCloud, ReceivedImage, ReceivedText, TopicName
from sags_node.messaging.rundir import connection_path
from sags_node.messaging.subscriber import Subscriber
from sags_node.sources.pictures import read_picture
from sags_node.types import AnchorStates, Camera

pytestmark = pytest.mark.live

MAX_AGE = 0.5  # s
NOTICED = 0.1  # s more until it is noticed: what docs/wire.md promises
FROZEN = 0.3  # s after the last new image, from which on the node shows nothing
BUSY = 1.0  # s that a busy machine may take on top


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
    settings = ["source.loop:=true", f"publish.run_dir:={run_dir}", *RUN_HERE]
    with killed(start(["run", phantom_session, *settings])) as running:
        until(connection_path(run_dir, "sags").exists, START_SECONDS)
        yield running


class Watcher:
    """Keeps what an overlay publishes, in order."""

    def __init__(self, run_dir: Path) -> None:
        self.topics = [
            f"{eye}/overlay/{kind}" for eye in ("left", "right") for kind in ("image", "color_key")
        ]
        self.subscriber = Subscriber(self.topics, ns="overlay", run_dir=run_dir)

    def pictures(self, count: int, drawn: bool, seconds: float = 60) -> list[dict[str, ReceivedImage]]:
        """The next so many frames with (or without) an overlay in the left eye: all four topics of each."""
        found: list[dict[str, ReceivedImage]] = []
        deadline, last = time.monotonic() + seconds, None
        while len(found) < count:
            assert time.monotonic() < deadline, self.status()
            last = self.subscriber.wait(self.topics[0], 0.1, after=last)
            if not isinstance(last, ReceivedImage) or bool(last.array.any()) != drawn:
                continue
            whole = self.subscriber.aligned(self.topics, last.stamp_ns, 0.2 if drawn else 0)
            found.append(dict(whole) if whole else {self.topics[0]: last})  # type: ignore[arg-type]  # images
        return found

    def newest_epoch(self) -> int:
        """Of the next frame with an overlay."""
        return self.pictures(1, drawn=True)[0][self.topics[0]].meta.epoch

    def status(self) -> dict[str, Any]:
        said = self.subscriber.latest("status")
        return json.loads(said.text) if isinstance(said, ReceivedText) else {}

    def close(self) -> None:
        self.subscriber.close()


@contextmanager
def overlay(run_dir: Path, **options: Any) -> Iterator[tuple[Overlay, Watcher]]:
    running = Overlay(run_dir, **options)
    running.start()
    try:
        until(connection_path(run_dir, "overlay").exists)
        watcher = Watcher(run_dir)
        try:
            yield running, watcher
        finally:
            watcher.close()
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


@pytest.mark.fault("node: ends before its first frame has reached an overlay")
def test_a_node_that_has_ended_as_its_first_frame_comes_is_waited_for(tmp_path: Path) -> None:
    waiting = "waiting for the node"
    with Publisher(PublishConfig(run_dir=tmp_path), "sags", "session-1") as node:
        with overlay(tmp_path) as (running, watcher):
            until(lambda: not node.poll(0) and all(node.wanted(str(name)) for name in NEEDED))
            connection_path(tmp_path, "sags").unlink()
            node.publish_result(plane_result(), 0)
            until(lambda: watcher.status().get("reason", waiting) != waiting)
            until(lambda: watcher.status()["reason"].startswith("stale"))  # whatever it was at first
            assert running.is_alive()


@pytest.mark.usefixtures("node")
def test_on_the_phantom_both_eyes_follow_the_tissue(
    phantom_session: Path, run_dir: Path, tmp_path: Path
) -> None:
    """A ball pinned to a pixel goes where the true surface there goes, shifted by the true disparity."""
    camera, truth, visible = phantom_truth(phantom_session)
    pixels = np.stack([project(camera(i), truth[i])[0] for i in range(len(truth))])  # [T, P, 2]
    start = steady_pixel(pixels, visible.all(0))
    scene = tmp_path / "scene.yaml"
    scene.write_text(
        f"objects: [{{shape: sphere, color: [255, 40, 40], anchors: [{{pixel: {start.round().tolist()}}}]}}]"
    )
    began = time.monotonic()
    with overlay(run_dir, scene=scene) as (running, watcher):
        frames = watcher.pictures(45, drawn=True)  # once through the recording
        summary = running.end()
    seconds = time.monotonic() - began
    frames = [frame for frame in frames if len(frame) == 4]
    assert len(frames) > 20
    full = np.median([(frame["left/overlay/image"].array[..., 3] > 0).sum() for frame in frames])
    steps, errors, disparities, first = [], [], [], None
    for frame in frames:
        left, right = frame["left/overlay/image"].array, frame["right/overlay/image"].array
        for eye, rgba in (("left", left), ("right", right)):
            keyed = frame[f"{eye}/overlay/color_key"].array
            assert np.array_equal(keyed, color_key(rgba, KEY))
            assert ((keyed == KEY).all(2) >= (rgba[..., 3] == 0)).all()
        if min((left[..., 3] > 0).sum(), (right[..., 3] > 0).sum()) < 0.9 * full:
            continue  # an instrument hides a part
        i = frame["left/overlay/image"].meta.frame_id % len(truth)
        if first is None:
            at = centre(left)
            distances = np.where(visible.all(0), np.linalg.norm(pixels[i] - at, axis=1), np.inf)
            first = at, i, np.argsort(distances)[:4]  # the surface points around it
        expected = (pixels[i, first[2]] - pixels[first[1], first[2]]).mean(0)
        steps.append(np.linalg.norm(expected))
        errors.append(np.linalg.norm(centre(left) - first[0] - expected))
        depth = project(camera(i), truth[i, first[2]])[1].mean()
        shift = centre(left) - centre(right)
        disparities.append(shift[0] - camera(i).K[0, 0] * phantom_baseline(phantom_session) / depth)
        assert abs(shift[1]) < 0.5
    assert len(errors) > 20 and max(steps) > 3  # it does move
    assert np.median(errors) < 1 and np.percentile(errors, 90) < 2
    assert np.abs(np.median(disparities)) < 0.5
    latency = summary["latency_ms"]
    assert 0 < latency["p50"] <= latency["p99"] < 1000 * seconds  # ms, of this session
    assert summary["overlay"] >= 20 and len(summary["objects"][0]["anchors"]) == 1


def phantom_truth(session: Path) -> tuple[Callable[[int], Camera], np.ndarray, np.ndarray]:
    """The left camera of each frame, and its surface points [T, P, 3] with whether they are seen [T, P]."""
    from sags_node.pipeline.session import open_session

    tracks = np.load(session / "tracks.npz")
    poses = np.load(session / "poses.npz")["T_world_cam"]
    K = open_session(session).rig.left.P[:, :3]
    return lambda i: Camera(320, 256, K, poses[i]), tracks["points"], tracks["visible"]


def steady_pixel(pixels: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """Where in the first frame tissue moves far, as one with what surrounds it, and is always seen."""
    inside = seen & ((pixels > 40) & (pixels < np.array([280, 216]))).all((0, 2))
    moved = (pixels - pixels[0])[:, inside]
    distances = np.linalg.norm(pixels[0, inside][:, None] - pixels[0, inside], axis=-1)
    around = np.argsort(distances, axis=1)[:, :9]
    stretch = np.linalg.norm(moved[:, around] - moved[:, :, None], axis=-1).max((0, 2))
    far = np.linalg.norm(moved, axis=-1).max(0)
    best: np.ndarray = pixels[0, inside][int(np.argmax(np.where(stretch < 0.25 * far, far, 0)))]
    return best


def phantom_baseline(session: Path) -> float:
    from sags_node.rig import read_rig

    P = read_rig(session / "calib").right.P
    return float(-P[0, 3] / P[0, 0])


@pytest.mark.usefixtures("node")
def test_the_saved_video_is_whole_also_where_there_is_no_overlay(run_dir: Path, tmp_path: Path) -> None:
    video = tmp_path / "overlay.mp4"
    with overlay(run_dir, save=video) as (running, watcher):
        until(lambda: watcher.status().get("state") == "running")
        watcher.pictures(6, drawn=True)
        summary = running.end()
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
        last = None
        for _ in range(20):
            last = watcher.subscriber.wait(watcher.topics[0], 60, after=last)
        summary = running.end()
    assert summary["overlay"] == 0 and summary["objects"][0]["reason"] is None
    assert summary["blanked"][UNSEEN] > 5


@pytest.mark.usefixtures("node")
def test_it_leaves_no_anchors_behind(run_dir: Path) -> None:
    with Subscriber(["anchors"], run_dir=run_dir) as subscriber:

        def anchors() -> int:
            newest = subscriber.latest("anchors")
            return len(newest.points) if isinstance(newest, ReceivedCloud) else -1

        with overlay(run_dir) as (running, watcher):
            watcher.pictures(1, drawn=True)
            until(lambda: anchors() == 1)
            running.end()
            until(lambda: anchors() == 0)


@pytest.mark.usefixtures("node")
def test_tips_that_are_too_near_are_told_of_their_own_frame(run_dir: Path, tmp_path: Path) -> None:
    scene = tmp_path / "zones.yaml"
    scene.write_text("{tissue_margin: 0.05, objects: [{shape: sphere, label: vessel, margin: 0.05}]}")
    near, tips = TopicName("proximity", ReceivedCloud), TopicName("instruments", ReceivedCloud)
    seen, said = {0: 0, 1: 0}, None
    with (
        overlay(run_dir, scene=scene),
        Subscriber([tips], run_dir=run_dir) as node,
        Subscriber([near], ns="overlay", run_dir=run_dir) as told,
    ):
        while min(seen.values()) < 10:
            said = until(lambda last=said: told.wait(near, 1.0, after=last))
            whole = node.aligned([tips], said.stamp_ns, 1.0)
            rows = {} if whole is None else {int(row["id"]): row for row in whole[tips].points}
            for row in said.points[[int(each) in rows for each in said.points["id"]]]:
                truth, zone = rows[int(row["id"])], int(row["zone"])
                apart = np.linalg.norm([row[f"near_{axis}"] - truth[axis] for axis in "xyz"])
                assert zone == -1 or row["distance"] == pytest.approx(apart, abs=1e-6)
                assert zone != 0 or row["distance"] == truth["clearance"] < 0.05
                seen[zone] = seen.get(zone, 0) + 1


@pytest.mark.fault("process: the node is stopped (SIGSTOP), reset or killed under an overlay")
def test_it_goes_blank_when_the_node_stops_is_reset_or_dies(
    node: subprocess.Popen[str], run_dir: Path
) -> None:
    with overlay(run_dir) as (running, watcher):
        watcher.pictures(3, drawn=True)
        node.send_signal(signal.SIGSTOP)
        blank_in_time(watcher)  # where the recording had just begun anew, because of that
        until(lambda: watcher.status()["reason"].startswith("stale"))
        assert len(watcher.pictures(2, drawn=False)) == 2  # and it says so again
        node.send_signal(signal.SIGCONT)
        before = watcher.newest_epoch()

        with ControlClient(run_dir=run_dir) as client:
            client.request("reset_model", timeout=30)
        until(lambda: watcher.newest_epoch() > before)  # recognised there, or pinned anew
        running.end()
    with overlay(run_dir, repin=True) as (running, watcher):
        watcher.pictures(3, drawn=True)
        with ControlClient(run_dir=run_dir) as client:
            client.request("reset_model", timeout=30)
        until(lambda: watcher.status()["objects"][0]["pinned"] > 1)
        watcher.pictures(3, drawn=True)
        node.kill()
        blank_in_time(watcher)
        until(lambda: watcher.status()["reason"].startswith("stale"))
        assert running.is_alive() and watcher.status()["state"] == "blank"


class Scope(threading.Thread):
    """Hands the phantom's images in, there and back, ten a second; frozen, the last pair over and over."""

    def __init__(self, session: Path, endpoint: str) -> None:
        super().__init__(daemon=True)
        self.frozen = threading.Event()
        self.ended = threading.Event()
        self.newest_ns = 0  # stamp of the last pair that was a new one
        self._endpoint = endpoint
        self._pairs = [
            [read_picture(session / eye / f"{i:04d}.jpg") for eye in ("left", "right")] for i in range(20)
        ]

    def run(self) -> None:
        there_and_back = itertools.cycle([*self._pairs, *self._pairs[-2:0:-1]])
        pair = next(there_and_back)
        with FrameSender(self._endpoint) as sender:
            while not self.ended.wait(0.1):
                stamp_ns = time.time_ns()
                if not self.frozen.is_set():
                    pair, self.newest_ns = next(there_and_back), stamp_ns
                sender.send(*pair, stamp_ns)


@pytest.mark.fault("image: both eyes of a live feed are frozen, under an overlay")
def test_it_goes_blank_when_the_feed_freezes(phantom_session: Path, tmp_path: Path) -> None:
    """All stamps are fresh, and the node goes on."""
    run_dir, endpoint = tmp_path / "run", f"tcp://127.0.0.1:{free_port()}"
    said = [f"source.endpoint:={endpoint}", "source.rate:=10", f"rig:={phantom_session / 'calib'}"]
    said += ["vision.tissue.method:=none", f"publish.run_dir:={run_dir}", *RUN_HERE]
    scope = Scope(phantom_session, endpoint)
    with killed(start(["run", ROOT / "launch/push.yaml", *said])):
        until(connection_path(run_dir, "sags").exists, START_SECONDS)
        scope.start()
        try:
            with overlay(run_dir) as (_, watcher):
                watcher.pictures(3, drawn=True, seconds=START_SECONDS)
                scope.frozen.set()
                drawn, _ = until_blank(watcher)
                assert drawn.stamp_ns < scope.newest_ns + (FROZEN + BUSY) * 1e9
                until(lambda: str(watcher.status().get("reason")).startswith("stale"))
                until(lambda: "picture_frozen" in watcher.status()["warning_codes"])
                scope.frozen.clear()
                watcher.pictures(3, drawn=True)
                until(lambda: "picture_frozen" not in watcher.status()["warning_codes"])
        finally:
            scope.ended.set()
            scope.join(10)


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


def until_blank(watcher: Watcher) -> tuple[ReceivedImage, ReceivedImage]:
    """The last image that showed something, and the empty one after it, which came in time."""
    shown = watcher.pictures(1, drawn=True)[-1] if watcher.status()["state"] == "running" else None
    last_shown = (
        watcher.subscriber.latest("left/overlay/image") if shown is None else shown["left/overlay/image"]
    )
    ticks: list[float] = []
    with repeating(lambda _: (ticks.append(time.monotonic()), time.sleep(0.01))):
        while True:
            newest = watcher.subscriber.wait("left/overlay/image", 30, after=last_shown)
            assert isinstance(newest, ReceivedImage), "the last overlay was left standing"
            if not newest.array.any():
                break
            last_shown = newest
    assert last_shown is not None and newest.meta.frame_id == -1
    age = (newest.meta.publish_ns - last_shown.stamp_ns) * 1e-9
    stood_still = sum(gap for gap in np.diff(ticks) if gap > 0.1)  # this process, and with it the overlay
    assert age < MAX_AGE + NOTICED + BUSY + stood_still
    return last_shown, newest


def blank_in_time(watcher: Watcher) -> str:
    """Wait for an empty image, check that it came in time, and give the reason that status gives."""
    until_blank(watcher)
    keyed = watcher.subscriber.wait("left/overlay/color_key", 60)
    assert isinstance(keyed, ReceivedImage)
    return str(until(lambda: watcher.status().get("reason")))
