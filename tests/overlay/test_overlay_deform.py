"""Objects that are bent with the tissue over them, and those that are checked against its surface."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
from fake_pinner import FakePinner
from flat_scene import camera_in_front

from sags_node.clients.overlay.draw import Body, Placed, draw
from sags_node.clients.overlay.frame import Anchor, TissueFrame
from sags_node.clients.overlay.held import HeldObject
from sags_node.clients.overlay.mesh import Mesh
from sags_node.clients.overlay.scene import ObjectSpec
from sags_node.confidence import confidence_of
from sags_node.errors import SagsError
from sags_node.geometry import transform
from sags_node.types import F64

CAMERA, SHAPE, WALL = camera_in_front(320, 256, 300.0), (256, 320), 0.1  # m away
SURE = float(confidence_of(np.float32(1e-3)))  # nine of ten errors are below 1 mm
HOLD = np.array([[x, y, WALL] for x in (-0.038, 0.038) for y in (-0.03, 0.03)])  # its own anchors
STATED = {"registration": {"residual_p90_mm": 0.5}}


WORKER = ThreadPoolExecutor(1)


class Node(FakePinner):
    """A wall of tissue, and anchors in it that go where they are sent."""

    frames = 0

    def frame(self, way: Any = np.zeros_like, depth: Any = WALL, **changed: Any) -> TissueFrame:
        """The next one, a second later."""
        self.frames += 1
        places = {number: np.array(place) for number, place in self.places.items()}
        anchors = {number: Anchor(at + way(at), 1.0, 1.0, SURE) for number, at in places.items()}
        depth, sure = (np.broadcast_to(np.float32(each), SHAPE).copy() for each in (depth, SURE))
        tissue, stamp = np.ones(SHAPE, bool), self.frames * 10**9
        return replace(TissueFrame(1, stamp, "s", 0, CAMERA, None, depth, tissue, anchors, sure), **changed)


def held(node: Node, depths: tuple[float, ...] = (0.0,), **more: Any) -> tuple[HeldObject, Body]:
    """Squares of 80 mm at depths below the wall (m), the deeper ones behind the same pixels; pinned."""
    x, y = np.meshgrid(*2 * [np.linspace(-0.04, 0.04, 41)])
    flat = np.stack([x.ravel(), y.ravel(), np.full(x.size, WALL)], 1)
    first = (np.arange(40)[:, None] * 41 + np.arange(40)).ravel()
    halves = [[first, first + 1, first + 41], [first + 42, first + 41, first + 1]]
    cells = np.concatenate([np.stack(half, 1) for half in halves])
    triangles = np.concatenate([cells + i * len(flat) for i in range(len(depths))]).astype(np.int32)
    vertices = np.concatenate([flat * (WALL + depth) / WALL for depth in depths]).astype(np.float32)
    body = Body(Mesh(vertices, triangles, np.full((len(triangles), 3), 200, np.float32)), 1.0, None)
    anchors = [{"place": place, "at": place} for place in HOLD.tolist()]
    spec = ObjectSpec.model_validate({"file": "organ.ply", "anchors": anchors, **more})
    thing = HeldObject(spec, "pin", node, False, 0.0, body, WORKER)
    for _ in range(6):
        placed(thing, node.frame())
    assert thing.is_sure or node.refusal, thing.unsure
    return thing, body


def placed(thing: HeldObject, frame: TissueFrame) -> Placed | None:
    """And all that is to be done in the background is done."""
    put = thing.placed(frame)
    WORKER.submit(int).result()
    return put


def bent(thing: HeldObject, frame: TissueFrame) -> tuple[Placed, F64]:
    put = placed(thing, frame)
    assert put is not None and put.vertices is not None and put.is_sure
    return put, put.vertices


def turned(place: F64) -> F64:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = cv2.Rodrigues(np.array([0.02, -0.05, 0.1]))[0], (0.003, -0.002, 0.004)
    return np.asarray(transform(T, place) - place)


def pulled(place: F64) -> F64:
    """By 8 mm towards the eye in the middle, and some um where the object's own anchors are."""
    fall = np.exp(-0.5 * (place[..., :2] ** 2).sum(-1) / 0.012**2)
    return np.asarray(fall[..., None] * np.array([0, 0, -0.008]))


@pytest.mark.parametrize("way", [np.zeros_like, turned])
def test_at_rest_it_is_exactly_the_rigid_object(way: Any) -> None:
    """Also where all goes as one: the rigid pose says it."""
    thing, body = held(node := Node(), (0.0, 0.01), deform=True)
    put, vertices = bent(thing, node.frame(way))
    assert np.array_equal(vertices, body.vertices)
    assert np.allclose(transform(put.T_world_body, HOLD), HOLD + way(HOLD), atol=1e-9)


def test_it_follows_the_surface_and_fades_to_the_rigid_motion_below() -> None:
    """Along the ray, as smoothstep: half of it at half of `deform_depth_mm`, and nothing beyond."""
    depths = (0.0, 0.005, 0.01, 0.015, 0.021)
    thing, body = held(node := Node(), depths, deform=True, deform_depth_mm=20)
    put, vertices = bent(thing, node.frame(pulled))
    rest = body.vertices.reshape(len(depths), -1, 3)
    ways, true = vertices.reshape(rest.shape) - rest, pulled(rest[0])
    rigid, left = np.linalg.norm(true, axis=1), np.linalg.norm(ways[0] - true, axis=1)
    assert np.median((left / rigid)[rigid > 0.002]) < 0.25 and left.max() < 0.004  # half of the pull
    for depth, way in zip(depths[:-1], ways, strict=False):
        share = 1 - (depth / 0.02) ** 2 * (3 - 2 * depth / 0.02)
        assert np.allclose(way, share * ways[0], atol=2e-6)  # the image has the wall to 1e-8 m
    assert not ways[-1].any()
    drawn = [draw(node.frame(), [each])[..., 3] for each in (put, replace(put, vertices=None))]
    assert drawn[0].any() and not np.array_equal(*drawn)


