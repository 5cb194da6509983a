"""What matched points say of a calibration: do rows agree, is tissue in front of both eyes, and if not, which
end is wrong, the calibration or the images.

Nothing is remapped: the raw pixels of a match go through the calibration, so that other readings of it (eyes
exchanged, a sign, another size) are tried at no cost.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np

from sags_node.checks import Finding
from sags_node.config.units import fitting_units, in_metres
from sags_node.rig import already_rectified, rectifies, rectify_eyes
from sags_node.rig.check import ENDOSCOPE_BASELINE, EXCHANGE_FILES, RECALIBRATE, size_made_for
from sags_node.types import F64, Bool, Eye, StereoRig

FEWEST_MATCHES = 30
LARGEST_ROW_ERROR = 1 / 180  # of the width, median: beyond it stereo finds no match
IN_FRONT = 0.8  # share of the matches: with fewer this is no stereo pair
CLEARLY = 1.5  # times the best row error, and
CLEARLY_PX = 0.3  # px above it: a reading that is worse than both does not fit
WRONG_MATCH = 4.0  # times the median distance from the median row error
LEAST_SCALE = 0.004  # difference of the eyes' scales: beyond it depth leans by more than matching errs
SURE_SCALE = 4.0  # times its standard error
EXPLAINED = 0.7  # px: where turn and scale leave more, the lenses are off too, and no scale fixes depth
ROUNDS = 10  # of fitting and leaving out outliers
TINY = 1e-12  # so that an exact fit keeps all
ALIGNED = (0.35, 1.0)  # px at a width of 640 px or less, median and 90 %: row errors of rectified images
WORSE = 2.0  # times larger: the row errors of these after they are rectified once more
RECTIFIED = "rectified:=true"
PICTURES_EXCHANGED = "the images are exchanged: the left ones come from the right camera"
PLAUSIBLE_DEPTH = (0.005, 1.0)  # m, the median: in an endoscope's view


class Rows(NamedTuple):
    """Matches in the rectified cameras' pixels."""

    errors: F64  # [M] px, how far below its row in the left image a point lies in the right one
    disparities: F64  # [M] px
    in_front: float  # share of points in front of both eyes
    median: float  # px, of the errors without their sign
    p90: float
    turn: tuple[float, float]  # degrees, pitch and roll of one eye that explain the errors best; with them:
    scale: float  # by how much larger the right image is than its calibration says, 0.01: 1 %
    scale_error: float  # standard error of that
    left_over: float  # px, RMS of the errors that turn and scale leave

    @property
    def scale_differs(self) -> bool:
        """Tell whether one eye's scale is off, beyond doubt."""
        return abs(self.scale) > max(LEAST_SCALE, SURE_SCALE * self.scale_error)


@dataclass(frozen=True, slots=True)
class Reading:
    """A hypothesis of how calibration and images belong together."""

    rows: Rows
    what: str
    fix: str


def rectified_rows(rig: StereoRig, matches: F64) -> Rows:
    """The row errors and disparities of matches [M, 4], raw pixels, as `match_eyes` gives them."""
    left, right = _undistorted(rig.left, matches[:, :2]), _undistorted(rig.right, matches[:, 2:])
    K = rig.left.P[:, :3]
    errors = K[1, 1] * (right[:, 1] - left[:, 1])
    disparities = K[0, 0] * (left[:, 0] - right[:, 0])
    in_front = float(np.mean(_signed_baseline(rig) * disparities > 0))
    median, p90 = np.percentile(np.abs(errors), [50, 90])
    turn, scale, scale_error, left_over = _turn(errors / K[1, 1], left)
    figures = float(median), float(p90), turn, scale, scale_error, float(K[1, 1]) * left_over
    return Rows(errors, disparities, in_front, *figures)


