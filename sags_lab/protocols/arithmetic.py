"""The figures of public evaluators, by their published descriptions. Nothing here knows a layout."""

from collections.abc import Sequence

import numpy as np

from sags_lab.protocols.point_tracks import average_jaccard
from sags_node.types import F32, F64, Bool

STIR_PX = (4, 8, 16, 32, 64)  # thresholds of the 2D ranking (stir-challenge.github.io, evaluation)
STIR_MM = (2, 4, 8, 16, 32)  # thresholds of the 3D ranking
STIR_2026 = (2, 4, 8, 16, 32)  # thresholds, px and mm (the same page since 2026)
STEREOMIS_PX = (1, 2, 4, 8, 16)  # of an image of 256x256 (github.com/mhayoz/online_endo_track)
STEREOMIS_LOST = 16  # px of such an image: a point farther off is lost
LEAST_KNOWN = 0.1  # of an image: SCARED leaves out frames with less true depth (arXiv 2101.01133, III-D)


def nearest_distances(points: F64, ends: F64) -> F64:
    """Return the distance [P] of each of `points` [P, D] from the nearest of `ends` [E, D]: STIR does not say
    which end belongs to which start."""
    distances: F64 = np.linalg.norm(points[:, None] - ends[None], axis=2).min(axis=1)
    return distances


def stereo_points_mm(left: F64, right: F64, K_left: F64, K_right: F64, baseline_mm: float) -> F64:
    """Return points [P, 3] (mm, left camera) of raw pixels [P, 2] of both eyes, as STIR makes its 3D truth.
    Raw images count as rectified, with the left eye's intrinsics [3, 3] and rows; only the distance between
    the principal points is taken off. Points behind the camera are infinite."""
    f, cx, cy = K_left[0, 0], K_left[0, 2], K_left[1, 2]
    disparity = left[:, 0] + (K_right[0, 2] - cx) - right[:, 0]
    z = np.divide(f * baseline_mm, disparity, out=np.full(len(left), np.inf), where=disparity > 0)
    return np.stack([(left[:, 0] - cx) * z / f, (left[:, 1] - cy) * z / f, z], axis=1)


def latency_score(times_ms: Sequence[float]) -> float:
    """Return STIR's figure of efficiency: (p99 + p95 + mean) / 3 of the times of frames, ms."""
    return float((np.percentile(times_ms, 99) + np.percentile(times_ms, 95) + np.mean(times_ms)) / 3)


def stir_2026_figures(distances: F64, visible: Bool, said: Bool) -> dict[str, float]:
    """Return STIR's figures since 2026, of points [N] of all frames and sequences: their distances from the
    truth, px or mm, whether they are visible, and whether they are said to be.

    The ranking is by average Jaccard. ATA: share of visible points within each threshold, whatever is said of
    their visibility, mean over thresholds. OA: share of points whose visibility is said rightly.
    """
    shares = [np.mean(distances[visible] < threshold) for threshold in STIR_2026] if visible.any() else [0.0]
    return {
        "average_jaccard": average_jaccard(distances, visible, said, STIR_2026),
        "average_tracking_accuracy": float(np.mean(shares)),
        "occlusion_accuracy": float(np.mean(visible == said)),
    }


def trajectory_figures(estimated: F64, known: F64) -> dict[str, float]:
    """Return StereoMIS's errors of a trajectory; both are `T_world_cam` [T, 4, 4], m.

    ATE: root mean square distance of camera positions after a rigid alignment of all, without scale
    (Horn, JOSA A 1987; Umeyama, PAMI 1991). RPE: mean error of the motion from one frame to the next.
    """
    R, t = _align(estimated[:, :3, 3], known[:, :3, 3])
    away = estimated[:, :3, 3] @ R.T + t - known[:, :3, 3]
    errors = np.linalg.inv(_steps(known)) @ _steps(estimated)
    cosines = (np.trace(errors[:, :3, :3], axis1=1, axis2=2) - 1) / 2
    return {
        "ate_rmse_mm": float(np.sqrt(np.mean(np.sum(away**2, axis=1)))) * 1e3,
        "rpe_mean_mm": float(np.mean(np.linalg.norm(errors[:, :3, 3], axis=1))) * 1e3,
        "rpe_mean_deg": float(np.mean(np.degrees(np.arccos(cosines.clip(-1, 1))))),
    }


def _align(points: F64, onto: F64) -> tuple[F64, F64]:
    """Rotation [3, 3] and translation [3] that align points [T, 3] with `onto`, by least squares."""
    middle, onto_middle = points.mean(0), onto.mean(0)
    U, _, Vt = np.linalg.svd((onto - onto_middle).T @ (points - middle))
    R = U @ np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))]) @ Vt
    return R, onto_middle - R @ middle


def _steps(poses: F64) -> F64:
    return np.asarray(np.linalg.inv(poses[:-1]) @ poses[1:])


def mean_depth_error(depth: F32, truth: F32) -> tuple[float, float] | None:
    """Return the mean absolute error (mm) where both depths [H, W] (m, 0 unknown) are known, and the share of
    the truth that is given. None: SCARED leaves the frame out, or nothing is given."""
    known = truth > 0
    given = known & (depth > 0)
    if np.mean(known) < LEAST_KNOWN or not given.any():
        return None
    error = np.abs(depth[given].astype(np.float64) - truth[given])
    return float(np.mean(error)) * 1e3, float(given.sum() / known.sum())


def depth_figures(depth: F32, truth: F32, where: Bool) -> dict[str, float] | None:
    """Return errors of depth [H, W] in `where`, mm, where it and the truth (m, 0 unknown) are known: mean,
    median and 90th percentile of absolute errors, and `bias_mm`, the median of signed ones (negative: too
    near). `given`: share of the truth with a depth. None: nothing is given."""
    known = where & (truth > 0)
    given = known & (depth > 0)
    if not given.any():
        return None
    errors = (depth[given].astype(np.float64) - truth[given]) * 1e3
    return {
        "mae_mm": float(np.mean(np.abs(errors))),
        "median_mm": float(np.median(np.abs(errors))),
        "p90_mm": float(np.percentile(np.abs(errors), 90)),
        "bias_mm": float(np.median(errors)),
        "given": float(given.sum() / known.sum()),
    }


def stereomis_figures(found: F64, truth: F64, visible: Bool, size: tuple[int, int]) -> dict[str, float]:
    """Return StereoMIS-Tracking's figures of points [P, T, 2] px that are seen where `visible` [P, T].

    `mte_px`: median error of each point where it is seen, mean over points. The others are in px of an image
    of 256x256. `delta`: share of what is seen after the first frame that is within 1, 2, 4, 8 and 16 px, mean
    over the five. `survival`: share of the frames of all points before the point is first seen more than
    16 px off.

    Args:
        size: width and height of the images, px.
    """
    errors = np.linalg.norm(found - truth, axis=2)
    medians = [np.median(error[seen]) for error, seen in zip(errors, visible, strict=True) if seen.any()]
    scaled = np.linalg.norm((found - truth) * 256 / np.asarray(size), axis=2)
    later = scaled[:, 1:][visible[:, 1:]]
    lost = (scaled > STEREOMIS_LOST) & visible
    return {
        "mte_px": float(np.mean(medians)),
        "delta": float(np.mean([np.mean(later < threshold) for threshold in STEREOMIS_PX])),
        "survival": float(np.mean(np.cumprod(~lost, axis=1))),
    }
