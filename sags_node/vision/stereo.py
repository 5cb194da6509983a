"""Metric depth, and how far to trust it, from a rectified pair."""

from __future__ import annotations

import cv2
import numba
import numpy as np

from sags_node.config import StereoConfig
from sags_node.errors import UsageError
from sags_node.types import F32, U8, Bool, Camera, RectifiedPair
from sags_node.vision.alignment import RowMonitor
from sags_node.vision.matchers import InverseSearch, SemiGlobal

FULL_SIZE_BELOW = 480  # px width: matching at half of less costs half of the accuracy and saves little
SMALLEST_SIDE = 32  # px of the matching picture: four patches of the inverse search
LEAST_AGREEMENT = 0.57  # matches below it are wrong more often than right
AGREEMENT_WINDOW = 9  # px
HIDDEN_TOLERANCE = 2.0  # px of disparity between two matches of one right pixel
NOISE_VARIANCE = 1.0  # grey levels squared: texture below it is camera noise, not agreement
HALF = np.float32(0.5)  # of a pixel's neighbours know their disparity
EDGE_MARGIN = 20 / 640  # of the width: depths smear that far across an instrument's edge


class StereoDepth:
    """Depth of the left rectified picture. Keeps nothing from frame to frame that changes it.

    Matching runs at the working size divided by the scale. A match is trusted as far as its
    neighbourhood agrees with the place in the right picture that it was matched to: the confidence is 0 at a
    zero-mean normalised cross-correlation (ZNCC) of 0.57 and below, where the depth is unknown, and 1 at 1.

    Raises:
        UsageError: the pictures are too small to match, or no disparity fits the depth range.
    """

    def __init__(self, config: StereoConfig, camera: Camera, baseline: float) -> None:
        scale = config.scale or (2 if camera.width >= FULL_SIZE_BELOW else 1)
        width, height = round(camera.width / scale), round(camera.height / scale)
        if min(width, height) < SMALLEST_SIDE:
            raise UsageError(
                f"{width}x{height} px are too few to match; lower vision.stereo.scale or raise vision.width "
                f"and vision.height"
            )
        self._size = width, height
        self._focal = float(camera.K[0, 0]) * width / camera.width
        self._baseline = baseline
        self._smallest = self._focal * baseline / config.max_depth
        self._largest = min(self._focal * baseline / config.min_depth, width - 1.0)
        if self._smallest >= self._largest:
            raise UsageError(
                f"the eyes' pictures do not overlap at vision.stereo.max_depth {config.max_depth} m; raise "
                f"it or check the calibration's baseline, {baseline * 1e3:.3g} mm"
            )
        self.rows = RowMonitor(camera.width)
        self._match: SemiGlobal | InverseSearch
        if config.method == "sgbm":
            self._match = SemiGlobal(self._smallest, self._largest)
        else:
            self._match = InverseSearch(self._smallest, self._largest, self._size)
        self._columns, self._rows = np.meshgrid(
            np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32)
        )
        margin = 2 * round(EDGE_MARGIN * camera.width) + 1
        self._margin = np.ones((margin, margin), np.uint8)

    def __call__(self, pair: RectifiedPair, tissue: Bool) -> tuple[F32, F32]:
        """Depth [H, W] (m, 0 unknown) and confidence [H, W] (0..1, 0 where the depth is unknown).

        Depth is unknown outside `tissue` [H, W] and within a few px of its edge.
        """
        assert pair.right is not None  # a frame without a right eye brings its depth
        left, right = self._gray(pair.left), self._gray(pair.right)
        disparity, row_error, known = self._match(left, right)
        depth = self._trusted(left, right, disparity, row_error, known, tissue)
        if isinstance(self._match, InverseSearch):  # the other one takes the calibration's rows for granted
            self.rows.update(row_error, known)
        return depth

    def judge(self, pair: RectifiedPair, disparity: F32, tissue: Bool) -> tuple[F32, F32]:
        """Depth and confidence of a disparity [H, W] (px; NaN or <= 0: unknown) that something else found,
        trusted only as far as the pictures agree, as its own is."""
        assert pair.right is not None  # there is no disparity without
        left, right = self._gray(pair.left), self._gray(pair.right)
        small = disparity
        if self._size != disparity.shape[1::-1]:
            small = cv2.resize(disparity, self._size, interpolation=cv2.INTER_AREA)
            small *= np.float32(self._size[0] / disparity.shape[1])
        known = small > 0
        small = np.where(known, small, np.float32(0))
        return self._trusted(left, right, small, np.zeros_like(small), known, tissue)

    def _trusted(
        self, left: U8, right: U8, disparity: F32, row_error: F32, known: Bool, tissue: Bool
    ) -> tuple[F32, F32]:
        agreement = self._agreement(left, right, disparity, row_error)
        known &= (disparity >= self._smallest) & (disparity <= self._largest)
        known &= (disparity <= self._columns) & (agreement > LEAST_AGREEMENT)
        _forget_hidden(disparity, known)
        some = disparity[::4, ::4][known[::4, ::4]]
        if some.size:  # the strip that the right eye does not see: a match is found there, never a true one
            known &= self._columns >= np.median(some)
        confidence = np.where(known, (agreement - LEAST_AGREEMENT) / (1 - LEAST_AGREEMENT), np.float32(0))

        inner = cv2.erode(tissue.view(np.uint8), self._margin)
        return self._enlarge(disparity, known, confidence, inner)

    def _gray(self, image: U8) -> U8:
        gray = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        shrunk: U8 = cv2.resize(gray, self._size, interpolation=cv2.INTER_AREA)
        return shrunk

    def _agreement(self, left: U8, right: U8, disparity: F32, row_error: F32) -> F32:
        """ZNCC [h, w] of each neighbourhood with the one it was matched to."""
        matched = cv2.remap(
            right,
            self._columns - disparity,
            self._rows + row_error,
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REPLICATE,
        )
        a, b = left.astype(np.float32), matched.astype(np.float32)
        mean_a, mean_b = _mean(a), _mean(b)
        covariance = _mean(a * b) - mean_a * mean_b
        variance_a = _mean(a * a) - mean_a * mean_a
        variance_b = _mean(b * b) - mean_b * mean_b
        noise = np.float32(NOISE_VARIANCE)
        spread = np.sqrt((variance_a + noise) * (variance_b + noise))
        return (covariance / spread).astype(np.float32, copy=False)

    def _enlarge(self, disparity: F32, known: Bool, confidence: F32, inner: U8) -> tuple[F32, F32]:
        """Depth and confidence at the working size, where `inner` [H, W] is not 0.

        Disparity is what is linear on a plane, so it is interpolated, and only between known neighbours.
        """
        weight = known.astype(np.float32)
        total = disparity * weight
        size = inner.shape[1::-1]
        if size != self._size:
            total, weight, confidence = (cv2.resize(array, size) for array in (total, weight, confidence))
        _to_depth(total, weight, confidence, inner, np.float32(self._focal * self._baseline))
        return total, confidence


