"""A made-up stereo pair with known disparities, to find out how a network wants its pictures."""

from __future__ import annotations

import cv2
import numpy as np

from sags_node.phantom.noise import fractal_noise
from sags_node.types import F32, U8

NEAREST, FARTHEST = 0.06, 0.02  # disparity, of the width: what an endoscope sees
TISSUE = np.array([[[176, 104, 92]]], np.float32)  # RGB
CONTRAST = 28.0  # grey levels


def make_pair(width: int, height: int) -> tuple[U8, U8, F32]:
    """Left and right picture [H, W, 3] RGB and the left one's disparity [H, W], px: gentle hills, painted."""
    rng = np.random.default_rng(0)
    paint = np.stack([fractal_noise(rng, (height, 2 * width), 0.1 * width, 6) for _ in range(2)], -1)
    picture = TISSUE + CONTRAST * paint[..., [0, 1, 1]]
    hills = fractal_noise(rng, (height, width), 0.5 * width, 2)
    hills = (hills - hills.min()) / np.ptp(hills)
    disparity = (width * (FARTHEST + (NEAREST - FARTHEST) * hills)).astype(np.float32)
    x, y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    offset = np.float32(width / 2)  # so that no picture ends where the other goes on
    left = cv2.remap(picture, x + offset - disparity, y, cv2.INTER_CUBIC)
    right = cv2.remap(picture, x + offset, y, cv2.INTER_NEAREST)
    return _bytes(left), _bytes(right), disparity


def _bytes(picture: F32) -> U8:
    return np.clip(np.rint(picture), 0, 255).astype(np.uint8)
