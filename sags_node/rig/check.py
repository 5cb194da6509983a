"""What is right, odd or wrong with the numbers of a calibration. `tools.calibration.rows` checks images."""

import logging
import shlex
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from sags_node import geometry
from sags_node.checks import Finding, is_wrong, refuse_errors
from sags_node.config.units import NAMES, UNITS, fitting_units, in_metres
from sags_node.types import F64, Eye, StereoRig

log = logging.getLogger(__name__)

ENDOSCOPE_BASELINE = (0.003, 0.010)  # m
LARGEST_BASELINE = 0.25  # m; more can only be another unit, as centimetres of an endoscope are
SMALLEST_BASELINE = 1e-4  # m; less can only be a baseline that was not multiplied by fx
OTHER_SIZES = (0.25, 1 / 3, 0.5, 2.0, 3.0, 4.0)  # of the stated size: a calibration may have been made for it
SAME_CENTRE = 0.12  # relative tolerance of principal point over middle, in which axes and eyes must agree
LARGEST_RADIUS, RADII = 4.0, 4001  # at distance 1 (76 degrees from the axis), and how many are tried
STRAIGHT = 0.1  # px by which skewed pixels may shift the first and the last row: no match is more exact
WIDE = 90  # degrees from corner to corner: beyond it lenses are often calibrated by fisheye models
EXCHANGE_FILES = (
    "exchange left.yaml and right.yaml (of a bag or ROS 2: source.left_info and source.right_info)"
)
RECALIBRATE = "run the stereo calibration again and save both files from one run"


def accept_rig(rig: StereoRig, where: Path | str) -> StereoRig:
    """Check a rig before use, log what is odd about it, and return it.

    Raises:
        UsageError: the check finds an error.
    """
    findings = check_rig(rig)
    refuse_errors(findings, where)
    for finding in findings:
        if finding.level == "warning":
            log.warning("%s: %s; %s", where, finding.what, finding.fix)
    return rig


def check_rig(rig: StereoRig, metres: float | None = None) -> list[Finding]:
    """Return what is right, odd or wrong with a calibration, each with a way to fix it.

    Args:
        metres: the unit that the user gave for its lengths; None: none was given.
    """
    return _until_wrong(rig, (check_eyes, partial(check_pair, metres=metres)))


def check_eyes(rig: StereoRig) -> list[Finding]:
    """Check each eye and what both must share. After an error here nothing else can be checked."""
    return _until_wrong(rig, (_check_numbers, _check_eyes, _check_rows))


def check_pair(rig: StereoRig, metres: float | None = None) -> list[Finding]:
    """Check which eye is which, and how far apart they are."""
    return _check_unit(rig, metres) or _until_wrong(rig, (_check_order, _check_baseline))


def _until_wrong(rig: StereoRig, looks: Sequence[Callable[[StereoRig], list[Finding]]]) -> list[Finding]:
    """Run the checks in turn, up to the first that finds an error: more would only repeat it."""
    found: list[Finding] = []
    for look in looks:
        found += look(rig)
        if is_wrong(found):
            break
    return found


def _eyes(rig: StereoRig) -> Iterator[tuple[str, Eye]]:
    yield "left.yaml", rig.left
    yield "right.yaml", rig.right


def _check_numbers(rig: StereoRig) -> list[Finding]:
    found = []
    for file, eye in _eyes(rig):
        fields = {
            "camera_matrix": eye.K,
            "distortion_coefficients": eye.distortion,
            "rectification_matrix": eye.R,
            "projection_matrix": eye.P,
        }
        for key, values in fields.items():
            if not np.isfinite(values).all():
                found.append(Finding("error", f"{file}: {key} holds NaN or infinity", RECALIBRATE))
    return found or [Finding("ok", "all numbers are finite")]


