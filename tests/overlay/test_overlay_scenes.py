"""Scene files of the overlay and the meshes that they name."""

import struct
from pathlib import Path

import numpy as np
import pytest
from command_line import refused

from sags_node.clients.overlay.mesh import mesh_of
from sags_node.clients.overlay.mesh_files import triangulate
from sags_node.clients.overlay.scene import ObjectSpec, read_scene
from sags_node.errors import UsageError


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


def binary_ply(*face: int) -> bytes:
    """Three corners and a face."""
    head = PLY.format(v=3, f=1, body="").replace("ascii", "binary_little_endian").encode()
    corners = struct.pack("<9f", *map(float, CORNERS.split()))
    return head + corners + struct.pack(f"<B{len(face)}i", len(face), *face)


FACET = "facet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 0.01 0 0\nvertex 0 0.01 0\nendloop\nendfacet\n"
TEXT_STL = f"solid a\n{FACET}{FACET.replace('0.01 0', '0.02 0')}endsolid a\n"
SOUND_FILES = {
    "mark.obj": "\ufeffv 0 0 0\nv 0.01 0 0\nv 0 0.01 0\nv 0 0 0.01\nf 1 2 3\n",
    "mark.stl": f"\ufeff{TEXT_STL}",
    "umlaut.ply": ply().decode().replace("1.0", "1.0\ncomment K\u00f6rper", 1),
    "named.stl": TEXT_STL.replace("solid a", "solid left vertex facet group"),
    "capitals.stl": TEXT_STL.upper(),
    "exponents.stl": TEXT_STL.replace("0.01", "1.0e-2"),
    **{f"starts with {start!r}.stl": TEXT_STL.replace("solid", start, 1)
       for start in (" solid", "\tSolid", "\r\nsolid")},
}  # fmt: skip


@pytest.mark.parametrize("encoding", ["utf-8", "latin-1"])
@pytest.mark.parametrize("name", SOUND_FILES)
def test_letters_marks_and_names_in_a_mesh_change_nothing(name: str, encoding: str, tmp_path: Path) -> None:
    text, file = SOUND_FILES[name], tmp_path / f"a{Path(name).suffix}"
    file.write_bytes(text.encode("utf-8" if text[0] == "\ufeff" else encoding))
    mesh = mesh_of(ObjectSpec(file=file))
    assert mesh is not None
    drawn = mesh.vertices[mesh.triangles[0]]
    assert np.allclose(drawn[np.lexsort(drawn.T)], [[0, 0, 0], [0.01, 0, 0], [0, 0.01, 0]])


@pytest.mark.parametrize("corners", [4, 5, 12, 64])
def test_a_polygon_is_covered_once_by_its_triangles(corners: int) -> None:
    """Stars with every second corner pulled in, anywhere in space: their area is known."""
    rng = np.random.default_rng(corners)
    angles = np.linspace(0, 2 * np.pi, corners, endpoint=False)
    radii = np.where(np.arange(corners) % 2, 0.2, 1.0)
    flat = np.column_stack([radii * np.cos(angles), radii * np.sin(angles), np.zeros(corners)])
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    points = flat @ turn.T + rng.normal(size=3)
    triangles = triangulate(points, [list(range(corners))])
    assert len(triangles) == corners - 2
    ends = points[triangles]
    areas = 0.5 * np.cross(ends[:, 1] - ends[:, 0], ends[:, 2] - ends[:, 0]) @ (turn @ [0, 0, 1])
    assert (areas > -1e-12).all()  # all turn as the polygon does, so none lies on another or outside
    neighbours = radii * np.roll(radii, -1) * np.sin(2 * np.pi / corners)
    assert areas.sum() == pytest.approx(0.5 * neighbours.sum())


def test_faces_of_many_corners_and_numbers_from_the_end(tmp_path: Path) -> None:
    corners = "v 0 0 0\nv 0.01 0 0\nv 0.01 0.01 0\nv 0 0.01 0\n"
    for number, face in enumerate(("f 1 2 3 4", "f -4 -3 -2 -1", "f 1/1/1 2//2 3/3 \\\n 4")):
        file = tmp_path / f"{number}.obj"
        file.write_text(f"{corners}{face}\n")
        mesh = mesh_of(ObjectSpec(file=file))
        assert mesh is not None and {*mesh.triangles.ravel().tolist()} == {0, 1, 2, 3}
        assert len(mesh.triangles) == 2


