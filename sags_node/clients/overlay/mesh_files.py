"""Vertices and triangles of PLY, OBJ and STL files, points of PLY, PCD and XYZ files; nothing else of them.

Such files come from anywhere. Open3D's readers do not look at the length of a line or at the corners of a
polygon, and end the process where something is wrong. trimesh's accept a file that breaks off, and take a
vertex 0 of OBJ for the last one. Here Python and numpy read every number, and all must be there.
"""

import logging
import re
import struct
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from sags_node.errors import UsageError
from sags_node.types import F64, I32

STL_START, STL_TRIANGLE = 84, 50  # bytes of a binary STL file
_STL_TRIANGLE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_PLY_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip
_PLY_PROPERTY = re.compile(r"property\s+(?:list\s+(\w+)\s+)?(\w+)\s+(\S+)")
_PLY_CORNERS = ("vertex_indices", "vertex_index")
MOST_CORNERS = 64  # of one face

Shape = tuple[F64, I32]
Face = Sequence[int]

log = logging.getLogger(__name__)


class _OtherFormError(Exception):
    """A file is sound, but its form is not read; the message says what to do."""


def parse_mesh(file: Path, data: bytes) -> Shape:
    """Read points [V, 3] and triangles [T, 3] (none of a point cloud) from the content of a file.

    Raises:
        UsageError: it cannot be read to its end, or a face names a vertex that is not there.
    """
    parse = {".ply": _ply, ".obj": _obj, ".stl": _stl, ".pcd": _pcd, ".xyz": _xyz}[file.suffix.lower()]
    try:
        points, faces = parse(data)
        if parse is _obj and not data.endswith((b"\n", b"\r")):
            _warn_of_the_rest(file, points, faces)
        points, triangles = _welded(points, triangulate(points, faces))
    except (ValueError, KeyError, IndexError, TypeError, OverflowError, struct.error) as error:
        why = str(error).partition("\n")[0][:100] or "it ends too early"
        raise UsageError(f"{file} is damaged: {why}; open it in a mesh viewer") from None
    except _OtherFormError as error:
        raise UsageError(f"{file}: {error}") from None
    return points, triangles


def _warn_of_the_rest(file: Path, points: F64, faces: Sequence[Face]) -> None:
    """OBJ has no mark at its end: one that broke off lacks a line break, and faces for its last vertices."""
    free = len(points) - len({corner for face in faces for corner in face})
    if free > 0:
        log.warning(
            "%s has no line break at its end, and %d of its %d vertices are in no face: if it broke off, "
            "export it again",
            *(file, free, len(points)),
        )


def _welded(points: F64, triangles: I32) -> Shape:
    """Merge vertices at one place, which exporters split where normals differ. Drop triangles that have no
    area or come twice: they spoil the count of crossings that tells inside from outside."""
    if not len(triangles):
        return points, triangles
    points, numbers = np.unique(points, axis=0, return_inverse=True)
    triangles = numbers.reshape(-1)[triangles].astype(np.int32)
    first, second, third = points[triangles].swapaxes(0, 1)
    triangles = triangles[np.cross(second - first, third - first).any(axis=1)]
    if not len(triangles):
        raise ValueError("none of its triangles has an area")
    _, first = np.unique(np.sort(triangles, axis=1), axis=0, return_index=True)
    return points, triangles[np.sort(first)]


def _rows(lines: Sequence[Sequence[bytes]]) -> F64:
    """Points [V, 3]: the first three words of each line."""
    fewest = min(map(len, lines), default=3)
    if fewest < 3:
        raise ValueError(f"a point has {fewest} numbers, not x y z")
    return np.array([[float(word) for word in line[:3]] for line in lines]).reshape(-1, 3)


# ---- PLY -------------------------------------------------------------------------------------------------


class _Numbers:
    """The body of a PLY file, one number after the other."""

    def __init__(self, form: str, body: bytes) -> None:
        self._order = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}[form]
        self._words = [] if self._order else body.split()
        self._body = body.partition(b"\n")[2]
        self._at = 0

    def table(self, kinds: Sequence[str], rows: int) -> F64:
        """The next `rows` rows of numbers of these types, [rows, kinds]."""
        at = self._at
        if not self._order:
            self._at += rows * len(kinds)
            words = self._words[at : self._at]
            return np.array([float(word) for word in words]).reshape(rows, len(kinds))
        row = np.dtype([(str(number), self._order + kind) for number, kind in enumerate(kinds)])
        self._at += rows * row.itemsize
        values = np.frombuffer(self._body, row, rows, at)
        return np.column_stack([values[name].astype(np.float64) for name in row.names or ()])

    def take(self, kind: str, count: int) -> list[float]:
        """The next numbers, all of one type."""
        if count < 0:
            raise ValueError(f"a list of {count} numbers")
        at = self._at
        if not self._order:
            self._at += count
            if self._at > len(self._words):
                raise ValueError("it ends too early")
            return [float(word) for word in self._words[at : self._at]]
        kind = self._order + kind
        self._at += count * np.dtype(kind).itemsize
        values: list[float] = np.frombuffer(self._body, kind, count, at).tolist()
        return values


