"""Calibration folders (`left.yaml`, `right.yaml` in ROS camera_info form) read into a checked `StereoRig`.

The keys are those of ROS `camera_calibration_parsers`, so files of `ros2 run camera_calibration
cameracalibrator` are used unchanged. Lengths are metres.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import yaml

from sags_node import geometry
from sags_node.errors import UsageError
from sags_node.types import F64, Camera, Eye, StereoRig

ENDOSCOPE_BASELINE = (0.003, 0.010)  # m
LARGEST_BASELINE = 0.5  # m; more can only be another unit
LARGEST_SIDE = 16384  # px
RECALIBRATE = "run the stereo calibration again and save both files from one run"


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing a calibration check looked at."""

    level: Literal["ok", "warning", "error"]
    what: str
    mend: str = ""


# ---- files -----------------------------------------------------------------------------------------------


def load_rig(folder: Path) -> StereoRig:
    """Read and check the calibration in a folder; the rig is named after the folder.

    Raises:
        UsageError: a file is missing or malformed, or `check_rig` finds an error.
    """
    rig = read_rig(folder)
    refuse_errors(check_rig(rig), folder)
    return rig


def refuse_errors(findings: list[Finding], where: Path) -> None:
    """End with the errors among the findings on a file or folder.

    Raises:
        UsageError: there are some.
    """
    errors = [finding for finding in findings if finding.level == "error"]
    if errors:
        raise UsageError("\n".join(f"{where}: {error.what}; {error.mend}" for error in errors))


def rectified_rig(name: str, width: int, height: int, K: F64, baseline: float) -> StereoRig:
    """A rig whose pictures are rectified already: both eyes have `K` [3, 3] px and no distortion.

    Args:
        baseline: m.
    """
    left, right = np.column_stack([K, np.zeros(3)]), np.column_stack([K, np.zeros(3)])
    right[0, 3] = -K[0, 0] * baseline
    eyes = [Eye(width, height, K, np.zeros(5), np.eye(3), P) for P in (left, right)]
    return StereoRig(name, *eyes)


def read_rig(folder: Path) -> StereoRig:
    """Read the calibration in a folder without judging it, for `check_rig` to report on.

    Raises:
        UsageError: a file is missing or malformed.
    """
    folder = Path(folder)
    return StereoRig(
        name=folder.resolve().name,
        left=_read_eye(folder / "left.yaml"),
        right=_read_eye(folder / "right.yaml"),
    )


def save_rig(rig: StereoRig, folder: Path) -> None:
    """Write `left.yaml` and `right.yaml`; the folder is made when it is missing."""
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    for side, eye in (("left", rig.left), ("right", rig.right)):
        (folder / f"{side}.yaml").write_text(eye_text(eye, side), encoding="utf-8")


def eye_text(eye: Eye, name: str) -> str:
    """The content of `left.yaml` or `right.yaml`: one eye as a ROS camera_info file."""
    text: str = yaml.safe_dump(_eye_to_tree(eye, name), sort_keys=False, default_flow_style=None)
    return text


def _eye_to_tree(eye: Eye, side: str) -> dict[str, Any]:
    def matrix(values: F64) -> dict[str, Any]:
        rows, cols = np.atleast_2d(values).shape
        return {"rows": rows, "cols": cols, "data": [float(value) for value in values.ravel()]}

    return {
        "image_width": eye.width,
        "image_height": eye.height,
        "camera_name": side,
        "camera_matrix": matrix(eye.K),
        "distortion_model": "plumb_bob",
        "distortion_coefficients": matrix(eye.distortion),
        "rectification_matrix": matrix(eye.R),
        "projection_matrix": matrix(eye.P),
    }


def _read_eye(file: Path) -> Eye:
    tree = _read_yaml(file)
    model = tree.get("distortion_model", "plumb_bob")
    if model != "plumb_bob":
        raise UsageError(f"{file}: distortion_model: {model!r} is not supported; calibrate with 'plumb_bob'")
    distortion = _matrix(tree, "distortion_coefficients", (4, 5), file)
    return Eye(
        width=_side(tree, "image_width", file),
        height=_side(tree, "image_height", file),
        K=_matrix(tree, "camera_matrix", (9,), file).reshape(3, 3),
        distortion=np.pad(distortion, (0, 5 - len(distortion))),
        R=_matrix(tree, "rectification_matrix", (9,), file).reshape(3, 3),
        P=_matrix(tree, "projection_matrix", (12,), file).reshape(3, 4),
    )


def _read_yaml(file: Path) -> dict[str, Any]:
    try:
        tree = yaml.safe_load(file.read_text(encoding="utf-8"))
    except OSError as error:
        mend = "a rig is a folder with left.yaml and right.yaml"
        raise UsageError(f"cannot read calibration {file}: {error.strerror}; {mend}") from None
    except (UnicodeDecodeError, yaml.YAMLError) as error:
        raise UsageError(f"{file} is not valid YAML: {' '.join(str(error).split())}") from None
    if not isinstance(tree, dict):
        raise UsageError(f"{file} is not a ROS camera_info file: it holds no keys such as camera_matrix")
    return tree


def _field(tree: dict[str, Any], key: str, file: Path) -> Any:
    if key not in tree:
        raise UsageError(f"{file}: {key} is missing; a ROS camera_info file has it, export the file again")
    return tree[key]


def _side(tree: dict[str, Any], key: str, file: Path) -> int:
    value = _field(tree, key, file)
    if not isinstance(value, int) or isinstance(value, bool) or not 1 <= value <= LARGEST_SIDE:
        raise UsageError(f"{file}: {key}: {value!r} is not a number of pixels between 1 and {LARGEST_SIDE}")
    return value