@numba.njit(cache=True, nogil=True)
def _to_depth(total: F32, weight: F32, confidence: F32, inner: U8, focal_baseline: np.float32) -> None:
    """In place: `total`, disparity times weight, becomes depth (m); it and the confidence become 0 where the
    depth is unknown. One pass: whole pictures in between take longer to allocate than to compute."""
    height, width = total.shape
    for y in range(height):
        for x in range(width):
            known = inner[y, x] != 0 and weight[y, x] > HALF and total[y, x] > 0
            total[y, x] = focal_baseline * weight[y, x] / total[y, x] if known else np.float32(0)
            confidence[y, x] = confidence[y, x] if known else np.float32(0)


@numba.njit(cache=True, nogil=True)
def _forget_hidden(disparity: F32, known: Bool) -> None:
    """Clear `known` where the right eye's pixel is taken by a nearer surface: the match must be wrong.

    This is what is left of the left-right check when only the left picture is matched.
    """
    height, width = disparity.shape
    for y in range(height):
        nearest = np.zeros(width, np.float32)  # by right column
        for x in range(width):
            if known[y, x]:
                column = int(x - disparity[y, x] + 0.5)
                nearest[column] = max(nearest[column], disparity[y, x])
        for x in range(width):
            if known[y, x]:
                column = int(x - disparity[y, x] + 0.5)
                known[y, x] = disparity[y, x] > nearest[column] - HIDDEN_TOLERANCE


def _mean(picture: F32) -> F32:
    mean: F32 = cv2.blur(picture, (AGREEMENT_WINDOW, AGREEMENT_WINDOW))
    return mean
