"""Points followed in one eye's images by common methods without a model, for comparison with anchors.

Each gets the points' pixels in the first image, and is then shown the images in turn.
"""

from collections.abc import Callable
from typing import Protocol

import cv2
import numpy as np

from sags_node.types import F32, F64, U8, Bool

CONSISTENT = 1.0  # px: largest forward-backward error
WINDOW = (21, 21)  # px, of Lucas-Kanade: the size of an anchor's patch
LEVELS = 3  # of its pyramid, beside the image itself
BOX = 33  # px: side of the box around a point that CSRT tracks
HALF_BOX = (BOX - 1) / 2
AT_ONCE = 1 << 14  # places: OpenCV takes no image of more than 32,766 rows

Step = Callable[[U8, U8, F64], tuple[F64, Bool]]  # gray images, pixels [P, 2] -> pixels, and if found [P]


class Follower(Protocol):
    """Follows points."""

    def follow(self, picture: U8) -> tuple[F64, Bool]:
        """Return the points' pixels [P, 2] in the next image [H, W, 3] RGB, and which are not lost [P]."""


class Chained:
    """Follows from each image to the next. A point with too large a forward-backward error (Kalal et al.,
    ICPR 2010) is lost for good, because nothing is kept by which it could be found again."""

    def __init__(self, step: Step, picture: U8, pixels: F64) -> None:
        self._step, self._gray = step, _gray(picture)
        self._pixels, self._kept = pixels, np.ones(len(pixels), np.bool_)

    def follow(self, picture: U8) -> tuple[F64, Bool]:
        before, self._gray = self._gray, _gray(picture)
        ends, found = self._step(before, self._gray, self._pixels)
        back, returned = self._step(self._gray, before, ends)
        height, width = self._gray.shape
        inside = (ends >= 0).all(1) & (ends <= [width - 1, height - 1]).all(1)
        near = np.linalg.norm(back - self._pixels, axis=1) < CONSISTENT
        self._kept = self._kept & found & returned & near & inside
        self._pixels = ends
        return ends, self._kept


class Csrt:
    """One correlation filter for each point (Lukezic et al., CVPR 2017); OpenCV's, with its defaults."""

    def __init__(self, picture: U8, pixels: F64) -> None:
        self._pixels = pixels.copy()
        self._trackers = []
        for x, y in pixels:
            tracker = cv2.legacy.TrackerCSRT.create()
            tracker.init(_bgr(picture), (float(x) - HALF_BOX, float(y) - HALF_BOX, BOX, BOX))
            self._trackers.append(tracker)

    def follow(self, picture: U8) -> tuple[F64, Bool]:
        found = np.zeros(len(self._trackers), np.bool_)
        shown = _bgr(picture)
        for i, tracker in enumerate(self._trackers):
            found[i], (x, y, width, height) = tracker.update(shown)
            if found[i]:
                self._pixels[i] = x + (width - 1) / 2, y + (height - 1) / 2
        return self._pixels.copy(), found


class Unmoved:
    """Leaves points where they were: its error says how much there is to follow."""

    def __init__(self, picture: U8, pixels: F64) -> None:
        self._pixels = pixels

    def follow(self, picture: U8) -> tuple[F64, Bool]:
        return self._pixels, np.ones(len(self._pixels), np.bool_)


def lucas_kanade(picture: U8, pixels: F64) -> Follower:
    """Make a follower by pyramidal Lucas-Kanade (Bouguet, 2001) from image to image."""
    return Chained(_lucas_kanade_step, picture, pixels)


def dense_flow(picture: U8, pixels: F64) -> Follower:
    """Make a follower by dense inverse search (Kroeger et al., ECCV 2016) from image to image."""
    flow = dis_flow()

    def step(before: U8, after: U8, pixels: F64) -> tuple[F64, Bool]:
        moved = sample(np.asarray(flow.calc(before, after, None), np.float32), pixels)
        return pixels + moved, np.ones(len(pixels), np.bool_)

    return Chained(step, picture, pixels)


FOLLOWERS: dict[str, Callable[[U8, F64], Follower]] = {
    "lucas_kanade": lucas_kanade,
    "dense_flow": dense_flow,
    "csrt": Csrt,
    "unmoved": Unmoved,
}


def dis_flow() -> cv2.DISOpticalFlow:
    return cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)


def sample(flow: F32, places: F64) -> F64:
    """Sample a flow [H, W, 2] at places [M, 2] px."""
    taken = [
        cv2.remap(flow, some[:, None], None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)[:, 0]
        for some in np.array_split(places.astype(np.float32), len(places) // AT_ONCE + 1)
    ]
    return np.concatenate(taken).astype(np.float64)


def _lucas_kanade_step(before: U8, after: U8, pixels: F64) -> tuple[F64, Bool]:
    start = pixels.astype(np.float32)
    ends, found, _ = cv2.calcOpticalFlowPyrLK(
        before, after, start, start.copy(), winSize=WINDOW, maxLevel=LEVELS
    )
    return np.asarray(ends, np.float64), np.asarray(found[:, 0] == 1)


def _bgr(picture: U8) -> U8:
    return np.asarray(cv2.cvtColor(picture, cv2.COLOR_RGB2BGR), np.uint8)


def _gray(picture: U8) -> U8:
    return np.asarray(cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY), np.uint8)
