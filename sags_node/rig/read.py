"""Reads every form of stereo calibration: ROS files (`ros`), OpenCV's own, folders of scikit-surgery.

OpenCV's (`cv2.FileStorage`, YAML or XML) are `intrinsics.yml` and `extrinsics.yml` as its sample stereo_calib
writes them, or one file with all matrices under any usual names. They do not say the unit of T.

Scikit-surgery's are text: `<prefix>.left.intrinsics.txt`, `.left.distortion.txt`, the same for the right eye,
and `<prefix>.l2r.txt` [4, 4] from left to right camera coordinates, mm.
"""

import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from enum import Enum
from functools import partial
from pathlib import Path

import cv2
import numpy as np

from sags_node.config.yaml_reader import check_dialect
from sags_node.errors import UsageError
from sags_node.files import near, open_file
from sags_node.rig import ros
from sags_node.rig.check import accept_rig
from sags_node.rig.rig import fit_distortion, rectified_rig, rectify_eyes
from sags_node.types import F64, StereoRig

NOMINAL_BASELINE = 0.005  # m, of one camera alone, and of eyes that nobody has calibrated
GUESSED_FOV = 60.0  # degrees across an image: D4D has 58, the Hamlyn heart 44, da Vinci's scopes 60 to 70
ARCHIVE = "calibrationdata.tar.gz"
ARCHIVE_SUFFIXES = (".tar.gz", ".tgz")
LARGEST_MATRIX = 64  # numbers
DISTORTION = (4, 5, 8, 12, 14)
COUNTS = {  # numbers of each matrix
    "M1": (9,), "M2": (9,), "D1": DISTORTION, "D2": DISTORTION, "R": (9,), "T": (3,), "l2r": (16,),
    "R1": (9,), "R2": (9,), "P1": (12,), "P2": (12,),
}  # fmt: skip
STARTS = (b"%YAML:", b"%YAML 1", b"<?xml", b"<opencv_storage")
SUFFIXES = (".yml", ".yaml", ".xml")
NAMES = {  # in OpenCV's files
    "M1": ("M1", "K1", "KL", "cameraMatrix1", "cameraMatrixL", "camera_matrix_1", "left_camera_matrix"),
    "M2": ("M2", "K2", "KR", "cameraMatrix2", "cameraMatrixR", "camera_matrix_2", "right_camera_matrix"),
    "D1": ("D1", "DL", "distCoeffs1", "distCoeffsL", "dist_coeffs_1", "left_distortion_coefficients"),
    "D2": ("D2", "DR", "distCoeffs2", "distCoeffsR", "dist_coeffs_2", "right_distortion_coefficients"),
    "T": ("T", "t"),
}
OTHER_MODELS = ("fisheye", "equidist", "kannala", "omni", "unified", "doublesphere", "scaramuzza", "ocam")
SHORT_MODELS = ("mei", "kb", "kb4", "kb8", "ucm", "eucm", "ds", "fov", "ftheta")
MEI = ("xi", "xi1", "xi2")  # what only that model has
DEEPEST = 3  # sections within sections that are looked through
SIZES = (("image_width", "image_height"), ("imageWidth", "imageHeight"), ("width", "height"))
SIZE_LISTS = ("imageSize", "image_size")
MILLIMETRE = 1e-3
PATTERNS = {  # of text files
    "M1": "*left.intrinsic*.txt",
    "D1": "*left.distortion*.txt",
    "M2": "*right.intrinsic*.txt",
    "D2": "*right.distortion*.txt",
    "l2r": "*l2r*",
}


class Form(Enum):
    """The form in which a calibration is stored."""

    ROS_FOLDER = "ROS camera_info files left.yaml and right.yaml"
    ROS_ARCHIVE = "calibrationdata.tar.gz of ROS camera_calibration"
    OPENCV_PAIR = "intrinsics and extrinsics files of OpenCV's stereo_calib"
    OPENCV_FILE = "one OpenCV file (.yml, .yaml, .xml) with all matrices, by its name"
    TEXT_FOLDER = "text matrices of scikit-surgery"


