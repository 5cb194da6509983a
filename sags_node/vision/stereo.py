"""Metric depth, and how far to trust it, from a rectified pair."""

from pathlib import Path

import cv2
import numpy as np

from sags_node.config.schema import StereoConfig
from sags_node.config.units import fitting_units, in_metres
from sags_node.errors import UsageError
from sags_node.rig.check import ENDOSCOPE_BASELINE
from sags_node.types import F32, Bool, Camera, Finding, RectifiedPair
from sags_node.vision.alignment import RowMonitor
from sags_node.vision.dense_depth import depth_of_patches, depth_of_pixels
from sags_node.vision.margin import clear_of_instruments
from sags_node.vision.matchers import match_patches
from sags_node.vision.near_limit import NearLimit
from sags_node.vision.pyramid import inner, level, pyramids

FULL_SIZE_BELOW = 480  # px width: matching at half of less costs half of the accuracy and saves little
SMALLEST_SIDE = 32  # px of the matching image: four patches of the inverse search
WIDEST = 1 / 3  # of the largest depth: a wider baseline makes the eyes' views differ too much
SMOOTHING_RADIUS = 1 / 100  # of the matching image's width


class StereoDepth:
    """Depth of the left rectified image. All that is kept from frame to frame, and changes it, is how near
    tissue can be (`NearLimit`).

    Matching runs at the working size divided by the scale. A match is trusted as far as its
    neighbourhood agrees with the place in the right image that it was matched to: the confidence is 0 at a
    zero-mean normalised cross-correlation (ZNCC) of 0.57 and below, where the depth is unknown, and 1 at 1.

    Args:
        path: of the calibration.

    Raises:
        UsageError: the images are too small to match, or the eyes too far apart for the depth range.
    """

    def __init__(
        self, config: StereoConfig, camera: Camera, baseline: float, path: Path | str = "PATH"
    ) -> None:
        scale = config.scale or (2 if camera.width >= FULL_SIZE_BELOW else 1)
        width, height = camera.width // scale, camera.height // scale
        if min(width, height) < SMALLEST_SIDE:
            raise UsageError(
                f"{width}x{height} px are too few to match; lower vision.stereo.scale or raise vision.width "
                f"and vision.height"
            )
        self._halvings = scale.bit_length() - 1
        self._size = width, height
        self._focal_baseline = float(camera.K[0, 0]) / scale * baseline
        self._smallest = self._focal_baseline / config.max_depth
        self._near = NearLimit(config, float(camera.K[0, 0]) * baseline)
        if self._smallest >= self._disparities()[1] or baseline > WIDEST * config.max_depth:
            units = fitting_units(baseline, *ENDOSCOPE_BASELINE)
            unit = f"{in_metres(units, path)}; " if units else ""
            raise UsageError(
                f"eyes that stand {baseline * 1e3:.3g} mm apart see nothing alike within "
                f"vision.stereo.max_depth, {config.max_depth:g} m; {unit}if that baseline is right, set "
                "vision.stereo.max_depth to how far away tissue can be"
            )
        self.rows = RowMonitor(camera.width)

    def __call__(self, pair: RectifiedPair, tissue: Bool) -> tuple[F32, F32]:
        """Return depth [H, W] (m, 0 unknown) and confidence [H, W] (0..1, 0 where the depth is unknown).

        Depth is unknown outside `tissue` [H, W] and within a few px of its edge.
        """
        left, right = pyramids(pair)
        assert right is not None  # a frame without a right eye brings its depth
        self._near.look(pair.t_capture_ns, left, right, tissue)
        patches = match_patches(left, right, self._disparities(), self._halvings)
        self.rows.update(patches.field[..., 1], patches.good, self._size[0])
        clear = clear_of_instruments(tissue, self._halvings)
        _leave_out_unseen(clear, -patches.field[..., 0][patches.good])
        return depth_of_patches(
            patches,
            clear,
            tissue.shape[1::-1],
            self._disparities(),
            round(SMOOTHING_RADIUS * self._size[0]),
            self._focal_baseline,
        )

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Return what is wrong with the rig, as far as matching tells. May be read from any thread."""
        return (*self.rows.findings, *self._near.findings)

    def judge(self, pair: RectifiedPair, disparity: F32, tissue: Bool) -> tuple[F32, F32]:
        """Return depth and confidence from a disparity [H, W] (px; NaN or <= 0: unknown) of a network. As
        with matched depth, it is trusted as far as the images agree."""
        left, right = pyramids(pair)
        assert right is not None  # there is no disparity without
        self._near.look(pair.t_capture_ns, left, right, tissue)
        if self._size != disparity.shape[1::-1]:
            ratio = np.float32(self._size[0] / disparity.shape[1])
            disparity = ratio * cv2.resize(disparity, self._size, interpolation=cv2.INTER_AREA)
        known = disparity > 0
        disparity = np.where(known, disparity, np.float32(0))
        columns, rows = np.meshgrid(*(np.arange(side, dtype=np.float32) for side in self._size))
        pictures = level(left, self._halvings), level(right, self._halvings)
        seen = cv2.remap(
            inner(pictures[1]), columns - disparity, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )
        clear = clear_of_instruments(tissue, self._halvings)
        _leave_out_unseen(clear, disparity[::4, ::4][known[::4, ::4]])
        return depth_of_pixels(
            pictures[0],
            seen,
            disparity,
            known,
            clear,
            tissue.shape[1::-1],
            self._disparities(),
            self._focal_baseline,
        )

    def _disparities(self) -> tuple[float, float]:
        """The smallest and the largest that are matched, px of the matching image."""
        return self._smallest, min(self._focal_baseline / self._near.limit, self._size[0] - 1.0)


def _leave_out_unseen(clear: Bool, disparities: F32) -> None:
    """Clears the strip that the right eye does not see: a match found there is never true."""
    if disparities.size:
        clear[:, : max(0, int(np.ceil(np.median(disparities))))] = False