def judge_matches(rig: StereoRig, matches: F64) -> list[Finding]:
    """Return what the matches [M, 4] (raw pixels) of an image pair, or of several, say of a rig.

    An error says which end is wrong: the calibration or the images.
    """
    if len(matches) < FEWEST_MATCHES:
        what = f"{len(matches)} points found in both eyes: too few to judge rows"
        return [Finding("warning", what, "give more images, sharp and with texture")]
    as_is, *others = _readings(rig, matches)
    fitting = [reading for reading in (as_is, *others) if reading.rows.in_front >= IN_FRONT]
    limit = LARGEST_ROW_ERROR * rig.left.width
    best = min((reading.rows.median for reading in fitting), default=np.inf)
    if best <= limit:
        enough = max(CLEARLY * best, best + CLEARLY_PX)
        named = next(reading for reading in fitting if reading.rows.median <= enough)
        if named.what == PICTURES_EXCHANGED and as_is.rows.median <= enough:
            return [_exchanged_or_shifted(as_is.rows)]
        if named is not as_is or _signed_baseline(rig) < 0:
            return [Finding("error", named.what, named.fix, _figures(named.rows))]
    if as_is.rows.median > limit:
        return [_rows_differ(as_is.rows)]
    if as_is.rows.in_front < IN_FRONT:
        what = f"only {as_is.rows.in_front:.0%} of the points lie in front of both eyes"
        fix = "the calibration is not of these images, or they show no stereo pair"
        return [Finding("error", what, fix, _figures(as_is.rows))]
    return _depth(rig, as_is.rows)


def judge_rectified(rig: StereoRig, matches: F64) -> list[Finding]:
    """Warn where rows agree in the images as they are, and less after rectification: they are rectified
    already. Matches [M, 4] as in `judge_matches`."""
    if len(matches) < FEWEST_MATCHES or not rectifies(rig):
        return []
    before, after = rectified_rows(already_rectified(rig), matches), rectified_rows(rig, matches)
    wide = max(rig.left.width / 640, 1.0)
    aligned = before.median <= ALIGNED[0] * wide and before.p90 <= ALIGNED[1] * wide
    if not aligned or after.median < WORSE * before.median or after.p90 < WORSE * before.p90:
        return []
    what = (
        f"rows agree to {before.median:.2f} px (median) as the images are, and to {after.median:.2f} px "
        "once this calibration has rectified them: they are rectified already"
    )
    figures = {"rows_as_they_are_px": round(before.median, 3), "rows_rectified_px": round(after.median, 3)}
    return [Finding("warning", what, f"set {RECTIFIED}", figures, launch=(RECTIFIED,))]


def _readings(rig: StereoRig, matches: F64) -> Iterator[Reading]:
    """The calibration as it is, then without each usual mistake; of two that fit alike the first counts."""
    rows = rectified_rows(rig, matches)
    exchanged = rectified_rows(replace(rig, left=rig.right, right=rig.left), matches)
    exchanged_files = Reading(
        exchanged,
        "the eyes are exchanged in the calibration: left.yaml is of the camera that took the right images",
        f"{EXCHANGE_FILES}; the images are in order",
    )
    wrong_sign = Reading(
        rows._replace(in_front=1 - rows.in_front),
        "T, or projection_matrix[3] of the right eye, has the wrong sign: points would lie behind the eyes",
        "change that sign in the calibration; the images are in order",
    )
    if _signed_baseline(rig) > 0:
        yield Reading(rows, "", "")
        yield Reading(
            exchanged,
            PICTURES_EXCHANGED,
            "exchange left and right of the source; the calibration is in order",
        )
        yield wrong_sign
    else:
        yield Reading(
            rows,
            "images and calibration agree that the left eye stands to the right of the other",
            "exchange left and right of the source, and both files of the calibration",
        )
        yield from (exchanged_files, wrong_sign) if rig.left.P[0, 3] < 0 else (wrong_sign, exchanged_files)
    yield from _other_directions(rig, matches)
    size = size_made_for(rig)
    if size is not None:
        yield Reading(
            rectified_rows(_other_size(rig, 1 / size), matches),
            f"camera_matrix is for images of {size:.3g} times the size that the calibration states",
            f"multiply camera_matrix and projection_matrix by {1 / size:.3g}, or calibrate at full size",
        )


