"""A session from start to end over real sockets, on images of the phantom, whose truth is known."""

import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import open3d as o3d
import pytest
import yaml
from command_line import RUN_HERE, figures_at_last, killed, refused, start
from places import ROOT
from ports import free_port
from test_overlay import BUSY, overlay
from test_registration import AWAY, HEIGHT, WIDTH, Organ, written
from waiting import START_SECONDS, repeating, until

from sags_node.client import MEASURING, FrameSender, ReceivedCloud, ReceivedImage, TopicName, measure
from sags_node.clients.overlay.scene import read_scene
from sags_node.confidence import error_of
from sags_node.geometry import transform, unproject
from sags_node.messaging.control import ControlClient
from sags_node.messaging.measure import ANCHORS, Measured
from sags_node.messaging.rundir import connection_path
from sags_node.messaging.subscriber import Subscriber
from sags_node.phantom.instruments import NOTHING, Instruments, joined
from sags_node.phantom.scene import Phantom, PhantomFrame, PhantomScene
from sags_node.rig import save_rig
from sags_node.types import F64, Camera

COUNT = 40  # frames of the whole session
PHANTOM = Phantom(PhantomScene(seconds=4.0, width=WIDTH, height=HEIGHT, seed=1))
CAMERA = Camera(WIDTH, HEIGHT, PHANTOM.rig.left.P[:, :3].astype(float), np.eye(4))
PINS = np.array([[120, 130], [200, 170]])  # px; the pull takes them 2.4 mm apart
ZONE, RADIUS, MARGIN = np.array([[200, 110]]), 0.004, 0.012  # px, m, m
TROCAR = np.array([-0.105, 0.125, -0.01])  # m
PULLED = 12  # of `COUNT`
BESIDE = np.array([-0.006, 0.004, -0.010])  # m, of the tip from the zone's middle
FROZEN = 0.3  # s after the last new image, from which on the node shows nothing
STILL = 4  # frames, after which what is told is told of the newest
POINTS, TIPS = TopicName("points", ReceivedCloud), TopicName("instruments", ReceivedCloud)
VIEW, PROXIMITY = TopicName("view/strain/image", ReceivedImage), TopicName("proximity", ReceivedCloud)
LITTLE = 0.02  # strain: nine of ten places have less than 0.006 by breath, one of ten has 0.035 by the pull


def at_px(pixels: Any, depth: Any) -> F64:
    return np.asarray(unproject(CAMERA, np.asarray(pixels, float), np.asarray(depth, float)), np.float64)


def filmed(i: int, tip: F64 | None = None) -> PhantomFrame:
    tool = [] if tip is None else [Instruments().grasper(tip, TROCAR)]
    return PHANTOM.frame(i, COUNT, tools=joined([NOTHING, *tool]))


def gone(points: F64, i: int) -> F64:
    """Where the tissue at places [N, 3] of frame 0 is in frame i: as the nearest vertex has moved."""
    before, now = (PHANTOM.tissue.vertices(at / COUNT).reshape(-1, 3) for at in (0, i))
    nearest = np.linalg.norm(before - points[:, None], axis=2).argmin(1)
    return np.asarray(points + (now - before)[nearest], np.float64)


class Film:
    """Hands images in, each when the node has taken the last: none is left out on a busy machine.

    Attributes:
        shown: stamp of each image -> number of the phantom's frame.
        is_frozen: the last images come over and over.
    """

    def __init__(self, sender: FrameSender, node: Subscriber, first: dict[int, PhantomFrame]) -> None:
        self._sender, self._node, self._frames = sender, node, first
        self._rng = np.random.default_rng(0)
        self._taken, self.is_frozen = 0, False
        self.shown: dict[int, int] = {}

    def step(self, _: int) -> None:
        stamp_ns, last = time.time_ns(), None
        if self.is_frozen:
            self._sender.send(*self._pair, stamp_ns)
            time.sleep(0.1)
            return
        frames, numbers, at = self._frames, list(self._frames), self._taken
        number = numbers[min(at, len(numbers) - 1 - at % 2)]
        left, right = frames[number].left, frames[number].right
        noise = self._rng.integers(-2, 3, left.shape)
        self._pair = [np.clip(eye + noise, 0, 255).astype(np.uint8) for eye in (left, right)]
        self.shown[stamp_ns] = number
        self._sender.send(*self._pair, stamp_ns)
        time.sleep(0.1)
        for _ in range(20):
            last = self._node.wait(ANCHORS, 0.1, after=last)
            if last is not None and last.stamp_ns >= stamp_ns:
                self._taken += self._frames is frames
                return

    def play(self, frames: dict[int, PhantomFrame]) -> None:
        """Show them in order, then the last two in turn: tissue is never quite still."""
        self._taken, self._frames = 0, frames
        until(lambda: self._taken >= len(frames) + STILL)


