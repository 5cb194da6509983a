"""How near tissue can be: the end of the disparities that are worth searching, found from the images.

A wide search costs time and accuracy where nothing is near, a narrow one gives near tissue the depth of what
lies behind it. So now and then a small image is searched as far as a scope can come, and the limit follows
what is found there.
"""

from collections import deque

import cv2
import numpy as np

from sags_node.config.schema import StereoConfig
from sags_node.types import F32, Bool, Finding, GrayPyramid
from sags_node.vision.coarse_stereo import coarse_disparity
from sags_node.vision.matchers import GUESS_WIDTH
from sags_node.vision.pyramid import BORDER, inner, level

NEAREST = 0.01  # m: nearer, most endoscopes cannot focus, and the eyes hardly share a view
PERIOD_NS = 500_000_000  # ns between two looks
AGREED = 2  # looks in a row that show something nearer
RETREAT = 10  # looks in a row without anything near, after which the limit goes back
ROOM = 0.7  # of the nearest depth that was found: tissue moves between two looks
LEAST_SHARE = 0.02  # of the tissue that both eyes see: fewer pixels may be wrong matches, or an instrument's
BEYOND, BEYOND_SHARE = 0.004, 0.1  # m: tissue too near to match is sought down to here; its share
SEARCHED = 96  # disparities at most: more cost too much, and are found in a smaller image as well
WINDOW = 9  # px of the small image, over which correlation is taken
MATCHES = 0.8  # correlation of two windows; 99 % stay below in images that do not belong together
PLAIN = 2.0  # grey levels, standard deviation in a window: less cannot be matched


class NearLimit:
    """The nearest depth that is matched.

    Attributes:
        limit: m; as far as is known, no tissue is nearer.
        findings: that tissue is nearer than a limit that was set, or else than `NEAREST`, and what helps. May
            be read from any thread.
    """

    def __init__(self, config: StereoConfig, focal_baseline: float) -> None:
        """
        Args:
            config: a `min_depth` that it sets stays, whatever the images show.
            focal_baseline: px m, of the whole image.
        """
        self.limit = self._usual = config.nearest
        self.findings: tuple[Finding, ...] = ()
        self._is_set = config.min_depth is not None
        self._focal_baseline = focal_baseline
        self._looked_ns: int | None = None
        self._beyond = np.inf  # m, the nearest that was found by searching on
        self._found: deque[float] = deque(maxlen=RETREAT)

    def look(self, t_capture_ns: int, left: GrayPyramid, right: GrayPyramid, tissue: Bool) -> None:
        """Take the images of one frame and its tissue [H, W]; most frames are skipped."""
        first = self._looked_ns is None
        if self._is_set and self.limit <= NEAREST:
            return
        if self._looked_ns is not None and 0 <= t_capture_ns - self._looked_ns < PERIOD_NS:
            return
        self._looked_ns = t_capture_ns
        self._found.append(nearest_tissue(left, right, tissue, self._focal_baseline))
        if not self._is_set:
            beyond = nearest_tissue(left, right, tissue, self._focal_baseline, BEYOND, BEYOND_SHARE)
            before, self._beyond = self._beyond, beyond
            self.findings = (self._too_near(beyond),) if max(before, beyond) < NEAREST else ()
        latest = list(self._found)[-AGREED:]
        agrees = len(latest) == AGREED or first  # before there is a model nothing can be spoilt
        if self._is_set:
            if agrees and max(latest) < self.limit:
                self.findings = (self._too_near(min(latest)),)
            elif min(latest) >= self.limit:
                self.findings = ()
        elif agrees and max(latest) < self.limit:
            self.limit = max(NEAREST, ROOM * min(latest))
        elif len(self._found) == RETREAT and ROOM * min(self._found) > self.limit:
            self.limit = min(self._usual, ROOM * min(self._found))

    def _too_near(self, depth: float) -> Finding:
        fix = f"the {1e3 * NEAREST:.0f} mm from which depth can be matched: move the scope back"
        if self._is_set:
            fix = "vision.stereo.min_depth: lower it, or leave it out"
        return Finding("tissue_too_near", f"tissue lies at {1e3 * depth:.0f} mm, nearer than {fix}")


def nearest_tissue(
    left: GrayPyramid,
    right: GrayPyramid,
    tissue: Bool,
    focal_baseline: float,
    end: float = NEAREST,
    share: float = LEAST_SHARE,
) -> float:
    """Return the depth (m) of the nearest `share` of the tissue [H, W] that both eyes see; infinite: unknown.

    Args:
        focal_baseline: px m, of the whole image.
        end: m, nearer is not searched.
    """
    width, halvings, most = left.full.shape[1], 0, focal_baseline / end
    while halvings < len(left.halves) and (width >> halvings > GUESS_WIDTH or most > SEARCHED << halvings):
        halvings += 1
    scale = 1 << halvings
    eyes = level(left, halvings), level(right, halvings)
    height, width = (side - 2 * BORDER for side in eyes[0].shape)
    disparity = coarse_disparity(*eyes, 0.0, min(most / scale, width - 1.0))
    first, second = (np.ascontiguousarray(inner(eye)) for eye in eyes)
    columns, rows = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    there = columns - disparity
    seen = cv2.remap(second, there, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    small = tissue[scale // 2 :: scale, scale // 2 :: scale][:height, :width]
    both = small & (there >= 0)
    known = both & (_agreement(first, seen) > MATCHES)
    count = round(share * np.count_nonzero(both))
    found = disparity[known & (disparity > 0)]
    if count == 0 or len(found) < count:
        return np.inf
    return float(focal_baseline / scale / np.partition(found, -count)[-count])


def _agreement(first: F32, second: F32) -> F32:
    """Correlation of the windows around each pixel; 0 where there is nothing to compare."""

    def mean(picture: F32) -> F32:
        return np.asarray(cv2.blur(picture, (WINDOW, WINDOW)), np.float32)

    a, b = first - mean(first), second - mean(second)
    aa, bb, ab = mean(a * a), mean(b * b), mean(a * b)
    correlation: F32 = np.where(np.minimum(aa, bb) > PLAIN**2, ab / np.sqrt(aa * bb + 1e-6), np.float32(0))
    return correlation
