"""Reads keyframe folders of SCARED (Allan et al., arXiv 2101.01133).

A keyframe is one view of a still organ, measured with structured light, and a video in which the scope moves
away: `endoscope_calibration.yaml`, `data/rgb.mp4` (left image above the right one), `data/frame_data`
(poses) and `data/scene_points` (the measured surface as seen from each frame). Lengths are in mm.
"""

import json
import logging
from pathlib import Path

import cv2
import numpy as np

from sags_node import geometry
from sags_node.checks import refuse_errors
from sags_node.config.schema import GeometryConfig
from sags_node.errors import SagsError, UsageError
from sags_node.media.picture_file import decode
from sags_node.media.video import Video
from sags_node.rig import accept_rig, check_intrinsics, rectified_rig
from sags_node.rig.read import numbers_in, open_storage
from sags_node.sources.layout import Layout
from sags_node.sources.numbered import NumberedFiles, open_numbered
from sags_node.sources.pictures import FolderPairs, Pairs, RawPair
from sags_node.sources.videos import OneVideoPairs
from sags_node.types import F32, F64, Eye, Reference, StereoRig

log = logging.getLogger(__name__)

FILE = "endoscope_calibration.yaml"
METRES = 1e-3  # m per unit of the files (mm)
BASELINES = (1e-3, 50e-3)  # m: outside, the file is not in millimetres
RECTIFIED_FOLDERS = (("left_rectified", "right_rectified"), ("data/left_finalpass", "data/right_finalpass"))
LARGEST_JSON = 2**20  # bytes
LARGEST_POINTS = 2**28  # bytes


class ScaredPairs(Pairs):
    """The frames of a keyframe's video with their poses and, if `references`, the structured light depth.

    Raises:
        UsageError: files are missing, damaged or do not fit each other.
    """

    def __init__(self, folder: Path, references: bool) -> None:
        self._pictures, _ = _open_pictures(folder)
        self._points: NumberedFiles | None = None
        try:
            self._left = read_calibration(folder, self._pictures.size).left
            self._poses = _read_poses(folder, self._pictures.count, self._left)
            if references:
                self._points = open_numbered(folder / "data/scene_points", ".tiff", LARGEST_POINTS)
        except SagsError:
            self.close()
            raise
        eye = self._left
        size = eye.width, eye.height
        self._look_up = cv2.initUndistortRectifyMap(eye.K, eye.distortion, eye.R, eye.P, size, cv2.CV_32FC1)
        self.count = self._pictures.count if self._poses is None else len(self._poses)
        self.rate, self.pixel_aspect = self._pictures.rate, self._pictures.pixel_aspect
        self.oddities, self.cut_off, self.reach = self._pictures.oddities, self._pictures.cut_off, self.count
        stamps = self._pictures.stamps
        self.stamps = None if stamps is None else stamps[: self.count]

    def at(self, index: int) -> RawPair | None:
        pair = self._pictures.at(index) if index < self.count else None
        if pair is None:
            return None
        return pair._replace(
            T_world_cam=None if self._poses is None else self._poses[index], reference=self._reference(index)
        )

    def close(self) -> None:
        self._pictures.close()
        if self._points is not None:
            self._points.close()

    def _reference(self, index: int) -> Reference | None:
        data = None if self._points is None else self._points.read(index)
        if data is None:
            return None
        width, height = self._left.width, self._left.height
        # x, y, z are stored as R, G, B; OpenCV returns B, G, R.
        name = f"data/scene_points of frame {index}"
        points = decode(data, cv2.IMREAD_UNCHANGED, name, "unpack or download scene_points.tar.gz again")
        if points.dtype != np.float32 or points.shape != (2 * height, width, 3):
            raise SagsError(
                f"{name} is no whole float TIFF of {width}x{2 * height} px and "
                "3 channels; unpack or download scene_points.tar.gz again"
            )
        return Reference(self._rectified_depth(points[:height, :, ::-1]), "structured_light")

    def _rectified_depth(self, points: F32) -> F32:
        """Depth [H, W] m in the left rectified image, from points [H, W, 3] mm at the raw image's pixels.
        Each rectified pixel takes the point of the nearest raw one: points are never averaged.
        """
        depth = points @ (self._left.R[2] * METRES).astype(np.float32)
        rectified = cv2.remap(depth, *self._look_up, cv2.INTER_NEAREST, borderValue=0)
        # Unknown is NaN in some files, 0 in others.
        return np.where(rectified > 0, rectified, np.float32(0))


def read_rig(folder: Path, judged: bool = True) -> StereoRig:
    """Read the keyframe's calibration for the images that are played, raw or rectified. Unless `judged`,
    its plausibility is not checked: images may have been resized since.

    Raises:
        UsageError: images or calibration are missing, damaged or implausible.
    """
    pictures, rectified = _open_pictures(folder)
    pictures.close()
    rig = read_calibration(folder, pictures.size)
    if judged:
        accept_rig(rig, folder / FILE)
    return rectified_rig(rig.name, *pictures.size, rig.left.P[:, :3], rig.baseline) if rectified else rig


