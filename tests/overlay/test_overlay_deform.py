"""Objects that are bent with the tissue over them, and those that are checked against its surface."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Executor, Future
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
from flat_scene import camera_in_front

from sags_node.confidence import confidence_of
from sags_node.errors import SagsError
from sags_node.geometry import transform
from sags_node.overlay.draw import Body, Placed, draw
from sags_node.overlay.frame import Anchor, TissueFrame
from sags_node.overlay.held import HeldObject
from sags_node.overlay.mesh import Mesh
from sags_node.overlay.pinner import Pinner
from sags_node.overlay.scene import ObjectSpec
from sags_node.types import F64

CAMERA = camera_in_front(320, 256, 300.0)
WALL = 0.1  # m away
SURE = float(confidence_of(np.float32(1e-3)))  # nine of ten errors are below 1 mm
SIDE = np.linspace(-0.04, 0.04, 41)  # m
HOLD = [[x, y, WALL] for x in (-0.038, 0.038) for y in (-0.03, 0.03)]  # where its own anchors are
STATED = {"residual_p90_mm": 0.5, "share": 1.0}
Way = Callable[[F64], F64]


class AtOnce(Executor):
    def submit(self, fn: Any, /, *args: Any, **kwargs: Any) -> Future[Any]:
        done: Future[Any] = Future()
        try:
            done.set_result(fn(*args, **kwargs))
        except SagsError as error:
            done.set_exception(error)
        return done


class Node(Pinner):
    """A wall of tissue, and anchors in it that go where they are sent."""

    def __init__(self) -> None:
        self.places: dict[int, F64] = {}
        self.refusal: SagsError | None = None
        self.frames = 0

    def pin(self, requests: Any) -> Future[list[int]]:
        def pinned() -> list[int]:
            if self.refusal is not None:
                raise self.refusal
            for request in requests:
                self.places[len(self.places) + 1] = np.array([request[axis] for axis in "xyz"])
            return list(self.places)[-len(requests) :]

        return AtOnce().submit(pinned)

    def frame(self, way: Way = np.zeros_like, **changed: Any) -> TissueFrame:
        """The next one, a second later."""
        self.frames += 1
        shape = CAMERA.height, CAMERA.width
        anchors = {
            number: Anchor(place + way(place), 1.0, 1.0, SURE) for number, place in self.places.items()
        }
        frame = TissueFrame(
            self.frames, self.frames * 10**9, "s", 0, CAMERA, None, np.full(shape, WALL, np.float32),
            np.ones(shape, bool), anchors, np.full(shape, SURE, np.float32),
        )  # fmt: skip
        return replace(frame, **changed)


def layers(*depths: float) -> Body:
    """Squares of 80 mm at depths below the wall (m), of small triangles."""
    x, y = np.meshgrid(SIDE, SIDE)
    flat = np.stack([x.ravel(), y.ravel(), np.full(x.size, WALL)], 1)
    first = (np.arange(40)[:, None] * 41 + np.arange(40)).ravel()
    cells = np.concatenate(
        [np.stack([first, first + 1, first + 41], 1), np.stack([first + 42, first + 41, first + 1], 1)]
    )
    triangles = np.concatenate([cells + i * len(flat) for i in range(len(depths))]).astype(np.int32)
    # Deeper ones lie behind the same pixels.
    vertices = np.concatenate([flat * (WALL + depth) / WALL for depth in depths])
    return Body(
        Mesh(vertices.astype(np.float32), triangles, np.full((len(triangles), 3), 200, np.float32)),
        1.0,
        "organ",
    )


def held(node: Node, body: Body, **more: Any) -> HeldObject:
    anchors = [{"place": place, "at": place} for place in HOLD]
    spec = ObjectSpec.model_validate({"file": "organ.ply", "anchors": anchors, **more})
    return HeldObject(spec, "pin", node, False, 0.0, body, AtOnce())


def ready(node: Node, thing: HeldObject) -> Placed:
    """As it is when all is pinned."""
    for _ in range(6):
        put = thing.placed(node.frame())
    assert put is not None and put.is_sure, thing.unsure
    return put


def turned(place: F64) -> F64:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = cv2.Rodrigues(np.array([0.02, -0.05, 0.1]))[0], (0.003, -0.002, 0.004)
    return np.asarray(transform(T, place) - place)


def pulled(place: F64) -> F64:
    """By 8 mm towards the eye in the middle; a few um where the object's own anchors are."""
    fall = np.exp(-0.5 * (place[..., :2] ** 2).sum(-1) / 0.012**2)
    return np.asarray(fall[..., None] * np.array([0, 0, -0.008]))


