"""What the overlay draws and what holds it: meshes, poses, both eyes, the colour key, scene files."""

from __future__ import annotations

from concurrent.futures import Future
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from synthetic import BASELINE, NORMAL, plane_depth, plane_result

from sags_node.apps.overlay_draw import NEAREST, UNDER, Body, Placed, color_key, draw, over
from sags_node.apps.overlay_frame import Anchor, TissueFrame
from sags_node.apps.overlay_held import HeldObject, Pinner, Request
from sags_node.apps.overlay_mesh import Mesh, mesh_of
from sags_node.apps.overlay_pose import on_a_line, on_surface, rigid_fit, surface_normal
from sags_node.apps.overlay_raster import fill
from sags_node.apps.overlay_scene import SHAPES, ObjectSpec, built_in
from sags_node.cli import main
from sags_node.errors import SagsError, UsageError
from sags_node.geometry import invert, quat_to_matrix, transform
from sags_node.types import Camera

K = np.array([[300.0, 0, 80], [0, 300, 60], [0, 0, 1]])
SIZE = (120, 160)
RED, KEY = (250, 0, 0), (0, 0, 255)


def wall(z: float = 0.05) -> TissueFrame:
    """A wall of tissue, everything in the camera's own coordinates."""
    camera = Camera(SIZE[1], SIZE[0], K, np.eye(4))
    depth = np.full(SIZE, z, np.float32)
    return TissueFrame(1, 1, "s", 0, camera, 0.005, depth, np.ones(SIZE, bool), {})


def ball(z: float, radius: float = 0.002, opacity: float = 1.0, label: str | None = None) -> Placed:
    """A red ball on the optical axis."""
    import open3d

    made = open3d.geometry.TriangleMesh.create_sphere(radius, 30)
    triangles = np.asarray(made.triangles, np.int32)
    color = np.tile(np.array(RED, np.float32), (len(triangles), 1))
    T = np.eye(4)
    T[2, 3] = z
    return Placed(Body(Mesh(np.asarray(made.vertices, np.float32), triangles, color), opacity, label), T)


def centre(rgba: np.ndarray) -> np.ndarray:
    """Middle (u, v) of what is drawn."""
    return np.argwhere(rgba[..., 3] > 0).mean(0)[::-1]


# ---- drawing ---------------------------------------------------------------------------------------------


def test_triangles_are_drawn_as_rays_see_them() -> None:
    """Against Open3D's ray casting: the same pixels, the same depths, the same triangles."""
    import open3d

    made = open3d.geometry.TriangleMesh.create_torus(0.012, 0.004, 60, 30)
    R = quat_to_matrix(np.array([0.8, 0.4, -0.2, 0.3]))
    vertices = np.asarray(made.vertices) @ R.T + [0.002, 0.001, 0.06]
    triangles = np.asarray(made.triangles, np.int32)
    pixels = np.ascontiguousarray((vertices / vertices[:, 2:] @ K.T)[:, :2])
    colors = np.random.default_rng(0).integers(0, 255, (len(triangles), 4), dtype=np.uint8)
    z, rgba = np.full(SIZE, np.inf, np.float32), np.zeros((*SIZE, 4), np.uint8)
    fill(pixels, np.ascontiguousarray(vertices[:, 2]), triangles, colors, z, rgba)

    v, u = np.mgrid[: SIZE[0], : SIZE[1]]
    rays = np.zeros((*SIZE, 6), np.float32)
    rays[..., 3:] = np.stack([u, v, np.ones_like(u)], -1) @ np.linalg.inv(K).T
    scene = open3d.t.geometry.RaycastingScene()
    scene.add_triangles(vertices.astype(np.float32), triangles.astype(np.uint32))
    hits = scene.cast_rays(open3d.core.Tensor.from_numpy(rays))
    truth, faces = hits["t_hit"].numpy(), hits["primitive_ids"].numpy()
    hit = np.isfinite(truth)
    assert hit.sum() > 3000
    assert (np.isfinite(z) != hit).sum() < 0.002 * hit.sum()
    both = hit & np.isfinite(z)
    assert np.percentile(np.abs(z[both] - truth[both]), 99) < 1e-6
    same = (rgba[both] == colors[faces[both]]).all(1)
    assert same.mean() > 0.99


