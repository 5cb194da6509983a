"""A model placed on tissue by pairs of points and its surface: how exactly, what is told, what is refused."""

import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from bridging import SEEN, anchored, anchored_at, sockets
from command_line import refused
from synthetic import at_frame, stream
from waiting import until

from sags_node.clients.overlay.registering import frames_of
from sags_node.clients.registration.register import Registration, register
from sags_node.clients.registration.rigid import kabsch, nine_of_ten, of_pairs, picking_error
from sags_node.clients.registration.surfaces import MIRROR, Shape, Surface
from sags_node.geometry import project, transform
from sags_node.messaging.address import NodeAddress
from sags_node.phantom.scene import Phantom, PhantomScene
from sags_node.types import F64, I32, AnchorsAhead, Camera

WIDTH, HEIGHT = 320, 256
SCENE = PhantomScene(seconds=4.0, width=WIDTH, height=HEIGHT, seed=1, still_tissue=True)
AWAY = np.eye(4)  # from the world to the model's own coordinates
AWAY[:3, :3], AWAY[:3, 3] = cv2.Rodrigues(np.array([0.4, -0.9, 0.3]))[0], (0.03, -0.2, 0.1)
PICKS = np.array([[120, 80], [230, 80], [240, 170], [150, 200], [160, 130]])  # px; no tool comes there
DEEP = 1.25  # times as far away as a point of the surface


# ---- what is told ----------------------------------------------------------------------------------------


def test_the_error_told_is_that_of_fitzpatrick() -> None:
    """His sum over the principal axes of the points, against the trace of what is propagated here."""
    rng = np.random.default_rng(0)
    points, target, error = rng.normal(0, [0.04, 0.02, 0.01], (6, 3)), rng.normal(0, 0.05, 3), 1e-3
    points -= points.mean(0)
    axes = np.linalg.svd(points)[2]
    squares = np.square(target) @ np.zeros(3)
    for axis in axes:
        from_axis = points - np.outer(points @ axis, axis)
        squares += np.sum((target - target @ axis * axis) ** 2) / np.mean(np.sum(from_axis**2, axis=1))
    fitzpatrick = 3 * error**2 / len(points) * (1 + squares / 3)
    arms = np.hstack([np.cross(np.tile(target, (3, 1)), np.eye(3)), np.eye(3)])
    told = arms @ np.linalg.inv(of_pairs(points, error)) @ arms.T
    assert np.trace(told) == pytest.approx(fitzpatrick)


@pytest.mark.parametrize(("shape", "quantile"), [((1, 1, 1), 2.500), ((1, 1, 0), 2.146), ((1, 0, 0), 1.645)])
def test_nine_of_ten_errors_are_below_what_is_told(shape: tuple[int, ...], quantile: float) -> None:
    """In three, two and one directions: tables of chi squared. Wilson and Hilferty are 1.3 % off in one."""
    covariance = np.zeros((6, 6))
    covariance[3:, 3:] = 1e-6 * np.diag(shape)
    assert nine_of_ten(covariance, np.zeros(3), np.zeros(3)) == pytest.approx(1e-3 * quantile, rel=0.015)


@pytest.mark.parametrize(("count", "picked"), [(3, 0.5e-3), (3, 1e-3), (5, 1e-3), (12, 1e-3), (20, 3e-3)])
def test_what_is_told_of_the_pairs_holds(count: int, picked: float) -> None:
    """Of six hundred draws: 0.86 is three standard deviations below nine of ten. Few pairs say little of how
    well they were picked, so picks that are worse than 1 mm are known by many pairs only."""
    rng = np.random.default_rng(count)
    within = 0
    for _ in range(600):
        at = rng.normal(0, 0.03, (count, 3))
        places = at + rng.normal(0, picked, at.shape)
        T = kabsch(at, places, np.full(count, 1 / count))
        error = picking_error(places - transform(T, at))
        told = nine_of_ten(np.linalg.inv(of_pairs(at - at.mean(0), error)), np.full(3, 0.03), np.zeros(3))
        within += np.linalg.norm(transform(T, at.mean(0) + 0.03) - at.mean(0) - 0.03) <= told
    assert within / 600 > 0.86


# ---- the fit ---------------------------------------------------------------------------------------------


