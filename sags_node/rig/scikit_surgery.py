"""Stereo calibrations as folders of text matrices, as scikit-surgery saves them.

`<prefix>.left.intrinsics.txt`, `.left.distortion.txt`, the same for the right eye, and `<prefix>.l2r.txt`
[4, 4] from left to right camera coordinates. Its unit is the millimetre.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from sags_node.errors import UsageError
from sags_node.files import read_file
from sags_node.rig.rig import fit_distortion, rectify_eyes
from sags_node.types import F64, StereoRig

MILLIMETRE = 1e-3
LARGEST_FILE = 2**16  # bytes
PATTERNS = {
    "left intrinsics": "*left.intrinsic*.txt",
    "left distortion": "*left.distortion*.txt",
    "right intrinsics": "*right.intrinsic*.txt",
    "right distortion": "*right.distortion*.txt",
    "left to right": "*l2r*",
}


def is_text_folder(folder: Path) -> bool:
    return any(folder.glob(PATTERNS["left intrinsics"]))


def read_folder(folder: Path, size: tuple[int, int] | None, metres: float | None) -> StereoRig:
    """The rig in a folder of text matrices, named after the folder.

    Args:
        size: width and height of the pictures, px: the files do not say it.
        metres: per unit of the translation; default: millimetres.

    Raises:
        UsageError: a file is missing, double or malformed, or the size is not given.
    """
    K_left, K_right = (_matrix(folder, f"{side} intrinsics", (9,)) for side in ("left", "right"))
    left, right = (
        fit_distortion(_matrix(folder, f"{side} distortion", (4, 5, 8, 12, 14)), f"{folder}: {side}")
        for side in ("left", "right")
    )
    l2r = _matrix(folder, "left to right", (16,)).reshape(4, 4)
    if size is None:
        raise UsageError(
            f"{folder}: text matrices do not say the size of the pictures: give --size WxH; for a launch "
            "file convert it first (sags calib convert)"
        )
    K = K_left.reshape(3, 3), K_right.reshape(3, 3)
    T = l2r[:3, 3] * (metres or MILLIMETRE)
    return rectify_eyes(folder.resolve().name, size, K, (left, right), l2r[:3, :3], T)


def _matrix(folder: Path, what: str, lengths: tuple[int, ...]) -> F64:
    """The numbers of one file, as one row."""
    files = sorted(folder.glob(PATTERNS[what]))
    if len(files) != 1:
        found = ", ".join(file.name for file in files) or "none"
        raise UsageError(f"{folder}: one file {PATTERNS[what]} is needed, found: {found}")
    file = files[0]
    try:
        text = read_file(file, LARGEST_FILE).decode("utf-8")
        numbers = np.array(text.replace(",", " ").split(), np.float64)
    except OSError as error:
        raise UsageError(f"cannot read calibration {file}: {error.strerror}; check the path") from None
    except ValueError:  # also of what is not UTF-8
        raise UsageError(f"{file} holds something else than numbers; save it again") from None
    if len(numbers) not in lengths:
        needed = " or ".join(map(str, lengths))
        raise UsageError(f"{file} holds {len(numbers)} numbers, not {needed}; save it again")
    return numbers
