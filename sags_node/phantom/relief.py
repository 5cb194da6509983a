"""The rest shape of the phantom's tissue: bowel loops on a fatty bed and a liver edge, as a height field.

Material coordinates are the x and y (m) of a surface point at rest. They never change; only positions do.
"""

from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np

from sags_node.phantom.noise import fractal_noise
from sags_node.types import F32, F64

SPACING = 0.6e-3  # m between vertices
BED_DEPTH = 0.082  # m, on the optical axis
BED_SLOPE = -0.16  # the far side is at the top of the image
FARTHEST = 0.098  # m, the extent covers the view at this depth
MARGIN = 0.010  # m, for camera motion and the second eye

# Centre lines in units of the half view at the bed, radius and axis height (m). The first is the one gripped.
_LOOPS: tuple[tuple[tuple[tuple[float, float], ...], float, float], ...] = (
    (((-0.95, 0.55), (-0.55, 0.22), (-0.10, -0.06), (0.35, -0.20), (0.80, -0.42)), 0.0112, 0.0050),
    (((-1.50, -0.10), (-0.80, -0.45), (-0.15, -0.62), (0.45, -0.66), (1.00, -0.90)), 0.0098, 0.0015),
    (((1.30, -0.70), (0.95, -0.20), (0.90, 0.30), (1.05, 0.80), (1.40, 1.10)), 0.0105, 0.0025),
    (((-1.50, 0.60), (-1.00, 0.80), (-0.55, 0.85), (-0.25, 1.10), (-0.10, 1.60)), 0.0090, 0.0020),
    (((0.30, 1.50), (0.22, 0.95), (0.45, 0.62), (0.85, 0.75), (1.10, 1.40)), 0.0080, 0.0005),
    (((-1.60, -0.75), (-1.10, -0.85), (-0.60, -1.00), (-0.20, -1.40)), 0.0090, -0.0005),
)
_LIVER_CENTER = (0.35, -1.55)
_LIVER_RADII = (1.05, 0.72)
_LIVER_HEIGHT = 0.013


@dataclass(frozen=True, slots=True)
class Relief:
    """The tissue at rest on a regular grid of material coordinates."""

    x: F64  # [cols] m
    y: F64  # [rows] m
    positions: F32  # [rows, cols, 3] m, world
    chart: F32  # [rows, cols, 2] m: coordinates of equal arc length, in which the texture is drawn
    loop: F32  # [rows, cols] 0..1, share of bowel
    liver: F32  # [rows, cols] 0..1
    tint: F32  # [rows, cols] -1..1, the loops differ in colour
    cavity: F32  # [rows, cols] 0..1, 1 = open to the light
    grip: tuple[int, int]  # row, column of the gripped vertex
    grip_axis: F64  # [2] direction of the gripped loop


def make_relief(rng: np.random.Generator, half_view: tuple[float, float]) -> Relief:
    """Make a random rest shape. `half_view`: tangent of half the angle of view, horizontal and vertical."""
    half = np.array(half_view)
    x, y = (np.arange(-h, h + SPACING, SPACING) for h in half * FARTHEST + MARGIN)
    grid = np.stack(np.meshgrid(x, y), -1)  # [rows, cols, 2]
    shape = grid.shape[:2]

    heights = [_bed_height(rng, shape)]
    charts, tints = [np.zeros_like(grid)], [0.0]
    grip_point, grip_axis = np.zeros(2), np.array([1.0, 0.0])
    for index, (points, radius, elevation) in enumerate(_LOOPS):
        control = np.array(points) + rng.uniform(-0.05, 0.05, (len(points), 2))
        curve = _smooth_curve(control * half * BED_DEPTH)
        height, chart = _loop_height(rng, grid, curve, radius * rng.uniform(0.93, 1.07), elevation)
        heights.append(height)
        charts.append(chart)
        tints.append(rng.uniform(-1, 1))
        if index == 0:
            at = int(0.46 * len(curve))
            grip_point = curve[at]
            grip_axis = (curve[at + 1] - curve[at - 1]) / np.linalg.norm(curve[at + 1] - curve[at - 1])
    heights.append(_liver_height(grid, half))
    charts.append(np.zeros_like(grid))
    tints.append(0.0)

    stack = np.stack(heights)
    softness = 0.7e-3  # m: the crease between two organs
    weights = np.exp((stack - stack.max(0)) / softness)
    height = stack.max(0) + softness * np.log(weights.sum(0))
    weights /= weights.sum(0)
    height += 0.15e-3 * fractal_noise(rng, shape, 0.008 / SPACING, 2)
    nearest = stack.argmax(0)
    rows, cols = np.indices(shape)
    depth = BED_DEPTH + BED_SLOPE * grid[..., 1] - height
    return Relief(
        x=x,
        y=y,
        positions=np.dstack([grid, depth]).astype(np.float32),
        chart=(grid + np.stack(charts)[nearest, rows, cols]).astype(np.float32),
        loop=weights[1:-1].sum(0).astype(np.float32),
        liver=weights[-1].astype(np.float32),
        tint=np.tensordot(np.array(tints), weights, 1).astype(np.float32),
        cavity=_cavity(height.astype(np.float32)),
        grip=(int(np.abs(y - grip_point[1]).argmin()), int(np.abs(x - grip_point[0]).argmin())),
        grip_axis=grip_axis,
    )