@pytest.mark.parametrize("way", [np.zeros_like, turned])
def test_at_rest_it_is_exactly_the_rigid_object(way: Way) -> None:
    """Also where all goes as one: the rigid pose says it."""
    node, body = Node(), layers(0, 0.01)
    thing = held(node, body, deform=True)
    ready(node, thing)
    put = thing.placed(node.frame(way))
    assert put is not None and put.vertices is not None and put.is_sure
    assert np.array_equal(put.vertices, body.vertices)
    assert np.allclose(transform(put.T_world_body, np.array(HOLD)), HOLD + way(np.array(HOLD)), atol=1e-9)


def test_it_follows_the_surface_and_fades_to_the_rigid_motion_below() -> None:
    """As smoothstep, along the ray: half of it at half of `deform_depth_mm`, and nothing beyond."""
    depths = (0.0, 0.005, 0.01, 0.015, 0.02)
    node, body = Node(), layers(*depths)
    thing = held(node, body, deform=True, deform_depth_mm=20)
    ready(node, thing)
    put = thing.placed(node.frame(pulled))
    assert put is not None and put.vertices is not None and put.is_sure
    ways = (put.vertices - body.vertices).reshape(len(depths), -1, 3)
    true = pulled(body.vertices.reshape(ways.shape)[0])
    moved = np.linalg.norm(true, axis=1) > 0.002
    left = np.linalg.norm(transform(put.T_world_body, ways[0]) - true, axis=1)
    assert np.median(left[moved] / np.linalg.norm(true[moved], axis=1)) < 0.25 and left.max() < 0.004
    for depth, way in zip(depths, ways, strict=True):
        share = 1 - (depth / 0.02) ** 2 * (3 - 2 * depth / 0.02)
        assert np.allclose(way, share * ways[0], atol=2e-6)  # the first layer is at the wall to a um
    assert np.array_equal(ways[-1], np.zeros_like(ways[-1]))
    drawn, rigid = (draw(node.frame(), [each])[..., 3] for each in (put, replace(put, vertices=None)))
    assert (drawn > 0).sum() > 0 and not np.array_equal(drawn, rigid)


@pytest.mark.parametrize(
    "how", [{"confidence": 0.49}, {"depth_confidence": 0.49}, {"place": np.full(3, np.nan)}]
)
def test_what_is_not_sure_does_not_pull(how: dict[str, Any]) -> None:
    node, body = Node(), layers(0)
    thing = held(node, body, deform=True)
    ready(node, thing)
    frame = node.frame(pulled)
    astray = max(frame.anchors)
    kept = replace(frame.anchors[astray], place=frame.anchors[astray].place + 0.01)
    without = {number: each for number, each in frame.anchors.items() if number != astray}
    shapes = []
    for anchors in (without | {astray: replace(kept, **how)}, without, without | {astray: kept}):
        put = thing.placed(replace(frame, anchors=anchors))
        assert put is not None and put.vertices is not None
        shapes.append(put.vertices)
    assert np.array_equal(shapes[0], shapes[1]) and not np.array_equal(shapes[1], shapes[2])


def test_while_nothing_bends_it_it_is_drawn_as_unsure() -> None:
    """The node refuses more anchors for a while; later none of them is sure."""
    node = Node()
    thing = held(node, layers(0), deform=True)
    while thing.times_pinned == 0:
        thing.placed(node.frame())
    node.refusal = SagsError("there are 256 anchors already")
    for _ in range(4):
        put = thing.placed(node.frame())
    assert put is not None and not put.is_sure and put.vertices is None
    assert thing.status()["unsure"] == "it is drawn rigid: there are 256 anchors already"
    node.refusal = None
    ready(node, thing)
    assert thing.status()["deform"]["pulling"] == thing.status()["deform"]["anchors"] > 20
    frame = node.frame()
    lost = {n: each if n <= len(HOLD) else replace(each, confidence=0.1) for n, each in frame.anchors.items()}
    put = thing.placed(replace(frame, anchors=lost))
    assert put is not None and not put.is_sure and put.vertices is None
    assert "0 of its 64 anchors on the tissue over it are sure" in thing.status()["unsure"]


