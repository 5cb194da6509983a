"""How the poses of a clip are meant: of two frames with depth one reading explains what is seen where.

Tools disagree on axes and on direction, and their files do not say which they took.
"""

from collections.abc import Callable
from typing import NamedTuple

import cv2
import numpy as np

from sags_node.types import F32, F64, U8, Bool

MOVES = (2.0, 0.15)  # px, and share of the width: motion between two frames that tells
CLEARLY = 0.8  # of the difference that the usual reading leaves, and of that of a camera that stands still
LEAST_SEEN = 0.3  # share of the pixels with depth that both frames show
STEP = 4  # px: every so many pixels are looked at
SOFT = 2.0  # px: differences are taken between blurred pictures, so that small errors tell little


class Seen(NamedTuple):
    """A frame of a clip."""

    picture: U8  # [H, W, 3] RGB
    depth: F32  # [H, W] m, 0 unknown
    tissue: Bool  # [H, W]


READINGS: dict[str, Callable[[F64], F64]] = {  # to camera to world [N, 4, 4] with axes right, down, forward
    "opencv": lambda poses: poses,
    "llff": lambda poses: poses[..., [1, 0, 2, 3]] * [1, 1, -1, 1],  # down, right, back: imgs2poses
    "opengl": lambda poses: poses * [1, -1, -1, 1],  # right, up, back
    "world_to_camera": lambda poses: np.linalg.inv(poses).astype(np.float64),
}


def reading_that_fits(poses: F64, K: F64, look: Callable[[int], Seen]) -> str | None:
    """Which of `READINGS` of poses [N, 4, 4] (m) explains the frames that `look` gives by their numbers; None
    where they do not tell, as of a camera that stands still."""
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
    """Every `STEP` th pixel of every `STEP` th row [h, w, 2]: x, y."""
    v, u = np.mgrid[: shape[0] : STEP, : shape[1] : STEP]
    return np.stack([u, v], -1).astype(np.float64)


def _moved(first: Seen, poses: F64, K: F64) -> F64:
    """Find where the first frame's `_pixels` lie in the other one; NaN behind it."""
    depth = first.depth[::STEP, ::STEP].astype(np.float64)
    rays = (_pixels(first.depth.shape) - K[:2, 2]) / K[[0, 1], [0, 1]]
    points = np.concatenate([rays, np.ones((*depth.shape, 1))], -1) * depth[..., None]
    T = np.linalg.inv(poses[1]) @ poses[0]
    there = points @ T[:3, :3].T + T[:3, 3]
    z = np.where(there[..., 2] > 1e-6, there[..., 2], np.nan)
    moved: F64 = there[..., :2] / z[..., None] * K[[0, 1], [0, 1]] + K[:2, 2]
    return moved


def _difference(first: Seen, other: Seen, way: F64) -> float:
    """Mean grey levels between a frame and the other one looked up where its pixels went; infinite where too
    few are seen in both."""
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