def _check_eyes(rig: StereoRig) -> list[Finding]:
    found = _check_size(rig)
    for file, eye in _eyes(rig):
        if not geometry.is_rotation(eye.R):
            found.append(Finding("error", f"{file}: rectification_matrix is not a rotation", RECALIBRATE))
        if not eye.P.any():
            what = f"{file}: projection_matrix is all zeros: the eyes were calibrated one by one, if at all"
            return [Finding("error", what, "calibrate both together: sags calib stereo, then set rig")]
        for key, K in (("camera_matrix", eye.K), ("projection_matrix", eye.P[:, :3])):
            found += check_intrinsics(f"{file}: {key}", K, eye.width, eye.height)
        if np.abs(eye.P[1:, 3]).max() > 1e-6 + 1e-3 * abs(eye.P[0, 3]):
            what = f"{file}: projection_matrix[7] and [11] are {eye.P[1, 3]:g} and {eye.P[2, 3]:g}, not 0"
            fix = "rows cannot agree: rectify eyes that stand beside each other"
            found.append(Finding("error", what, fix))
        found += _check_distortion(file, eye) + _check_model(file, eye)
    return found or [Finding("ok", "rotations, focal lengths and principal points are plausible")]


def check_intrinsics(where: str, K: F64, width: int, height: int) -> list[Finding]:
    """Return what is odd or wrong with the `K` [3, 3] (px) of an image; `where` names it in the findings."""
    if np.any(K[2, :2] != 0):
        what = f"{where} is transposed: its last row is {K[2, 0]:g} {K[2, 1]:g} {K[2, 2]:g}, not 0 0 1"
        return [Finding("error", what, "write its columns as rows (MATLAB's cameraParameters are so)")]
    if K[1, 0] != 0 or abs(K[2, 2] - 1) > 1e-6:
        what = f"{where}: its second row begins with {K[1, 0]:g}, its last one is 0 0 {K[2, 2]:g}, not 0 0 1"
        fix = "for images of another size scale fx, fy, cx and cy alone; or calibrate again"
        return [Finding("error", what, fix)]
    found = []
    if (shift := abs(K[0, 1] / K[1, 1]) * height / 2 if K[1, 1] else 0.0) > STRAIGHT:
        what = f"{where}: its skew of {K[0, 1]:g} px shifts the first row by {shift:.2g} px"
        found.append(Finding("error", what, "calibrate without skew (MATLAB: EstimateSkew): none is applied"))
    for axis, focal in (("fx", K[0, 0]), ("fy", K[1, 1])):
        if not 0.2 * width < focal < 20 * width:
            what = f"{where}: {axis} = {focal:g} px is not plausible for an image {width} px wide"
            found.append(Finding("error", what, "give it in pixels of the full image"))
    for axis, centre, side in (("cx", K[0, 2], width), ("cy", K[1, 2], height)):
        if not -side < centre < 2 * side:
            what = f"{where}: {axis} = {centre:g} px is far outside an image of {side} px"
            found.append(Finding("error", what, "check image_width, image_height and the calibration"))
        elif not 0.2 * side < centre < 0.8 * side:
            what = f"{where}: {axis} = {centre:g} px is far from the middle of {side} px"
            found.append(Finding("warning", what, "check that the calibration is of this image size"))
    return found


def _check_distortion(file: str, eye: Eye) -> list[Finding]:
    """Warn if the radial distortion turns back before it reaches the image's corners."""
    k1, k2, _, _, k3, k4, k5, k6 = np.pad(eye.distortion, (0, 8 - len(eye.distortion)))
    farthest = np.maximum(eye.K[:2, 2], [eye.width, eye.height] - eye.K[:2, 2]) / eye.K[[0, 1], [0, 1]]
    radius = np.linspace(0, LARGEST_RADIUS, RADII)
    square = radius**2
    distorted = radius * (1 + square * (k1 + square * (k2 + square * k3)))
    distorted /= 1 + square * (k4 + square * (k5 + square * k6))
    turns = np.flatnonzero(np.diff(distorted) <= 0)
    if not len(turns) or distorted[turns[0]] >= np.hypot(*farthest):
        return []
    reach = distorted[turns[0]] * eye.K[0, 0]
    what = f"{file}: the distortion turns back {reach:.0f} px from the principal point, inside the image"
    return [Finding("warning", what, "what lies farther out is wrong: calibrate with the board there too")]


