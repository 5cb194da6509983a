"""Tips and forbidden zones: distances known by arithmetic, what is told of them, and what is drawn."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from made_messages import meta
from test_overlay_drawing import wall

from sags_node.clients.overlay.draw import UNDER, Body, Placed, draw
from sags_node.clients.overlay.mesh import Mesh, mesh_of
from sags_node.clients.overlay.proximity import FIELDS, HELD, MAX_AGE, TISSUE, UNKNOWN, Proximity
from sags_node.clients.overlay.scene import ALARM, ObjectSpec, SceneSpec
from sags_node.confidence import SURE
from sags_node.geometry import project, quat_to_matrix, transform
from sags_node.messaging.content import INSTRUMENT_FIELDS
from sags_node.messaging.received import ReceivedCloud
from sags_node.types import F32

HALF = 0.01  # m, of the cube
MARGIN = 0.005  # m
TURNED = np.eye(4)
TURNED[:3, :3], TURNED[:3, 3] = quat_to_matrix(np.array([0.8, 0.4, -0.2, 0.3])), (0.01, -0.02, 0.09)
FRAME = replace(wall(), stamp_ns=10**9)
NAN = (np.nan, np.nan, np.nan)
SURENESS = [(0.9, {}, 1), (0.4, {}, 0), (0.9, {"is_sure": 0}, 0), (0.9, {"depth_confidence": 0.4}, 0)]


def cube(is_closed: bool = True) -> Body:
    """Around its origin; without its side at +x it is open."""
    corners = np.array(list(product((-HALF, HALF), repeat=3)))
    sides = [(4, 6, 7, 5), (0, 1, 3, 2), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    triangles = [(a, *pair) for a, b, c, d in sides for pair in ((b, c), (c, d))]
    shown = np.array(triangles, np.int32)[0 if is_closed else 2 :]
    return Body(Mesh(np.float32(corners), shown, np.full((len(shown), 3), 90, np.float32)), 0.5, "artery")


def watched(body: Body, **tissue: float) -> Proximity:
    zone = {"label": "artery", "shape": "sphere", "margin": MARGIN}
    return Proximity(SceneSpec.model_validate({"objects": [zone], **tissue}), [body])


def told(tips: Sequence[Any], at_s: float = 1.0, changes: Any = None, **columns: Any) -> ReceivedCloud:
    """A message of `instruments`; what is not given is 0, or sure."""
    rows = np.zeros(len(tips), [(name, "<u4" if name == "id" else "<f4") for name in INSTRUMENT_FIELDS])
    tips = np.array(tips, np.float32).reshape(-1, 3)
    given = {"id": np.arange(1, len(tips) + 1), "confidence": 0.9, "clearance_confidence": 0.9}
    for name, values in (given | dict(zip("xyz", tips.T, strict=True)) | columns).items():
        rows[name] = values
    return ReceivedCloud("sags/instruments", meta(1, 1e3 * at_s, **(changes or {})), 0, (), rows)


def looked(near: Proximity, said: ReceivedCloud, put: Placed | None) -> dict[str, F32]:
    rows = near.look(said, FRAME, [put])
    assert rows is not None
    return dict(zip(FIELDS, rows.T, strict=True))


@pytest.mark.parametrize(
    ("tip", "is_closed", "place"),  # before a side, beside an edge, inside; without a side: inside, before it
    [
        ((0.014, 0.002, -0.003), True, (HALF, 0.002, -0.003)), ((0.013, 0.012, 0), True, (HALF, HALF, 0)),
        ((0, 0.004, 0.008), True, (0, 0.004, 0.008)), ((0, 0.004, 0.008), False, (0, 0.004, 0.008)),
        ((0.012, 0, 0.008), False, (HALF, 0, HALF)),
    ],
)  # fmt: skip
def test_the_nearest_place_of_a_zone_is_on_its_mesh(tip: Any, is_closed: bool, place: Any) -> None:
    body = cube(is_closed)
    rigid, bent = Placed(body, TURNED), Placed(body, TURNED, vertices=np.add(body.vertices, (0, 0, 0.001)))
    for put, moved in ((rigid, 0.0), (bent, 0.001)):
        at, there = (np.asarray(transform(TURNED, np.add(each, [0, 0, moved]))) for each in (tip, place))
        row = looked(watched(body), told([at]), put)
        assert np.allclose([row[f"near_{axis}"][0] for axis in "xyz"], there, atol=1e-6)
        assert row["distance"][0] == pytest.approx(np.linalg.norm(at - there), abs=1e-6)
        assert (row["zone"][0], row["id"].view(np.uint32)[0]) == (1, 1)
        assert row["margin"][0] == np.float32(MARGIN)


@pytest.mark.fault(
    "file: a forbidden zone's mesh has a hole, an empty or a repeated triangle, or split vertices"
)
@pytest.mark.parametrize("flaw", ["hole", "empty", "twice", "turned round", "split"])
def test_the_inside_of_a_zone_is_known_in_spite_of_flaws(flaw: str, tmp_path: Path) -> None:
    whole = cube()
    vertices, faces = whole.vertices, whole.triangles
    added = {"empty": [[5, 5, 6]], "twice": faces[3:4], "turned round": faces[3:4, ::-1]}
    faces = faces[1:] if flaw == "hole" else np.vstack([faces, added.get(flaw, faces[:0])])
    if flaw == "split":  # at every edge
        vertices, faces = vertices[faces].reshape(-1, 3), np.arange(faces.size).reshape(-1, 3)
    text = "".join(f"v {x:g} {y:g} {z:g}\n" for x, y, z in vertices)
    text += "".join(f"f {a} {b} {c}\n" for a, b, c in faces + 1)
    (tmp_path / "a.obj").write_text(text)
    body = Body(mesh_of(ObjectSpec(file=tmp_path / "a.obj")), 0.5, "artery")
    row = looked(watched(body), told([(0, 0.004, 0.002), (0.014, 0, 0)]), Placed(body, np.eye(4)))
    assert sorted(row["distance"].tolist()) == pytest.approx([0, 0.014 - HALF], abs=1e-6)


def test_only_what_is_nearer_than_its_margin_is_told() -> None:
    tips = [(x, 0, 0) for x in (HALF + MARGIN + 1e-4, HALF + MARGIN - 1e-4)]
    said = told(tips, clearance=[0.0031, 0.0029])
    row = looked(watched(cube(), tissue_margin=0.003), said, Placed(cube(), np.eye(4)))
    assert list(zip(row["zone"], row["id"].view(np.uint32), strict=True)) == [(TISSUE, 2), (1, 2)]
    assert len(looked(watched(cube()), told([]), Placed(cube(), np.eye(4)))["x"]) == 0


@pytest.mark.parametrize("speed", [0.02, 0.003, 0.001, -0.005])
def test_the_speed_and_the_time_to_contact_of_a_steady_approach(speed: float) -> None:
    """Also when the tip is 3 mm wrong in one of six frames."""
    near, put = watched(cube()), Placed(cube(), np.eye(4))
    for step in range(6):
        x = HALF + 0.004 - speed * 0.1 * (step - 5) + (0.003 if step == 3 else 0)
        row = looked(near, told([(x, 0, 0)], 1 + 0.1 * step), put)
        assert step >= 2 or np.isnan(row["closing"]).all()
    assert row["closing"][0] == pytest.approx(speed, abs=1e-5)
    assert row["contact"][0] == pytest.approx(0.004 / speed if speed > 0.002 else np.nan, 1e-3, nan_ok=True)


@pytest.mark.parametrize(("tip", "zone", "sure"), SURENESS)
def test_what_is_not_sure_is_told_and_drawn_as_unsure(tip: float, zone: Any, sure: int) -> None:
    body, T = cube(), np.eye(4)
    T[2, 3] = 0.03
    near, put = watched(body), Placed(body, T, **zone)
    row = looked(near, told([(0.012, 0, 0.03)], confidence=tip), put)
    assert (row["confidence"][0] >= SURE) == sure
    assert near.status(FRAME.stamp_ns)["near"][0]["sure"] == bool(sure)
    (shown,) = near.shown(FRAME, [put])
    assert (shown.is_sure, shown.body.label) == (bool(sure), "artery 2 mm")
    shown.body.label = None
    drawn = draw(FRAME, [shown])
    assert set(np.unique(drawn[..., 3])) - {0} == {255 if sure else round(UNDER * 255)}
    assert drawn[..., 0].max() > 150 > drawn[..., 1].max()


@pytest.mark.fault("instruments: a tip or a forbidden zone that is not known")
def test_what_is_not_known_has_a_row_that_says_so() -> None:
    near = watched(cube(), tissue_margin=0.003)
    row = looked(near, told([NAN, (0, 0, 0)], clearance=[np.nan, 0.009]), None)
    assert list(zip(row["zone"], row["id"].view(np.uint32), strict=True)) == [(UNKNOWN, 1), (1, 0)]
    assert np.isnan(row["distance"]).all() and not row["confidence"].any()
    told_too = {"reason": None, "near": [], "unknown_tips": [1], "unplaced_zones": ["artery"]}
    assert near.status(FRAME.stamp_ns) == told_too


def test_nothing_old_is_told_or_drawn_as_new() -> None:
    near, put = watched(cube(), tissue_margin=0.003), Placed(cube(), np.eye(4))
    said = told([(0, 0, 0)], clearance=0.001, near_z=0.001)
    assert near.status(FRAME.stamp_ns)["reason"] and near.look(said, FRAME, [put]) is not None
    assert near.look(said, FRAME, [put]) is None  # the same again
    for other in ({"session": "t"}, {"epoch": 1}):
        assert near.look(told([], 1.1, other), FRAME, [put]) is None
    held, later = (replace(FRAME, stamp_ns=FRAME.stamp_ns + round(1e9 * (HELD + s))) for s in (0, 1e-3))
    assert len(near.shown(held, [put])) == 3 and near.shown(later, [put]) == [put]
    now = FRAME.stamp_ns + round(1e9 * MAX_AGE)
    assert near.status(now)["near"] and near.status(now)["reason"] is None
    assert near.status(now + 1)["near"] == [] and near.status(now + 1)["reason"]
    near.look(said, replace(FRAME, epoch=1), [put])
    assert near.shown(FRAME, [put]) == [put] and near.status(now)["reason"]


def test_without_a_unit_or_from_an_older_node_nothing_is_told() -> None:
    old = told([(0, 0, 0)])
    old = replace(old, points=old.points[[name for name in INSTRUMENT_FIELDS if name != "near_x"]])
    for said in (told([(0, 0, 0)], 1.0, {"units": "relative"}), old):
        near = watched(cube())
        assert near.look(said, FRAME, [Placed(cube(), np.eye(4))]) is None
        assert near.status(FRAME.stamp_ns)["reason"] == near.reason is not None


@pytest.mark.parametrize(("margin", "color"), [(0.011, ALARM), (0.009, (255, 255, 255))])
def test_a_line_leads_from_the_tip_to_the_tissue(margin: float, color: Any) -> None:
    tip, place = np.array([-0.005, 0.002, 0.04]), np.array([0.001, 0.002, 0.048])
    near = watched(cube(), tissue_margin=margin)
    near.look(told([tip], clearance=0.01, near_x=place[0], near_y=place[1], near_z=place[2]), FRAME, [None])
    label, line = near.shown(FRAME, [None])
    assert label.body.label == "10 mm" and np.allclose(label.T_world_body[:3, 3], place, atol=1e-6)
    rgba = draw(FRAME, [line])
    drawn = np.argwhere(rgba[..., 3] == 255)[:, ::-1]
    start, end = (project(FRAME.camera, each)[0] for each in (tip, place))
    length = np.linalg.norm(end - start)
    along, aside = ((drawn - start) @ way / length for way in (end - start, (end - start)[::-1] * [-1, 1]))
    wide = 0.0003 * FRAME.camera.K[0, 0] / tip[2] + 1
    assert np.abs(aside).max() < wide and abs(along.min()) < 1 + wide and abs(along.max() - length) < 1 + wide
    hue = rgba[tuple(drawn.T[::-1])][:, :3].astype(float)
    assert np.allclose(hue / hue[:, :1], np.array(color) / color[0], atol=0.02)
