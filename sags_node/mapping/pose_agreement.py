"""Whether an image and its measured depth agree with what is expected from a camera pose."""

from dataclasses import dataclass

import cv2
import numpy as np

from sags_node.types import F32, U8, Bool, Camera, Observation, RenderedView

WIDTH = 160  # px, about: of the shrunk images that are compared
WINDOW = 9  # shrunk px: shading wider than that is the light's, which moves with the scope
LEAST_VARIANCE = 1.0  # grey levels squared: less texture is noise
LEAST_COVERED = 0.4  # share of the tissue in view that must be known
LEAST_CORRELATION = 0.5
STEREO_ERROR = 0.35  # px: error of a measured disparity
SPREAD = 3.0  # of these errors: what differs by more is another surface
LEAST_NEAR = 0.6  # share of the depths that must agree
LARGEST_OFFSET = 1.5  # of these errors: difference that is common to all depths
LEAST_DEPTHS = 200  # shrunk px with depth that a comparison needs


@dataclass(frozen=True, slots=True)
class Small:
    """An image and its depth, shrunk."""

    gray: F32  # [h, w] grey levels
    depth: F32  # [h, w] m, 0 unknown
    where: Bool  # [h, w] which of it counts


@dataclass(frozen=True, slots=True)
class Agreement:
    """How well a frame agrees with what is expected."""

    covered: float  # share of the frame's tissue about which anything is expected
    correlation: float  # of the images, within small windows; -1..1
    near: float | None  # share of the depths that agree; None: too few are measured
    offset: float  # px of disparity that all depths differ by

    @property
    def is_contradiction(self) -> bool:
        """Tell whether the agreement is below half of what a new pose needs: moved tissue agrees better."""
        unlike = self.correlation < LEAST_CORRELATION / 2
        return unlike or (self.near is not None and self.near < LEAST_NEAR / 2)

    @property
    def rank(self) -> tuple[bool, float]:
        """The order of agreements: larger is better."""
        return not self.problem, self.correlation

    @property
    def problem(self) -> str:
        """Say what disagrees; empty: nothing does."""
        if self.covered < LEAST_COVERED:
            return "hardly any known tissue in view"
        if self.correlation < LEAST_CORRELATION:
            return "the image does not show what the model has there"
        if self.near is None:
            return ""
        if self.near < LEAST_NEAR or abs(self.offset) > LARGEST_OFFSET * STEREO_ERROR:
            return "the depth is not that of the model"
        return ""


def shrunk(gray: U8 | F32, depth: F32, where: Bool) -> Small:
    """Shrink to about `WIDTH` by a whole number; depths are picked, not averaged, as edges must not blur."""
    step = max(1, round(gray.shape[1] / WIDTH))
    rows, columns = gray.shape[0] // step, gray.shape[1] // step

    inside = slice(step // 2, rows * step, step), slice(step // 2, columns * step, step)
    cut = np.asarray(gray[: rows * step, : columns * step], np.float32)
    small = cv2.resize(cut, (columns, rows), interpolation=cv2.INTER_AREA)
    return Small(small, depth[inside], where[inside])


def small_frame(observation: Observation) -> Small:
    """Shrink what a frame shows."""
    return shrunk(observation.gray, observation.depth, observation.tissue)


def small_view(view: RenderedView) -> Small:
    """Shrink what the model shows."""
    gray = cv2.cvtColor(view.rgb, cv2.COLOR_RGB2GRAY)
    return shrunk(gray, view.depth, (view.alpha > 0.5) & (view.depth > 0))


def agreement(expected: Small, frame: Small, camera: Camera, baseline: float) -> Agreement:
    """The agreement of a frame with what is expected, pixel by pixel; exposure and wide shading do not count.

    Args:
        camera: of the images before they were shrunk, to compute disparities in px.
        baseline: m.
    """
    where = expected.where & frame.where
    tissue = max(1, int(np.count_nonzero(frame.where)))
    covered = float(np.count_nonzero(where)) / tissue
    both = where & (expected.depth > 0) & (frame.depth > 0)
    correlation = local_correlation(expected.gray, frame.gray, where)
    if np.count_nonzero(both) < LEAST_DEPTHS:
        return Agreement(covered, correlation, None, 0.0)
    focal_baseline = float(camera.K[0, 0]) * baseline
    differences = focal_baseline / expected.depth[both] - focal_baseline / frame.depth[both]
    near = float(np.mean(np.abs(differences) < SPREAD * STEREO_ERROR))
    return Agreement(covered, correlation, near, float(np.median(differences)))


def local_correlation(a: F32, b: F32, where: Bool) -> float:
    """The zero-mean correlation of two images [h, w] in small windows, which weigh by their texture."""
    weight = where.astype(np.float32)
    count = _sum(weight)
    inside = where & (count > WINDOW)
    if not inside.any():
        return 0.0
    per = 1 / np.maximum(count, 1)
    mean_a, mean_b = _sum(weight * a) * per, _sum(weight * b) * per
    variance_a = _sum(weight * a * a) * per - mean_a * mean_a
    variance_b = _sum(weight * b * b) * per - mean_b * mean_b
    covariance = _sum(weight * a * b) * per - mean_a * mean_b
    textured = inside & (variance_a > LEAST_VARIANCE) & (variance_b > LEAST_VARIANCE)
    spread = float(np.sqrt(variance_a[textured] * variance_b[textured]).sum())
    return float(covariance[textured].sum()) / spread if spread > 0 else 0.0


def _sum(picture: F32) -> F32:
    total: F32 = cv2.boxFilter(picture, -1, (WINDOW, WINDOW), normalize=False, borderType=cv2.BORDER_CONSTANT)
    return total