@pytest.mark.parametrize(
    "how", [{"confidence": 0.49}, {"depth_confidence": 0.49}, {"place": np.full(3, np.nan)}]
)
def test_what_is_not_sure_does_not_pull(how: dict[str, Any]) -> None:
    thing, _ = held(node := Node(), deform=True)
    frame = node.frame(pulled)
    one = max(frame.anchors)
    astray = replace(frame.anchors[one], place=frame.anchors[one].place + 0.01)
    without = {number: each for number, each in frame.anchors.items() if number != one}
    unsure, gone, sure = (
        bent(thing, replace(frame, anchors=without | more))[1]
        for more in ({one: replace(astray, **how)}, {}, {one: astray})
    )
    assert np.array_equal(unsure, gone) and not np.array_equal(sure, gone)


def test_while_nothing_bends_it_it_is_drawn_as_unsure() -> None:
    """The node has no room for more anchors until it is asked again; later none of them is sure."""
    node = Node()
    node.refusal = SagsError("no room")
    thing, _ = held(node, deform=True)
    node.refusal = None
    while thing.times_pinned == 0:  # its own anchors
        placed(thing, node.frame())
    node.refusal = SagsError("no room")
    put = [placed(thing, node.frame()) for _ in range(3)][-1]
    assert put is not None and not put.is_sure and put.vertices is None
    assert thing.status()["unsure"] == "it is drawn rigid: no room"
    node.refusal = None
    assert [placed(thing, node.frame()) for _ in range(4)] and thing.is_sure
    anchors, own = node.frame().anchors, len(HOLD)
    lost = {n: each if n <= own else replace(each, confidence=0.1) for n, each in anchors.items()}
    put = placed(thing, node.frame(anchors=lost))
    assert put is not None and not put.is_sure and put.vertices is None
    assert thing.status()["unsure"].endswith("0 of its 64 anchors on the tissue over it are sure")


# ---- the check against the surface -----------------------------------------------------------------------


def checked(node: Node, thing: HeldObject, depth: Any, **changed: Any) -> dict[str, Any]:
    """What is said when the wall has been at a depth (m) for two seconds."""
    for _ in range(2):
        placed(thing, node.frame(depth=depth, **changed))
    return thing.status()


def test_it_is_unsure_where_the_surface_is_farther_than_stated_and_than_depths_err() -> None:
    """0.5 mm stated and 1 mm of error: the limit is 1.5 mm. Without a statement nothing is checked."""
    thing, _ = held(node := Node(), **STATED)
    said = checked(node, thing, WALL - 0.0014)
    assert said["sure"] and said["residual_mm"] == pytest.approx(1.4, abs=0.02)
    assert said["residual_limit_mm"] == pytest.approx(1.5, abs=0.01)
    said = checked(node, thing, WALL - 0.0016)
    assert not said["sure"] and "the surface is 1.6 mm off, 0.5 were stated" in said["unsure"]
    hidden = checked(node, thing, WALL, tissue=np.zeros(SHAPE, bool))
    assert hidden["residual_mm"] is None and not hidden["sure"]  # nothing says that it is right again
    assert checked(node, thing, WALL)["sure"]
    for more in ({}, {"registration": {"verdict": "good"}}):
        thing, _ = held(node := Node(), **more)
        said = checked(node, thing, WALL - 0.02)
        assert said["sure"] and not {"residual_mm", "residual_limit_mm", "deform"} & said.keys()


@pytest.mark.parametrize(("share", "sure"), [(0.6, True), (1.0, False)])
def test_only_what_is_surely_measured_of_the_tissue_that_matched_counts(share: float, sure: bool) -> None:
    """A third of the image shows something else: tissue that lay there before, an instrument, a guess."""
    thing, _ = held(node := Node(), registration={"residual_p90_mm": 0.5, "share": share})
    other = np.broadcast_to(np.arange(SHAPE[1]) < SHAPE[1] // 3, SHAPE)
    depth = np.where(other, WALL - 0.02, WALL)
    assert checked(node, thing, depth)["sure"] == sure
    assert checked(node, thing, depth, tissue=~other)["sure"]
    assert checked(node, thing, depth, confidence=np.where(other, 0.4, SURE).astype(np.float32))["sure"]


def test_it_is_looked_at_once_a_second_as_it_is_bent() -> None:
    """Tissue is pulled for a tenth of a second, and then for good."""
    u, v = np.meshgrid(np.arange(SHAPE[1]), np.arange(SHAPE[0]))
    rays = np.stack([u, v, np.ones(SHAPE)], -1) @ np.linalg.inv(CAMERA.K).T
    bulge = WALL + pulled(WALL * rays)[..., 2]
    (bending, _), (rigid, _) = held(one := Node(), **STATED, deform=True), held(two := Node(), **STATED)
    seen = []
    for tenth in range(31):
        pulls = tenth == 5 or tenth >= 9
        for node, thing in ((one, bending), (two, rigid)):
            frame = node.frame(pulled if pulls else np.zeros_like, bulge if pulls else WALL)
            placed(thing, replace(frame, stamp_ns=10**10 + tenth * 10**8))
        seen.append((bending.status()["sure"], rigid.status()["sure"]))
    assert seen == [(True, True)] * 11 + [(True, False)] * 20