def load_rig(path: Path) -> StereoRig:
    """Read and check a calibration.

    Raises:
        UsageError: `read_rig` cannot read it, or `check_rig` finds an error.
    """
    return accept_rig(read_rig(path), path)


def load_camera(file: Path) -> StereoRig:
    """Read and check the camera_info file of one camera; the right eye is a nominal one.

    Raises:
        UsageError: it cannot be read, or `check_rig` finds an error.
    """
    return accept_rig(replace(ros.read_one(Path(file), NOMINAL_BASELINE), path=file), file)


def guessed_rig(width: int, height: int, pixel_aspect: float = 1.0) -> StereoRig:
    """Guess a rig of usual optics for uncalibrated images of this size (px); it is not `metric`.

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
        size: width and height of the images, px, for the forms that do not say it.
        metres: per unit of length, if not the usual one: 1 for ROS and OpenCV, 0.001 for scikit-surgery.

    Raises:
        UsageError: nothing known is there, or a file is missing or malformed.
    """
    return replace(_read(Path(path), size, metres), path=path)


def _read(path: Path, size: tuple[int, int] | None, metres: float | None) -> StereoRig:
    form = find_form(path)
    folder = path if path.is_dir() else path.parent
    if form is Form.ROS_FOLDER:
        return with_unit(ros.read_folder(folder), metres)
    if form is Form.ROS_ARCHIVE:
        return with_unit(ros.read_archive(path / ARCHIVE if path.is_dir() else path), metres)
    if form is Form.OPENCV_PAIR:
        return read_files(pair_in(folder), folder.resolve().name, size, metres)
    if form is Form.OPENCV_FILE:
        return read_files([path], path.stem, size, metres)
    if form is Form.TEXT_FOLDER:
        return read_text_folder(folder, size, metres)
    raise UsageError(unknown_form(path))


def with_unit(rig: StereoRig, metres: float | None) -> StereoRig:
    """Return the rig in metres, its lengths given in units of `metres`; None: they are metres already."""
    factors = np.array([1.0, 1.0, 1.0, metres or 1.0])
    left, right = (replace(eye, P=eye.P * factors) for eye in (rig.left, rig.right))
    return replace(rig, left=left, right=right)


def find_form(path: Path) -> Form | None:
    """Return the form of calibration of a file or folder; None: none that is known."""
    is_folder = path.is_dir()
    folder = path if is_folder else path.parent
    if path.name in ros.SIDES or (is_folder and any((folder / side).is_file() for side in ros.SIDES)):
        return Form.ROS_FOLDER
    if path.name.endswith(ARCHIVE_SUFFIXES) or (is_folder and (folder / ARCHIVE).is_file()):
        return Form.ROS_ARCHIVE
    pair = pair_in(folder)
    if path in pair or (is_folder and pair):
        return Form.OPENCV_PAIR
    if is_opencv(path):
        return Form.OPENCV_FILE
    if is_folder and is_text_folder(folder):
        return Form.TEXT_FOLDER
    return None


def unknown_form(path: Path) -> str:
    """Return the error message for a path that holds no calibration."""
    if not path.exists():
        what = f"no calibration: no {path / 'left.yaml'}; a rig is a folder with left.yaml and right.yaml"
        return f"{what}; {near(path)}"
    looked_for = "; ".join(form.value for form in Form)
    return f"{path} is no calibration; looked for: {looked_for}; docs/calibration.md converts others"


# ---- two cameras and how they stand to each other ---------------------------------------------------------


def _rig(
    matrix: Callable[[str], F64], name: str, where: str, size: tuple[int, int] | None, R: F64, T: F64
) -> StereoRig:
    """The rig made from M1 D1 M2 D2, which `matrix` reads, R [3, 3] and T [3] (m)."""
    K = matrix("M1").reshape(3, 3), matrix("M2").reshape(3, 3)
    left, right = (fit_distortion(matrix(key), f"{where}: {key}") for key in ("D1", "D2"))
    if size is None:
        raise UsageError(
            f"{where} does not say the size of the images: give --size WxH; for a launch file "
            "convert it first (sags calib convert)"
        )
    return replace(rectify_eyes(name, size, K, (left, right), R, T), says_P=False)