def zoned(scene: Path, zone: F64) -> None:
    """The registered organ, bending; and a ball below the surface, held by one anchor, that is forbidden."""
    ball = o3d.geometry.TriangleMesh.create_sphere(1e3 * RADIUS)
    assert o3d.io.write_triangle_mesh(str(scene.parent / "ball.ply"), ball)
    said = yaml.safe_load(scene.read_text())
    said["objects"][0]["deform"] = True
    zoned = {"file": "ball.ply", "scale": 1e-3, "label": "vessel", "margin": MARGIN}
    said["objects"] += [zoned | {"anchors": [{"place": zone.tolist(), "at": [0, 0, 0]}]}]
    scene.write_text(yaml.safe_dump(said))


@pytest.mark.live
@pytest.mark.fault("image: both eyes of a live feed are frozen, under an overlay")
def test_register_hold_pull_occlude_come_near_measure_and_freeze(tmp_path: Path) -> None:
    run_dir, endpoint = tmp_path / "run", f"tcp://127.0.0.1:{free_port()}"
    rest, pull = ({i: filmed(i) for i in numbers} for numbers in ((1, 0), range(8, PULLED + 1)))
    zone, pins = (
        at_px(px, rest[0].depth[px[:, 1], px[:, 0]] + deep) for px, deep in ((ZONE, 2e-3), (PINS, 0))
    )
    tip = gone(zone, PULLED)[0] + BESIDE
    save_rig(PHANTOM.rig, tmp_path / "rig")
    settings = (f"rig:={tmp_path / 'rig'}", f"source.endpoint:={endpoint}", "source.rate:=10")
    more = (f"publish.run_dir:={run_dir}", "mapping.iterations:=1", *RUN_HERE)
    with ExitStack() as stack:
        enter = stack.enter_context
        enter(killed(start(["run", ROOT / "launch/push.yaml", *settings, *more])))
        until(connection_path(run_dir, "sags").exists, START_SECONDS)
        control = enter(ControlClient(run_dir=run_dir))
        film = Film(enter(FrameSender(endpoint)), enter(Subscriber([ANCHORS], run_dir=run_dir)), rest)
        node = enter(Subscriber([POINTS, TIPS, VIEW, *MEASURING], run_dir=run_dir))
        enter(repeating(film.step))

        def length(sure: bool = True) -> tuple[Measured, float]:
            """Of the line between the pins, and its truth."""

            def found() -> Any:
                frame = node.aligned(MEASURING, until(lambda: node.latest(ANCHORS)).stamp_ns, 1.0)
                told = frame and measure(frame, ids)
                fits = told and told.value and (told.unsure is None or not sure)
                return fits and (told, film.shown[frame[ANCHORS].stamp_ns])

            told, number = until(found)
            return told, float(np.linalg.norm(np.subtract(*gone(pins, number))))

        def is_right() -> bool:
            """Twice the error of nine of ten is 3.3 standard deviations."""
            measured, truth = length()
            assert measured.value is not None and measured.error is not None
            return abs(measured.value - truth) < 2 * measured.error

        def strain() -> float:
            """The largest, but for one of ten of what is known."""
            told = until(lambda: node.latest(POINTS)).points["strain_max"]
            return float(np.nanquantile(told, 0.9)) if np.isfinite(told).mean() > 0.1 else np.nan

        # Register: the model comes to lie where it is.
        film.play(rest)
        # The scene names the file as it is found from there, also where a link leads to its folder.
        files = written(Organ(), tmp_path)
        model = (files / "organ.ply").rename(files / f"{'organ' * 20}.ply")  # longer than a label may be
        (tmp_path / "deep/scenes").mkdir(parents=True)
        (tmp_path / "linked").symlink_to("deep/scenes")
        scene = tmp_path / "linked/scene.yaml"
        command = ("register", model, "--points", files / "pairs.yaml", "--run-dir", run_dir)
        command += ("-o", scene, "--force", "--json")

        def registered() -> Any:
            """After a gap on a busy machine too little is sure to begin with."""
            said = figures_at_last(*command)
            return said["targets"][0]["expected_mm"] < 1.5 and said

        said = until(registered)
        refused(2, *command[:-2], said=(str(scene), "exists already", "--force"))
        organ = read_scene(scene).objects[0]
        kept = organ.registration and organ.registration.model_dump()
        assert kept == {key: said[key] for key in said if key != "scene"}
        for each in organ.anchors:
            off = np.linalg.norm(transform(np.linalg.inv(AWAY), 1e-3 * np.array(each.at)) - each.place)
            assert said["verdict"] == "good" and 1e3 * off < said["targets"][0]["expected_mm"]

        # Hold and measure, at rest: next to nothing is strained.
        zoned(scene, zone[0])
        ids = [control.request("add_anchor", {"u": u, "v": v})["id"] for u, v in PINS.tolist()]
        assert is_right()
        # As above: then it begins again.
        until(lambda: control.request("start_strain") and film.play(rest) is None and strain() < LITTLE)
        control.request("open_view", {"name": "strain", "show": "strain", "width": WIDTH, "height": HEIGHT})
        _, watcher = enter(overlay(run_dir, scene=scene))
        told = enter(Subscriber([PROXIMITY], ns="overlay", run_dir=run_dir))

        def held() -> Any:
            objects = watcher.status().get("objects", ())
            return [each["reason"] for each in objects] == [None, None] and objects[0]

        def checked() -> Any:
            """And measured against the tissue's surface, with which it bends."""
            organ = held()
            is_known = organ and organ["sure"] and organ["residual_mm"] is not None
            return is_known and organ["deform"]["pulling"] > 20 and organ

        organ = until(checked)
        assert organ["residual_mm"] <= organ["residual_limit_mm"]
        assert until(lambda: node.latest(VIEW)).array.shape == (HEIGHT, WIDTH, 4)

        # Pull: lengths follow, and the tissue is strained.
        film.play(pull)
        measured, truth = length(sure=False)  # the tissue at the pins looks otherwise now
        assert measured.value is not None
        assert abs(measured.value - truth) < abs(measured.value - np.linalg.norm(np.subtract(*pins)))
        until(lambda: strain() > LITTLE)

        # Occlude and come near: the tip is where it is, and as near to the zone as it is.
        film.play({PULLED: filmed(PULLED, tip)})

        def tips() -> Any:
            rows = until(lambda: node.latest(TIPS)).points
            return len(rows) == 1 and np.isfinite(rows["x"][0]) and rows[0]

        row = until(tips)
        assert np.linalg.norm([row[axis] for axis in "xyz"] - tip) < 2 * error_of(row["confidence"])

        def near() -> Any:
            """What is told of the zone, and of which tip: that of its own frame."""
            said = until(lambda: told.latest(PROXIMITY))
            rows = said.points[(said.points["zone"] == 2) & np.isfinite(said.points["distance"])]
            seen = node.aligned([TIPS], said.stamp_ns, 1.0)
            return len(rows) and seen and (rows[0], seen[TIPS].points[0])

        (row, seen), truth = until(near), float(np.linalg.norm(BESIDE)) - RADIUS
        apart = np.linalg.norm([row[f"near_{axis}"] - seen[axis] for axis in "xyz"])
        assert row["id"] == seen["id"] and row["distance"] == pytest.approx(apart, abs=1e-6)
        assert truth < MARGIN and abs(row["distance"] - truth) < 2 * error_of(row["confidence"])

        # And back.
        film.play(dict(reversed(pull.items())) | rest)
        until(held)
        assert is_right()

        # Frozen: all stamps are fresh, and the node goes on.
        film.is_frozen = True
        assert watcher.blank_in_time().stamp_ns < max(film.shown) + (FROZEN + BUSY) * 1e9
        until(lambda: "picture_frozen" in watcher.status()["warning_codes"])
        film.is_frozen = False
        watcher.pictures(3, drawn=True)
        until(lambda: "picture_frozen" not in watcher.status()["warning_codes"])