def _other_directions(rig: StereoRig, matches: F64) -> Iterator[Reading]:
    """R and T (left to right camera) as other programs write them: transposed, or from right to left."""
    R, T = rig.T_right_left[:3, :3], rig.T_right_left[:3, 3]
    if not T.any():
        return
    size = rig.left.width, rig.left.height
    K, distortion = (rig.left.K, rig.right.K), (rig.left.distortion, rig.right.distortion)
    transpose, anew = "write its transpose in the place of R", "leave R1 R2 P1 P2 out, and read the file anew"
    for there, what, fix in (
        (T, "R, from left to right camera, is transposed, as MATLAB keeps it", f"{transpose}, {anew}"),
        (
            -R.T @ T,
            "R and T go from the right to the left camera",
            f"{transpose}, minus that transpose times T in the place of T, {anew}",
        ),
    ):
        other = rectify_eyes(rig.name, size, K, distortion, R.T, there)
        yield Reading(rectified_rows(other, matches), what, fix)


def _exchanged_or_shifted(rows: Rows) -> Finding:
    """The error where rows fit either way, as in rectified images, and points lie behind the eyes."""
    shift = float(np.percentile(-rows.disparities, 98))
    what = (
        f"{PICTURES_EXCHANGED}; or their principal points differ by at least {shift:.0f} px more than the "
        "calibration says"
    )
    fix = (
        "cover the left eye's lens: if the right image goes dark, exchange left and right of the source; "
        "if not, calibrate again with images as they come now"
    )
    return Finding("error", what, fix, _figures(rows))


def _other_size(rig: StereoRig, factor: float) -> StereoRig:
    scale = np.diag([factor, factor, 1.0])
    left, right = (replace(eye, K=scale @ eye.K, P=scale @ eye.P) for eye in (rig.left, rig.right))
    return replace(rig, left=left, right=right)


def _undistorted(eye: Eye, pixels: F64) -> F64:
    """Find where pixels [M, 2] lie in the rectified camera, at distance 1."""
    rays: F64 = cv2.undistortPoints(pixels[:, None], eye.K, eye.distortion, R=eye.R)[:, 0]
    return rays


def _signed_baseline(rig: StereoRig) -> float:
    """How far the right eye stands to the right of the left one, m, whichever of them is the reference."""
    return float(rig.left.P[0, 3] / rig.left.P[0, 0] - rig.right.P[0, 3] / rig.right.P[0, 0])


def _figures(rows: Rows) -> dict[str, float]:
    return {
        "matches": len(rows.errors),
        "row_error_median_px": round(rows.median, 3),
        "row_error_p90_px": round(rows.p90, 3),
        "disparity_median_px": round(float(np.median(rows.disparities)), 3),
    }


def judge_scale(rig: StereoRig, rows: Rows) -> list[Finding]:
    """Tell whether one eye's image is larger than its calibration says: its rows then drift apart over the
    height, and depth leans over the width. Nothing where both have one scale."""
    if not rows.scale_differs:
        return []
    depth = _median_depth(rig, rows)
    leans = -rows.scale * 100 * depth**2 / (rig.left.P[0, 0] * _signed_baseline(rig)) * 1e3
    what = (
        f"{_scale_said(rows)}. If its columns are like its rows, depth leans by {abs(leans):.1f} mm in "
        f"100 px at {depth * 1e3:.0f} mm, too {'near' if leans > 0 else 'far'} on the right"
    )
    fix = "calibrate again with zoom, focus and image size as they are used, and the board up to the edges"
    if rows.left_over <= EXPLAINED:
        fx, fy = (rig.right.K[k, k] * (1 + rows.scale) for k in (0, 1))
        fix += f"; until then set fx to {fx:.2f} and fy to {fy:.2f} in camera_matrix of right.yaml"
    else:
        what += f". Rows are still off by {rows.left_over:.1f} px then: the distortion is wrong, too"
    figures = {
        "scale": round(rows.scale, 4),
        "scale_standard_error": round(rows.scale_error, 5),
        "rows_left_over_px": round(rows.left_over, 3),
        "leans_mm_per_100_px": round(float(leans), 3),
    }
    return [Finding("warning", what, fix, figures)]


