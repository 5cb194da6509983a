"""Pairs from the phantom: exact disparity, true shading and highlights; and crops of them."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np

from sags_node.config import PhantomSource
from sags_node.learning.example import Example
from sags_node.phantom.scene import Phantom
from sags_node.types import StereoFrame
from sags_node.vision.rectify import Rectifier

SIZE = (640, 512)  # px
FRAMES = 6  # of each tissue, over its whole motion
SHRINK = (0.4, 0.8)  # from the rendered size to an example's
ASIDE = (-0.05, 0.25)  # of an example's width: how much larger its disparities are than the phantom's
SMALLEST = 1.0  # px: a smaller disparity is not learnt

Advance = Callable[[int, int, str], None]  # done, of, what


def render(rng: np.random.Generator, tissues: int, advance: Advance) -> list[Example]:
    """Whole pictures of `tissues` phantoms, each of another tissue, gloss and smoke."""
    examples = []
    for made in range(tissues):
        advance(made, tissues, "rendering the phantom")
        # The phantom that everything else is measured on has seed 0.
        config = PhantomSource(
            width=SIZE[0],
            height=SIZE[1],
            seed=int(rng.integers(1, 2**31)),
            camera_motion="sway",
            noise=0,
            gloss=float(rng.choice([0.3, 1, 3, 10])),
            smoke=float(rng.choice([0, 0, 0.3])),
        )
        phantom = Phantom(config)
        rectifier = Rectifier(phantom.rig, *SIZE)
        focal_baseline = float(rectifier.camera.K[0, 0]) * rectifier.baseline
        for index in range(FRAMES):
            frame = phantom.frame(index, FRAMES)
            pair = rectifier(StereoFrame(index, 0, 0, frame.left, frame.right))
            assert pair.right is not None  # the phantom has two eyes
            known = frame.depth > 0
            disparity = np.divide(focal_baseline, frame.depth, out=np.zeros_like(frame.depth), where=known)
            examples.append(Example(pair.left, pair.right, disparity))
    return examples


def crop(rng: np.random.Generator, whole: Example, size: tuple[int, int]) -> Example:
    """A part of a rendered pair, `size` px wide and high, at a smaller scale. The eyes' parts may lie aside
    of each other, so that disparities are others than the phantom's."""
    scale = float(rng.uniform(*SHRINK))
    inner = round(SIZE[0] * scale), round(SIZE[1] * scale)
    left, right = (cv2.resize(eye, inner, interpolation=cv2.INTER_AREA) for eye in whole[:2])
    disparity = cv2.resize(whole.disparity, inner, interpolation=cv2.INTER_NEAREST_EXACT) * np.float32(scale)
    x, y = (int(rng.integers(0, outer - side + 1)) for outer, side in zip(inner, size, strict=True))
    aside = round(rng.uniform(*ASIDE) * size[0])
    aside = int(np.clip(aside, -x, inner[0] - size[0] - x))
    rows = slice(y, y + size[1])
    moved = np.where(disparity > 0, disparity + np.float32(aside), np.float32(0))
    moved[moved < SMALLEST] = 0
    here, there = (rows, slice(x, x + size[0])), (rows, slice(x + aside, x + aside + size[0]))
    return Example(left[here], right[there], np.asarray(moved[here], np.float32))
