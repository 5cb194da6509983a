"""A drawn right view, and what it is compared with: the left image, warped by depth."""

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np

from sags_node.config.schema import Box
from sags_node.engine.rasterizer.rasterize import Drawer
from sags_node.engine.rasterizer.views import colours_of
from sags_node.kernels.jit import kernel
from sags_node.mapping.right_eye import right_eye_mask
from sags_node.quality import metrics
from sags_node.tools.evaluation.run import MappedFrame
from sags_node.types import F32, U8, Bool, RectifiedPair, StereoFrame
from sags_node.vision.rectify import Rectifier

LARGEST_STEP = 1.0  # px of disparity between neighbours of one surface: steeper ones the right eye cannot see


def warp_to_right(left: F32, depth: F32, focal_px: float, baseline: float) -> tuple[F32, Bool]:
    """The left image as the right eye would see it, and where that is known.

    Neighbouring left pixels of nearly one disparity span the surface between them; the nearest surface hides
    the others. What no surface covers stays unknown.

    Args:
        left: [H, W, 3] rectified.
        depth: [H, W] m, of the left image, 0 unknown.
        focal_px: of the rectified pair.
        baseline: m.

    Returns:
        The image [H, W, 3] (0 where unknown) and the mask [H, W].
    """
    disparity = np.divide(np.float32(focal_px * baseline), depth, out=np.zeros_like(depth), where=depth > 0)
    columns = _left_columns(disparity)
    known: Bool = columns >= 0
    rows = np.broadcast_to(np.arange(depth.shape[0], dtype=np.float32)[:, None], depth.shape)
    warped: F32 = cv2.remap(left, columns, rows.copy(), cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    return np.where(known[..., None], warped, np.float32(0)), known


def right_figures(
    shown: MappedFrame, pair: RectifiedPair, usable: Bool, drawer: Drawer, before: U8 | None = None
) -> dict[str, dict[str, float]]:
    """PSNR of the right eye's image, each after a fit of gain and offset.

    Args:
        shown: what the run made of the frame.
        pair: the frame, with its right eye.
        usable: [H, W] of `right_pixels`.
        before: [H, W, 3] the right image of the frame before.

    Returns:
        `novel`: of the model alone; the mapper never saw that eye. `right`, where the warp is known: `psnr`
        of the right view, if it was shown; `warp_psnr` of the left image, warped by the stereo stage's
        depth; `model_psnr`; `copy_psnr` of the image before; `coverage`, the share of `novel`'s pixels.
    """
    assert pair.right is not None
    camera, focal_px = shown.snapshot.camera, float(shown.snapshot.camera.K[0, 0])
    depths = shown.depth[shown.tissue & (shown.depth > 0)]
    mask = right_eye_mask(shown.tissue, depths, focal_px, shown.baseline) & usable
    planes = drawer.forward(shown.snapshot.gaussians, camera.moved_right(shown.baseline))
    model, truth = colours_of(planes), metrics.as_float(pair.right)
    figures = {"novel": {"psnr": metrics.fitted_psnr(model, truth, mask)}}
    warp, known = warp_to_right(metrics.as_float(pair.left), shown.measured_depth, focal_px, shown.baseline)
    both = mask & known
    if both.any():
        pictures = {"warp_psnr": warp, "model_psnr": model}
        if shown.right_rgb is not None:
            pictures["psnr"] = metrics.as_float(shown.right_rgb)
        if before is not None:
            pictures["copy_psnr"] = metrics.as_float(before)
        figures["right"] = {key: metrics.fitted_psnr(each, truth, both) for key, each in pictures.items()}
        figures["right"]["coverage"] = float(both.sum() / mask.sum())
    return figures


def right_pixels(rectifier: Rectifier, frame: StereoFrame, exclude: Sequence[Box]) -> Bool:
    """A mask [H, W] of rectified right pixels that show the raw image outside the boxes of `exclude`."""
    white = np.full_like(frame.left, 255)
    for x, y, width, height in exclude:
        white[y : y + height, x : x + width] = 0
    rectified = rectifier(replace(frame, right=white)).right
    assert rectified is not None
    usable: Bool = (rectified == 255).all(-1)
    return usable


@kernel
def _left_columns(disparity: F32) -> F32:
    """The left column that each right pixel shows, -1 unknown, [H, W]."""
    height, width = disparity.shape
    columns = np.full((height, width), np.float32(-1))
    for y in range(height):
        nearest = np.zeros(width, np.float32)  # disparity of what each right pixel shows so far
        for x in range(width - 1):
            here, beside = disparity[y, x], disparity[y, x + 1]
            if here <= 0 or beside <= 0 or abs(beside - here) >= LARGEST_STEP:
                continue
            start, end = x - here, x + 1 - beside  # start < end: the step is below one pixel
            for column in range(max(0, int(np.ceil(start))), min(width - 1, int(np.floor(end))) + 1):
                share = (column - start) / (end - start)
                between = here + share * (beside - here)
                if between > nearest[column]:
                    nearest[column] = between
                    columns[y, column] = x + share
    return columns
