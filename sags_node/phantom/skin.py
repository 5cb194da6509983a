"""What the tissue looks like: colour, wetness and fine relief, fixed in material coordinates."""

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np

from sags_node.phantom.noise import fractal_noise
from sags_node.phantom.relief import SPACING, Relief
from sags_node.types import F32

_SUBPIXEL_BITS = 4

PAINT_TEXEL = 0.1e-3  # m, the texture is always painted this fine, then shrunk to what the cameras resolve

# Linear-light reflectances (RGB).
_SEROSA = np.array([0.60, 0.235, 0.205], np.float32)
_SEROSA_PALE = np.array([0.66, 0.36, 0.30], np.float32)
_SEROSA_DARK = np.array([0.46, 0.115, 0.115], np.float32)
_MESENTERY = np.array([0.47, 0.165, 0.140], np.float32)
_FAT = np.array([0.80, 0.50, 0.24], np.float32)
_LIVER = np.array([0.200, 0.050, 0.042], np.float32)
# Optical density of a full vessel: blood absorbs green and blue; a deep vein looks bluish.
_ARTERY = np.array([0.55, 1.75, 1.55], np.float32)
_VEIN = np.array([0.95, 1.15, 0.80], np.float32)
_CAPILLARY = np.array([0.12, 0.45, 0.40], np.float32)


@dataclass(frozen=True, slots=True)
class Skin:
    """Textures over material coordinates: texel (row, col) lies at x0 + col * texel, y0 + row * texel."""

    color: F32  # [H, W, 3] linear reflectance, furrows darkened
    surface: F32  # [H, W, 3]: slope along x, slope along y, wetness 0..1
    x0: float  # m
    y0: float  # m
    texel: float  # m


def paint_skin(relief: Relief, rng: np.random.Generator, footprint: float) -> Skin:
    """Paint the textures; `footprint` is what one camera pixel covers (m), finer detail is averaged away."""
    zoom = SPACING / PAINT_TEXEL
    rows, cols = relief.chart.shape[:2]
    shape = (round(rows * zoom), round(cols * zoom))
    size = shape[::-1]

    def enlarge(field: F32) -> F32:
        return np.asarray(cv2.resize(field, size, interpolation=cv2.INTER_LINEAR), np.float32)

    # Detail is drawn flat, then wrapped round the loops by their arc-length chart.
    chart = enlarge(relief.chart)
    at = (chart - np.array([relief.x[0], relief.y[0]], np.float32)) / np.float32(PAINT_TEXEL)

    def wrap(flat: F32) -> F32:
        folded = cv2.remap(flat, at, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT_101)
        return np.asarray(folded, np.float32)

    loop, liver, tint = enlarge(relief.loop), enlarge(relief.liver), enlarge(relief.tint)
    bed = np.clip(1 - loop - liver, 0, 1)
    fat = _fat_share(rng, shape, bed, loop)
    color = _base_color(rng, shape, loop, liver, fat, tint, wrap)
    color *= np.exp(-_blood(rng, shape, 1 - 0.8 * liver - 0.5 * fat, wrap))
    color *= enlarge(relief.cavity)[..., None]

    slope = _slopes(rng, shape, bed, liver, fat, wrap)
    wetness = np.clip(0.75 + 0.30 * fractal_noise(rng, shape, 90, 3) - 0.25 * fat, 0.15, 1)
    surface = np.dstack([slope, wetness]).astype(np.float32)

    shrink = min(1.0, PAINT_TEXEL / (0.75 * footprint))
    small = (max(8, int(size[0] * shrink)), max(8, int(size[1] * shrink)))
    texel = SPACING * cols / small[0]
    corner = 0.5 * (texel - SPACING)  # from the centre of the first vertex to that of the first texel
    return Skin(
        color=cv2.resize(color, small, interpolation=cv2.INTER_AREA),
        surface=cv2.resize(surface, small, interpolation=cv2.INTER_AREA),
        x0=float(relief.x[0] + corner),
        y0=float(relief.y[0] + corner),
        texel=texel,
    )


