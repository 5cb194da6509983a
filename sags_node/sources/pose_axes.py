"""Finds the axes and the direction of a clip's poses: the reading that warps frames with depth best wins.

Tools disagree on axes and direction, and their files do not tell which ones they use.
"""

from collections.abc import Callable
from typing import NamedTuple

import cv2
import numpy as np

from sags_node.types import F32, F64, U8, Bool

MOVES = (2.0, 0.15)  # px, and share of the width: smallest and largest useful motion between frames
CLEARLY = 0.8  # largest ratio of the best difference to those of a still camera and of other readings
LEAST_SEEN = 0.3  # share of the pixels with depth that both frames must show
STEP = 4  # px between compared pixels
SOFT = 2.0  # px, sigma of the blur before images are compared, so that small errors matter little


class Seen(NamedTuple):
    """A frame of a clip."""

    picture: U8  # [H, W, 3] RGB
    depth: F32  # [H, W] m, 0 unknown
    tissue: Bool  # [H, W]


READINGS: dict[str, Callable[[F64], F64]] = {  # each converts poses [N, 4, 4] to T_world_cam, OpenCV axes
    "opencv": lambda poses: poses,
    "llff": lambda poses: poses[..., [1, 0, 2, 3]] * [1, 1, -1, 1],  # down, right, back: imgs2poses
    "opengl": lambda poses: poses * [1, -1, -1, 1],  # right, up, back
    "world_to_camera": lambda poses: np.linalg.inv(poses).astype(np.float64),
}


def reading_that_fits(poses: F64, K: F64, look: Callable[[int], Seen]) -> str | None:
    """Return which of `READINGS` of poses [N, 4, 4] (m) explains the frames, which `look` gives by number.
    None if that is not clear, e.g. because the camera stands still."""
    if np.allclose(poses, poses[0], atol=1e-9):
        return None
    first, still, left = look(0), 0.0, dict.fromkeys(READINGS, 0.0)
    for number in sorted({round(at) for at in np.linspace(1, len(poses) - 1, 8)}):
        ways = {name: _moved(first, read(poses)[[0, number]], K) for name, read in READINGS.items()}
        motion = float(np.nanmedian(np.linalg.norm(ways["opencv"] - _pixels(first.depth.shape), axis=-1)))
        if not MOVES[0] <= motion <= MOVES[1] * first.depth.shape[1]:
            continue
        other = look(number)
        still += _difference(first, other, _pixels(first.depth.shape))
        for name, way in ways.items():
            left[name] += _difference(first, other, way)
    best = min(left, key=lambda name: left[name])
    others = [each for each in left.values() if each > left[best] * (1 + 1e-6)]  # as of the best: the same
    return best if left[best] < CLEARLY * min([still, *others]) else None


def _pixels(shape: tuple[int, ...]) -> F64:
    """The grid [h, w, 2] of every `STEP`-th pixel: x, y."""
    v, u = np.mgrid[: shape[0] : STEP, : shape[1] : STEP]
    return np.stack([u, v], -1).astype(np.float64)


def _moved(first: Seen, poses: F64, K: F64) -> F64:
    """The first frame's `_pixels`, projected into the other frame [h, w, 2]; NaN behind its camera."""
    depth = first.depth[::STEP, ::STEP].astype(np.float64)
    rays = (_pixels(first.depth.shape) - K[:2, 2]) / K[[0, 1], [0, 1]]
    points = np.concatenate([rays, np.ones((*depth.shape, 1))], -1) * depth[..., None]
    T = np.linalg.inv(poses[1]) @ poses[0]
    there = points @ T[:3, :3].T + T[:3, 3]
    z = np.where(there[..., 2] > 1e-6, there[..., 2], np.nan)
    moved: F64 = there[..., :2] / z[..., None] * K[[0, 1], [0, 1]] + K[:2, 2]
    return moved


def _difference(first: Seen, other: Seen, way: F64) -> float:
    """The mean difference (grey levels) of a frame and the other one, sampled at `way`; infinite if too few
    pixels are in both."""
    gray, there = (
        cv2.GaussianBlur(cv2.cvtColor(each.picture, cv2.COLOR_RGB2GRAY), (0, 0), SOFT).astype(np.float32)
        for each in (first, other)
    )
    known = ((first.depth > 0) & first.tissue)[::STEP, ::STEP]
    inside = known & np.isfinite(way).all(-1) & (way >= 0).all(-1)
    inside &= (way <= np.array(gray.shape[::-1]) - 1).all(-1)
    if inside.sum() < LEAST_SEEN * max(known.sum(), 1):
        return np.inf
    at = np.nan_to_num(way).astype(np.float32)
    moved = cv2.remap(there, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return float(np.mean(np.abs(gray[::STEP, ::STEP] - moved)[inside]))
