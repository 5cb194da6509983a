"""What holds the objects of the overlay: poses found from anchors, through motion, hiding and new starts."""

from __future__ import annotations

import re
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
from fake_pinner import FakePinner
from flat_scene import Scene, camera_in_front, flat_means, flat_scene
from synthetic import BASELINE, NORMAL, plane_depth, plane_result

from sags_node.clients.overlay.draw import Body
from sags_node.clients.overlay.frame import Anchor, TissueFrame
from sags_node.clients.overlay.held import AGAIN, ELSEWHERE, GONE, HeldObject
from sags_node.clients.overlay.mesh import Mesh, rod
from sags_node.clients.overlay.pinner import Pinner, Request
from sags_node.clients.overlay.pose import on_surface, surface_normal
from sags_node.clients.overlay.scene import ObjectSpec
from sags_node.clients.registration.rigid import on_a_line, rigid_fit
from sags_node.errors import SagsError, UsageError
from sags_node.geometry import invert, quat_to_matrix, transform
from sags_node.mapping.anchors import Anchors


def test_what_was_pinned_is_given_back_to_the_start_that_has_it() -> None:
    asked: list[Any] = []

    class Client:
        def __enter__(self) -> Client:
            return self

        def __exit__(self, *_: object) -> None: ...

        def request(self, op: str, args: Request, timeout: float) -> Any:
            asked.append((op, args))
            return {"id": len(asked), "session": "first"}

    pinner = Pinner(Client)  # type: ignore[arg-type]
    assert pinner.pin([{"u": 1, "v": 2}]).result(5) == [1]
    assert pinner.pin([{"u": 3, "v": 4}]).result(5) == [2]
    pinner.forget([1])
    pinner.close()
    assert asked[2:] == [("remove_anchor", {"id": 2, "session": "first"})]


# ---- poses -----------------------------------------------------------------------------------------------


def pose(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    T = np.eye(4)
    T[:3, :3] = quat_to_matrix(rng.normal(size=4))
    T[:3, 3] = rng.normal(size=3)
    return T


def test_a_rigid_motion_is_found_also_when_one_anchor_went_astray() -> None:
    rng = np.random.default_rng(4)
    model = rng.uniform(-0.02, 0.02, (6, 3))
    T = pose(5)
    places = np.asarray(transform(T, model))
    found, error = rigid_fit(model, places, np.ones(6))
    assert np.allclose(found, T, atol=1e-9) and error < 1e-9
    places[2] += [0.02, -0.01, 0.015]
    found, error = rigid_fit(model, places, np.ones(6))
    assert (
        np.linalg.norm(transform(found, model)[[0, 1, 3, 4, 5]] - places[[0, 1, 3, 4, 5]], axis=1).max()
        < 5e-4
    )
    flat = model * [1, 1, 0]  # a mirror image fits as well, but is no motion
    found, _ = rigid_fit(flat, np.asarray(transform(T, flat)), np.ones(6))
    assert np.linalg.det(found[:3, :3]) == pytest.approx(1) and np.allclose(found, T, atol=1e-9)


def test_points_on_a_line_hold_nothing() -> None:
    line = np.arange(4.0)[:, None] * [1, 2, 3]
    assert on_a_line(line) and on_a_line(np.zeros((3, 3)))
    assert not on_a_line(line + np.eye(4, 3))


PLANE = plane_result()
CAMERA = PLANE.pair.camera
FRAME = TissueFrame(5, 5, "s", 2, CAMERA, BASELINE, plane_depth(CAMERA), PLANE.observation.tissue, {})


def on_plane(u: int, v: int) -> np.ndarray:
    local = np.linalg.inv(CAMERA.K) @ (u, v, 1.0) * float(FRAME.depth[v, u])
    return np.asarray(transform(CAMERA.T_world_cam, local))


def test_one_anchor_gives_the_place_and_the_normal_of_the_surface() -> None:
    place = on_plane(30, 40)
    normal = surface_normal(FRAME, place)
    assert normal is not None
    towards = CAMERA.T_world_cam[:3, :3] @ NORMAL
    assert np.allclose(normal, -towards / np.linalg.norm(NORMAL), atol=1e-3)
    assert surface_normal(replace(FRAME, depth=FRAME.depth * np.float32(np.nan)), place) is None
    assert surface_normal(replace(FRAME, tissue=~np.ones_like(FRAME.tissue)), place) is None
    assert surface_normal(FRAME, CAMERA.T_world_cam[:3, 3] - CAMERA.T_world_cam[:3, 2]) is None
    right = CAMERA.T_world_cam[:3, 0]
    T = on_surface(place, np.array([0.0, 0, 0.001]), normal, right)
    assert np.allclose(T[:3, 2], normal) and T[:3, 0] @ right > 0.9
    assert np.allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3)) and np.linalg.det(T[:3, :3]) > 0
    assert np.allclose(transform(T, np.array([0, 0, 0.001])), place)