def _scale_said(rows: Rows) -> str:
    return (
        f"beside the left image the right one is {abs(rows.scale):.1%} "
        f"{'larger' if rows.scale > 0 else 'smaller'} than the calibration says: rows drift apart by "
        f"{100 * abs(rows.scale):.1f} px in 100 px down"
    )


def _rows_differ(rows: Rows) -> Finding:
    """The error that no reading explains the rows; it gives the turn and scale of one eye that fit best."""
    pitch, roll = rows.turn
    what = (
        f"rows differ by {rows.median:.2f} px (median), {rows.p90:.2f} px (90 %): as if one eye were turned "
        f"by {pitch:.2f} degrees up or down and {roll:.2f} degrees about its axis"
    )
    figures = _figures(rows) | {"pitch_deg": pitch, "roll_deg": roll}
    if rows.scale_differs:
        what += f"; {_scale_said(rows)}"
        figures["scale"] = round(rows.scale, 4)
    fix = "the calibration is not of these images (another scope, zoom or focus): calibrate again"
    return Finding("error", what, fix, figures)


def _turn(errors: F64, left: F64) -> tuple[tuple[float, float], float, float, float]:
    """Fit row errors [M] of points `left` [M, 2] of the left image, all at distance 1, without wrong
    matches: pitch and roll (degrees), scale and its standard error, and the RMS that these leave."""
    design = np.column_stack([np.ones(len(errors)), left])
    found, kept = fit_without_outliers(design, errors, WRONG_MATCH)
    inner = design[kept]
    variance = float(np.sum((errors[kept] - inner @ found) ** 2)) / max(len(inner) - 3, 1)
    spread = float(np.linalg.pinv(inner.T @ inner)[2, 2])
    pitch, roll = np.degrees(found[:2])
    turn = round(float(pitch), 3), round(float(roll), 3)
    return turn, float(found[2]), float(np.sqrt(variance * spread)), float(np.sqrt(variance))


def fit_without_outliers(design: F64, values: F64, farthest: float) -> tuple[F64, Bool]:
    """Fit values [M] = design [M, K] @ x by least squares, repeatedly without outliers.

    Args:
        farthest: largest distance that is kept, in median distances.

    Returns:
        x [K], and which values were kept [M].
    """
    kept = np.ones(len(values), np.bool_)
    for _ in range(ROUNDS):
        found: F64 = np.linalg.lstsq(design[kept], values[kept], rcond=None)[0].astype(np.float64)
        away = np.abs(values - design @ found)
        kept = away <= farthest * np.median(away) + TINY
    return found, kept


def _depth(rig: StereoRig, rows: Rows) -> list[Finding]:
    depth = _median_depth(rig, rows)
    figures = _figures(rows) | {"depth_median_m": round(depth, 4)}
    if not PLAUSIBLE_DEPTH[0] <= depth <= PLAUSIBLE_DEPTH[1]:
        what = f"points would lie at {depth:.3g} m (median); an endoscope sees 0.005 to 1 m"
        units = fitting_units(_signed_baseline(rig), *ENDOSCOPE_BASELINE, rig.unit)
        fix = in_metres(units, rig.path, rig.unit) if units else RECALIBRATE
        return [Finding("error", what, fix, figures)]
    per_pixel = depth**2 / (rig.left.P[0, 0] * _signed_baseline(rig))
    what = (
        f"the images' points lie in front of both eyes, at {depth * 1e3:.0f} mm; matches cannot show "
        f"whether the principal points differ sideways: 0.1 px would be {0.1 * per_pixel * 1e3:.2f} mm there"
    )
    return [Finding("ok", what, "", figures)]


def _median_depth(rig: StereoRig, rows: Rows) -> float:
    return float(np.median(_signed_baseline(rig) * rig.left.P[0, 0] / rows.disparities))