# ---- the check against the surface -----------------------------------------------------------------------


def checked(node: Node, thing: HeldObject, depth: Any, **changed: Any) -> dict[str, Any]:
    """What is said when the wall has been at a depth (m) for two seconds."""
    for _ in range(2):
        shape = CAMERA.height, CAMERA.width
        thing.placed(node.frame(depth=np.broadcast_to(np.float32(depth), shape).copy(), **changed))
    return thing.status()


def test_it_is_unsure_when_the_surface_is_farther_than_stated_and_the_depth_may_be_wrong() -> None:
    """0.5 mm stated, 1 mm of error: the limit is 1.5 mm."""
    node = Node()
    thing = held(node, layers(0), registration=STATED)
    ready(node, thing)
    said = checked(node, thing, WALL - 0.0014)
    assert said["residual_mm"] == pytest.approx(1.4, abs=0.02) and said["sure"]
    assert said["residual_limit_mm"] == pytest.approx(1.5, abs=0.01)
    said = checked(node, thing, WALL - 0.0016)
    assert not said["sure"] and "the surface is 1.6 mm off, 0.5 were stated" in said["unsure"]
    hidden = checked(node, thing, WALL, tissue=np.zeros((CAMERA.height, CAMERA.width), bool))
    assert hidden["residual_mm"] is None and not hidden["sure"]  # nothing says that it is right again
    assert checked(node, thing, WALL)["sure"]


def test_only_what_is_surely_measured_of_tissue_counts() -> None:
    """A third of the picture shows something else: an instrument, a guess, or what lay there before."""
    node, other = Node(), np.zeros((CAMERA.height, CAMERA.width), bool)
    other[:, : CAMERA.width // 3] = True
    depth = np.where(other, WALL - 0.02, WALL)
    for share, sure in ((0.6, True), (1.0, False)):
        thing = held(node, layers(0), registration=STATED | {"share": share})
        ready(node, thing)
        assert checked(node, thing, depth)["sure"] == sure
        assert checked(node, thing, depth, tissue=~other)["sure"]
        guessed = np.where(other, 0.4, SURE).astype(np.float32)
        assert checked(node, thing, depth, confidence=guessed)["sure"]


def test_it_is_looked_at_once_a_second_and_as_it_is_bent() -> None:
    node = Node()
    thing = held(node, layers(0), registration=STATED, deform=True)
    ready(node, thing)
    frame = node.frame(pulled)
    rays = (
        np.stack([*np.meshgrid(np.arange(320), np.arange(256)), np.ones((256, 320))], -1)
        @ np.linalg.inv(CAMERA.K).T
    )
    bulging = (WALL + pulled(WALL * rays)[..., 2]).astype(np.float32)
    for later in range(30):
        thing.placed(replace(frame, depth=bulging, stamp_ns=frame.stamp_ns + later * 10**8))
    assert thing.status()["sure"], thing.status()
    rigid = held(node, layers(0), registration=STATED)
    ready(node, rigid)
    frame = node.frame(depth=bulging)
    seen = []
    for later in range(21):
        rigid.placed(replace(frame, depth=bulging if later == 10 else np.full_like(bulging, WALL),
                             stamp_ns=frame.stamp_ns + later * 10**8))  # fmt: skip
        seen.append(rigid.status()["sure"])
    assert seen == [True] * 11 + [False] * 10


def test_without_a_stated_residual_nothing_is_checked() -> None:
    node = Node()
    for more in ({}, {"registration": {"verdict": "good"}}):
        thing = held(node, layers(0), **more)
        ready(node, thing)
        said = checked(node, thing, WALL - 0.02)
        assert said["sure"] and not {"residual_mm", "residual_limit_mm", "deform"} & said.keys()
