"""Two stereo matchers. Both take rectified grey pictures [h, w] of one size and give three arrays [h, w]:
disparity (px), row error (px, how far below its own row the match lies) and where a match was found.
"""

from __future__ import annotations

import cv2
import numpy as np

from sags_node.types import F32, U8, Bool

Match = tuple[F32, F32, Bool]

SGBM_BLOCK = 5  # px
PATCH_STRIDE = 6  # px, of patches of 8
SMALL_WIDTH = 320  # px
SEARCH_STEPS = 8
GUESS_WIDTH = 160  # px: coarse matching wide enough for the folds of an organ
LARGEST_ROW_ERROR = 2.0  # px
LARGEST_ROW_STEP = 0.35  # px beside the mean row error around
ROW_WINDOW = 21  # px
SMOOTHING_RADIUS = 1 / 100  # of the width
SMOOTHING_VARIANCE = 0.2  # px squared: where disparity varies less around, it is noise on a smooth surface


class SemiGlobal:
    """StereoSGBM (Hirschmueller, PAMI 2008) over a range of disparities (px)."""

    def __init__(self, smallest: float, largest: float) -> None:
        self._smallest = int(smallest)
        count = 16 * int(np.ceil((largest + 1 - self._smallest) / 16))
        self._pad = self._smallest + count
        self._matcher = cv2.StereoSGBM.create(
            minDisparity=self._smallest,
            numDisparities=count,
            blockSize=SGBM_BLOCK,
            P1=8 * SGBM_BLOCK**2,
            P2=32 * SGBM_BLOCK**2,
            disp12MaxDiff=1,
            uniquenessRatio=5,
            speckleWindowSize=50,
            speckleRange=1,
            mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
        )

    def __call__(self, left: U8, right: U8) -> Match:
        # OpenCV leaves out the columns that the largest disparity would push out of the picture: pad them.
        padded = [cv2.copyMakeBorder(eye, 0, 0, self._pad, 0, cv2.BORDER_REPLICATE) for eye in (left, right)]
        sixteenths = self._matcher.compute(padded[0], padded[1])[:, self._pad :]
        disparity = sixteenths.astype(np.float32) / np.float32(16)
        # A pixel without a match is marked by (minDisparity - 1) * 16.
        return disparity, np.zeros_like(disparity), sixteenths >= self._smallest * 16


class InverseSearch:
    """Dense inverse search (Kroeger et al., ECCV 2016), an optical flow, from left to right.

    On the smooth surface of organs it is more accurate than `SemiGlobal` in the same time, but it only
    refines a guess that is right to a few pixels. A coarse `SemiGlobal` gives it afresh for every frame: that
    takes a millisecond, is as accurate as starting from the previous frame's disparity, and keeps no memory
    that could lock in an error.
    """

    def __init__(self, smallest: float, largest: float, size: tuple[int, int]) -> None:
        shrink = max(1, round(size[0] / GUESS_WIDTH))
        self._size = size
        self._guess_size = size[0] // shrink, size[1] // shrink
        self._guess_shrink = size[0] / self._guess_size[0]
        self._guess = SemiGlobal(smallest / self._guess_shrink, largest / self._guess_shrink)
        self._dis = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
        # The guess is good at its own resolution: no need to search at coarser ones.
        if size[0] >= SMALL_WIDTH:
            # Fewer patches at the finest resolution cost as much as many at half of it, and halve the error
            # at edges. In smaller pictures, whose patches span more, refinement matters more.
            self._dis.setFinestScale(0)
            self._dis.setPatchStride(PATCH_STRIDE)
            self._dis.setGradientDescentIterations(SEARCH_STEPS)
            self._smoothing_radius = round(SMOOTHING_RADIUS * size[0])
        else:
            self._smoothing_radius = 0  # refinement has smoothed as much as these few pixels bear
        self._dis.setCoarsestScale(max(self._dis.getFinestScale(), shrink.bit_length() - 2))
        self._dis.setVariationalRefinementIterations(1 if size[0] >= SMALL_WIDTH else 2)

    def __call__(self, left: U8, right: U8) -> Match:
        small = [cv2.resize(eye, self._guess_size, interpolation=cv2.INTER_AREA) for eye in (left, right)]
        guess, _, known = self._guess(small[0], small[1])
        flow = np.zeros((*left.shape, 2), np.float32)
        flow[..., 0] = cv2.resize(_fill(guess, known), self._size) * -self._guess_shrink
        flow = self._dis.calc(left, right, flow)
        # Calibrations are off by a row or so, smoothly over the picture. A wrong match jumps to another row.
        row_error = np.clip(flow[..., 1], -LARGEST_ROW_ERROR, LARGEST_ROW_ERROR)
        step = np.abs(row_error - cv2.blur(row_error, (ROW_WINDOW, ROW_WINDOW)))
        known = (step < LARGEST_ROW_STEP) & (np.abs(row_error) < LARGEST_ROW_ERROR)
        disparity = -flow[..., 0]
        if self._smoothing_radius > 0:
            disparity = _smooth(disparity, self._smoothing_radius)
        return disparity, row_error, known


def _smooth(disparity: F32, radius: int) -> F32:
    """The guided filter (He et al., PAMI 2013) with the picture as its own guide.

    Planes and steps larger than the noise stay as they are.
    """
    window = 2 * radius + 1, 2 * radius + 1
    mean = cv2.blur(disparity, window)
    variance = cv2.blur(disparity * disparity, window) - mean * mean
    kept = variance / (variance + np.float32(SMOOTHING_VARIANCE))
    smooth: F32 = cv2.blur(kept, window) * disparity + cv2.blur(mean * (1 - kept), window)
    return smooth


def _fill(disparity: F32, known: Bool) -> F32:
    """Unknown pixels become the mean of the known ones around, near ones before those farther off."""
    filled = np.where(known, disparity, np.float32(0))
    weight = known.astype(np.float32)
    for window in (7, 31, 127):
        near = cv2.blur(weight, (window, window))
        mean = cv2.blur(filled, (window, window)) / np.maximum(near, np.float32(1e-6))
        empty = (weight == 0) & (near > 1e-3)
        filled[empty] = mean[empty]
        weight[empty] = 1
    filled[weight == 0] = np.median(disparity[known]) if known.any() else 0
    return filled