def test_what_reaches_behind_the_eye_or_outside_the_picture_is_left_out() -> None:
    for place in ([0, 0, -0.03], [5.0, 0, 0.03], [0, -5.0, 0.03]):
        placed = ball(0.0)
        placed.T_world_body[:3, 3] = place
        assert draw(wall(), [placed])[..., 3].sum() == 0


def test_a_ball_in_front_of_tissue_is_a_full_disc_and_shaded() -> None:
    rgba = draw(wall(), [ball(0.03)])
    drawn = rgba[..., 3] > 0
    assert drawn.sum() == pytest.approx(np.pi * (300 * 0.002 / 0.03) ** 2, rel=0.03)
    assert set(np.unique(rgba[..., 3])) == {0, 255}
    assert rgba[60, 80, 0] > 240 and 100 < rgba[60, 99, 0] < 180  # lit from the eye
    assert not rgba[drawn, 1:3].any()


def test_what_lies_under_the_tissue_shows_through_faintly() -> None:
    rgba = draw(wall(0.05), [ball(0.06)])
    assert set(np.unique(rgba[..., 3])) == {0, round(UNDER * 255)}
    on_it = draw(wall(0.05), [ball(0.05 + 0.0025)])  # its top is 0.5 mm under: it counts as on the surface
    assert on_it[60, 80, 3] == 255 and on_it[60, 91, 3] == round(UNDER * 255)
    picture = np.full((*SIZE, 3), 100, np.uint8)
    shown = over(picture, rgba)
    assert shown[60, 80, 0] == pytest.approx(100 + UNDER * (rgba[60, 80, 0] - 100), abs=1)
    assert (shown[rgba[..., 3] == 0] == 100).all() and (picture == 100).all()


def test_the_nearer_of_two_objects_wins() -> None:
    near, far = ball(0.03, 0.001), ball(0.04, 0.003, opacity=0.5)
    for both in ([near, far], [far, near]):
        rgba = draw(wall(), both)
        assert rgba[60, 80, 3] == 255 and rgba[60, 95, 3] == 128


@pytest.mark.parametrize("what", ["instrument", "unknown depth"])
def test_nothing_is_drawn_over_instruments_or_unknown_depth(what: str) -> None:
    frame = wall()
    if what == "instrument":
        frame.tissue[:, 80:] = False
    else:
        frame.depth[:, 80:] = np.nan
    thing = ball(0.03, label="vessel")
    whole, rgba = draw(wall(), [thing], note="12 ms"), draw(frame, [thing], note="12 ms")
    assert not rgba[:, 80:, 3].any() and whole[:, 80:, 3].any()
    assert np.array_equal(rgba[:, :80], whole[:, :80])


def test_a_label_is_readable_over_tissue_and_follows_its_object() -> None:
    one = draw(wall(0.03), [Placed(Body(None, 1.0, "A"), ball(0.05).T_world_body)])
    rows, columns = np.nonzero(one[..., 3])
    assert len(rows) > 20 and one[rows, columns, :3].max() > 240 and one[rows, columns, :3].min() == 0
    assert abs(rows.mean() - 60) < 10 and 0 < columns.mean() - 80 < 20


# ---- the right eye ---------------------------------------------------------------------------------------


def test_both_eyes_agree_with_the_disparity() -> None:
    baseline = 0.005
    thing = ball(0.04)
    left, right = draw(wall(), [thing]), draw(wall(), [thing], baseline)
    shift = 300 * baseline / 0.04
    assert centre(left)[0] - centre(right)[0] == pytest.approx(shift, abs=0.3)
    assert centre(left)[1] == pytest.approx(centre(right)[1], abs=0.1)
    faint = draw(wall(0.03), [thing], baseline)
    assert set(np.unique(faint[..., 3])) == {0, round(UNDER * 255)}


def test_in_the_right_eye_no_instrument_at_any_depth_is_drawn_over() -> None:
    """A real instrument is put at several depths, and its silhouette in the right eye stays free."""
    baseline, thing = 0.005, ball(0.05, 0.006)
    frame = wall()
    frame.tissue[:, 86:92] = False
    rgba = draw(frame, [thing], baseline)
    assert (rgba[..., 3] > 0).sum() > 200
    for z in (NEAREST, 0.035, 0.04, 0.044):
        shift = 300 * baseline / z
        columns = np.arange(int(np.floor(86 - shift)), int(np.ceil(91 - shift)) + 1)
        assert not rgba[:, columns, 3].any(), z