# ---- objects held by anchors -----------------------------------------------------------------------------


PIXELS = [[20, 20], [70, 30], [30, 55], [85, 50]]
PLACES = np.stack([on_plane(u, v) for u, v in PIXELS])
LOCAL = np.asarray(transform(invert(CAMERA.T_world_cam), PLACES))
LOCAL -= LOCAL.mean(0)  # m, in an object in their middle with the camera's axes
WORKER = ThreadPoolExecutor(1)
EVERYWHERE = Body(rod(np.full(3, -1.0), np.ones(3), (0, 0, 0)), 1.0, None)  # so it lies at any anchors


def held(
    anchors: list[Request] | list[dict[str, Any]],
    repin: bool = False,
    pinner: FakePinner | None = None,
    **more: Any,
) -> HeldObject:
    spec = ObjectSpec.model_validate({"shape": "sphere", "anchors": anchors, **more})
    return HeldObject(spec, "pin", pinner or FakePinner(), repin, 0, EVERYWHERE, WORKER)


def with_anchors(places: Any, confidence: Any = 1.0, frame: TissueFrame = FRAME) -> TissueFrame:
    """The frame with anchors 1, 2, ... at these places, hidden below a confidence of 1; None: no such row."""
    sure = np.broadcast_to(confidence, len(places))
    anchors = {
        i + 1: Anchor(np.asarray(place, np.float64), float(sure[i] == 1), float(sure[i]))
        for i, place in enumerate(places)
        if place is not None
    }
    return replace(frame, anchors=anchors)


def placed_at(thing: HeldObject, frame: TissueFrame) -> np.ndarray:
    """Its pose, once it has been pinned."""
    for _ in range(3):
        T = thing.place(frame)
        if T is not None:
            return T
    raise AssertionError(thing.reason)


def test_without_a_calibration_nothing_is_sure() -> None:
    """Its size beside the tissue is a guess then."""
    thing = held([{"pixel": [30, 40]}])
    known = with_anchors([on_plane(30, 40)])
    placed_at(thing, known)
    for metric in (True, False):
        put = thing.placed(replace(known, metric=metric))
        assert put is not None and put.is_sure is thing.is_sure is metric
    assert "calibrated" in str(thing.status()["unsure"])


def test_one_anchor_carries_the_object_and_keeps_its_direction_while_hidden() -> None:
    thing = held([{"pixel": [30, 40]}], pinner=(pinner := FakePinner()))
    T = placed_at(thing, with_anchors([on_plane(30, 40)]))
    assert pinner.asked == [[{"u": 30, "v": 40}]]
    assert np.allclose(T[:3, 3], on_plane(30, 40))
    hidden = replace(FRAME, tissue=~np.ones_like(FRAME.tissue))
    again = thing.place(with_anchors([on_plane(33, 41)], 0.3, hidden))
    assert again is not None and np.allclose(again[:3, :3], T[:3, :3])
    assert np.allclose(again[:3, 3], on_plane(33, 41))
    assert thing.place(with_anchors([on_plane(33, 41)], 0.05, hidden)) is None
    assert thing.reason == f"its anchor was not recognised for too long; {AGAIN}"


