"""Figures of merit for images, depth and timings.

Images are float32 RGB 0..1 `[H, W, 3]`; `tissue` is True where a pixel counts. A figure over an empty
mask is NaN: nothing is invented where nothing was measured.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

import cv2
import numpy as np

from sags_node.types import F32, F64, I64, U8, Bool

Plane = TypeVar("Plane", F32, Bool)
BEST_PSNR = 100.0  # dB, of identical images, so that the mean over frames stays finite


def as_float(picture: U8) -> F32:
    """Convert uint8 0..255 to float32 0..1."""
    return picture.astype(np.float32) / np.float32(255)


def psnr(picture: F32, truth: F32, tissue: Bool) -> float:
    """The peak signal-to-noise ratio (dB) over tissue pixels only: "PSNR*"."""
    return _decibel(_squared_error(picture, truth, tissue))


def paper_psnr(picture: F32, truth: F32, tissue: Bool) -> float:
    """The PSNR (dB) as in the literature: both images are multiplied by the mask, without a margin,
    and all pixels are averaged: masked ones count as perfect (EndoGaussian, SAGS: `metrics.py`)."""
    return _decibel(_squared_error(picture, truth, tissue) * float(tissue.mean()))


def paper_ssim(picture: F32, truth: F32, tissue: Bool) -> float:
    """The `ssim` as in the literature: both images are black where masked, and all pixels count."""
    black = tissue[..., None].astype(np.float32)
    return ssim(picture * black, truth * black, np.ones_like(tissue))


def _squared_error(picture: F32, truth: F32, tissue: Bool) -> float:
    if not tissue.any():
        return float("nan")
    difference = picture[tissue].astype(np.float64) - truth[tissue]
    return float(np.mean(difference * difference))


def _decibel(squared_error: float) -> float:
    if squared_error <= 10 ** (-BEST_PSNR / 10):
        return BEST_PSNR
    return float(-10 * np.log10(squared_error))


def ssim(picture: F32, truth: F32, tissue: Bool) -> float:
    """Structural similarity (Wang et al. 2004: 11x11 Gaussian of sigma 1.5, K1 0.01, K2 0.03), mean of the
    map over tissue and channels.

    A window at the border of the mask also sees pixels beyond it. Those are set to the truth in both
    images, so that an instrument, which the model does not draw, does not lower the tissue beside it.
    """
    if not tissue.any():
        return float("nan")
    shown = np.where(tissue[..., None], picture, truth)
    compute = cv2.quality.QualitySSIM_compute  # type: ignore[attr-defined]  # missing in OpenCV's stubs
    _, similarity = compute(truth * np.float32(255), shown * np.float32(255))
    return float(np.mean(similarity[..., :3][tissue], dtype=np.float64))


def fit_gain_offset(picture: F32, truth: F32, mask: Bool) -> F32:
    """Fit `gain * picture + offset` to `truth`, each per channel, by least squares over `mask`.

    Two cameras of a rig differ in exposure and white balance; the model only ever saw the left one.
    A channel without contrast keeps gain 1. The result [H, W, 3] is not clipped.
    """
    fitted = picture.copy()
    if not mask.any():
        return fitted
    for channel in range(picture.shape[2]):
        x = picture[..., channel][mask].astype(np.float64)
        y = truth[..., channel][mask].astype(np.float64)
        variance = x.var()
        gain = np.mean((x - x.mean()) * (y - y.mean())) / variance if variance > 1e-12 else 1.0
        offset = y.mean() - gain * x.mean()
        fitted[..., channel] = np.float32(gain) * picture[..., channel] + np.float32(offset)
    return fitted


def fitted_psnr(picture: F32, truth: F32, mask: Bool) -> float:
    """The `psnr` (dB) over `mask` of an image of another exposure, after `fit_gain_offset`."""
    return psnr(fit_gain_offset(picture, truth, mask), truth, mask)


@dataclass(frozen=True, slots=True)
class DepthErrors:
    """How far a depth image is from its reference, over tissue; NaN where nothing could be compared."""

    median_mm: float
    p90_mm: float
    rmse_mm: float
    coverage: float  # share of the tissue pixels with a reference where depth is given


def depth_errors(depth: F32, reference: F32, tissue: Bool) -> DepthErrors:
    """Compute the errors of `depth` [H, W] against `reference` [H, W], both in metres with 0 unknown."""
    comparable = tissue & (reference > 0)
    given = comparable & (depth > 0)
    coverage = float(given.sum() / comparable.sum()) if comparable.any() else float("nan")
    if not given.any():
        return DepthErrors(float("nan"), float("nan"), float("nan"), coverage)
    errors = np.abs(depth[given].astype(np.float64) - reference[given]) * 1e3
    return DepthErrors(
        float(np.median(errors)),
        float(np.percentile(errors, 90)),
        float(np.sqrt(np.mean(errors * errors))),
        coverage,
    )


def resample_nearest(picture: Plane, width: int, height: int) -> Plane:
    """Look up `picture` [h, w] at the pixel centres of a `height` x `width` grid over the same view.

    Pixel centres are integers, so centre u of the new grid lies at (u + 0.5) * w / width - 0.5 of the old
    one. Depth is never interpolated: a mean across an edge is a surface that does not exist.
    """
    rows = _nearest_centres(height, picture.shape[0])
    columns = _nearest_centres(width, picture.shape[1])
    resampled: Plane = picture[rows[:, None], columns[None, :]]
    return resampled


def _nearest_centres(size: int, old_size: int) -> I64:
    centres = (np.arange(size) + 0.5) * (old_size / size) - 0.5
    nearest: I64 = np.floor(centres + 0.5).astype(np.int64)
    return nearest


def percentiles(values: Sequence[float] | F64) -> dict[str, float] | None:
    """The p50, p90, p99 and max of `values`; None: there are none."""
    if len(values) == 0:
        return None
    p50, p90, p99 = np.percentile(values, [50, 90, 99])
    return {"p50": float(p50), "p90": float(p90), "p99": float(p99), "max": float(np.max(values))}
