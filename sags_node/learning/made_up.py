"""Pairs from single pictures: surfaces that are painted with them, one before the other.

Each surface has its own texture, and a disparity that belongs to the left picture. The right eye sees the
texture as it is, the left one sees it moved by the disparity. So the truth is exact, and what one eye alone
sees is as it would be.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from sags_node.learning.example import Example
from sags_node.phantom.noise import fractal_noise
from sags_node.types import F32, U8

DISPARITIES = (0.015, 0.35)  # of the width, of the farthest surface: what endoscopes see, and more
RELIEF = (0.02, 0.3)  # of the disparity: hills of the farthest surface
TILT = 0.15  # px per px, in both directions
STEEPEST = 0.6  # px per px: from 1 on a surface would fold over itself
MOST_BEFORE = 3  # surfaces before the farthest
STEP = (0.01, 0.06)  # of the width: how much nearer one of them is
ZOOM = (0.6, 1.6)  # of a texture
METAL = 0.4  # share of the nearer surfaces that are bars, as instruments are
BAR = (0.06, 0.2)  # of the width: half of a bar's


def make_up(rng: np.random.Generator, textures: Sequence[U8], size: tuple[int, int]) -> Example:
    """A pair, `size` px wide and high, painted with these textures [H, W, 3] RGB."""
    width, height = size
    x, y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    depth = _hills(rng, size, float(np.exp(rng.uniform(*np.log(DISPARITIES)))) * width)
    left, right = _painted(rng, _texture(rng, textures), x, y, depth)
    for _ in range(rng.integers(0, MOST_BEFORE + 1)):
        is_bar = rng.random() < METAL
        cover = _bar(rng, x, y) if is_bar else _blob(rng, size)
        behind = depth[cover > 0.5]
        if behind.size == 0:
            continue
        base = float(behind.max()) + float(rng.uniform(*STEP)) * width
        own = _hills(rng, size, base)
        own += np.float32(base) - own.min()
        paint = _metal(rng, size) if is_bar else _texture(rng, textures)
        near_left, near_right = _painted(rng, paint, x, y, own)
        # Cut out where the right eye sees it; the left one sees the cut moved.
        moved = cv2.remap(cover, x - own, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        left += (near_left - left) * moved[..., None]
        right += (near_right - right) * cover[..., None]
        depth = np.where(moved > 0.5, own, depth)
    return Example(_bytes(left), _bytes(right), np.asarray(depth, np.float32))


def _hills(rng: np.random.Generator, size: tuple[int, int], middle: float) -> F32:
    """A smooth disparity around `middle` (px), [h, w]."""
    width, height = size
    hills = fractal_noise(rng, (height, width), width * float(rng.uniform(0.15, 0.8)), 3)
    hills *= np.float32(middle * np.exp(rng.uniform(*np.log(RELIEF))))
    across, down = rng.uniform(-TILT, TILT, 2)
    hills += np.linspace(-across, across, width, dtype=np.float32) * np.float32(width / 2)
    hills += np.linspace(-down, down, height, dtype=np.float32)[:, None] * np.float32(height / 2)
    steepest = float(np.abs(np.diff(hills, axis=1)).max())
    hills *= np.float32(min(1.0, STEEPEST / steepest, 0.8 * middle / float(-hills.min() + 1e-6)))
    return np.asarray(middle + hills, np.float32)


def _texture(rng: np.random.Generator, textures: Sequence[U8]) -> F32:
    """One of them, turned over, its contrast changed."""
    picture = textures[int(rng.integers(len(textures)))].astype(np.float32)
    picture = picture[:: rng.choice([-1, 1]), :: rng.choice([-1, 1])]
    if rng.random() < 0.3:
        picture = picture.transpose(1, 0, 2)
    return np.ascontiguousarray(picture)


def _metal(rng: np.random.Generator, size: tuple[int, int]) -> F32:
    """A gray gradient with streaks, larger than the pair."""
    shape = (2 * size[1], 2 * size[0])
    gray = float(rng.uniform(40, 200)) + 30 * fractal_noise(rng, shape, size[0] * 0.5, 2)
    gray += float(rng.uniform(0, 8)) * fractal_noise(rng, shape, 6, 2)
    return np.repeat(gray[..., None], 3, 2)


def _painted(rng: np.random.Generator, texture: F32, x: F32, y: F32, disparity: F32) -> tuple[F32, F32]:
    """What left and right eye see of a surface with this texture."""
    zoom = float(np.exp(rng.uniform(*np.log(ZOOM))))
    rows, columns = texture.shape[:2]
    begin = (
        float(rng.uniform(0, max(1, columns - zoom * x.shape[1]))),
        float(rng.uniform(0, max(1, rows - zoom * x.shape[0]))),
    )
    if zoom > 1:
        texture = cv2.GaussianBlur(texture, (0, 0), 0.45 * zoom)
    across, down = np.float32(zoom) * x + np.float32(begin[0]), np.float32(zoom) * y + np.float32(begin[1])

    def sampled(columns: F32) -> F32:
        drawn: F32 = cv2.remap(texture, columns, down, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT_101)
        return drawn

    return sampled(across - np.float32(zoom) * disparity), sampled(across)


def _blob(rng: np.random.Generator, size: tuple[int, int]) -> F32:
    """A rounded shape [h, w], 0..1."""
    noise = fractal_noise(rng, size[::-1], size[0] * float(rng.uniform(0.2, 0.6)), 2)
    return np.asarray(np.clip(4 * (noise - float(rng.uniform(0.3, 1.0))) + 0.5, 0, 1), np.float32)


def _bar(rng: np.random.Generator, x: F32, y: F32) -> F32:
    """A straight bar [h, w], 0..1, that comes in from outside."""
    height, width = x.shape
    turn = float(rng.uniform(0, 2 * np.pi))
    tip = rng.uniform(0.2, 0.8, 2) * (width, height)
    along = (x - tip[0]) * np.cos(turn) + (y - tip[1]) * np.sin(turn)
    across = (y - tip[1]) * np.cos(turn) - (x - tip[0]) * np.sin(turn)
    inside = np.minimum(float(rng.uniform(*BAR)) * width - np.abs(across), along)
    return np.asarray(np.clip(inside + 0.5, 0, 1), np.float32)


def _bytes(picture: F32) -> U8:
    return np.clip(np.rint(picture), 0, 255).astype(np.uint8)
