"""The two surfaces of a registration: the model's, and the tissue's as it was measured for a moment."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sags_node.confidence import LEAST, error_of
from sags_node.geometry import Array, unproject
from sags_node.types import F32, F64, I32, Bool, Camera

MIRROR = np.array([-1.0, 1.0, 1.0])
POINTS = 1500  # points that are taken of one frame, about
NINE_OF_TEN = 1.645  # standard deviations, within which nine of ten errors of a depth lie
DIRECTIONS = 99  # of rays that tell inside from outside; odd, so that there is a majority
BEHIND = 1.01  # a ray that meets nothing before 1 / `BEHIND` of the way to a triangle reaches it


class Shape:
    """A model: triangles [T, 3] between vertices [V, 3] (m, in its own coordinates), searched by Open3D."""

    def __init__(self, vertices: F64, triangles: I32) -> None:
        import open3d.core as o3c
        from open3d.t.geometry import RaycastingScene

        self.vertices, self.triangles = vertices, triangles
        self._tensor = o3c.Tensor.from_numpy
        self._scene: Any = RaycastingScene()
        corners = np.ascontiguousarray(triangles.astype(np.uint32))
        self._scene.add_triangles(self._tensor(vertices.astype(np.float32)), self._tensor(corners))

    def facing(self, eye: Array) -> Shape:
        """Return the part that an eye at [3] sees: the triangles whose middles nothing hides. Their winding
        does not count, as files have it either way."""
        middles = self.vertices[self.triangles].mean(1)
        seen = self._meets(eye, middles) > 1 / BEHIND
        return Shape(self.vertices, self.triangles[seen])

    def nearest(self, points: Array) -> tuple[F64, F64]:
        """The nearest places on it to points [N, 3], and its unit normals there, both [N, 3]."""
        found = self._scene.compute_closest_points(self._tensor(points.astype(np.float32)))
        return found["points"].numpy().astype(np.float64), found["primitive_normals"].numpy().astype(
            np.float64
        )

    def contains(self, points: Array) -> Bool:
        """Tell which points [N, 3] lie inside: most rays from there cross it an odd number of times
        (Nooruddin and Turk 2003). As most are enough, it may have holes."""
        rays = np.empty((len(points), DIRECTIONS, 6), np.float32)
        rays[..., :3], rays[..., 3:] = points[:, None], _all_round(DIRECTIONS)
        crossed = self._scene.count_intersections(self._tensor(rays)).numpy()
        return np.asarray((crossed % 2).mean(1) > 0.5)

    def hides(self, eye: Array, points: Array) -> Bool:
        """Tell which rays from an eye at [3] through points [N, 3] meet it, before or behind the point."""
        return np.isfinite(self._meets(eye, points))

    def mirrored(self) -> Shape:
        """Return it mirrored in x, as a file of the other handedness would have it."""
        return Shape(self.vertices * MIRROR, self.triangles[:, ::-1])

    def _meets(self, eye: Array, points: Array) -> F32:
        """Where rays from an eye through points [N, 3] meet it first; 1: at the point, inf: nowhere."""
        rays = np.hstack([np.broadcast_to(eye, points.shape), points - eye]).astype(np.float32)
        found: F32 = self._scene.cast_rays(self._tensor(np.ascontiguousarray(rays)))["t_hit"].numpy()
        return found


def _all_round(count: int) -> F64:
    """Directions [count, 3] that are evenly spread: a spiral by the golden angle."""
    turns = np.arange(count) * np.pi * (3 - 5**0.5)
    z = 1 - (2 * np.arange(count) + 1) / count
    flat = np.sqrt(1 - z**2)
    return np.stack([flat * np.cos(turns), flat * np.sin(turns), z], -1)


def evenly(shape: tuple[int, ...]) -> tuple[int, tuple[slice, slice]]:
    """Return a spacing in px that leaves about `POINTS` pixels of an image [H, W], and their slices."""
    every = max(1, int(np.sqrt(shape[0] * shape[1] / POINTS)))
    return every, np.s_[every // 2 :: every, every // 2 :: every]


@dataclass(frozen=True, slots=True)
class Surface:
    """Measured points with their errors."""

    points: F64  # [N, 3] m, world
    errors: F64  # [N] m, one standard deviation
    eye: F64  # [3] m, world: where it is seen from

    @classmethod
    def of_depth(cls, depth: F32, confidence: F32, tissue: Bool, camera: Camera) -> Surface:
        """Take about `POINTS`, evenly, from the tissue in a depth image [H, W] (m; 0 or NaN: unknown)."""
        every, at = evenly(depth.shape)
        rows, columns = np.nonzero((depth[at] > 0) & tissue[at] & (confidence[at] >= LEAST))
        pixels = np.stack([columns, rows], -1) * every + every // 2
        z, sure = depth[at][rows, columns], confidence[at][rows, columns]
        points = unproject(camera, pixels.astype(np.float64), z.astype(np.float64))
        errors = np.maximum(error_of(sure), 1e-4) / NINE_OF_TEN
        return cls(np.asarray(points), errors.astype(np.float64), camera.T_world_cam[:3, 3].copy())

    @classmethod
    def joined(cls, parts: Sequence[Surface]) -> Surface:
        """Join what several frames saw; the eye is that of the last one."""
        points, errors = (
            np.concatenate([getattr(part, name) for part in parts]) for name in ("points", "errors")
        )
        return cls(points, errors, parts[-1].eye)
