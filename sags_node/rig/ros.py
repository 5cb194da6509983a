"""ROS camera_info files: `left.yaml` and `right.yaml` in a folder, or in a `calibrationdata.tar.gz`.

The keys are those of ROS `camera_calibration_parsers`, so files of `ros2 run camera_calibration
cameracalibrator` are used unchanged. Lengths are metres.
"""

import gzip
import re
import tarfile
import zlib
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import yaml

from sags_node.config.yaml_reader import parse_yaml
from sags_node.errors import UsageError, brief
from sags_node.files import check_folder, open_file, read_file, whole
from sags_node.rig.rig import LARGEST_SIDE, PLUMB_BOB, RATIONAL, part_of_sensor
from sags_node.types import F64, Eye, StereoRig

LARGEST_FILE = 2**20  # bytes of one camera_info file
LARGEST_READ = 2**24  # bytes taken from an archive at once
LARGEST_ARCHIVE = 2**32  # bytes, unpacked
MODELS = {"plumb_bob": (4, PLUMB_BOB), "rational_polynomial": (RATIONAL,)}  # numbers of coefficients
MODELS["radtan"] = MODELS["plumb_bob"]  # as kalibr calls it
MATRICES = (
    "camera_matrix",
    "distortion_coefficients",
    "rectification_matrix",
    "projection_matrix",
)  # K D R P of the message
SIDES = ("left.yaml", "right.yaml")
NOT_THEIRS = "projection_by: cv2.stereoRectify\n"  # R and P stood in no file: see `StereoRig.says_P`


def content_of(file: Path, fix: str = "check the path") -> bytes:
    """Read the bytes of a calibration file.

    Raises:
        UsageError: it is missing, no plain file or too large; the message ends with `fix`.
    """
    try:
        return read_file(file, LARGEST_FILE)
    except OSError as error:
        raise UsageError(f"cannot read calibration {file}: {error.strerror}; {fix}") from None


def read_folder(folder: Path) -> StereoRig:
    """Read the rig in `left.yaml` and `right.yaml`; it is named after the folder.

    Raises:
        UsageError: a file is missing or malformed.
    """
    fix = "a rig is a folder with left.yaml and right.yaml"
    contents = {str(file): content_of(file, fix) for file in eye_files(folder)}
    eyes = (_read_eye(content, file) for file, content in contents.items())
    says_P = not any(NOT_THEIRS.encode() in content for content in contents.values())
    return StereoRig(folder.resolve().name, *eyes, says_P=says_P)


def read_one(file: Path, baseline: float) -> StereoRig:
    """Read the rig of one camera's camera_info file (`ost.yaml`, `left.yaml`); it is named after the file.

    Args:
        baseline: m, to a right eye that does not exist; nothing may depend on it.

    Raises:
        UsageError: the file is missing or malformed.
    """
    eye = _read_eye(content_of(file), str(file))
    P = eye.P.copy()
    P[0, 3] = -P[0, 0] * baseline
    return StereoRig(file.stem, eye, replace(eye, P=P))


def read_archive(archive: Path) -> StereoRig:
    """Read the rig in the `calibrationdata.tar.gz` of ROS camera_calibration; nothing is unpacked to disk.

    Raises:
        UsageError: it is no tar.gz, is damaged, or a file in it is missing or malformed.
    """
    found: dict[str, Eye] = {}
    try:
        with (
            open_file(archive) as packed,
            _Limited(fileobj=packed) as unpacked,
            tarfile.open(fileobj=unpacked, mode="r:") as tar,
        ):
            for member in tar:
                side = PurePosixPath(member.name).name
                if side in SIDES and member.isfile() and side not in found:
                    stream = tar.extractfile(member)
                    assert stream is not None  # members that are files have one
                    found[side] = _read_eye(stream.read(LARGEST_FILE + 1), f"{archive}: {member.name}")
                if len(found) == len(SIDES):
                    break
    except (tarfile.TarError, OSError, EOFError, zlib.error) as error:
        raise UsageError(f"{archive} is not a readable tar.gz: {error}; save it again") from None
    for side in SIDES:
        if side not in found:
            raise UsageError(
                f"{archive} holds no {side}; a stereo calibration of camera_calibration has left.yaml and "
                "right.yaml (ost.yaml is of one camera)"
            )
    return StereoRig(archive.name.split(".")[0], *(found[side] for side in SIDES))


class _Limited(gzip.GzipFile):
    """Reads no more than a calibration needs: a forged header may ask for any amount."""

    def read(self, size: int | None = -1) -> bytes:
        if size is None or not 0 <= size <= LARGEST_READ:
            raise tarfile.ReadError(f"a part of {size} bytes")
        return super().read(size)

    def seek(self, offset: int, whence: int = 0) -> int:
        if offset > LARGEST_ARCHIVE:
            raise tarfile.ReadError("far larger than the images of a calibration")
        return super().seek(offset, whence)


def eye_files(folder: Path) -> tuple[Path, Path]:
    """Return the paths of `left.yaml` and `right.yaml` in a rig's folder."""
    return folder / SIDES[0], folder / SIDES[1]