Shape = tuple[int, int]
Wrap = Callable[[F32], F32]


def _between(low: float, high: float, values: F32) -> F32:
    """Smooth step from 0 at `low` to 1 at `high`."""
    t = np.clip((values - low) / (high - low), 0, 1)
    return np.asarray(t * t * (3 - 2 * t), np.float32)


def _mix(a: F32, b: F32, share: F32) -> F32:
    return np.asarray(a + (b - a) * share[..., None], np.float32)


def _fat_share(rng: np.random.Generator, shape: Shape, bed: F32, loop: F32) -> F32:
    """Yellow patches: most of them in the bed, streaks where loops are attached."""
    patches = fractal_noise(rng, shape, 140, 4)
    return np.asarray(
        bed * _between(0.1, 0.9, patches) + 0.45 * loop * _between(2.0, 3.0, patches), np.float32
    )


def _base_color(
    rng: np.random.Generator, shape: Shape, loop: F32, liver: F32, fat: F32, tint: F32, wrap: Wrap
) -> F32:
    broad = wrap(fractal_noise(rng, shape, 260, 3)) + tint
    mottle = wrap(fractal_noise(rng, shape, 45, 4))
    grain = wrap(fractal_noise(rng, shape, 9, 2))
    serosa = _mix(
        np.broadcast_to(_SEROSA, (*shape, 3)), _SEROSA_PALE, _between(0.2, 2.2, broad + 0.5 * mottle)
    )
    serosa = _mix(serosa, _SEROSA_DARK, _between(0.1, 2.2, -broad + 0.7 * mottle))
    color = _mix(np.broadcast_to(_MESENTERY, (*shape, 3)), serosa, loop)
    color = _mix(color, _FAT, fat)
    color = _mix(color, _LIVER, liver)
    color *= np.exp(0.10 * mottle + 0.05 * grain)[..., None]
    color[..., 1:] *= np.exp(-0.07 * wrap(fractal_noise(rng, shape, 22, 3)))[..., None]  # patchy perfusion
    return color


def _blood(rng: np.random.Generator, shape: Shape, perfused: F32, wrap: Wrap) -> F32:
    """Optical density [H, W, 3] of the vessels; the number of trees is proportional to the area."""
    area = shape[0] * shape[1] / 1e6
    veins = grow_vessels(rng, shape, roots=int(7 * area), width=9.0, thinnest=2.0)
    arteries = grow_vessels(rng, shape, roots=int(24 * area), width=4.2, thinnest=0.5)
    network = np.exp(-((fractal_noise(rng, shape, 26, 2) / 0.10) ** 2))  # lines along the zero crossings
    patchy = _between(-0.6, 1.4, fractal_noise(rng, shape, 160, 2))
    density = (
        wrap(cv2.GaussianBlur(veins, (0, 0), 1.6))[..., None] * _VEIN
        + wrap(arteries)[..., None] * _ARTERY
        + wrap(network * patchy)[..., None] * _CAPILLARY
    )
    return np.asarray(density * perfused[..., None], np.float32)


def _slopes(rng: np.random.Generator, shape: Shape, bed: F32, liver: F32, fat: F32, wrap: Wrap) -> F32:
    """Slopes [H, W, 2] of the fine relief, far below the mesh spacing; they make the wet highlights."""
    texel = np.float32(PAINT_TEXEL)
    ripples = np.float32(0.06e-3) * fractal_noise(rng, shape, 20, 2)
    wrinkles = np.float32(-0.22e-3) * np.abs(fractal_noise(rng, shape, 26, 2))
    lobules = texel * _lobules(rng, shape, cell=22.0)
    tremble = np.float32(0.03e-3) * fractal_noise(rng, shape, 7, 1)

    def slope(height: F32) -> F32:
        down, right = np.gradient(height, texel)
        return wrap(np.dstack([right, down]).astype(np.float32))

    total = (
        slope(ripples + tremble)
        + slope(wrinkles) * (np.clip(bed + 0.12, 0, 1) * (1 - fat))[..., None]
        + slope(lobules) * fat[..., None]
    )
    total *= (1 - 0.6 * liver)[..., None]
    return np.asarray(np.clip(total, -0.9, 0.9), np.float32)


