"""Points and meshes as PLY, PCD, OBJ and STL files.

Open3D's writers report success on a full disk. Here a file is made in memory, and Python writes it.
"""

from collections.abc import Sequence
from io import BytesIO
from typing import NamedTuple

import numpy as np

from sags_node.types import F32, I32, U8

_STL_TRIANGLE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_PLY_FACE = np.dtype([("count", "u1"), ("corners", "<i4", 3)])


class Surface(NamedTuple):
    """Points, m, and what is known of them; with triangles it is a mesh."""

    points: F32  # [N, 3]
    colors: U8  # [N, 3] RGB
    normals: F32 | None = None  # [N, 3]
    triangles: I32 | None = None  # [T, 3] indices of points


def encoded(suffix: str, surface: Surface) -> bytes:
    """The content of a file with this suffix; .stl has no colours."""
    return {".ply": _ply, ".pcd": _pcd, ".obj": _obj, ".stl": _stl}[suffix.lower()](surface)


def _ply(surface: Surface) -> bytes:
    columns: list[tuple[str, str, F32 | U8]] = [("float", "x y z", surface.points)]
    if surface.normals is not None:
        columns.append(("float", "nx ny nz", surface.normals))
    columns.append(("uchar", "red green blue", surface.colors))
    head = ["ply", "format binary_little_endian 1.0", f"element vertex {len(surface.points)}"]
    head += [f"property {kind} {name}" for kind, names, _ in columns for name in names.split()]
    faces = b""
    if surface.triangles is not None:
        head += [f"element face {len(surface.triangles)}", "property list uchar int vertex_indices"]
        rows = np.empty(len(surface.triangles), _PLY_FACE)
        rows["count"], rows["corners"] = 3, surface.triangles
        faces = rows.tobytes()
    return _lines([*head, "end_header"]) + _side_by_side([values for _, _, values in columns]) + faces


def _pcd(surface: Surface) -> bytes:
    """A colour is one number whose bytes are blue, green, red and 0, as the Point Cloud Library has it."""
    bgr0 = np.zeros((len(surface.points), 4), np.uint8)
    bgr0[:, :3] = surface.colors[:, ::-1]
    count = len(surface.points)
    head = ["VERSION 0.7", "FIELDS x y z rgb", "SIZE 4 4 4 4", "TYPE F F F F", "COUNT 1 1 1 1"]
    head += [f"WIDTH {count}", "HEIGHT 1", "VIEWPOINT 0 0 0 1 0 0 0", f"POINTS {count}", "DATA binary"]
    return _lines(head) + _side_by_side([surface.points, bgr0])


def _obj(surface: Surface) -> bytes:
    """A mesh with normals; colours stand behind the points, where most programs look for them."""
    assert surface.normals is not None and surface.triangles is not None
    text = BytesIO()
    coloured = np.column_stack([surface.points, surface.colors / 255])
    np.savetxt(text, coloured, "v %.7g %.7g %.7g %.4g %.4g %.4g")
    np.savetxt(text, surface.normals, "vn %.4g %.4g %.4g")
    np.savetxt(text, np.repeat(surface.triangles + 1, 2, axis=1), "f %d//%d %d//%d %d//%d")
    return text.getvalue()


def _stl(surface: Surface) -> bytes:
    assert surface.triangles is not None
    corners = surface.points[surface.triangles]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    rows = np.zeros(len(corners), _STL_TRIANGLE)
    rows["corners"] = corners
    rows["normal"] = across / np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-30)
    return bytes(80) + np.uint32(len(rows)).tobytes() + rows.tobytes()


def _lines(lines: Sequence[str]) -> bytes:
    return "".join(f"{line}\n" for line in lines).encode()


def _side_by_side(columns: Sequence[F32 | U8]) -> bytes:
    """The bytes of all columns, row by row, each in its own type."""
    return np.hstack([np.ascontiguousarray(each).view(np.uint8) for each in columns]).tobytes()
