"""One door for every form of stereo calibration."""

from __future__ import annotations

from dataclasses import replace
from enum import Enum
from pathlib import Path

import numpy as np

from sags_node.errors import UsageError
from sags_node.files import near
from sags_node.rig import matrices, ros
from sags_node.rig.check import accept_rig
from sags_node.rig.rig import rectified_rig
from sags_node.types import StereoRig

NOMINAL_BASELINE = 0.005  # m, of one camera alone, and of eyes that nobody has calibrated
GUESSED_FOV = 60.0  # degrees across a picture: D4D has 58, the Hamlyn heart 44, da Vinci's scopes 60 to 70
ARCHIVE = "calibrationdata.tar.gz"
ARCHIVE_SUFFIXES = (".tar.gz", ".tgz")


class Form(Enum):
    """How a calibration is kept."""

    ROS_FOLDER = "ROS camera_info files left.yaml and right.yaml"
    ROS_ARCHIVE = "calibrationdata.tar.gz of ROS camera_calibration"
    OPENCV_PAIR = "intrinsics and extrinsics files of OpenCV's stereo_calib"
    OPENCV_FILE = "one OpenCV file with all matrices"
    TEXT_FOLDER = "text matrices of scikit-surgery"


def load_rig(path: Path) -> StereoRig:
    """Read and check a calibration.

    Raises:
        UsageError: it cannot be read, as `read_rig`, or `check_rig` finds an error.
    """
    return accept_rig(read_rig(path), path)


def load_camera(file: Path) -> StereoRig:
    """Read and check the camera_info file of one camera; the right eye is a nominal one.

    Raises:
        UsageError: it cannot be read, or `check_rig` finds an error.
    """
    return accept_rig(ros.read_one(Path(file), NOMINAL_BASELINE), file)


def guessed_rig(width: int, height: int, pixel_aspect: float = 1.0) -> StereoRig:
    """Eyes of usual optics for pictures of this size (px) that nobody has calibrated; not `metric`.

    Args:
        pixel_aspect: width of a pixel over its height.
    """
    fx = 0.5 * width / np.tan(np.radians(0.5 * GUESSED_FOV))
    K = np.array([[fx, 0, 0.5 * (width - 1)], [0, pixel_aspect * fx, 0.5 * (height - 1)], [0, 0, 1]])
    return replace(rectified_rig("guessed", width, height, K, NOMINAL_BASELINE), metric=False)


def read_rig(path: Path, size: tuple[int, int] | None = None, metres: float | None = None) -> StereoRig:
    """Read a calibration of any known form without judging it, for `check_rig` to report on.

    The rig is named after the folder or file. What is not rectified is rectified by `cv2.stereoRectify`.

    Args:
        size: width and height of the pictures, px, for the forms that do not say it.
        metres: per unit of length, where it is another than usual: ROS and OpenCV 1, scikit-surgery 0.001.

    Raises:
        UsageError: nothing known is there, or a file is missing or malformed.
    """
    path = Path(path)
    form = find_form(path)
    folder = path if path.is_dir() else path.parent
    if form is Form.ROS_FOLDER:
        return with_unit(ros.read_folder(folder), metres)
    if form is Form.ROS_ARCHIVE:
        return with_unit(ros.read_archive(path / ARCHIVE if path.is_dir() else path), metres)
    if form is Form.OPENCV_PAIR:
        return matrices.read_files(matrices.pair_in(folder), folder.resolve().name, size, metres)
    if form is Form.OPENCV_FILE:
        return matrices.read_files([path], path.stem, size, metres)
    if form is Form.TEXT_FOLDER:
        return matrices.read_text_folder(folder, size, metres)
    raise UsageError(unknown_form(path))


def with_unit(rig: StereoRig, metres: float | None) -> StereoRig:
    """The rig whose lengths were read in another unit than metres."""
    factors = np.array([1.0, 1.0, 1.0, metres or 1.0])
    left, right = (replace(eye, P=eye.P * factors) for eye in (rig.left, rig.right))
    return StereoRig(rig.name, left, right)


def find_form(path: Path) -> Form | None:
    """Which form of calibration a file or folder is; None: none that is known."""
    is_folder = path.is_dir()
    folder = path if is_folder else path.parent
    if path.name in ros.SIDES or (is_folder and any((folder / side).is_file() for side in ros.SIDES)):
        return Form.ROS_FOLDER
    if path.name.endswith(ARCHIVE_SUFFIXES) or (is_folder and (folder / ARCHIVE).is_file()):
        return Form.ROS_ARCHIVE
    pair = matrices.pair_in(folder)
    if path in pair or (is_folder and pair):
        return Form.OPENCV_PAIR
    if matrices.is_opencv(path):
        return Form.OPENCV_FILE
    if is_folder and matrices.is_text_folder(folder):
        return Form.TEXT_FOLDER
    return None


def unknown_form(path: Path) -> str:
    """What to say where there is no calibration."""
    if not path.exists():
        what = f"no calibration: no {path / 'left.yaml'}; a rig is a folder with left.yaml and right.yaml"
        return f"{what}; {near(path)}"
    looked_for = "; ".join(form.value for form in Form)
    return f"{path} is no calibration; looked for: {looked_for}"
