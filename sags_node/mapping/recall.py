"""Anchors that were out of sight for long are found again by recognising what surrounded them.

Images are remembered in which anchors were seen, in several states of the tissue. In a later image their
features (ORB, `vision.landmarks`) are looked for again. Around an anchor they tell how the tissue was moved,
turned and scaled; the anchor's own patch must then fit, and the scale must agree with the change of depth.
"""

from collections import deque
from dataclasses import dataclass

import cv2
import numpy as np

from sags_node.types import F32, F64, I64, U8, Bool
from sags_node.vision.landmarks import APART, FEWEST, Features, agreeing, matched

MOST_PICTURES = 12
LIKE = 0.3  # share of features found again: an image with fewer shows the tissue in another state
NEAR = 0.3  # of the width: features within this distance of an anchor count
MOST_AROUND = 30  # the nearest features around an anchor that are used
SAME_MOTION = 0.01  # of the width: most that a feature may deviate from the common motion around the anchor
SAME_SCALE = 1.25  # largest ratio of the scales by image and by depth; its reciprocal is the smallest


@dataclass(frozen=True, slots=True)
class _Remembered:
    """An image in which anchors were seen."""

    features: Features
    ids: I64  # [A] of the anchors
    pixels: F64  # [A, 2] px
    depths: F64  # [A] m
    patches: U8  # [A, P, P] gray, around them


@dataclass(frozen=True, slots=True)
class Place:
    """Where an anchor seems to be.

    Attributes:
        linear: [2, 2] px per px: how what surrounds it was turned and scaled since its patch was taken.
    """

    id: int
    pixel: F64  # [2] px
    linear: F64
    patch: U8  # [P, P] gray, from when it was remembered
    depth: float  # m, then

    @property
    def scale(self) -> float:
        """The scale of the image: above 1, the tissue came nearer."""
        return float(np.sqrt(abs(np.linalg.det(self.linear))))


class Recall:
    """Images in which anchors were seen."""

    def __init__(self) -> None:
        self._pictures: deque[_Remembered] = deque(maxlen=MOST_PICTURES)
        self._turn = 0

    def remember(self, features: Features, ids: I64, pixels: F64, depths: F64, patches: U8) -> None:
        """Keep an image that shows anchors, if it shows another state of the tissue or new anchors."""
        if len(ids) == 0:
            return
        if self._pictures and np.isin(ids, [i for kept in self._pictures for i in kept.ids]).all():
            rows, _ = matched(self._pictures[-1].features, features)
            if len(rows) >= LIKE * len(features.places):
                return
        if len(self._pictures) == MOST_PICTURES:
            del self._pictures[1]  # the first one shows how it all began
        self._pictures.append(_Remembered(features, ids, pixels.copy(), depths.copy(), patches.copy()))

    def look(self, features: Features, lost: I64) -> list[Place]:
        """Find where lost anchors may be in an image, by one remembered image that shows any of them; each
        call takes the next one."""
        shows = [kept for kept in reversed(self._pictures) if np.isin(kept.ids, lost).any()]
        if not shows:
            return []
        self._turn += 1
        kept = shows[self._turn % len(shows)]
        before, after = matched(kept.features, features)
        start, end = kept.features.places[before], features.places[after]
        agreed = agreeing(start, end, APART * features.width)
        return _placed(kept, lost, start[agreed], end[agreed], features.width)

    def keep(self, ids: I64) -> None:
        """Forget the images that show none of these anchors: the others were removed."""
        kept = [picture for picture in self._pictures if np.isin(picture.ids, ids).any()]
        self._pictures = deque(kept, MOST_PICTURES)


def _placed(kept: _Remembered, lost: I64, start: F32, end: F32, width: int) -> list[Place]:
    """The lost anchors of a remembered image, by the features [K, 2] around each."""
    places = []
    for row in np.flatnonzero(np.isin(kept.ids, lost)):
        ways = np.hypot(*(start - kept.pixels[row]).T)
        around = np.argsort(ways, kind="stable")[:MOST_AROUND]
        around = around[ways[around] < NEAR * width]
        if len(around) < FEWEST:
            continue
        similarity, follows = cv2.estimateAffinePartial2D(
            start[around], end[around], method=cv2.RANSAC, ransacReprojThreshold=SAME_MOTION * width
        )
        if similarity is None or np.count_nonzero(follows) < max(FEWEST, len(around) / 2):
            continue
        linear, shift = similarity[:, :2], similarity[:, 2]
        pixel = linear @ kept.pixels[row] + shift
        places.append(Place(int(kept.ids[row]), pixel, linear, kept.patches[row], float(kept.depths[row])))
    return places


def fits_depth(place: Place, depth: float) -> bool:
    """Tell whether the tissue came nearer in the image as it did in depth (m)."""
    ratio = place.scale * depth / place.depth
    return 1 / SAME_SCALE < ratio < SAME_SCALE


def straightened(gray: U8, tissue: Bool, place: Place, radius: int) -> tuple[U8, Bool]:
    """Turn and scale the image around a place back to the remembered view, a square of 2 radius + 1 px;
    returns it, and where all pixels that it is sampled from are tissue."""
    size = 2 * radius + 1
    back = np.concatenate([place.linear, (place.pixel - place.linear @ [radius, radius])[:, None]], axis=1)
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    turned = cv2.warpAffine(gray, back, (size, size), flags=flags)
    share = cv2.warpAffine(tissue.view(np.uint8) * np.uint8(255), back, (size, size), flags=flags)
    return np.asarray(turned, np.uint8), np.asarray(share == 255, np.bool_)