def _matrix(tree: dict[str, Any], key: str, lengths: tuple[int, ...], file: Path) -> F64:
    value = _field(tree, key, file)
    data = value.get("data") if isinstance(value, dict) else None
    needed = " or ".join(map(str, lengths))
    if not isinstance(data, list) or len(data) not in lengths:
        raise UsageError(f"{file}: {key}.data: {data!r} is not a list of {needed} numbers")
    try:
        return np.array(data, dtype=np.float64)
    except (TypeError, ValueError):
        raise UsageError(f"{file}: {key}.data: {data!r} is not a list of {needed} numbers") from None


# ---- checks ----------------------------------------------------------------------------------------------


def check_rig(rig: StereoRig) -> list[Finding]:
    """What is right, odd or wrong with a calibration, each with a way to mend it.

    The first broken group ends the checks: what follows would only repeat it.
    """
    findings: list[Finding] = []
    for check in (_check_numbers, _check_eyes, _check_rows, _check_order, _check_baseline):
        findings += check(rig)
        if any(finding.level == "error" for finding in findings):
            break
    return findings


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
    found = []
    for file, eye in _eyes(rig):
        if not geometry.is_rotation(eye.R):
            found.append(Finding("error", f"{file}: rectification_matrix is not a rotation", RECALIBRATE))
        for key, K in (("camera_matrix", eye.K), ("projection_matrix", eye.P[:, :3])):
            found += check_intrinsics(f"{file}: {key}", K, eye.width, eye.height)
    return found or [Finding("ok", "rotations, focal lengths and principal points are plausible")]


def check_intrinsics(where: str, K: F64, width: int, height: int) -> list[Finding]:
    """What is odd or wrong with `K` [3, 3] px of a picture; `where` names it."""
    found = []
    for axis, focal in (("fx", K[0, 0]), ("fy", K[1, 1])):
        if not 0.2 * width < focal < 20 * width:
            what = f"{where}: {axis} = {focal:g} px is not plausible for a picture {width} px wide"
            found.append(Finding("error", what, "give it in pixels of the full picture"))
    for axis, centre, side in (("cx", K[0, 2], width), ("cy", K[1, 2], height)):
        if not -side < centre < 2 * side:
            what = f"{where}: {axis} = {centre:g} px is far outside a picture of {side} px"
            found.append(Finding("error", what, "check image_width, image_height and the calibration"))
        elif not 0.2 * side < centre < 0.8 * side:
            what = f"{where}: {axis} = {centre:g} px is far from the middle of {side} px"
            found.append(Finding("warning", what, "check that the calibration is of this picture size"))
    return found


def _check_rows(rig: StereoRig) -> list[Finding]:
    left, right = rig.left, rig.right
    if (left.width, left.height) != (right.width, right.height):
        what = f"left.yaml is {left.width}x{left.height}, right.yaml {right.width}x{right.height}"
        return [Finding("error", what, "both eyes need the same picture size")]
    found = []
    for name, row, column, tolerance in (
        ("fx", 0, 0, 1e-3 * left.P[0, 0]),
        ("fy", 1, 1, 1e-3 * left.P[1, 1]),
        ("cy", 1, 2, 0.5),
    ):
        a, b = left.P[row, column], right.P[row, column]
        if abs(a - b) > tolerance:
            what = f"rectified {name} differs: {a:g} px in left.yaml, {b:g} px in right.yaml"
            mend = "the files are not from one stereo calibration; " + RECALIBRATE
            found.append(Finding("error", what, mend))
    return found or [Finding("ok", "rectified rows of both eyes agree")]


def _check_order(rig: StereoRig) -> list[Finding]:
    left, right = float(rig.left.P[0, 3]), float(rig.right.P[0, 3])
    what = f"projection_matrix[3] is {left:g} in left.yaml and {right:g} in right.yaml"
    if left < 0 and right == 0:
        return [Finding("error", f"{what}: the eyes are swapped", "exchange left.yaml and right.yaml")]
    if left != 0:
        return [Finding("error", what, "the left one must be 0: the left eye is the reference")]
    if right == 0:
        return [Finding("error", f"{what}: there is no baseline", RECALIBRATE)]
    if right > 0:
        mend = "the right one must be -fx * baseline, negative: exchange the eyes or mend the sign"
        return [Finding("error", what, mend)]
    return [Finding("ok", "the left eye is the reference")]


def _check_baseline(rig: StereoRig) -> list[Finding]:
    baseline = rig.baseline
    if baseline > LARGEST_BASELINE:
        what = f"the baseline of {baseline:g} m looks like millimetres"
        mend = "divide projection_matrix[3] in right.yaml by 1000: lengths are metres"
        return [Finding("error", what, mend)]
    if not ENDOSCOPE_BASELINE[0] <= baseline <= ENDOSCOPE_BASELINE[1]:
        what = f"a baseline of {baseline * 1e3:.3g} mm is unusual for a stereo endoscope (3 to 10 mm)"
        return [Finding("warning", what, "check the unit of projection_matrix[3] in right.yaml: fx * metres")]
    return [Finding("ok", f"baseline {baseline * 1e3:.3g} mm")]


# ---- the camera everything else uses ---------------------------------------------------------------------


def rectified_camera(rig: StereoRig, width: int, height: int) -> Camera:
    """The left rectified camera resized to a working size, at the world's origin."""
    size = rig.left.width, rig.left.height
    K = geometry.scale_intrinsics(rig.left.P[:, :3], size, (width, height))
    return Camera(width, height, K, np.eye(4))