# ---- text ------------------------------------------------------------------------------------------------


def is_text_folder(folder: Path) -> bool:
    return any(folder.glob(PATTERNS["M1"]))


def read_text_folder(folder: Path, size: tuple[int, int] | None, metres: float | None) -> StereoRig:
    """Read the rig in a folder of text matrices; it is named after the folder.

    Args:
        size: width and height of the images, px: the files do not say it.
        metres: per unit of the translation; default: millimetres.

    Raises:
        UsageError: a file is missing, there twice or malformed, or the size is not given.
    """
    l2r = _text_matrix(folder, "l2r").reshape(4, 4)
    T = l2r[:3, 3] * (metres or MILLIMETRE)
    matrix = partial(_text_matrix, folder)
    rig = _rig(matrix, folder.resolve().name, str(folder), size, l2r[:3, :3], T)
    return rig if metres else replace(rig, unit="mm")


def _text_matrix(folder: Path, key: str) -> F64:
    """The numbers of one file, as one row."""
    files = sorted(folder.glob(PATTERNS[key]))
    if len(files) != 1:
        found = ", ".join(file.name for file in files) or "none"
        raise UsageError(f"{folder}: one file {PATTERNS[key]} is needed, found: {found}")
    file = files[0]
    try:
        text = ros.content_of(file).decode("utf-8")
        numbers = np.array(text.replace(",", " ").split(), np.float64)
    except ValueError:  # also of what is not UTF-8
        raise UsageError(f"{file} holds something else than numbers; save it again") from None
    if len(numbers) not in COUNTS[key]:
        raise UsageError(f"{file} holds {len(numbers)} numbers, not {_needed(key)}; save it again")
    return numbers


def _needed(key: str) -> str:
    return " or ".join(map(str, COUNTS[key]))


# ---- OpenCV ----------------------------------------------------------------------------------------------


def is_opencv(file: Path) -> bool:
    """Tell whether a file looks as if `cv2.FileStorage` wrote it."""
    if file.suffix.lower() not in SUFFIXES or not file.is_file():
        return False
    with open_file(file) as opened:
        return opened.read(64).lstrip().startswith(STARTS)


def pair_in(folder: Path) -> list[Path]:
    """Return those of the sample's `intrinsics` and `extrinsics` files that a folder has."""
    names = [folder / f"{stem}{suffix}" for stem in ("intrinsics", "extrinsics") for suffix in SUFFIXES]
    return [file for file in names if file.is_file()]


def read_files(
    files: Sequence[Path], name: str, size: tuple[int, int] | None, metres: float | None
) -> StereoRig:
    """Read the rig in files that together hold M1 D1 M2 D2 R T, or these under other usual names.

    R1 R2 P1 P2, if they are there, are kept, so that images are rectified as other programs do with them.

    Args:
        size: width and height of the images, px, where the files do not say it.
        metres: per unit of T; default 1.

    Raises:
        UsageError: a file cannot be read, a matrix is missing or malformed, or the size is not known.
    """
    storages = [(file, open_storage(file)) for file in files]
    for file, storage in storages:
        _refuse_other_models(file, storage.root())
    where = " and ".join(map(str, files))
    matrix = partial(_matrix, storages)
    size, T = _size(storages) or size, matrix("T") * (metres or 1.0)
    rig = _rig(matrix, name, where, size, matrix("R").reshape(3, 3), T)
    if not all(_find(storages, key) for key in ("R1", "R2", "P1", "P2")):
        return rig
    eyes = []
    for eye, R_key, P_key in ((rig.left, "R1", "P1"), (rig.right, "R2", "P2")):
        P = matrix(P_key).reshape(3, 4) * [1.0, 1.0, 1.0, metres or 1.0]
        eyes.append(replace(eye, R=matrix(R_key).reshape(3, 3), P=P))
    return StereoRig(name, *eyes)