BAD_FILES = {
    "gone.ply": (None, "No such file"),
    "empty.ply": (b"", "no PLY header"),
    "nothing.ply": (ply(0, 0, ""), "holds no points"),
    "nothing.obj": (b"# nothing\n", "holds no triangles"),
    "nan.ply": (ply(body=CORNERS.replace("0.01", "nan", 1) + "3 0 1 2\n"), "1 of its 3 vertices"),
    "huge.xyz": (b"0 8 5" + b"1" * 40, "1 of its 1 vertices"),
    "far.ply": (ply(body=CORNERS.replace("0.01", "10") + "3 0 1 2\n"), "for millimetres set scale: 0.001"),
    "tiny.ply": (ply(body=CORNERS.replace("0.01", "1e-5") + "3 0 1 2\n"), "for metres set scale: 1"),
    **{f"{face}.ply": (ply(body=f"{CORNERS}{face}\n"), "a face names a vertex that is not there")
       for face in ("3 0 1 3", "3 0 1 -1", "5 0 1 2 0 2147483647")},
    **{f"binary {corner}.ply": (binary_ply(0, 1, corner), "a face names a vertex that is not there")
       for corner in (3, -1, 2**31 - 1)},
    **{f"{face}.ply": (ply(body=f"{CORNERS}{face}\n"), f"{few} different corners of {face[0]}")
       for face, few in (("0", 0), ("2 0 1", 2), ("4 0 1 2 1", 3))},
    "short.ply": (ply(faces=2), "it ends too early"),
    "index.obj": (b"v 0 0 0\nv 1 0 0\nf 1 2 3\n", "a vertex that is not there"),
    "zero.obj": (b"v 0 0 0\nv 1 0 0\nf 0 1 2\n", "the first one is 1"),
    "word.obj": (b"v 0 0 zero\n", "could not convert"),
    "half.obj": (b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\nv 0 1", "a point has 2 numbers"),
    **{f"before {cut}.stl": (TEXT_STL[: TEXT_STL.rindex(cut)], "it breaks off: ")
       for cut in ("facet", "02 0", "1 0", "endfacet", "endsolid")},
    "columns.xyz": (b"0 0\n0 0.01\n0.01 0\n", "a point has 2 numbers"),
    "counted.xyz": (b"1 0 0 0\n2 0 0.01 0\n3 0.01 0 0\n", "counts its lines; remove it"),
    "strips.ply": (ply().replace(b"element face", b"element tristrips"), "its tristrips elements"),
    "called.ply": (ply().replace(b"vertex_indices", b"corners"), "only faces with vertex_indices"),
    "half.stl": (b"solid a\nvertex 0 0 0\nvertex 1 0 0\n", "is damaged"),
    "less.pcd": (b"# .PCD\nFIELDS x y z\nPOINTS 2\nDATA ascii\n0 0 0\n", "1 points of 2"),
    "word.xyz": (b"0 0 0\n0 0 zero\n", "could not convert"),
    "claims.ply": (ply(3_000_000_000), "claims 3000000001 elements"),
    "claims.stl": (bytes(80) + (10**9).to_bytes(4, "little"), "1000000000 triangles"),
    "claims.pcd": (b"# .PCD\nFIELDS x y z\nPOINTS 999999999\nDATA binary\n", "claims 999999999"),
    "packed.pcd": (b"# .PCD\nFIELDS x y z\nPOINTS 9\nDATA binary_compressed\n", "save it as ascii or binary"),
    "mesh.gltf": (b"{}", "must end in one of"),
    "large.stl": ("solid\n" * (12 << 20), "64 at most are read"),
}  # fmt: skip


@pytest.mark.fault("file: a mesh whose faces name corners that there are not")
@pytest.mark.parametrize("name", BAD_FILES)
def test_a_bad_mesh_is_one_clear_message(name: str, tmp_path: Path) -> None:
    content, said = BAD_FILES[name]
    if content is not None:
        (tmp_path / name).write_bytes(content.encode() if isinstance(content, str) else content)
    (tmp_path / "scene.yaml").write_text(f"objects: [{{file: {name}, anchors: [{{pixel: [1, 2]}}]}}]")
    refused(2, "overlay", "--scene", tmp_path / "scene.yaml", said=(name, said))


@pytest.mark.parametrize(("rest", "warned"), [("", 1), ("\n", 0), (" 4", 0)])
def test_a_mesh_without_an_end_mark_that_may_have_broken_off_is_warned_of(
    rest: str, warned: int, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "a.obj").write_text(f"v 0 0 0\nv 0.01 0 0\nv 0 0.01 0\nv 0.01 0.01 0\nf 1 2 3{rest}")
    assert mesh_of(ObjectSpec(file=tmp_path / "a.obj")) is not None
    said = [each.getMessage() for each in caplog.records]
    assert len(said) == warned and all("a.obj" in each and "1 of its 4 vertices" in each for each in said)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("objects: [{shape: target, colour: [1, 2, 3]}]", "'objects.0.colour'; did you mean 'color'?"),
        ("objects: []", "objects: "),
        ("objects: [{color: [1, 2, 3]}]", "needs a file, a shape or a label"),
        ("objects: [{shape: target, file: a.ply}]", "a file or a shape, not both"),
        ("objects: [{shape: target, anchors: [{pixel: [1, 2]}, {pixel: [3, 4]}]}]", "two anchors"),
        ("objects: [{shape: target, anchors: [{pixel: [1, 2], place: [1, 2, 3]}]}]", "either pixel: [u, v]"),
        ("objects: [{shape: target, color: [0, 0, 240]}]", "too near the key colour"),
        ("objects: [{shape: target, deform: true}]", "deform: true needs a file, and three anchors"),
        ("objects: [{shape: target, deform_depth_mm: 9}]", "deform_depth_mm says how deep `deform: true`"),
        ("objects: [{shape: sphere, scale: 2}]", "scale is of a file, which this object has not"),
        ("objects: [{file: a.ply, coordinates: world, anchors: [{pixel: [1, 2]}]}]", "coordinates is for"),
        ("objects: [{shape: target, margin: 5}]", "objects.0.margin: a margin is in metres"),
        ("objects: [{shape: target, margin: 0}]", "for 5 mm write 0.005"),
        ("objects: [{label: a, margin: 0.005}]", "margin makes a forbidden zone of a file or a shape"),
        ("{color_key: [255, 90, 40], objects: [{shape: target, margin: 0.01}]}", "what a tip is too near to"),
        ("objects: [{shape: target, color: [0.2, 0.8, 1]}]", "multiply 0..1 by 255"),
        ("{color_key: [0, 0, 1], objects: [{shape: target}]}", "color_key: a colour is bytes of 0..255"),
        ("objects: [{shape: target, color: [9, 9, 9, 255]}]", "how opaque it is says `opacity:`"),
    ],
)  # fmt: skip
def test_a_wrong_scene_is_one_clear_message(text: str, said: str, tmp_path: Path) -> None:
    (tmp_path / "scene.yaml").write_text(text)
    refused(2, "overlay", "--scene", tmp_path / "scene.yaml", said=("scene.yaml", said))
    with pytest.raises(UsageError) as caught:
        read_scene(tmp_path / "scene.yaml")
    assert ("at least 1 item" in str(caught.value)) == (text == "objects: []")  # a wrong object is there


def test_other_mistakes_are_named(tmp_path: Path) -> None:
    scene = tmp_path / "scene.yaml"
    refused(2, "overlay", "--scene", scene, said=("scene.yaml", "check the path"))
    scene.write_text("objects: [{shape: target}]")
    refused(2, "overlay", "--scene", scene, "--pin", "3", "4", said=("--pin is for the built-in target",))
    for pin in (("nan", "4"), ("3", "inf")):
        refused(2, "overlay", "--pin", *pin, said=("built-in scene", "should be a finite number"))
    refused(2, "overlay", "--scene", scene, "--endpoint", "tcp://127.0.0.1:9", said=("--control",))