class Organ:
    """A part of the phantom's tissue as a model, and what an exact camera measures of all of it."""

    def __init__(self) -> None:
        phantom = Phantom(SCENE)
        eye = phantom.rig.left
        self.camera = Camera(WIDTH, HEIGHT, eye.P[:, :3].copy(), np.eye(4))
        _, self.depth = phantom.still(0.0).look(self.camera, 1)
        vertices = phantom.tissue.vertices(0.0).reshape(-1, 3).astype(np.float64)
        triangles = phantom.tissue.faces.astype(np.int32)
        pixels, _ = project(self.camera, vertices[triangles].mean(1))
        part = np.linalg.norm((pixels - [160, 130]) / [120, 95], axis=1) < 1
        used, numbers = np.unique(triangles[part], return_inverse=True)
        self.vertices = np.asarray(transform(AWAY, vertices[used]))
        self.triangles: I32 = numbers.reshape(-1, 3).astype(np.int32)
        self.model = Shape(self.vertices, self.triangles)
        rays = np.concatenate([PICKS, np.ones((len(PICKS), 1))], 1) @ np.linalg.inv(self.camera.K).T
        self.picks = rays * self.depth[PICKS[:, 1], PICKS[:, 0]][:, None].astype(np.float64)
        self.at = np.asarray(transform(AWAY, self.picks))
        self.targets = np.asarray(transform(AWAY, DEEP * self.picks))
        self.surface = self.seen(self.depth)

    def seen(self, depth: Any) -> Surface:
        sure = np.full(depth.shape, 0.85, np.float32)
        return Surface.of_depth(depth, sure, np.ones(depth.shape, np.bool_), self.camera)

    def off(self, found: Registration) -> F64:
        assert found.T_world_model is not None
        return np.linalg.norm(transform(found.T_world_model, self.targets) - DEEP * self.picks, axis=1)


@pytest.fixture(scope="module")
def organ() -> Organ:
    return Organ()


def picked(organ: Organ, seed: int) -> F64:
    return organ.picks + np.random.default_rng(seed).normal(0, 1e-3, organ.picks.shape)


def fitted(organ: Organ, **changed: Any) -> Registration:
    """From what is true of the organ but for what is changed."""
    given: dict[str, Any] = {"model": organ.model, "at": organ.at, "places": organ.picks}
    return register(**given | {"surface": organ.surface, "targets": organ.targets} | changed)


@pytest.mark.parametrize("seed", range(4))
def test_the_surface_makes_it_better_than_the_pairs_and_no_worse_than_told(organ: Organ, seed: int) -> None:
    found = fitted(organ, places=picked(organ, seed))
    assert found.verdict == "good" and found.expected is not None and found.expected_by_pairs is not None
    assert (organ.off(found) < found.expected).all() and (found.expected < found.expected_by_pairs).all()
    assert np.median(organ.off(found)) < 1.5e-3
    assert found.share > 0.95


def test_what_lies_over_a_part_of_it_does_not_pull(organ: Organ) -> None:
    """A fifth of the image shows something 6 mm nearer, all over the model's middle."""
    depth = organ.depth.copy()
    depth[100:160, 110:200] -= 0.006
    clean, found = (
        fitted(organ, places=picked(organ, 0), surface=organ.seen(d)) for d in (organ.depth, depth)
    )
    assert np.abs(organ.off(found) - organ.off(clean)).max() < 0.5e-3
    assert found.share < 0.9


# ---- refused ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("factor", "said"),
    [
        (1000, "divide --scale by 1000"), (1e-3, "multiply --scale by 1000"), (0.1, "multiply --scale by 10"),
        (25.4, "mm for inch"), (3, "the pairs do not belong together"),
    ],
)  # fmt: skip
def test_a_wrong_unit_is_refused(organ: Organ, factor: float, said: str) -> None:
    model = Shape(factor * organ.vertices, organ.triangles)
    found = fitted(organ, model=model, at=factor * organ.at, targets=factor * organ.targets)
    assert found.verdict == "refused" and said in found.reason


