"""The camera's pose on what the robot moves: `hand_eye.yaml` beside a rig's `left.yaml`."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from sags_node.config.yaml_reader import read_yaml
from sags_node.errors import UsageError
from sags_node.files import check_folder, whole
from sags_node.geometry import is_rigid
from sags_node.types import F64

FILE = "hand_eye.yaml"
KEYS = ("T_hand_cam", "offset_ms", "figures")
LARGEST_DISTANCE = 2.0  # m, from the hand to the camera: a scope has half a metre


@dataclass(frozen=True, slots=True)
class HandEye:
    """A hand-eye calibration."""

    T_hand_cam: F64  # [4, 4] m, pose of the left raw camera in the frame whose pose the robot tells
    offset_ns: int = 0  # robot's stamp - image's stamp, at the same moment


def read_hand_eye(file: Path) -> HandEye:
    """Read a `hand_eye.yaml`.

    Raises:
        UsageError: it is missing, holds no rigid transform in metres, or has an unknown key.
    """
    if not file.is_file():
        raise UsageError(
            f"{file} does not exist: calibrate with sags calib hand-eye, or set robot.hand_eye to the file"
        )
    tree = read_yaml(file, "hand-eye calibration")
    said: Any = tree if isinstance(tree, dict) else {}
    if other := [str(key) for key in said if key not in KEYS]:
        raise UsageError(f"{file}: unknown key '{other[0]}'; known: {', '.join(KEYS)}")
    try:
        rows, offset_ms = said["T_hand_cam"], said.get("offset_ms", 0.0)
        if bool in map(type, [offset_ms, *(number for row in rows for number in row)]):
            raise ValueError("true would be taken for 1")
        T, offset_ns = np.array(rows, np.float64), round(float(offset_ms) * 1e6)
    except (KeyError, TypeError, ValueError, OverflowError):
        raise UsageError(f"{file}: T_hand_cam must be 4 rows of 4 numbers, offset_ms a number") from None
    if not is_rigid(T):
        raise UsageError(f"{file}: T_hand_cam is no rotation and translation above a last row 0 0 0 1")
    if np.linalg.norm(T[:3, 3]) > LARGEST_DISTANCE:
        raise UsageError(
            f"{file}: the camera is {np.linalg.norm(T[:3, 3]):.3g} m from the hand; T_hand_cam is in metres"
        )
    return HandEye(T, offset_ns)


def save_hand_eye(hand_eye: HandEye, folder: Path, figures: Mapping[str, Any]) -> None:
    """Write `hand_eye.yaml` into a rig's folder; `figures` tell readers of the file how good it is.

    Raises:
        SagsError: it cannot be written.
    """
    tree = {
        "T_hand_cam": [[float(number) for number in row] for row in hand_eye.T_hand_cam],
        "offset_ms": hand_eye.offset_ns * 1e-6,
        "figures": dict(figures),
    }
    check_folder(folder)
    text = yaml.safe_dump(tree, sort_keys=False, default_flow_style=None)
    with whole(folder / FILE) as partial:
        partial.write_text(f"# Metres. Made by sags calib hand-eye.\n{text}", encoding="utf-8")
