"""Meshes and point clouds from files, checked before anything is drawn with them, and the built-in shapes.

Everything ends as one triangle mesh in metres; a point becomes a small octahedron.
"""

import re
from codecs import BOM_UTF8
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sags_node.clients.overlay.mesh_files import STL_START, STL_TRIANGLE, parse_mesh, stl_triangles
from sags_node.clients.overlay.pose import on_surface
from sags_node.clients.overlay.scene import ObjectSpec, checked
from sags_node.errors import UsageError
from sags_node.files import read_file
from sags_node.geometry import transform
from sags_node.types import F32, F64, I32

MAX_FILE_BYTES = 64 << 20
MAX_TRIANGLES = 200_000
MAX_POINTS = 20_000
LARGEST = 1.0  # m across: nothing in a body is larger
SMALLEST = 5e-4  # m across: nobody sees what is smaller, and a zone so small warns of nothing
HEADER_BYTES = 1 << 16
GREEN = (60, 230, 120)  # RGB
ROD = 0.0003  # m, the radius of a line
LEAN = np.radians(35)  # rad, tilt of the target's arrow: along the line of sight it would be a dot

_MESHES, _POINTS = (".ply", ".obj", ".stl"), (".ply", ".pcd", ".xyz")
_KINDS = " ".join(dict.fromkeys(_MESHES + _POINTS))


@dataclass(frozen=True, slots=True)
class Mesh:
    vertices: F32  # [V, 3] m
    triangles: I32  # [T, 3]
    colors: F32  # [T, 3] RGB 0..255


def mesh_of(spec: ObjectSpec) -> Mesh | None:
    """The surface of an object; None for a mere label.

    Raises:
        UsageError: its file cannot be read, or holds nothing that can be drawn.
    """
    if spec.shape is not None:
        return _target(spec.color) if spec.shape == "target" else _marker(spec.color)
    return None if spec.file is None else _load(spec, spec.file)


def surface_of(file: Path, scale: float) -> Mesh:
    """Read the triangles of a file, which must not be a point cloud; `scale`: metres per unit of the file.

    Raises:
        UsageError: as `mesh_of`, or it holds points only.
    """
    if file.suffix.lower() not in _MESHES:
        raise UsageError(f"{file} is no surface: the name must end in one of {' '.join(_MESHES)}")
    return _load(checked(ObjectSpec, {"file": file, "scale": scale}, file), file, points_too=False)


# ---- files -----------------------------------------------------------------------------------------------


def _load(spec: ObjectSpec, file: Path, points_too: bool = True) -> Mesh:
    points, triangles = parse_mesh(file, _content(file))
    may_be_points = points_too and file.suffix.lower() in _POINTS
    what = "triangles" if len(triangles) or not may_be_points else "points"
    count, most = (len(triangles), MAX_TRIANGLES) if what == "triangles" else (len(points), MAX_POINTS)
    if count == 0:
        raise UsageError(f"{file} holds no {what}, or is damaged; open it in a mesh viewer")
    if count > most:
        raise UsageError(f"{file} holds {count} {what}, {most} at most can be drawn; simplify it")
    with np.errstate(over="ignore"):
        points = (points * spec.scale).astype(np.float32).astype(np.float64)  # rounded as they will be drawn
    _check_vertices(file, points)
    if what == "points":
        points, triangles = _octahedra(points, spec.point_size)
    return Mesh(points.astype(np.float32), triangles, _painted(len(triangles), spec.color))


def _content(file: Path) -> bytes:
    """The bytes of a file, after a check that it is what its name says and not too large for the memory."""
    kind = file.suffix.lower()
    if f"{kind} " not in f"{_KINDS} ":
        raise UsageError(f"cannot draw {file}: the name must end in one of {_KINDS}")
    try:
        size = file.stat().st_size
        if size > MAX_FILE_BYTES:
            most = MAX_FILE_BYTES >> 20
            raise UsageError(f"{file} has {size >> 20} MiB, {most} at most are read; simplify it")
        data = read_file(file, MAX_FILE_BYTES).removeprefix(BOM_UTF8)  # Windows puts it before text
    except OSError as error:
        raise UsageError(f"cannot read {file}: {error.strerror}; check the path") from None
    start, size, claimed = data[:HEADER_BYTES], len(data), 0
    if kind == ".ply":
        header, ended, _ = start.partition(b"end_header")
        if not header.startswith(b"ply") or not ended:
            raise UsageError(f"{file} is no PLY file, or is damaged: it has no PLY header")
        claimed = sum(int(number) for number in re.findall(rb"element\s+\S+\s+(\d+)", header))
    elif kind == ".pcd":
        header, ended, _ = start.partition(b"\nDATA ")
        if not ended:
            raise UsageError(f"{file} is no PCD file, or is damaged: it has no PCD header")
        if start.startswith(b"binary_compressed", len(header) + len(ended)):
            raise UsageError(f"{file} is a compressed PCD file; save it as ascii or binary")
        claimed = max(
            (int(number) for number in re.findall(rb"\n(?:POINTS|WIDTH)\s+(\d+)", header)), default=0
        )
    elif kind == ".stl":
        claimed = stl_triangles(start, size) or 0
        if claimed and size != STL_START + claimed * STL_TRIANGLE:
            raise UsageError(f"{file} is damaged: its size does not fit its {claimed} triangles")
    if claimed > size:  # each takes at least a byte
        raise UsageError(f"{file} is damaged: it claims {claimed} elements in {size} bytes")
    return data