def _ply(data: bytes) -> tuple[F64, list[Face]]:
    header, _, body = data.partition(b"end_header")
    points: F64 = np.zeros((0, 3))
    faces: list[Face] = []
    first, *elements = re.split(r"^element\s+", header.decode("latin-1"), flags=re.MULTILINE)
    form = re.search(r"^format\s+(\w+)", first, re.MULTILINE)
    if form is None:
        raise ValueError("its header names no format")
    numbers = _Numbers(form[1], body)
    for element in elements:
        head, *lines = element.splitlines()
        name, count = head.split()
        found = [match.groups() for match in map(_PLY_PROPERTY.match, lines) if match is not None]
        names = [called for _, _, called in found]
        kinds = [(length and _PLY_TYPES[length], _PLY_TYPES[kind]) for length, kind, _ in found]
        if all(length is None for length, _ in kinds):
            table = numbers.table([kind for _, kind in kinds], int(count))
            if name == "vertex":
                points = table[:, [names.index(axis) for axis in "xyz"]]
            continue
        corners = next((number for number, called in enumerate(names) if called in _PLY_CORNERS), None)
        if int(count) and (name == "face") != (corners is not None):
            raise _OtherFormError(
                f"its {name} elements are not read, only faces with vertex_indices; save it with these"
            )
        for _ in range(int(count)):
            row = [
                numbers.take(kind, 1 if length is None else int(numbers.take(length, 1)[0]))
                for length, kind in kinds
            ]
            if corners is not None:
                faces.append([int(corner) for corner in row[corners]])
    return points, faces


# ---- OBJ, STL --------------------------------------------------------------------------------------------


def _obj(data: bytes) -> tuple[F64, list[Face]]:
    lines = data.replace(b"\\\r\n", b" ").replace(b"\\\n", b" ").splitlines()
    vertices: list[Sequence[bytes]] = []
    faces: list[Face] = []
    for line in map(bytes.strip, lines):
        if line.startswith((b"v ", b"v\t")):
            vertices.append(line.split()[1:])
        elif line.startswith((b"f ", b"f\t")):
            said = [int(word.partition(b"/")[0]) for word in line.split()[1:]]
            if 0 in said:
                raise ValueError("a face names vertex 0, and the first one is 1")
            faces.append([number - 1 if number > 0 else len(vertices) + number for number in said])
    return _rows(vertices), faces


def stl_triangles(start: bytes, size: int) -> int | None:
    """Return how many triangles a binary STL file of `size` bytes claims; None: it is an ASCII file."""
    claimed = int.from_bytes(start[STL_START - 4 : STL_START], "little")
    is_text = start.lstrip().lower().startswith(b"solid") and size != STL_START + claimed * STL_TRIANGLE
    return None if is_text else claimed


def _stl_words(data: bytes) -> list[bytes]:
    """All words of an ASCII STL file in lower case, without the names of solids, which may be any words."""
    words: list[bytes] = []
    for line in data.lower().splitlines():
        said = line.split()
        words += said[:1] if said[:1] in ([b"solid"], [b"endsolid"]) else said
    return words


def _stl(data: bytes) -> tuple[F64, list[Face]]:
    claimed = stl_triangles(data[:STL_START], len(data))
    if claimed is None:
        words = _stl_words(data)
        places = [number for number, word in enumerate(words) if word == b"vertex"]
        facets, ended = words.count(b"facet"), words.count(b"endfacet")
        if not len(places) == 3 * facets == 3 * ended or words[-1] != b"endsolid":
            raise ValueError(
                f"it breaks off: {facets} facet, {len(places)} vertex, {ended} endfacet; its last word is "
                f"{words[-1].decode('latin-1')}"
            )
        corners = np.array([[float(word) for word in words[at + 1 : at + 4]] for at in places])
    else:
        corners = np.frombuffer(data, _STL_TRIANGLE, claimed, STL_START)["corners"].astype(np.float64)
    corners = corners.reshape(-1, 3)
    faces: list[Face] = list(np.arange(len(corners)).reshape(-1, 3).tolist())
    return corners, faces


# ---- points ----------------------------------------------------------------------------------------------