def test_many_anchors_carry_it_rigidly_whatever_is_hidden() -> None:
    thing = held([{"pixel": p} for p in PIXELS])
    T = placed_at(thing, with_anchors(PLACES))
    assert np.allclose(T, CAMERA.T_world_cam, atol=1e-6)  # coordinates of the camera
    motion = np.eye(4)
    motion[:3, :3] = quat_to_matrix(np.array([1.0, 0.1, -0.05, 0.08]))
    motion[:3, 3] = [0.003, -0.002, 0.001]
    moved = np.asarray(transform(motion, PLACES))
    for confidence in (1.0, [1, 1, 0.02, 1]):
        astray = moved.copy()
        if confidence != 1.0:
            astray[2] += 0.01  # of the hidden one
        T = placed_at(thing, with_anchors(astray, confidence))
        assert np.allclose(T, motion @ CAMERA.T_world_cam, atol=1e-6)
    assert thing.place(with_anchors(moved, [1, 1, 0.02, 0.02])) is None
    assert thing.reason == f"2 of its 4 anchors hold it, 3 are needed; {AGAIN}"


def test_of_anchors_in_sight_those_count_that_are_recognised() -> None:
    """One that is visible and not recognised may be on other tissue: here 1 mm off, too little to be taken
    for astray."""
    thing = held([{"pixel": p} for p in PIXELS])
    T = placed_at(thing, with_anchors(PLACES))
    assert thing.is_sure
    slipped = PLACES.copy()
    slipped[3] += [0.001, 0, 0]
    wrong, right = (
        {i + 1: Anchor(place, 1.0, sure[i]) for i, place in enumerate(slipped)}
        for sure in ([1.0, 1.0, 1.0, 1.0], [1.0, 1.0, 1.0, 0.05])
    )
    off = []
    for anchors in (wrong, right):
        found = thing.place(replace(FRAME, anchors=anchors))
        assert found is not None and thing.is_sure
        off.append(np.linalg.norm(transform(found @ invert(T), PLACES) - PLACES, axis=1).max())
    assert off[1] < 0.2 * off[0]
    few = {i + 1: Anchor(place, 1.0, 0.3 if i > 1 else 1.0) for i, place in enumerate(PLACES)}
    assert thing.place(replace(FRAME, anchors=few)) is not None and not thing.is_sure  # three hold a shape
    assert thing.status()["sure"] is False


TEXTURED = camera_in_front(128, 96, 100.0)


def textured(seed: int, frame: int) -> Scene:
    """A plane 80 mm away, with a texture of its own, in one of ten frames a second."""
    noise = np.random.default_rng(seed).uniform(0, 255, (96, 128)).astype(np.float32)
    picture = cv2.normalize(cv2.GaussianBlur(noise, (0, 0), 2), None, 20, 230, cv2.NORM_MINMAX)
    means = flat_means(TEXTURED, 0.08, 2.0)
    return flat_scene(TEXTURED, means, picture.astype(np.uint8), 0.08, frame, frame * 100_000_000)


@pytest.mark.fault("image: tissue around an anchor looks otherwise, in full view (simulated)")
def test_what_one_visible_anchor_holds_is_unsure_until_it_is_recognised_again() -> None:
    """The tissue around it looks otherwise for fifteen seconds, in full view."""
    anchors, thing = Anchors(), held([{"pixel": [60, 45]}])
    anchors.add_pixel(60, 45, *textured(0, 0))
    said: list[str] = []
    for number in range(230):
        observation, snapshot, view = textured(1 if 30 <= number < 180 else 0, number)
        anchors.update(observation, snapshot, view)
        anchors.age(number * 100_000_000)
        states = anchors.states()
        assert states.visibility[0] == 1
        known = {1: Anchor(states.points[0].astype(np.float64), 1.0, float(states.confidence[0]))}
        frame = TissueFrame(number, number, "s", 0, TEXTURED, BASELINE, view.depth, observation.tissue, known)
        placed = thing.place(frame) is not None
        said.append(("sure" if thing.is_sure else "unsure") if placed else str(thing.reason))
    assert said[:3] == ["being pinned", "being pinned", "sure"] and set(said[2:45]) == {"sure"}
    assert set(said[60:135]) == {"unsure"}  # from 2 s on without a sight of it, to 11 s
    assert set(said[150:180]) == {f"its anchor was not recognised for too long; {AGAIN}"}
    assert set(said[190:]) == {"sure"}