def test_what_the_left_eye_does_not_see_stays_free_in_the_right_one() -> None:
    baseline, thing = 0.005, ball(0.04, 0.1)
    rgba = draw(wall(0.06), [thing], baseline)
    assert not rgba[:, SIZE[1] - int(300 * baseline / NEAREST) :, 3].any()


# ---- the colour key --------------------------------------------------------------------------------------


@pytest.mark.parametrize("key", [KEY, (0, 255, 0), (0, 0, 0)])
def test_the_colour_key_is_exact(key: tuple[int, int, int]) -> None:
    rng = np.random.default_rng(0)
    rgba = np.zeros((*SIZE, 4), np.uint8)
    rgba[20:80, 20:90] = rng.integers(0, 256, (60, 70, 4))
    rgba[30, 30] = (*key, 255)
    rgba[31, 31] = (*key, 40)
    keyed = color_key(rgba, key)
    is_key = (keyed == key).all(2)
    v, u = np.mgrid[: SIZE[0], : SIZE[1]]
    alpha = rgba[..., 3]
    drawn = (alpha >= 128) | ((alpha > 0) & ((u + v) % 2 == 0))
    assert np.array_equal(is_key, ~drawn)
    difference = np.abs(keyed.astype(int) - rgba[..., :3])[drawn]
    assert difference.sum(1).max() == 1 and (difference > 0).sum() >= 2  # only where it would be the key


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


def plane_frame() -> TissueFrame:
    result = plane_result()
    camera = result.pair.camera
    depth, tissue = plane_depth(camera), result.observation.tissue
    return TissueFrame(5, 5, "s", 2, camera, BASELINE, depth, tissue, {})


def on_plane(frame: TissueFrame, u: int, v: int) -> np.ndarray:
    local = np.linalg.inv(frame.camera.K) @ (u, v, 1.0) * float(frame.depth[v, u])
    return np.asarray(transform(frame.camera.T_world_cam, local))


def test_one_anchor_gives_the_place_and_the_normal_of_the_surface() -> None:
    frame = plane_frame()
    place = on_plane(frame, 30, 40)
    normal = surface_normal(frame, place)
    assert normal is not None
    towards = frame.camera.T_world_cam[:3, :3] @ NORMAL
    assert np.allclose(normal, -towards / np.linalg.norm(NORMAL), atol=1e-3)
    assert surface_normal(replace(frame, depth=frame.depth * np.float32(np.nan)), place) is None
    assert surface_normal(replace(frame, tissue=~np.ones_like(frame.tissue)), place) is None
    assert surface_normal(frame, frame.camera.T_world_cam[:3, 3] - frame.camera.T_world_cam[:3, 2]) is None
    right = frame.camera.T_world_cam[:3, 0]
    T = on_surface(place, np.array([0.0, 0, 0.001]), normal, right)
    assert np.allclose(T[:3, 2], normal) and T[:3, 0] @ right > 0.9
    assert np.allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3)) and np.linalg.det(T[:3, :3]) > 0
    assert np.allclose(transform(T, np.array([0, 0, 0.001])), place)


# ---- objects held by anchors -----------------------------------------------------------------------------


class FakePinner(Pinner):
    """Gives ids at once, or refuses; remembers what was asked."""

    def __init__(self) -> None:
        self.asked: list[Any] = []
        self.removed: list[int] = []
        self.forgotten: list[int] = []
        self.refusal: SagsError | None = None
        self._next = 1

    def pin(self, requests: Any) -> Future[list[int]]:
        self.asked.append(requests)
        future: Future[list[int]] = Future()
        if self.refusal is not None:
            future.set_exception(self.refusal)
            return future
        future.set_result(list(range(self._next, self._next + len(requests))))
        self._next += len(requests)
        return future

    def remove(self, ids: Any) -> None:
        self.removed += ids

    def forget(self, ids: Any) -> None:
        self.forgotten += ids