def save_rig(rig: StereoRig, folder: Path) -> None:
    """Write `left.yaml` and `right.yaml`; the folder is made when it is missing.

    Raises:
        SagsError: they cannot be written; both stay as they were.
    """
    check_folder(folder)
    left_file, right_file = eye_files(folder)
    said = "" if rig.says_P else NOT_THEIRS
    with whole(left_file) as left, whole(right_file) as right:
        left.write_text(eye_text(rig.left, "left") + said, encoding="utf-8")
        right.write_text(eye_text(rig.right, "right") + said, encoding="utf-8")


def eye_text(eye: Eye, name: str) -> str:
    """Return the content of `left.yaml` or `right.yaml`: one eye as a ROS camera_info file."""
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
        "distortion_model": "rational_polynomial" if len(eye.distortion) == RATIONAL else "plumb_bob",
        "distortion_coefficients": matrix(eye.distortion),
        "rectification_matrix": matrix(eye.R),
        "projection_matrix": matrix(eye.P),
    }


def _read_eye(content: bytes, file: str) -> Eye:
    tree = _read_yaml(content, file)
    eye = Eye(
        width=_side(tree, "image_width", file),
        height=_side(tree, "image_height", file),
        K=_matrix(tree, "camera_matrix", 9, file).reshape(3, 3),
        distortion=_distortion(tree, file),
        R=_matrix(tree, "rectification_matrix", 9, file).reshape(3, 3),
        P=_matrix(tree, "projection_matrix", 12, file).reshape(3, 4),
    )
    if not eye.K.any():
        raise UsageError(f"{file}: camera_matrix is zero: so ROS says that nobody has calibrated the camera")
    roi = tree.get("roi") or {}
    x, y, width, height = (_count(roi, key, file) for key in ("x_offset", "y_offset", "width", "height"))
    across, down = (_count(tree, f"binning_{axis}", file) for axis in "xy")
    return part_of_sensor(eye, (x, y, width, height), (across, down), file)


def _read_yaml(content: bytes, file: str) -> dict[str, Any]:
    """The keys of a camera_info file, or of what `ros2 topic echo` prints of the message."""
    if len(content) > LARGEST_FILE:
        raise UsageError(f"{file} is larger than {LARGEST_FILE} bytes: it is no calibration; check the path")
    documents = (parse_yaml(part, file) for part in re.split(rb"^---\s*$", content, flags=re.MULTILINE))
    tree = next((document for document in documents if document is not None), None)
    if not isinstance(tree, dict):
        raise UsageError(f"{file} is not a ROS camera_info file: it holds no keys such as camera_matrix")
    lower = {str(key).lower(): value for key, value in tree.items()}
    if "camera_matrix" in tree or "k" not in lower:
        return tree
    named = {key: {"data": lower.get(short)} for short, key in zip("kdrp", MATRICES, strict=True)}
    sides = {f"image_{side}": lower.get(side) for side in ("width", "height")}
    return lower | named | sides


def _count(tree: Any, key: str, file: str) -> int:
    """A number of pixels of a region; 0 where it is not said."""
    value = tree.get(key, 0) if isinstance(tree, dict) else None
    if type(value) is not int or not 0 <= value <= LARGEST_SIDE:  # bool is a subclass of int
        raise UsageError(f"{file}: {key}: {brief(value)} is not a number of pixels up to {LARGEST_SIDE}")
    return value


def _field(tree: dict[str, Any], key: str, file: str) -> Any:
    if key not in tree:
        raise UsageError(f"{file}: {key} is missing; a ROS camera_info file has it, export the file again")
    return tree[key]


def _side(tree: dict[str, Any], key: str, file: str) -> int:
    value = _field(tree, key, file)
    if type(value) is not int or not 1 <= value <= LARGEST_SIDE:
        raise UsageError(
            f"{file}: {key}: {brief(value)} is not a number of pixels between 1 and {LARGEST_SIDE}"
        )
    return value


def _distortion(tree: dict[str, Any], file: str) -> F64:
    model = tree.get("distortion_model", "plumb_bob")
    if not isinstance(model, str) or model not in MODELS:
        fix = "calibrate with 'plumb_bob' or 'rational_polynomial'"
        raise UsageError(f"{file}: distortion_model: {brief(model)} is not supported; {fix}")
    coefficients = _numbers(tree, "distortion_coefficients", file)
    lengths = MODELS[model]
    if len(coefficients) not in lengths:
        needed = " or ".join(map(str, lengths))
        raise UsageError(
            f"{file}: distortion_coefficients.data holds {len(coefficients)} numbers, distortion_model "
            f"{model} has {needed}"
        )
    return np.pad(coefficients, (0, lengths[-1] - len(coefficients)))


def _matrix(tree: dict[str, Any], key: str, count: int, file: str) -> F64:
    numbers = _numbers(tree, key, file)
    if numbers.shape != (count,):
        raise UsageError(f"{file}: {key}.data holds {numbers.size} numbers, not {count}")
    return numbers


def _numbers(tree: dict[str, Any], key: str, file: str) -> F64:
    value = _field(tree, key, file)
    data = value.get("data") if isinstance(value, dict) else None
    if isinstance(data, list) and len(data) == 1 and isinstance(data[0], str):
        data = data[0].split()  # without commas, as Kinetic wrote it
    try:
        numbers = np.array(data, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):  # OverflowError: an integer of hundreds of digits
        numbers = np.zeros(())
    if not isinstance(data, list) or numbers.ndim != 1 or bool in map(type, data):
        raise UsageError(f"{file}: {key}.data: {brief(data)} is not a list of numbers")
    return numbers
