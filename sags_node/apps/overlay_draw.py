"""Virtual geometry over a picture, hidden where real things are in front of it.

Shapes are clouds of surface samples, dense enough to leave no holes; drawing is one z-buffer over them.
Everything is in the left camera's coordinates, metres.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from sags_node.types import F32, F64, U8, Bool

OPACITY = 0.85
ON_SURFACE = 0.0005  # m; what lies this little under the surface is still drawn: it lies on it
DRAPE_REACH = 0.004  # m; how far a flat shape bends to lie on a curved surface
SAMPLES_PER_PIXEL = 2.0  # along a line
MAX_SAMPLES_ALONG = 400  # bounds the cost of a shape close to the camera
LABEL_ASIDE = 0.005  # m to the right of the point
LEAN = np.array([0.5, -0.8, 0.0])  # to the upper right of the picture
GREEN, YELLOW = (60, 230, 120), (255, 210, 40)  # RGB


@dataclass(frozen=True, slots=True)
class Samples:
    points: F64  # [N, 3] m
    colors: F64  # [N, 3] RGB 0..255, shaded

    def __add__(self, other: Samples) -> Samples:
        return Samples(
            np.concatenate([self.points, other.points]), np.concatenate([self.colors, other.colors])
        )


def target(point: F64, normal: F64, K: F64, depth: F32) -> Samples:
    """A ring on the surface and an arrow that points at its middle."""
    spacing = _spacing(point, K)
    leaning = normal + LEAN  # along the line of sight an arrow would be a dot
    tip = point + 0.001 * normal
    return _ring(point, normal, K, depth) + arrow(
        tip, leaning / np.linalg.norm(leaning), 0.010, spacing, YELLOW
    )


def marker(point: F64, normal: F64, K: F64, depth: F32) -> Samples:
    """A ring on the surface and a sphere that hovers 5 mm above it."""
    ball = sphere(point + 0.005 * normal, 0.0015, _spacing(point, K), YELLOW)
    return _ring(point, normal, K, depth) + ball


SHAPES = {"target": target, "sphere": marker}


def _ring(point: F64, normal: F64, K: F64, depth: F32) -> Samples:
    return drape(disc(point, normal, 0.003, 0.004, _spacing(point, K), GREEN), K, depth)


def drape(samples: Samples, K: F64, depth: F32) -> Samples:
    """Move samples along their rays onto the surface `depth` [H, W] (m), where it is within `DRAPE_REACH`."""
    height, width = depth.shape
    points = samples.points.copy()
    pixels = points @ K.T
    columns, rows = np.rint(pixels[:, :2] / pixels[:, 2:]).astype(np.intp).T
    inside = (points[:, 2] > 0) & (columns >= 0) & (columns < width) & (rows >= 0) & (rows < height)
    surface = np.full(len(points), np.nan)
    surface[inside] = depth[rows[inside], columns[inside]]
    near = np.abs(surface - points[:, 2]) < DRAPE_REACH  # NaN compares as False
    points[near] *= (surface[near] / points[near, 2])[:, None]
    return Samples(points, samples.colors)


def disc(
    center: F64, normal: F64, inner: float, outer: float, spacing: float, color: tuple[int, int, int]
) -> Samples:
    """The part of a disc between two radii."""
    radii, angles = _grid(inner, outer, 2 * np.pi * outer, spacing)
    across, along = _tangents(normal)
    offsets = radii[:, None] * (np.cos(angles)[:, None] * across + np.sin(angles)[:, None] * along)
    points = center + offsets
    return Samples(points, _shade(points, np.broadcast_to(normal, points.shape), color))


def sphere(center: F64, radius: float, spacing: float, color: tuple[int, int, int]) -> Samples:
    """Samples on a spiral of golden angles: as dense at the poles as elsewhere."""
    count = int(np.clip(4 * np.pi * (radius / spacing) ** 2, 50, MAX_SAMPLES_ALONG**2))
    heights = 1 - (2 * np.arange(count) + 1) / count
    angles = np.pi * (3 - np.sqrt(5)) * np.arange(count)
    flat = np.sqrt(1 - heights**2)
    normals = np.stack([flat * np.cos(angles), flat * np.sin(angles), heights], axis=1)
    points = center + radius * normals
    return Samples(points, _shade(points, normals, color))


def arrow(tip: F64, away: F64, length: float, spacing: float, color: tuple[int, int, int]) -> Samples:
    """An arrow whose tip is at `tip` and whose tail lies in direction `away` (unit)."""
    head, wide, thin = 0.35 * length, 0.12 * length, 0.04 * length
    along, angles = _grid(0.0, length, 2 * np.pi * wide, spacing)
    radii = np.where(along < head, wide * along / head, thin)
    first, second = _tangents(away)
    outwards = np.cos(angles)[:, None] * first + np.sin(angles)[:, None] * second
    points = tip + along[:, None] * away + radii[:, None] * outwards
    return Samples(points, _shade(points, outwards, color))


def draw(picture: U8, samples: Samples, K: F64, depth: F32, tissue: Bool) -> tuple[U8, int]:
    """Draw samples over a picture [H, W, 3] where nothing real is in front; returns it and the pixels drawn.

    A sample is hidden where the surface `depth` [H, W] (m, NaN unknown) is nearer, where the depth is
    unknown, and where the pixel is not `tissue`: an instrument is in front.
    """
    height, width = depth.shape
    ahead = samples.points[:, 2] > 0
    points, colors = samples.points[ahead], samples.colors[ahead]
    pixels = points @ K.T
    columns, rows = np.rint(pixels[:, :2] / pixels[:, 2:]).astype(np.intp).T
    inside = (columns >= 0) & (columns < width) & (rows >= 0) & (rows < height)
    columns, rows, z, colors = columns[inside], rows[inside], points[inside, 2], colors[inside]
    seen = (z < depth[rows, columns] + ON_SURFACE) & tissue[rows, columns]  # NaN compares as False
    order = np.argsort(-z[seen])  # far to near: the nearest is written last and stays
    columns, rows, colors = columns[seen][order], rows[seen][order], colors[seen][order]
    drawn = picture.copy()
    drawn[rows, columns] = np.rint(OPACITY * colors + (1 - OPACITY) * picture[rows, columns])
    return drawn, len(np.unique(rows * width + columns))


def label(picture: U8, point: F64, K: F64, text: str) -> None:
    """Write beside the pixel of a point, in place."""
    u, v = (K @ point)[:2] / point[2]
    scale = picture.shape[0] / 1000
    at = (int(u + LABEL_ASIDE * K[0, 0] / point[2]), int(v))
    for color, thickness in (((0, 0, 0), 3), ((255, 255, 255), 1)):
        cv2.putText(
            picture, text, at, cv2.FONT_HERSHEY_SIMPLEX, max(scale, 0.4), color, thickness, cv2.LINE_AA
        )


def _spacing(point: F64, K: F64) -> float:
    """Distance (m) between samples that lie closer than a pixel at the depth of `point`."""
    return float(point[2] / (K[0, 0] * SAMPLES_PER_PIXEL))


def _grid(start: float, end: float, around: float, spacing: float) -> tuple[F64, F64]:
    """Samples between `start` and `end`, and angles around a circle of circumference `around`: all pairs."""
    rows = int(np.clip((end - start) / spacing, 2, MAX_SAMPLES_ALONG))
    columns = int(np.clip(around / spacing, 8, MAX_SAMPLES_ALONG))
    values, angles = np.meshgrid(np.linspace(start, end, rows), np.linspace(0, 2 * np.pi, columns))
    return values.ravel(), angles.ravel()


def _tangents(normal: F64) -> tuple[F64, F64]:
    """Two unit vectors across `normal` and across each other."""
    helper = np.eye(3)[int(np.argmin(np.abs(normal)))]
    first = np.cross(normal, helper)
    first /= np.linalg.norm(first)
    return first, np.cross(normal, first)


def _shade(points: F64, normals: F64, color: tuple[int, int, int]) -> F64:
    """Colour lit from the camera, as an endoscope lights."""
    towards = -points / np.linalg.norm(points, axis=1, keepdims=True)
    light = 0.45 + 0.55 * np.abs((normals * towards).sum(axis=1))
    shaded: F64 = light[:, None] * np.array(color, np.float64)
    return shaded