def test_named_points_of_the_object_come_to_lie_at_its_anchors() -> None:
    T = CAMERA.T_world_cam @ pose(3)
    model = np.asarray(transform(invert(T), PLACES))
    thing = held([{"pixel": p, "at": at.tolist()} for p, at in zip(PIXELS, model, strict=True)])
    assert np.allclose(placed_at(thing, with_anchors(PLACES)), T, atol=1e-6)
    in_world = held([{"place": place.tolist()} for place in PLACES], coordinates="world")
    assert np.allclose(placed_at(in_world, with_anchors(PLACES)), np.eye(4), atol=1e-6)


# ---- an object lies where its anchors are, or is not drawn ------------------------------------------------

SCALES = {"mm": 1e-3, "cm": 1e-2, "inch": 0.0254}  # m for one of a file's units


def of_file(at: np.ndarray | None, scale: float, around: Any = None, **more: Any) -> tuple[HeldObject, Any]:
    """A tube of a file, 30 mm long and centred on `around` (m), held by the first of `PIXELS`; the frame."""
    places = PLACES[: 4 if at is None else len(at)]
    anchors: list[dict[str, Any]] = [{"pixel": pixel} for pixel in PIXELS[: len(places)]]
    for anchor, said in zip(anchors, [] if at is None else at.tolist(), strict=False):
        anchor["at"] = said
    spec = ObjectSpec.model_validate({"file": "tube.stl", "scale": scale, "anchors": anchors, **more})
    ends = np.array([[-0.015, 0.0, 0.0], [0.015, 0.0, 0.0]]) + (0 if around is None else around)
    body = Body(rod(*ends, (0, 0, 0)), 1.0, None)
    return HeldObject(spec, "pin", FakePinner(), False, 0, body, WORKER), with_anchors(places)


@pytest.mark.parametrize("unit", SCALES)
@pytest.mark.parametrize("said", ["in the file's units", "in metres, as before", "in metres, and said"])
def test_named_points_are_read_in_the_files_units_or_in_metres_where_only_these_fit(
    unit: str, said: str, caplog: pytest.LogCaptureFixture
) -> None:
    in_metres = said != "in the file's units"
    more = {"at_units": "m"} if said.endswith("said") else {}
    thing, frame = of_file(LOCAL / (1 if in_metres else SCALES[unit]), SCALES[unit], **more)
    T = placed_at(thing, frame)
    assert np.allclose(T[:3, 3], PLACES.mean(0), atol=1e-6) and thing.is_sure and thing.unsure is None
    assert ("is read in metres" in caplog.text) == (said == "in metres, as before")  # never without a word


@pytest.mark.parametrize(("at", "offset"), [((0, 0, 5), 5e-3), ((0, 0, 0.005), 5e-3), ((0, 0, 0), 0.0)])
def test_so_is_that_of_a_single_anchor(at: tuple[float, ...], offset: float) -> None:
    thing, frame = of_file(np.array([at], np.float64), 1e-3)
    assert np.linalg.norm(placed_at(thing, frame)[:3, 3] - on_plane(*PIXELS[0])) == pytest.approx(offset)


@pytest.mark.parametrize(
    ("at", "around", "said"),
    [
        (None, None, r"5\d\.?\d* mm from its anchors: are the file's coordinates those of the camera"),
        (np.zeros((1, 3)), (0.1, 0, 0), r" 85 mm from its anchors: is `at` in the file's units"),
        (1e3 * LOCAL + (300, 0, 0), None, r"\d mm from its anchors: is `at` in the file's units"),
    ],
)  # fmt: skip
def test_what_does_not_lie_at_its_anchors_is_refused(at: np.ndarray | None, around: Any, said: str) -> None:
    """By more than its own size and 10 mm: it would flood the image, or be nowhere."""
    thing, frame = of_file(at, 1e-3, around)
    for _ in range(5):
        assert thing.place(frame) is None
    assert re.search(said, str(thing.reason)), thing.reason
    assert thing.status()["reason"] == thing.reason and thing.status()["anchors"] == []


@pytest.mark.parametrize(("factor", "sure"), [(1.0, True), (1.1, True), (2.0, False), (0.5, False)])
def test_what_does_not_fit_its_anchors_is_unsure_and_says_why(factor: float, sure: bool) -> None:
    """The anchors are up to 22 mm from their middle: at 1.1 of that they are off by 2.2 mm at most."""
    assert 0.02 < np.linalg.norm(LOCAL, axis=1).max() < 0.025
    thing, frame = of_file(1e3 * factor * LOCAL, 1e-3, at_units="file")
    placed_at(thing, frame)
    assert thing.is_sure == sure and thing.status()["sure"] == sure
    assert sure or "mm from where its shape has it: check `at`" in thing.status()["unsure"]