def _check_model(file: str, eye: Eye) -> list[Finding]:
    """Warn if four coefficients of a wide view may be of a fisheye model, whose files look the same."""
    view = 2 * np.degrees(np.arctan(np.hypot(eye.width, eye.height) / (eye.K[0, 0] + eye.K[1, 1])))
    if view <= WIDE or len(eye.distortion) > 5 or eye.distortion[4] or not eye.distortion.any():
        return []
    what = (
        f"{file}: four coefficients and a view of {view:.0f} degrees from corner to corner: are they of a "
        "fisheye model (equidistant)? They are read as plumb_bob"
    )
    return [Finding("warning", what, "if they are, depth is wrong: calibrate with sags calib stereo")]


def size_made_for(rig: StereoRig, rectified: bool = False) -> float | None:
    """Return the image size that `K`, or P, was probably made for, over the size that the rig states: 0.5
    for half the size. None: the principal points lie near the middle, or do not agree on another size."""
    ratios = [
        ratio
        for _, eye in _eyes(rig)
        for K in (eye.P if rectified else eye.K,)
        for ratio in (2 * K[0, 2] / (eye.width - 1), 2 * K[1, 2] / (eye.height - 1))
    ]
    for size in OTHER_SIZES:
        if all(abs(ratio / size - 1) < SAME_CENTRE for ratio in ratios):
            return size
    return None


def _check_size(rig: StereoRig) -> list[Finding]:
    of_K, of_P, eye = size_made_for(rig), size_made_for(rig, rectified=True), rig.left
    if (size := of_K or of_P) is None:
        return []
    wrong = ["projection_matrix"] if of_K is None else ["camera_matrix", "projection_matrix"]
    made_for = f"{eye.width * size:.0f}x{eye.height * size:.0f}"
    what = (
        f"both principal points lie at {size:.3g} of the middle: {wrong[0]} is of {made_for} images, "
        f"the files say {eye.width}x{eye.height}"
    )
    fix = f"if the images are {eye.width}x{eye.height}, multiply {' and '.join(wrong)} by "
    return [Finding("warning", what, f"{fix}{1 / size:.3g}, or calibrate at that size")]


def wrong_size(path: Path | str, calibrated: tuple[int, int], size: tuple[int, int]) -> Finding | None:
    """Return what is wrong if images of this `size` (width, height, px) are used with the calibration at
    `path`, which is of the `calibrated` size; None: nothing."""
    ratio, down = size[0] / calibrated[0], size[1] / calibrated[1]
    what = "the calibration is for {}x{} px, the images are {}x{}".format(*calibrated, *size)
    if ratio != down:
        fix = "the images have another shape (cropped?): calibrate with images as they come now"
        return Finding("error", what, fix)
    fix = (
        f"calibrate at {size[0]}x{size[1]}, or if the images are only resized, not cropped: "
        f"sags calib convert {shlex.quote(str(path))} -o FOLDER --scale {ratio:g}"
    )
    return (
        None if ratio == 1 else Finding("error", f"{what}, {ratio:.3g} times as large", fix, {"scale": ratio})
    )


def _check_rows(rig: StereoRig) -> list[Finding]:
    left, right = rig.left, rig.right
    if (left.width, left.height) != (right.width, right.height):
        what = f"left.yaml is {left.width}x{left.height}, right.yaml {right.width}x{right.height}"
        return [Finding("error", what, "both eyes need the same image size")]
    found: list[Finding] = []
    for name, row, column, tolerance in (
        ("fx", 0, 0, 1e-3 * left.P[0, 0]),
        ("fy", 1, 1, 1e-3 * left.P[1, 1]),
        ("cy", 1, 2, 0.5),
    ):
        a, b = left.P[row, column], right.P[row, column]
        if abs(a - b) > tolerance:
            what = f"rectified {name} differs: {a:g} px in left.yaml, {b:g} px in right.yaml"
            fix = "the files are not from one stereo calibration; " + RECALIBRATE
            if name == "cy" and not found:  # only the rows disagree
                what += f": do the eyes' images begin {abs(a - b):g} rows apart (roi, y_offset, a crop)?"
                fix = "read out the same rows of both eyes, or calibrate with these images and set rig"
            found.append(Finding("error", what, fix))
    return found or [Finding("ok", "rectified rows of both eyes agree")]