PIXELS = [[20, 20], [70, 30], [30, 55], [85, 50]]


def held(anchors: list[Request] | list[dict[str, Any]], repin: bool = False, **more: Any) -> HeldObject:
    spec = ObjectSpec.model_validate({"shape": "sphere", "anchors": anchors, **more})
    return HeldObject(spec, "pin", FakePinner(), repin)


def with_anchors(frame: TissueFrame, places: Any, confidence: Any = 1.0) -> TissueFrame:
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


def test_one_anchor_carries_the_object_and_keeps_its_direction_while_hidden() -> None:
    frame = plane_frame()
    thing = held([{"pixel": [30, 40]}])
    T = placed_at(thing, with_anchors(frame, [on_plane(frame, 30, 40)]))
    assert thing._pinner.asked == [[{"u": 30, "v": 40}]]  # type: ignore[attr-defined]  # the fake one
    assert np.allclose(T[:3, 3], on_plane(frame, 30, 40))
    hidden = replace(frame, tissue=~np.ones_like(frame.tissue))
    again = thing.place(with_anchors(hidden, [on_plane(frame, 33, 41)], 0.3))
    assert again is not None and np.allclose(again[:3, :3], T[:3, :3])
    assert np.allclose(again[:3, 3], on_plane(frame, 33, 41))
    assert thing.place(with_anchors(hidden, [on_plane(frame, 33, 41)], 0.05)) is None
    assert thing.reason == "its anchor was not seen for too long"
    changed = Anchor(on_plane(frame, 33, 41), visibility=1.0, confidence=0.01)
    assert thing.place(replace(hidden, anchors={1: changed})) is not None  # it is in sight


def test_many_anchors_carry_it_rigidly_whatever_is_hidden() -> None:
    frame = plane_frame()
    places = np.stack([on_plane(frame, u, v) for u, v in PIXELS])
    thing = held([{"pixel": p} for p in PIXELS])
    T = placed_at(thing, with_anchors(frame, places))
    assert np.allclose(T, frame.camera.T_world_cam, atol=1e-6)  # coordinates of the camera
    motion = np.eye(4)
    motion[:3, :3] = quat_to_matrix(np.array([1.0, 0.1, -0.05, 0.08]))
    motion[:3, 3] = [0.003, -0.002, 0.001]
    moved = np.asarray(transform(motion, places))
    for confidence in (1.0, [1, 1, 0.02, 1]):
        astray = moved.copy()
        if confidence != 1.0:
            astray[2] += 0.01  # of the hidden one
        T = placed_at(thing, with_anchors(frame, astray, confidence))
        assert np.allclose(T, motion @ frame.camera.T_world_cam, atol=1e-6)
    assert thing.place(with_anchors(frame, moved, [1, 1, 0.02, 0.02])) is None
    assert thing.reason == "2 of its 4 anchors are sure, 3 are needed"


def test_named_points_of_the_object_come_to_lie_at_its_anchors() -> None:
    frame = plane_frame()
    T = frame.camera.T_world_cam @ pose(3)
    places = np.stack([on_plane(frame, u, v) for u, v in PIXELS])
    model = np.asarray(transform(invert(T), places))
    thing = held([{"pixel": p, "at": at.tolist()} for p, at in zip(PIXELS, model, strict=True)])
    assert np.allclose(placed_at(thing, with_anchors(frame, places)), T, atol=1e-6)
    in_world = held([{"place": place.tolist()} for place in places], coordinates="world")
    assert np.allclose(placed_at(in_world, with_anchors(frame, places)), np.eye(4), atol=1e-6)


def test_it_waits_for_tissue_with_depth_and_for_the_node() -> None:
    frame = plane_frame()
    thing = held([{"pixel": [65, 30]}])  # columns 60 to 69 are an instrument
    assert thing.place(frame) is None and thing.reason == "pixel 65 30 shows an instrument"
    unknown = replace(frame, depth=frame.depth * np.float32(np.nan), tissue=np.ones_like(frame.tissue))
    assert thing.place(unknown) is None and thing.reason == "no depth at pixel 65 30"
    assert held([]).place(unknown) is None
    with pytest.raises(UsageError, match=r"pin 96 30 lies outside the left picture of 96x64"):
        held([{"pixel": [96, 30]}]).place(frame)
    thing = held([{"pixel": [30, 30]}])
    thing._pinner.refusal = SagsError("there are 256 anchors already")  # type: ignore[attr-defined]  # fake
    assert [thing.place(frame) for _ in range(2)] == [None, None]
    assert thing.reason == "there are 256 anchors already"


