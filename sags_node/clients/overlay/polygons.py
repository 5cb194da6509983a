"""Polygons of a mesh, cut into triangles."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sags_node.types import F64, I32

MOST_CORNERS = 64  # of one face


def triangulate(points: F64, faces: Sequence[Sequence[int]]) -> I32:
    """Triangles [T, 3] of faces with three corners and more; `points` are [V, 3].

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
    """Ears of a polygon [N, 3] that need not be convex, one after the other."""
    flat = _flattened(corners)
    left = list(range(len(flat)))
    triangles: list[Sequence[int]] = []
    while len(left) > 3:
        ear = next((at for at in range(len(left)) if _is_ear(flat, left, at)), 0)  # 0: it crosses itself
        triangles.append((left[ear - 1], left[ear], left[(ear + 1) % len(left)]))
        del left[ear]
    return [*triangles, tuple(left)]


def _flattened(corners: F64) -> list[tuple[float, float]]:
    """In the two axes in which the polygon is largest, counterclockwise."""
    following = np.roll(corners, -1, axis=0)
    normal = np.cross(corners, following).sum(0)  # twice its area, by Newell
    axis = int(np.abs(normal).argmax())
    first, second = (axis + 1) % 3, (axis + 2) % 3
    if normal[axis] < 0:
        first, second = second, first
    return [(float(corner[first]), float(corner[second])) for corner in corners]


def _is_ear(flat: list[tuple[float, float]], left: list[int], at: int) -> bool:
    """A corner that points outwards, with no other one inside."""
    a, b, c = left[at - 1], left[at], left[(at + 1) % len(left)]
    if _turn(flat[a], flat[b], flat[c]) <= 0:
        return False
    ring = [(flat[a], flat[b]), (flat[b], flat[c]), (flat[c], flat[a])]
    others = (flat[p] for p in left if p not in (a, b, c))
    return not any(all(_turn(*side, other) >= 0 for side in ring) for other in others)


def _turn(a: tuple[float, float], b: tuple[float, float], c: tuple[float, float]) -> float:
    """Twice the area of a triangle; positive where it turns left."""
    return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
