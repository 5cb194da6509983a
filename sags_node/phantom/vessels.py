"""Branching vessels, grown as random walks that split and thin out."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from sags_node.types import F32

_SUBPIXEL_BITS = 4


@dataclass(frozen=True, slots=True)
class _Sprout:
    row: float
    col: float
    heading: float
    width: float  # px


def grow_vessels(
    rng: np.random.Generator, shape: tuple[int, int], roots: int, width: float, thinnest: float
) -> F32:
    """Strength of blood [rows, cols] 0..1: `roots` trees of `width` px, down to twigs of `thinnest` px."""
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
    """One winding stretch [n, 2] (x, y) up to a fork, and what leaves the fork."""
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