@pytest.mark.parametrize(
    ("factors", "under", "said"),
    [
        ((-1, -1, 1), 0.0, "as -x, -y, z (one is RAS, the other LPS)"), ((1, 1, 1), 0.0, None),
        ((1, 1, 1), 0.02, None),  # m: what lies under the tissue is held by places over it
    ],
)  # fmt: skip
def test_points_that_lie_on_the_file_in_other_axes_only_are_unsure(
    factors: Any, under: float, said: str | None
) -> None:
    """A wall of 0.1 m through all anchors, and their points in Slicer's RAS."""
    local = LOCAL + np.array([0.03, 0.02, 0.05])
    _, _, (along, across, _) = np.linalg.svd(local - local.mean(0))
    ends = [local.mean(0) + a * along + b * across for a, b in ((-0.05, -0.05), (-0.05, 0.05), (0.1, 0))]
    wall = Mesh(np.float32(ends), np.array([[0, 1, 2]], np.int32), np.zeros((1, 3), np.float32))
    at = 1e3 * (local * factors - [0, 0, under])
    anchors = [{"pixel": pixel, "at": each.tolist()} for pixel, each in zip(PIXELS, at, strict=True)]
    spec = ObjectSpec.model_validate({"file": "a.stl", "scale": 1e-3, "anchors": anchors})
    thing = HeldObject(spec, "pin", FakePinner(), False, 0, Body(wall, 1.0, None), WORKER)
    placed_at(thing, with_anchors(PLACES))
    assert thing.is_sure == (said is None) and str(said or None) in str(thing.unsure)


@pytest.mark.fault("file: an object that was registered in another session of the node")
@pytest.mark.parametrize(
    ("registration", "recorded_s", "sure"),
    [
        ({"session": "s"}, None, True), ({"session": "t"}, None, False), ({}, None, True), (None, None, True),
        ({"session": "s", "epoch": 2}, None, True), ({"session": "s", "epoch": 1}, None, False),
        ({"session": "s", "epoch": 1}, 3.0, True), ({"session": "t", "epoch": 2}, 3.0, False),
    ],
)  # fmt: skip
def test_what_was_registered_in_another_session_is_unsure(
    registration: Any, recorded_s: float | None, sure: bool
) -> None:
    """`s` is the session of the frame, 2 its epoch: of a recording, each turn has its own."""
    thing, frame = of_file(1e3 * LOCAL, 1e-3, at_units="file", registration=registration)
    placed_at(thing, replace(frame, recorded_s=recorded_s))
    assert thing.is_sure == sure and thing.unsure == (None if sure else ELSEWHERE)


def test_a_recording_that_loops_pins_again_where_it_was_pinned() -> None:
    """Only when it comes to the same place: until then the pixel shows other tissue. A model that is reset
    meanwhile stays lost until then."""
    place = on_plane(30, 40)
    thing = held([{"pixel": [30, 40]}], pinner=(pinner := FakePinner()))
    here = with_anchors([place])
    for recorded_s in (1.0, 1.1, 1.2):
        T = thing.place(replace(here, recorded_s=recorded_s))
    assert T is not None and len(pinner.asked) == 1
    gone = np.full(3, np.nan)
    lost, again = with_anchors([gone]), with_anchors([gone, place])
    for recorded_s in (1.3, 5.9, 0.0, 0.9):
        assert thing.place(replace(lost, recorded_s=recorded_s)) is None
        assert thing.reason == f"lost: {GONE}" and len(pinner.asked) == 1
    for recorded_s in (1.0, 1.1, 1.2):
        T = thing.place(replace(again, recorded_s=recorded_s))
    assert T is not None and thing.status()["pinned"] == 2


