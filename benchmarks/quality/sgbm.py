"""OpenCV's StereoSGBM (Hirschmueller, PAMI 2008), which the node's stage is compared with."""

import cv2
import numpy as np
from numpy.typing import NDArray

from sags_node.config.schema import StereoConfig
from sags_node.geometry import disparity_to_depth
from sags_node.quality import metrics
from sags_node.types import F32, U8, Bool, Camera, GrayPyramid, RectifiedPair
from sags_node.vision.pyramid import inner, level, pyramids
from sags_node.vision.stereo import StereoDepth

BLOCK = 5  # px
COMMON = {"blockSize": BLOCK, "P1": 8 * BLOCK**2, "P2": 32 * BLOCK**2, "disp12MaxDiff": 1}


class PlainSGBM:
    """SGBM as OpenCV's own sample `stereo_match.py` sets it up, without our checks."""

    def __init__(self, config: StereoConfig, camera: Camera, baseline: float, scale: int) -> None:
        self._size = round(camera.width / scale), round(camera.height / scale)
        self._focal = float(camera.K[0, 0]) * self._size[0] / camera.width
        self._baseline = baseline
        self._smallest = int(self._focal * baseline / config.max_depth)
        count = 16 * int(np.ceil((self._focal * baseline / config.nearest - self._smallest) / 16))
        self._matcher = cv2.StereoSGBM.create(
            self._smallest, count, **COMMON, uniquenessRatio=10, speckleWindowSize=100, speckleRange=2
        )

    def __call__(self, pair: RectifiedPair, tissue: Bool) -> tuple[F32, F32]:
        assert pair.right is not None  # there is nothing to match without
        left, right = (
            cv2.resize(cv2.cvtColor(eye, cv2.COLOR_RGB2GRAY), self._size, interpolation=cv2.INTER_AREA)
            for eye in (pair.left, pair.right)
        )
        disparity = _pixels(self._matcher.compute(left, right), self._smallest)
        depth = disparity_to_depth(disparity, self._focal, self._baseline)
        depth = metrics.resample_nearest(depth, tissue.shape[1], tissue.shape[0]) * tissue
        return depth, (depth > 0).astype(np.float32)


class JudgedSGBM:
    """SGBM in place of the stage's own matcher: on the stage's images, and the stage judges the matches."""

    def __init__(self, config: StereoConfig, camera: Camera, baseline: float, scale: int) -> None:
        self._stage = StereoDepth(config.model_copy(update={"scale": scale}), camera, baseline)
        self._halvings = scale.bit_length() - 1
        focal_baseline = float(camera.K[0, 0]) / scale * baseline
        self._smallest = int(focal_baseline / config.max_depth)
        largest = min(focal_baseline / config.nearest, camera.width // scale - 1.0)
        count = 16 * int(np.ceil((largest + 1 - self._smallest) / 16))
        self._pad = self._smallest + count
        self._matcher = cv2.StereoSGBM.create(
            self._smallest, count, **COMMON, uniquenessRatio=5, speckleWindowSize=50, speckleRange=1,
            mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
        )  # fmt: skip

    def __call__(self, pair: RectifiedPair, tissue: Bool) -> tuple[F32, F32]:
        # OpenCV leaves out the columns that the largest disparity would push out of the image: pad them.
        left, right = (
            cv2.copyMakeBorder(self._gray(eye), 0, 0, self._pad, 0, cv2.BORDER_REPLICATE)
            for eye in pyramids(pair)
        )
        disparity = _pixels(self._matcher.compute(left, right)[:, self._pad :], self._smallest)
        return self._stage.judge(pair, disparity, tissue)

    def _gray(self, eye: GrayPyramid | None) -> U8:
        assert eye is not None  # there is nothing to match without
        return np.asarray(cv2.convertScaleAbs(inner(level(eye, self._halvings))), np.uint8)


def _pixels(sixteenths: NDArray[np.int16], smallest: int) -> F32:
    """Disparity (px), 0 where no match was found: OpenCV marks that by one below the smallest."""
    known = sixteenths >= smallest * 16
    return np.where(known, sixteenths.astype(np.float32) / np.float32(16), np.float32(0))
