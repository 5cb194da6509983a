"""Whether anything moved."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np

from sags_node.kernels.jit import kernel
from sags_node.types import F32, F64, U8, RectifiedPair
from sags_node.vision.pyramid import inner, level, pyramids

HALVINGS = 3  # 8x8 px are averaged: camera noise up to 4 grey levels stays below the limit
BLOCK = 4  # shrunk px: 32 px, the length over which something moves or does not
LARGEST_DIFFERENCE = 1.0  # grey levels, mean over a block
EVERY = 8  # px
LARGEST_SHARE = 0.005  # of the blocks that may differ more: a highlight flickers


class StillScene:
    """Compares pictures with those of the last frame in which something moved, not with the frame before:
    slow motion adds up and is seen."""

    def __init__(self) -> None:
        self._eyes: list[F32] | None = None
        self._pose: F64 = np.eye(4)
        self._frames = 0

    def forget(self) -> None:
        """Take the next frame for one in which something moved."""
        self._eyes = None

    def __call__(self, pair: RectifiedPair) -> int:
        """For how many frames, this one included, pictures and pose are the same; 0: something moved."""
        eyes = [level(eye, min(HALVINGS, len(eye.halves))) for eye in pyramids(pair) if eye is not None]
        before, pose = self._eyes, pair.camera.T_world_cam
        stays = np.array_equal(pose, self._pose)
        if stays and before is not None and len(before) == len(eyes) and all(map(_alike, eyes, before)):
            self._frames += 1
        else:
            self._eyes, self._pose, self._frames = eyes, pose, 0
        return self._frames


def _alike(a: F32, b: F32) -> bool:
    difference = cv2.absdiff(inner(a), inner(b))
    height, width = difference.shape
    blocks = max(1, width // BLOCK), max(1, height // BLOCK)
    mean = cv2.resize(difference, blocks, interpolation=cv2.INTER_AREA)
    return bool(np.mean(mean > LARGEST_DIFFERENCE) <= LARGEST_SHARE)


def rms_difference(a: RectifiedPair, b: RectifiedPair) -> float:
    """Grey levels, over every eighth pixel of both eyes: enough to tell a repeated frame from a moved one."""
    squares = [
        _mean_square(x.full, y.full)
        for x, y in zip(pyramids(a), pyramids(b), strict=True)
        if x is not None and y is not None
    ]
    return float(np.sqrt(max(squares)))


@kernel
def _mean_square(a: U8, b: U8) -> Any:
    """Of the differences of every eighth pixel of every eighth row."""
    total, count = np.int64(0), 0
    for y in range(0, a.shape[0], EVERY):
        for x in range(0, a.shape[1], EVERY):
            difference = np.int64(a[y, x]) - np.int64(b[y, x])
            total += difference * difference
            count += 1
    return total / count