def test_it_waits_for_tissue_with_depth_and_for_the_node() -> None:
    thing = held([{"pixel": [65, 30]}])  # columns 60 to 69 are an instrument
    assert thing.place(FRAME) is None and str(thing.reason).startswith(
        "pixel 65 30 shows no tissue: an instrument"
    )
    unknown = replace(FRAME, depth=FRAME.depth * np.float32(np.nan), tissue=np.ones_like(FRAME.tissue))
    assert thing.place(unknown) is None and thing.reason == "no depth at pixel 65 30"
    assert held([]).place(unknown) is None
    with pytest.raises(UsageError, match=r"pin 96 30 lies outside the left image of 96x64"):
        held([{"pixel": [96, 30]}]).place(FRAME)
    thing = held([{"pixel": [30, 30]}], pinner=(pinner := FakePinner()))
    pinner.refusal = SagsError("there are 256 anchors already")
    assert [thing.place(FRAME) for _ in range(2)] == [None, None]
    assert thing.reason == "there are 256 anchors already"


def test_the_default_place_is_the_middle_of_the_tissue() -> None:
    thing = held([], pinner=(pinner := FakePinner()))
    thing.place(FRAME)
    ((asked,),) = pinner.asked
    assert abs(asked["u"] - 43) < 8 and abs(asked["v"] - 32) < 3


@pytest.mark.parametrize("how", ["model", "node", "removed"])
@pytest.mark.parametrize("repin", [False, True])
def test_after_a_new_start_it_is_lost_or_pinned_anew(how: str, repin: bool) -> None:
    place = on_plane(30, 40)
    thing = held([{"pixel": [30, 40]}], repin, pinner := FakePinner())
    assert [thing.place(replace(with_anchors([place]), recorded_s=s)) for s in (1, 1, 1, 3)][-1] is not None
    after = {
        "model": with_anchors([np.full(3, np.nan)]),
        "node": replace(with_anchors([place]), session="another", recorded_s=2.0),
        "removed": with_anchors([None]),
    }[how]
    assert thing.place(after) is None and str(thing.reason).startswith("lost: ")
    kept = how == "model"  # the node looks for its anchors on
    assert (pinner.removed, pinner.forgotten) == (([], [1]) if how == "node" else ([] if kept else [1], []))
    if not repin:
        assert thing.place(after) is None and str(thing.reason).startswith("lost: ")
        assert (thing.place(with_anchors([place])) is not None) == kept
        return
    fresh = replace(with_anchors([np.full(3, np.nan), place]), session=after.session)
    assert np.allclose(placed_at(thing, fresh)[:3, 3], place)
    assert thing.status()["pinned"] == 2 and pinner.removed == ([] if how == "node" else [1])


def test_after_a_start_with_another_size_it_is_pinned_at_the_same_place_of_the_picture() -> None:
    thing = held([{"pixel": [30, 40]}], True, pinner := FakePinner())
    placed_at(thing, with_anchors([on_plane(30, 40)]))
    larger = {name: getattr(FRAME, name).repeat(2, 0).repeat(2, 1) for name in ("depth", "tissue")}
    for _ in range(2):
        thing.place(replace(FRAME, **larger, session="another"))
    assert pinner.asked == [[{"u": 30, "v": 40}], [{"u": 60.5, "v": 80.5}]]  # middles of pixels are integers


@pytest.mark.fault("model: the tissue at an object's anchors leaves it")
@pytest.mark.parametrize(("count", "least"), [(1, 1), (3, 3), (4, 3)])
def test_what_lost_its_anchors_comes_back_with_them_where_they_are_then(count: int, least: int) -> None:
    """With the node's NaN for all of them or some, also before it was placed first; never beside them."""
    places = PLACES[:count]
    moved = places + CAMERA.T_world_cam[:3, :3] @ [0.004, 0.002, 0.0]
    thing = held([{"pixel": p} for p in PIXELS[:count]], pinner=(pinner := FakePinner()))
    for _ in range(4):
        assert thing.place(with_anchors([np.full(3, np.nan), *places[1:]])) is None
    T = placed_at(thing, with_anchors(places))
    for found in range(count + 1):
        now = [place if i < found else np.full(3, np.nan) for i, place in enumerate(moved)]
        put = thing.place(with_anchors(now))
        assert (put is not None) == (found >= least)
        if put is None:
            assert AGAIN in str(thing.reason) and thing.status()["sure"] is False
        else:
            assert np.allclose(transform(put @ invert(T), places[:found]), moved[:found], atol=1e-6)
    assert thing.is_sure and len(pinner.asked) == 1 and pinner.removed == []