def _refuse_other_models(file: Path, node: cv2.FileNode, depth: int = 0) -> None:
    """Raise UsageError for a file that names another lens model, whose matrices look the same."""
    for key in node.keys() if node.isMap() and depth < DEEPEST else ():
        value, name = node.getNode(key), _plain(key)
        said = value.string() if value.isString() else f"{value.real():g}"
        other = any(word in _plain(said) for word in OTHER_MODELS) or _plain(said) in SHORT_MODELS
        flag = ("fisheye" in name or name in MEI) and _plain(said) not in ("", "0", "false", "no")
        if flag or (other and any(word in name for word in ("model", "type"))):
            fix = "calibrate with 'plumb_bob' or 'rational_polynomial' (sags calib stereo)"
            raise UsageError(f"{file}: {key}: {said} is not supported; {fix}")
        _refuse_other_models(file, value, depth + 1)


def _plain(text: str) -> str:
    return re.sub(r"[^a-z0-9.]", "", text.lower())


Storages = Sequence[tuple[Path, cv2.FileStorage]]


def open_storage(file: Path) -> cv2.FileStorage:
    """Open a file of matrices.

    Raises:
        UsageError: it is missing, too large, or not written by OpenCV.
    """
    try:
        text = ros.content_of(file).decode("utf-8")
        directive, _, document = text.partition("\n")
        if directive.startswith("%YAML"):  # of two equal keys OpenCV would take the first
            check_dialect(document, str(file))
        storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
        has_names = storage.root().isMap()
    except (UnicodeDecodeError, cv2.error, SystemError):
        raise UsageError(f"{file} is not a YAML or XML file as OpenCV writes it; save it again") from None
    if not has_names:
        raise UsageError(f"{file} holds no matrices with names; save it again")
    return storage


def _find(storages: Storages, key: str) -> tuple[Path, cv2.FileNode] | None:
    for name in NAMES.get(key, (key,)):
        for file, storage in storages:
            node = storage.getNode(name)
            if not node.empty():
                return file, node
    return None


def _matrix(storages: Storages, key: str) -> F64:
    """The numbers of one matrix, as one row."""
    found = _find(storages, key)
    if found is None:
        names = ", ".join(NAMES.get(key, (key,)))
        where = " and ".join(str(file) for file, _ in storages)
        raise UsageError(f"{where}: looked for a matrix named {names}; a stereo calibration needs it")
    file, node = found
    numbers = numbers_in(node)
    if numbers is None or numbers.size not in COUNTS[key]:
        what = f"{node.name()} is not a matrix of {_needed(key)} numbers"
        turn = key == "R" and numbers is not None and numbers.size == 3
        fix = "of a rotation vector save cv2.Rodrigues(R)[0]" if turn else "save the file again"
        raise UsageError(f"{file}: {what}; {fix}")
    return numbers


def numbers_in(node: cv2.FileNode) -> F64 | None:
    """Return the numbers of a matrix or list as one row; None: it is neither, or is far too large."""
    if node.isSeq():
        return np.array([node.at(index).real() for index in range(min(node.size(), LARGEST_MATRIX))])
    if not node.isMap():
        return None
    sizes = node.getNode("sizes")  # OpenCV 5 writes it for one dimension; in XML it is a number, not a list
    size = sizes.at(0) if sizes.isSeq() and sizes.size() == 1 else sizes
    claimed = size.real() if size.isInt() else node.getNode("rows").real() * node.getNode("cols").real()
    if not 0 < claimed <= LARGEST_MATRIX:  # OpenCV would allocate what is claimed
        return None
    try:
        matrix = node.mat()
    except cv2.error:  # fewer numbers than it has rows and columns
        return None
    return None if matrix is None else np.asarray(matrix, np.float64).ravel()


def _size(storages: Storages) -> tuple[int, int] | None:
    for key in SIZE_LISTS:
        found = _find(storages, key)
        numbers = None if found is None else numbers_in(found[1])
        if numbers is not None and len(numbers) == 2:
            return _pixels(numbers[0]), _pixels(numbers[1])
    for names in SIZES:
        width, height = (_find(storages, name) for name in names)
        if width is not None and height is not None:
            return _pixels(width[1].real()), _pixels(height[1].real())
    return None


def _pixels(number: float) -> int:
    """A number as whole pixels; 0 for NaN and infinity: the size is then refused."""
    return int(number) if np.isfinite(number) else 0
