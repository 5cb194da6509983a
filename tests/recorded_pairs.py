"""Single pairs of real recordings, and their calibration as text."""

from __future__ import annotations

import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from sags_node.types import U8, Bool, Eye, StereoFrame, StereoRig

ROOT = Path(__file__).parent.parent
DATA = Path(os.environ.get("SAGS_DATA", ROOT / "../shared/data"))


def recording(name: str) -> Path:
    folder = DATA / name
    if not folder.is_dir():
        pytest.skip(f"recording {name} is not under SAGS_DATA ({DATA})")
    return folder


def read_rgb(file: Path) -> U8:
    return cv2.cvtColor(cv2.imread(str(file)), cv2.COLOR_BGR2RGB)


def make_frame(left: U8, right: U8, tissue: Bool | None = None) -> StereoFrame:
    return StereoFrame(7, 1_000, 2_000, left, right, tissue=tissue)


def rig_from_text(
    K_left: Path, d_left: Path, K_right: Path, d_right: Path, l2r: Path, width: int, height: int
) -> StereoRig:
    """A rig from matrices saved as text, translation in millimetres."""
    K1, K2, d1, d2, T = (np.loadtxt(file) for file in (K_left, K_right, d_left, d_right, l2r))
    R1, R2, P1, P2, *_ = cv2.stereoRectify(
        K1, d1, K2, d2, (width, height), T[:3, :3], T[:3, 3:] * 1e-3, flags=cv2.CALIB_ZERO_DISPARITY, alpha=0
    )
    return StereoRig("text", Eye(width, height, K1, d1, R1, P1), Eye(width, height, K2, d2, R2, P2))