def _pcd(data: bytes) -> tuple[F64, list[Face]]:
    """Read the forms ascii and binary
    (https://pointclouds.org/documentation/tutorials/pcd_file_format.html)."""
    header, _, rest = data.partition(b"\nDATA ")
    form, _, body = rest.partition(b"\n")
    said = {
        line.split()[0]: line.split()[1:] for line in header.decode("latin-1").splitlines() if line.strip()
    }
    names, count = said["FIELDS"], int(said["POINTS"][0])
    repeats = [int(number) for number in said.get("COUNT", ["1"] * len(names))]
    if form.strip() == b"ascii":
        first = dict(zip(names, np.cumsum([0, *repeats]).tolist(), strict=False))
        rows = [line.split() for line in body.splitlines() if line.strip()]
        if len(rows) != count:
            raise ValueError(f"it has {len(rows)} points of {count}")
        points = np.array([[float(row[first[axis]]) for axis in "xyz"] for row in rows])
        return points.reshape(-1, 3), []
    kinds = [kind.lower() + size for kind, size in zip(said["TYPE"], said["SIZE"], strict=True)]
    fields = zip(kinds, repeats, strict=True)
    row = np.dtype([(str(number), f"<{kind}", (times,)) for number, (kind, times) in enumerate(fields)])
    values = np.frombuffer(body, row, count)
    axes = [values[str(names.index(axis))][:, 0].astype(np.float64) for axis in "xyz"]
    return np.column_stack(axes), []


def _xyz(data: bytes) -> tuple[F64, list[Face]]:
    lines = [line.split() for line in data.splitlines() if line.strip() and not line.startswith(b"#")]
    points = _rows(lines)
    if (
        len(points) > 2
        and len(lines[0]) > 3
        and points[0, 0] in (0, 1)
        and np.all(np.diff(points[:, 0]) == 1)
    ):
        raise _OtherFormError("its first column counts its lines; remove it, so that each begins with x y z")
    return points, []


# ---- polygons --------------------------------------------------------------------------------------------


def triangulate(points: F64, faces: Sequence[Sequence[int]]) -> I32:
    """Cut faces with three corners or more into triangles [T, 3]; `points` are [V, 3].

    Raises:
        ValueError: a face names a vertex that is not there, or one twice, or has too many or too few corners.
    """
    triangles: list[Sequence[int]] = []
    for face in faces:
        if not all(0 <= corner < len(points) for corner in face):
            raise ValueError("a face names a vertex that is not there")
        if len(face) == 3:
            triangles.append(face)
        elif 3 < len(face) <= MOST_CORNERS and len(set(face)) == len(face):
            triangles += [[face[number] for number in triangle] for triangle in _cut(points[list(face)])]
        else:
            raise ValueError(f"a face has {len(set(face))} different corners of {len(face)}")
    return np.array(triangles, np.int32).reshape(-1, 3)


def _cut(corners: F64) -> list[Sequence[int]]:
    """The triangles of a polygon [N, 3], convex or not, by ear clipping."""
    flat = _flattened(corners)
    left = list(range(len(flat)))
    triangles: list[Sequence[int]] = []
    while len(left) > 3:
        ear = next((at for at in range(len(left)) if _is_ear(flat, left, at)), 0)  # 0: it crosses itself
        triangles.append((left[ear - 1], left[ear], left[(ear + 1) % len(left)]))
        del left[ear]
    return [*triangles, tuple(left)]


def _flattened(corners: F64) -> list[tuple[float, float]]:
    """The polygon projected to the two axes in which it is largest, counterclockwise."""
    following = np.roll(corners, -1, axis=0)
    normal = np.cross(corners, following).sum(0)  # twice its area, by Newell
    axis = int(np.abs(normal).argmax())
    first, second = (axis + 1) % 3, (axis + 2) % 3
    if normal[axis] < 0:
        first, second = second, first
    return [(float(corner[first]), float(corner[second])) for corner in corners]


def _is_ear(flat: list[tuple[float, float]], left: list[int], at: int) -> bool:
    """Whether a corner is convex, and no other corner lies in the triangle that it cuts off."""
    a, b, c = left[at - 1], left[at], left[(at + 1) % len(left)]
    if _turn(flat[a], flat[b], flat[c]) <= 0:
        return False
    ring = [(flat[a], flat[b]), (flat[b], flat[c]), (flat[c], flat[a])]
    others = (flat[p] for p in left if p not in (a, b, c))
    return not any(all(_turn(*side, other) >= 0 for side in ring) for other in others)


def _turn(a: tuple[float, float], b: tuple[float, float], c: tuple[float, float]) -> float:
    """Twice the area of a triangle; positive where it turns left."""
    return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