def _check_order(rig: StereoRig) -> list[Finding]:
    left, right = float(rig.left.P[0, 3]) + 0.0, float(rig.right.P[0, 3]) + 0.0  # no minus before a zero
    what = f"projection_matrix[3] is {left:g} in left.yaml and {right:g} in right.yaml"
    if left < 0 and right == 0:
        return [Finding("error", f"{what}: the eyes are exchanged", EXCHANGE_FILES)]
    if left != 0:
        return [Finding("error", what, "the left one must be 0: the left eye is the reference")]
    if right == 0:
        return [Finding("error", f"{what}: there is no baseline", RECALIBRATE)]
    if right > 0:
        fix = "the right one must be -fx * baseline, negative: exchange the eyes or fix the sign"
        return [Finding("error", what, fix)]
    return [Finding("ok", "the left eye is the reference")]


def _check_baseline(rig: StereoRig) -> list[Finding]:
    baseline = rig.baseline
    units = fitting_units(baseline, *ENDOSCOPE_BASELINE, rig.unit)
    in_unit = in_metres(units, rig.path, rig.unit) if units else ""
    names = " or ".join(NAMES[unit] for unit in units)
    if baseline > LARGEST_BASELINE:
        looks = f"looks like {names}" if units else "is too large"
        fix = in_unit or f"is the side of the board's squares right? {RECALIBRATE}"
        return [Finding("error", f"the baseline of {baseline:g} m {looks}", fix)]
    if baseline < SMALLEST_BASELINE:
        what = f"a baseline of {baseline * 1e3:.3g} mm is too small"
        if in_unit:
            return [Finding("error", f"{what}: the files' looks like {names}", in_unit)]
        what += ": projection_matrix[3] is -fx * baseline"
        fix = f"multiply it in right.yaml by fx, {rig.right.P[0, 0]:g}, if it holds the baseline itself"
        return [Finding("error", what, fix)]
    if not ENDOSCOPE_BASELINE[0] <= baseline <= ENDOSCOPE_BASELINE[1]:
        what = f"a baseline of {baseline * 1e3:.3g} mm is unusual for a stereo endoscope (3 to 10 mm)"
        fix = in_unit or "check projection_matrix[3] in right.yaml: it is -fx * metres"
        return [Finding("warning", what, fix)]
    return [Finding("ok", f"baseline {baseline * 1e3:.3g} mm")]


def _check_unit(rig: StereoRig, metres: float | None) -> list[Finding]:
    """Find out whether the given unit makes the baseline that of no endoscope, and another unit would fit."""
    said = next((unit for unit, each in UNITS.items() if each == metres), None)
    least, most = ENDOSCOPE_BASELINE
    baseline = rig.baseline
    if said is None or least <= baseline <= most or (said == "m" and baseline <= LARGEST_BASELINE):
        return []
    in_other = {unit: baseline / UNITS[said] * each for unit, each in UNITS.items()}
    fitting = [unit for unit, length in in_other.items() if least <= length <= most]
    if not fitting:
        return []
    what = f"--unit {said} makes the baseline {baseline * 1e3:.3g} mm"
    ways = " or ".join(f"--unit {unit} ({in_other[unit] * 1e3:.3g} mm)" for unit in fitting)
    fix = (
        f"say {ways}; if it is right (no endoscope), divide the baseline in the files by "
        f"{1 / UNITS[said]:.5g} (projection_matrix[3] in right.yaml, or T and P2[0][3]), and say --unit m"
    )
    return [Finding("error", what, fix)]