def _check_vertices(file: Path, vertices: F64) -> None:
    if not np.isfinite(vertices).all():
        bad = int((~np.isfinite(vertices).all(1)).sum())
        raise UsageError(
            f"{file}: {bad} of its {len(vertices)} vertices are not finite or far too large; fix the file"
        )
    across = float(np.ptp(vertices, axis=0).max())
    if across > LARGEST:
        raise UsageError(
            f"{file} is {across:.3g} m across, {LARGEST:g} m at most makes sense; "
            "for millimetres set scale: 0.001"
        )
    if across < SMALLEST and len(vertices) > 1:
        raise UsageError(
            f"{file} is {1e3 * across:.3g} mm across, {1e3 * SMALLEST:g} mm at least make sense; "
            "for metres set scale: 1"
        )


def _octahedra(points: F64, radius: float) -> tuple[F64, I32]:
    corners = radius * np.concatenate([np.eye(3), -np.eye(3)])
    faces = np.array([[i, j, k] for i in (0, 3) for j in (1, 4) for k in (2, 5)], np.int32)
    starts = 6 * np.arange(len(points), dtype=np.int32)[:, None, None]
    return (points[:, None] + corners).reshape(-1, 3), (starts + faces).reshape(-1, 3)


# ---- built-in shapes: the anchor is the origin, z points away from the tissue ------------------------------


def _target(color: tuple[int, int, int]) -> Mesh:
    """A ring on the surface and an arrow that points at its middle."""
    around = np.linspace(0, 2 * np.pi, 11)
    ring = _turned(0.0035 + 0.0005 * np.cos(around), 0.0005 * np.sin(around), 48)
    head, back, tip = -0.0035, -0.010, 0.0  # along z: where the cone begins, the shaft's end, the tip
    points, triangles = _turned(
        np.array([0, 0.0004, 0.0004, 0.0012, 0]), np.array([back, back, head, head, tip]), 20
    )
    cos, sin = np.cos(np.pi - LEAN), np.sin(np.pi - LEAN)
    leaning = points @ np.array([[1, 0, 0], [0, cos, -sin], [0, sin, cos]]).T + (0.0, 0.0, 0.001)
    return _joined([(ring, GREEN), ((leaning, triangles), color)])


def _marker(color: tuple[int, int, int]) -> Mesh:
    """A ball of 2 mm radius around the anchor."""
    angles = np.linspace(-np.pi / 2, np.pi / 2, 17)
    return _joined([(_turned(0.002 * np.cos(angles), 0.002 * np.sin(angles), 32), color)])


def rod(start: F64, end: F64, color: tuple[int, int, int]) -> Mesh:
    """Return a thin line between two different places [3] (m)."""
    length = float(np.linalg.norm(end - start))
    points, triangles = _turned(np.array([0, ROD, ROD, 0]), np.array([0, 0, length, length]), 8)
    way = (end - start) / length
    T = on_surface(start, np.zeros(3), way, np.eye(3)[int(np.abs(way).argmin())])
    return Mesh(np.asarray(transform(T, points), np.float32), triangles, _painted(len(triangles), color))


def _turned(radii: F64, heights: F64, segments: int) -> tuple[F64, I32]:
    """Vertices [V, 3] and outward triangles [T, 3] of a profile (m, running up) revolved about z."""
    angles = 2 * np.pi * np.arange(segments) / segments
    rings = [radii[:, None] * np.cos(angles), radii[:, None] * np.sin(angles)]
    vertices = np.stack([*rings, np.repeat(heights[:, None], segments, 1)], -1).reshape(-1, 3)
    ring, place = np.divmod(np.arange((len(radii) - 1) * segments), segments)
    start, beside = ring * segments + place, ring * segments + (place + 1) % segments
    lower = np.stack([start, beside, beside + segments], -1)[radii[ring] > 1e-9]
    upper = np.stack([start, beside + segments, start + segments], -1)[radii[ring + 1] > 1e-9]
    return vertices, np.concatenate([lower, upper]).astype(np.int32)


def _joined(parts: Sequence[tuple[tuple[F64, I32], tuple[int, int, int]]]) -> Mesh:
    starts = np.cumsum([0, *(len(vertices) for (vertices, _), _ in parts)])
    numbered = zip(parts, starts, strict=False)
    return Mesh(
        np.concatenate([vertices for (vertices, _), _ in parts]).astype(np.float32),
        np.concatenate([triangles + np.int32(start) for ((_, triangles), _), start in numbered]),
        np.concatenate([_painted(len(triangles), color) for (_, triangles), color in parts]),
    )


def _painted(count: int, color: tuple[int, int, int]) -> F32:
    return np.tile(np.array(color, np.float32), (count, 1))