def _bed_height(rng: np.random.Generator, shape: tuple[int, int]) -> F64:
    """Mesentery: gathered folds, sharp in the valleys."""
    swell = fractal_noise(rng, shape, 0.030 / SPACING, 1)
    folds = np.abs(fractal_noise(rng, shape, 0.011 / SPACING, 2))
    return np.asarray(1.5e-3 * swell + 1.7e-3 * np.sqrt(folds), np.float64)


def _smooth_curve(control: F64) -> F64:
    """Catmull-Rom curve through [n, 2] points, about 3 mm between samples."""
    padded = np.vstack([2 * control[0] - control[1], control, 2 * control[-1] - control[-2]])
    pieces = []
    for a, b, c, d in zip(padded[:-3], padded[1:-2], padded[2:-1], padded[3:], strict=True):
        count = max(2, int(np.linalg.norm(c - b) / 3e-3))
        t = np.arange(count)[:, None] / count
        pieces.append(
            0.5 * (2 * b + (c - a) * t + (2 * a - 5 * b + 4 * c - d) * t**2 + (3 * b - a - 3 * c + d) * t**3)
        )
    return np.vstack([*pieces, control[-1:]])


def _loop_height(
    rng: np.random.Generator, grid: F64, curve: F64, radius: float, elevation: float
) -> tuple[F64, F64]:
    """Height (m) of a tube over the bed; and the offset [..., 2] (m) from x, y to arc length across it."""
    offset, along = _nearest_on_curve(grid, curve)
    distance = np.hypot(offset[..., 0], offset[..., 1])
    waves = np.sin(2 * np.pi * along / rng.uniform(0.015, 0.020) + rng.uniform(0, 6))
    folds = np.sin(2 * np.pi * along / rng.uniform(0.0045, 0.006) + rng.uniform(0, 6))
    swelling = fractal_noise(rng, grid.shape[:2], 0.020 / SPACING, 1)
    local_radius = radius * (1 + 0.05 * waves + 0.010 * folds + 0.06 * swelling)
    ratio = distance / local_radius
    round_part = np.minimum(ratio, 0.9)
    flank = (0.9 / np.sqrt(1 - 0.81)) * (ratio - round_part)  # goes on straight below the equator
    height = elevation + local_radius * (np.sqrt(1 - round_part**2) - flank)
    arc = local_radius * (np.arcsin(round_part) + 2.3 * (ratio - round_part))
    stretch = (arc - distance) / np.maximum(distance, 1e-6)
    return height, offset * np.minimum(stretch, 2.0)[..., None]


def _nearest_on_curve(grid: F64, curve: F64) -> tuple[F64, F64]:
    """Vector [..., 2] from the nearest point of a polyline [n, 2], and that point's place along it (m)."""
    best = np.full(grid.shape[:2], np.inf)
    offset = np.zeros_like(grid)
    along = np.zeros(grid.shape[:2])
    start = 0.0
    for a, b in pairwise(curve):
        length = float(np.linalg.norm(b - a))
        direction = (b - a) / length
        place = np.clip((grid - a) @ direction, 0, length)
        vector = grid - a - place[..., None] * direction
        squared = (vector**2).sum(-1)
        nearer = squared < best
        best[nearer] = squared[nearer]
        offset[nearer] = vector[nearer]
        along[nearer] = start + place[nearer]
        start += length
    return offset, along


def _liver_height(grid: F64, half: F64) -> F64:
    scaled = (grid / (half * BED_DEPTH) - _LIVER_CENTER) / _LIVER_RADII
    inside = 1 - (scaled**2).sum(-1)
    return np.asarray(np.where(inside > 0, np.sqrt(np.maximum(inside, 0)) * _LIVER_HEIGHT, 0.05 * inside))


def _cavity(height: F32) -> F32:
    """Share 0..1 of the light that arrives, less in a furrow: compares the height with its surroundings."""
    open_share = np.ones_like(height)
    for width, weight in ((1.6e-3, 0.55), (5e-3, 0.75)):
        around = cv2.GaussianBlur(height, (0, 0), width / SPACING, borderType=cv2.BORDER_REPLICATE)
        open_share *= np.exp(-weight * np.maximum(around - height, 0) / (0.6 * width))
    return open_share