def read_calibration(folder: Path, size: tuple[int, int]) -> StereoRig:
    """Read `endoscope_calibration.yaml`, and rectify with OpenCV's defaults, as the public SCARED tools do.

    Args:
        size: width and height of one eye's image, px.

    Raises:
        UsageError: the file is missing, damaged or implausible.
    """
    file = folder / FILE
    storage = open_storage(file)
    M1, M2, R = (_matrix(storage, file, key, (9,)).reshape(3, 3) for key in ("M1", "M2", "R"))
    D1, D2 = (_matrix(storage, file, key, (4, 5)) for key in ("D1", "D2"))
    T = _matrix(storage, file, "T", (3,)) * METRES
    for key, K in (("M1", M1), ("M2", M2)):
        refuse_errors(check_intrinsics(key, K, *size), file)
    if not geometry.is_rotation(R):
        raise UsageError(f"{file}: R is not a rotation; download the file again")
    if not BASELINES[0] <= np.linalg.norm(T) <= BASELINES[1]:
        raise UsageError(
            f"{file}: T puts the eyes {np.linalg.norm(T) / METRES:.3g} mm apart, possible are "
            f"{BASELINES[0] / METRES:g} to {BASELINES[1] / METRES:g}; the unit is millimetres"
        )
    if T[0] > 0:
        raise UsageError(f"{file}: T points to the left: the eyes are exchanged; SCARED maps left to right")
    R1, R2, P1, P2, *_ = cv2.stereoRectify(M1, D1, M2, D2, size, R, T[:, None])
    eyes = [
        Eye(*size, K, np.pad(D, (0, 5 - len(D))), R, P) for K, D, R, P in ((M1, D1, R1, P1), (M2, D2, R2, P2))
    ]
    return StereoRig(f"{folder.parent.name}_{folder.name}", *eyes, path=folder)


def _matrix(storage: cv2.FileStorage, file: Path, key: str, lengths: tuple[int, ...]) -> F64:
    """The numbers of one matrix, as one row."""
    values = numbers_in(storage.getNode(key))
    if values is None or values.size not in lengths or not np.isfinite(values).all():
        needed = " or ".join(map(str, lengths))
        raise UsageError(f"{file}: {key} is not a matrix of {needed} numbers; download the file again")
    return values


def _open_pictures(folder: Path) -> tuple[OneVideoPairs | FolderPairs, bool]:
    """Open the images of the folder; also tells whether they are rectified."""
    if (folder / "data/rgb.mp4").is_file():
        video = Video(folder / "data/rgb.mp4")
        return OneVideoPairs(video, Layout(GeometryConfig(layout="over_under"))), False
    for left, right in RECTIFIED_FOLDERS:
        if (folder / left).is_dir():
            pictures = FolderPairs(folder / left, folder / right)
            names = [pictures.files[0].stem, pictures.files[-1].stem]
            numbers = [int(name[-6:]) if name[-6:].isdecimal() else -1 for name in names]
            if numbers != [0, pictures.count - 1]:
                raise UsageError(
                    f"{folder / left}: the images must be numbered like the poses, from 000000 without "
                    f"gaps, not {names[0]} to {names[1]}"
                )
            return pictures, True
    raise UsageError(
        f"{folder} holds neither data/rgb.mp4 nor left_rectified/ and right_rectified/; check the path, and "
        "that the keyframe has a video (keyframe_5 has none)"
    )


def _read_poses(folder: Path, count: int, left: Eye) -> F64 | None:
    """`T_world_cam` [N, 4, 4] m of the left rectified camera; the world is frame 0's camera. None if
    there are no files.

    `camera-pose` maps points from the keyframe's raw left camera to the raw left camera of the frame.
    """
    files = open_numbered(folder / "data/frame_data", ".json", LARGEST_JSON)
    if files is None:
        log.warning("%s has no data/frame_data: the camera is taken to stand still", folder)
        return None
    poses: list[F64] = []
    T_world_key, T_rectified_raw = np.eye(4), geometry.rigid(left.R, np.zeros(3))
    while len(poses) < count and (text := files.read(len(poses))) is not None:
        T_raw_key = _read_pose(text, f"{folder / 'data/frame_data'} {len(poses)}")
        if not poses:
            T_world_key = T_rectified_raw @ T_raw_key
        poses.append(T_world_key @ geometry.invert(T_rectified_raw @ T_raw_key))
    if len(poses) == count and files.read(count) is not None:
        log.warning("%s has poses of more than its %d images; were all of them copied?", folder, count)
    files.close()
    if not poses:
        raise UsageError(f"{folder / 'data/frame_data'} holds no frame_data000000.json; unpack it again")
    if len(poses) < count:
        log.warning("%s has poses for %d of %d frames; the rest is left out", folder, len(poses), count)
    return np.stack(poses)


def _read_pose(text: bytes, name: str) -> F64:
    try:
        pose = np.array(json.loads(text)["camera-pose"], np.float64)
    except (ValueError, TypeError, KeyError, OverflowError):
        raise UsageError(f"{name}: no JSON with a camera-pose of numbers; unpack it again") from None
    if pose.shape != (4, 4) or not np.isfinite(pose).all() or not geometry.is_rotation(pose[:3, :3]):
        raise UsageError(f"{name}: camera-pose is not a rotation and a translation [4, 4]; unpack it again")
    pose[:3, 3] *= METRES
    return pose