@pytest.mark.parametrize("pairs", [3, 5])  # three are as well fitted by their mirror image
def test_a_mirrored_file_is_refused(organ: Organ, pairs: int) -> None:
    at, places = organ.at[:pairs] * MIRROR, picked(organ, 1)[:pairs]
    model, targets = organ.model.mirrored(), organ.targets * MIRROR
    found = fitted(organ, model=model, at=at, places=places, targets=targets)
    assert found.verdict == "refused" and "handedness" in found.reason


@pytest.mark.fault("file: points of a model in other axes (RAS for LPS) or another unit than its file")
@pytest.mark.parametrize(
    ("factors", "moved", "said"),
    [
        ((-1, -1, 1), 0.2, "-x, -y, z (one is RAS, the other LPS)"), ((1, 1, -1), 0.2, "x, y, -z"),
        ((1e-3, 1e-3, 1e-3), 0.2, "x, y, z times 1e+03"), ((-1, -1, 1), 0.0, "-x, -y, z"),
    ],
)  # fmt: skip
def test_points_in_other_axes_or_another_unit_than_the_file_are_refused(
    organ: Organ, factors: Any, moved: float, said: str
) -> None:
    """Wherever the file has its origin, with picks that are 1 mm wrong."""
    away = np.array([moved, -moved, 2 * moved]) - organ.vertices.mean(0)
    changed = {"model": Shape(organ.vertices + away, organ.triangles), "targets": organ.targets + away}
    at = organ.at + away + np.random.default_rng(3).normal(0, 3e-4, organ.at.shape)
    found = fitted(organ, at=at * factors, **changed)
    assert found.verdict == "refused" and f"as {said}" in found.reason and "mm from the file" in found.reason
    assert fitted(organ, at=at, **changed).verdict == "good"


def on_a_line(points: F64) -> F64:
    return np.asarray(points[0] + np.linspace(0, 1, 4)[:, None] * (points[1] - points[0]))


@pytest.mark.parametrize(
    ("at", "places", "said"),
    [
        pytest.param(lambda at: at[:2], lambda at: at[:2], "2 pairs: give 3 to 20", id="two pairs"),
        pytest.param(on_a_line, on_a_line, "lie on a line", id="pairs on a line"),
        pytest.param(np.copy, lambda at: np.add(at, [0.3, 0, 0]), "in sight", id="beside what is seen"),
        pytest.param(np.copy, lambda at: at[[1, 0, 2, 3, 4]], "fit each other to", id="two exchanged"),
        pytest.param(
            lambda at: at + np.eye(5)[:, 2:3] * (0.04, 0, 0.03), np.copy,
            "mm from the model: are these points of this file", id="one beside the model",
        ),
    ],
)  # fmt: skip
def test_what_is_out_of_sight_and_pairs_that_do_not_fit_are_refused(
    organ: Organ, at: Callable[[F64], F64], places: Callable[[F64], F64], said: str
) -> None:
    found = fitted(organ, at=at(organ.at), places=places(organ.picks))
    assert found.verdict == "refused" and said in found.reason


@pytest.mark.parametrize("shape", ["plane", "ball", "tube"])
def test_an_even_shape_is_refused(shape: str) -> None:
    """However well it fits: it could lie elsewhere as well."""
    rng = np.random.default_rng(0)
    x, y = np.meshgrid(np.linspace(-0.03, 0.03, 61), np.linspace(-0.03, 0.03, 61))
    squares = {"plane": 0 * x, "ball": x**2 + y**2, "tube": x**2}[shape]
    points = np.stack([x, y, 0.08 + 0.2 * (shape == "plane") * x + 0.05 - np.sqrt(0.05**2 - squares)], -1)
    first = (np.arange(10, 50)[:, None] * 61 + np.arange(10, 50)).ravel()
    halves = [[first, first + 1, first + 61], [first + 62, first + 61, first + 1]]
    triangles = np.concatenate([np.stack(half, 1) for half in halves]).astype(np.int32)
    vertices = points.reshape(-1, 3)
    at = vertices[rng.choice(first, 6, replace=False)]
    measured = vertices + rng.normal(0, 2e-4, vertices.shape) * [0, 0, 1]
    surface = Surface(measured, np.full(len(measured), 4e-4), np.zeros(3))
    found = register(Shape(vertices, triangles), at, at + rng.normal(0, 1e-3, at.shape), surface, at)
    assert found.verdict == "refused" and "its shape is even" in found.reason


# ---- the command, beside a node --------------------------------------------------------------------------