def test_the_default_place_is_the_middle_of_the_tissue() -> None:
    thing = held([])
    thing.place(plane_frame())
    ((asked,),) = thing._pinner.asked  # type: ignore[attr-defined]  # the fake one
    assert abs(asked["u"] - 43) < 8 and abs(asked["v"] - 32) < 3


@pytest.mark.parametrize("how", ["model", "node", "removed"])
@pytest.mark.parametrize("repin", [False, True])
def test_after_a_new_start_it_is_lost_or_pinned_anew(how: str, repin: bool) -> None:
    frame = plane_frame()
    place = on_plane(frame, 30, 40)
    thing = held([{"pixel": [30, 40]}], repin)
    placed_at(thing, with_anchors(frame, [place]))
    after = {
        "model": with_anchors(frame, [np.full(3, np.nan)]),
        "node": replace(with_anchors(frame, [place]), session="another"),
        "removed": with_anchors(frame, [None]),
    }[how]
    assert thing.place(after) is None and str(thing.reason).startswith("lost: ")
    pinner: Any = thing._pinner
    assert (pinner.removed, pinner.forgotten) == (([], [1]) if how == "node" else ([1], []))
    if not repin:
        assert thing.place(with_anchors(frame, [place])) is None and str(thing.reason).startswith("lost: ")
        return
    fresh = replace(with_anchors(frame, [None, place]), session=after.session)
    assert np.allclose(placed_at(thing, fresh)[:3, 3], place)
    assert thing.status()["pinned"] == 2


# ---- scenes and meshes -----------------------------------------------------------------------------------


@pytest.mark.parametrize("shape", SHAPES)
def test_built_in_shapes_stand_on_the_tissue(shape: str) -> None:
    mesh = mesh_of(built_in((1, 2), shape).objects[0])
    assert mesh is not None and 100 < len(mesh.triangles) < 5000
    assert mesh.vertices[:, 2].min() > -0.0025 and np.ptp(mesh.vertices, axis=0).max() < 0.02


def mesh_file(folder: Path, name: str, scale: float = 1.0) -> Path:
    import open3d

    made = open3d.geometry.TriangleMesh.create_box(0.01, 0.02, 0.03).scale(scale, center=(0, 0, 0))
    made.compute_triangle_normals()  # STL wants them
    if name.endswith((".pcd", ".xyz")):
        points = open3d.geometry.PointCloud(made.vertices)
        assert open3d.io.write_point_cloud(str(folder / name), points, write_ascii=name.endswith("xyz"))
    else:
        assert open3d.io.write_triangle_mesh(str(folder / name), made)
    return folder / name


@pytest.mark.parametrize("name", ["box.ply", "box.obj", "box.stl", "box.pcd", "box.xyz"])
def test_meshes_and_points_are_read_in_metres(name: str, tmp_path: Path) -> None:
    spec = ObjectSpec(file=mesh_file(tmp_path, name, 1000.0), scale=0.001, point_size=0.001)
    mesh = mesh_of(spec)
    assert mesh is not None
    points = name.endswith((".pcd", ".xyz"))
    assert len(mesh.triangles) == (8 * 8 if points else 12)
    room = 0.002 if points else 0.0
    assert np.allclose(np.ptp(mesh.vertices, axis=0), np.array([0.01, 0.02, 0.03]) + room, atol=1e-6)


PLY = "ply\nformat ascii 1.0\nelement vertex {v}\nproperty float x\nproperty float y\nproperty float z\n"
PLY += "element face {f}\nproperty list uchar int vertex_indices\nend_header\n{body}"
CORNERS = "0 0 0\n0.01 0 0\n0 0.01 0\n"


def ply(vertices: int = 3, faces: int = 1, body: str = CORNERS + "3 0 1 2\n") -> bytes:
    return PLY.format(v=vertices, f=faces, body=body).encode()