def _lobules(rng: np.random.Generator, shape: Shape, cell: float) -> F32:
    """Height (px) of rounded cells side by side, as fat has them."""
    seeds = np.full(shape, 255, np.uint8)
    count = int(shape[0] * shape[1] / cell**2)
    seeds[rng.integers(0, shape[0], count), rng.integers(0, shape[1], count)] = 0
    distance = cv2.GaussianBlur(cv2.distanceTransform(seeds, cv2.DIST_L2, 5), (0, 0), 1.5)
    return np.asarray(-0.6 * distance**2 / cell, np.float32)


@dataclass(frozen=True, slots=True)
class _Sprout:
    row: float
    col: float
    heading: float
    width: float  # px


def grow_vessels(
    rng: np.random.Generator, shape: tuple[int, int], roots: int, width: float, thinnest: float
) -> F32:
    """Draw `roots` trees of vessels, from `width` px down to `thinnest` px: strength [rows, cols] 0..1."""
    canvas = np.zeros(shape, np.uint8)
    rows, cols = shape
    growing = [
        _Sprout(
            rng.uniform(0, rows), rng.uniform(0, cols), rng.uniform(0, 2 * np.pi), width * rng.uniform(0.6, 1)
        )
        for _ in range(roots)
    ]
    while growing:
        sprout = growing.pop()
        line, children = _grow(rng, sprout, thinnest)
        strength = int(255 * min(1.0, 0.35 + 0.65 * sprout.width / width))
        # A twig thinner than a texel keeps its share of the colour.
        strength = int(strength * min(1.0, sprout.width))
        cv2.polylines(
            canvas,
            [np.round(line * 2**_SUBPIXEL_BITS).astype(np.int32)],
            isClosed=False,
            color=strength,
            thickness=max(1, round(sprout.width)),
            lineType=cv2.LINE_AA,
            shift=_SUBPIXEL_BITS,
        )
        inside = [s for s in children if -20 < s.row < rows + 20 and -20 < s.col < cols + 20]
        growing.extend(inside)
    return np.asarray(cv2.GaussianBlur(canvas, (0, 0), 0.7) / np.float32(255), np.float32)


def _grow(rng: np.random.Generator, sprout: _Sprout, thinnest: float) -> tuple[F32, list[_Sprout]]:
    """One winding stretch [n, 2] (x, y) up to a fork, and the branches that leave the fork."""
    steps = int(rng.integers(8, 22))
    step = 1.2 + 1.5 * np.sqrt(sprout.width)
    bends = np.cumsum(rng.normal(0, 0.24, steps))
    headings = sprout.heading + bends
    x = sprout.col + np.concatenate([[0.0], np.cumsum(np.cos(headings) * step)])
    y = sprout.row + np.concatenate([[0.0], np.cumsum(np.sin(headings) * step)])
    children = []
    side = rng.choice([-1.0, 1.0])
    # Murray's law would keep the sum of cubes; the larger branch goes nearly straight on.
    for share, turn in ((rng.uniform(0.78, 0.92), -0.25), (rng.uniform(0.45, 0.75), rng.uniform(0.7, 1.3))):
        if sprout.width * share >= thinnest:
            heading = float(headings[-1] + side * turn)
            children.append(_Sprout(float(y[-1]), float(x[-1]), heading, sprout.width * share))
    return np.stack([x, y], -1).astype(np.float32), children