def written(organ: Organ, folder: Path) -> Path:
    """The organ in mm, and its pairs, in a folder."""
    import open3d as o3d

    vertices, triangles = o3d.utility.Vector3dVector(1e3 * organ.vertices), organ.triangles
    mesh = o3d.geometry.TriangleMesh(vertices, o3d.utility.Vector3iVector(triangles))
    assert o3d.io.write_triangle_mesh(str(folder / "organ.ply"), mesh)
    at, targets = ((1e3 * points).tolist() for points in (organ.at, organ.targets))
    pairs = [{"pixel": pixel, "at": each} for pixel, each in zip(PICKS.tolist(), at, strict=True)]
    (folder / "pairs.yaml").write_text(yaml.safe_dump({"pairs": pairs, "targets": targets}))
    return folder


@pytest.mark.live
def test_frames_of_before_a_gap_are_not_used_with_those_after_it(tmp_path: Path) -> None:
    """As where frames are held for a while: an organ may lie elsewhere since. Anchors that somebody wants
    ahead lie in them where they were seen, as the surface does."""
    seconds, gap, states = 1.0, 1.5, anchored().anchors
    ahead = AnchorsAhead(np.full(4, np.float32(0.1)), states.points + np.float32(0.005), states.pixels)
    expected = replace(anchored(), anchors=replace(states, ahead=ahead))
    with sockets(tmp_path) as running, ThreadPoolExecutor(1) as pool:
        looking = pool.submit(frames_of, NodeAddress(run_dir=tmp_path), seconds)
        until(lambda: running.poll(10) or running.wanted("tf"))
        now_ns = time.time_ns()
        for number in range(12):  # of one moment, however long this takes
            running.publish_result(at_frame(anchored(), number, now_ns + number), dropped=0)
            running.poll(30)
        time.sleep(gap)
        assert not looking.done()
        resumed = time.time()
        with stream(running, lambda number: at_frame(expected, number, time.time_ns())):
            seen = looking.result(60)
    stamps = [frame.stamp_ns * 1e-9 for frame in seen]
    assert np.allclose([frame.anchors[SEEN].place for frame in seen], states.points[0])
    assert stamps[0] > resumed and np.diff(stamps).max() < seconds
    assert stamps[-1] - stamps[0] > 0.89 * seconds


POINT = "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\n"


@pytest.mark.live
def test_what_the_command_refuses(organ: Organ, tmp_path: Path) -> None:
    files = written(organ, tmp_path)
    pairs = yaml.safe_load((files / "pairs.yaml").read_text())

    def says(code: int, changed: dict[str, Any], *more: object, said: tuple[str, ...]) -> None:
        (files / "pairs.yaml").write_text(yaml.safe_dump(pairs | changed))
        given = ("--points", files / "pairs.yaml", "-o", files / "out.yaml", "--run-dir", tmp_path)
        refused(code, "register", files / "organ.ply", *given, *more, said=said)
        assert not (files / "out.yaml").exists()

    def first(**changed: Any) -> dict[str, Any]:
        return {"pairs": [{"at": pairs["pairs"][0]["at"]} | changed, *pairs["pairs"][1:]]}

    with sockets(tmp_path) as running, stream(running, anchored_at):
        says(2, first(pixel=[900, 3]), said=("pair 1", "outside the image of 96x64"))
        says(1, first(anchor=77), said=("pair 1: there is no anchor 77; the node has ",))
        says(2, first(), said=("pairs.yaml: pairs.0", "either pixel: [u, v] or anchor: NUMBER"))
        says(2, {"pears": 3}, said=("unknown key 'pears'", "did you mean 'pairs'?"))
        says(2, {}, "--scale", "1", said=("set scale: 0.001",))
        says(2, {}, "--scale", "5000", said=("organ.ply: scale", "or equal to 1000 (got 5000.0)"))
        says(1, {}, "--ns", "other", said=("no node runs as 'other'",))
        for name in ("organ.ply", "pairs.yaml"):  # given again, -o counts
            says(2, {}, "--force", "-o", files / name, said=(f"{name} is read by this command",))
        (files / "organ.ply").write_text(f"{POINT}end_header\n0 0 0\n")
        says(2, {}, said=("holds no triangles",))