BAD_FILES = {
    "gone.ply": (None, "No such file"),
    "empty.ply": (b"", "no PLY header"),
    "nothing.ply": (ply(0, 0, ""), "holds no points"),
    "nothing.obj": (b"# nothing\n", "holds no triangles"),
    "nan.ply": (ply(body=CORNERS.replace("0.01", "nan", 1) + "3 0 1 2\n"), "1 of its 3 vertices"),
    "far.ply": (ply(body=CORNERS.replace("0.01", "10") + "3 0 1 2\n"), "for millimetres set scale: 0.001"),
    "index.ply": (ply(body=CORNERS + "3 0 1 7\n"), "a vertex that is not there"),
    "claims.ply": (ply(3_000_000_000), "claims 3000000001 elements"),
    "claims.stl": (bytes(80) + (10**9).to_bytes(4, "little"), "1000000000 triangles"),
    "claims.pcd": (b"# .PCD\nFIELDS x y z\nPOINTS 999999999\nDATA binary\n", "claims 999999999"),
    "packed.pcd": (b"# .PCD\nFIELDS x y z\nPOINTS 9\nDATA binary_compressed\n", "save it as ascii or binary"),
    "mesh.gltf": (b"{}", "must end in one of"),
    "large.stl": ("solid\n" * (12 << 20), "64 at most are read"),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD_FILES)
def test_a_bad_mesh_is_one_clear_message(name: str, tmp_path: Path) -> None:
    content, said = BAD_FILES[name]
    if content is not None:
        (tmp_path / name).write_bytes(content.encode() if isinstance(content, str) else content)
    (tmp_path / "scene.yaml").write_text(f"objects: [{{file: {name}, anchors: [{{pixel: [1, 2]}}]}}]")
    refused(tmp_path / "scene.yaml", name, said)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("objects: [{shape: target, colour: [1, 2, 3]}]", "'objects.0.colour'; did you mean 'color'?"),
        ("objects: [{shape: target, anchors: [{pixl: [1, 2]}]}]", "did you mean 'pixel'?"),
        ("object: []", "did you mean 'objects'?"),
        ("objects: []", "objects: "),
        ("[1, 2]", "a map of keys, it is a list"),
        ("objects: [", "not valid YAML"),
        ("objects: [{color: [1, 2, 3]}]", "needs a file, a shape or a label"),
        ("objects: [{shape: target, file: a.ply}]", "a file or a shape, not both"),
        ("objects: [{shape: cube}]", "'target' or 'sphere'"),
        ("objects: [{shape: target, anchors: [{pixel: [1, 2]}, {pixel: [3, 4]}]}]", "two anchors"),
        ("objects: [{shape: target, anchors: [{pixel: [1, 2], place: [1, 2, 3]}]}]", "either pixel: [u, v]"),
        ("objects: [{shape: target, anchors: [{pixel: [.nan, 2]}]}]", "finite number"),
        ("objects: [{shape: target, color: [0, 0, 240]}]", "too near the key colour"),
        ("objects: [{shape: target, opacity: 0}]", "greater than 0"),
    ],
)  # fmt: skip
def test_a_wrong_scene_is_one_clear_message(text: str, said: str, tmp_path: Path) -> None:
    (tmp_path / "scene.yaml").write_text(text)
    refused(tmp_path / "scene.yaml", "scene.yaml", said)


def test_other_mistakes_are_named(tmp_path: Path) -> None:
    refused(tmp_path / "gone.yaml", "gone.yaml", "check the path")
    (tmp_path / "scene.yaml").write_text("objects: [{shape: target}]")
    refused(tmp_path / "scene.yaml", "--pin is for the built-in target", extra=("--pin", "3", "4"))
    refused(tmp_path / "scene.yaml", "--control", extra=("--endpoint", "tcp://127.0.0.1:9"))


def refused(scene: Path, *said: str, extra: tuple[str, ...] = ()) -> None:
    result = CliRunner().invoke(main, ["overlay", "--scene", str(scene), *extra])
    assert result.exit_code == 2 and result.stdout == "", result.output
    assert result.stderr.count("rror:") == 1 and all(part in result.stderr for part in said), result.stderr
