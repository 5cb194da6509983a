"""Reads clips in the layout of EndoNeRF (Wang et al., MICCAI 2022).

`images/` holds left images, `masks/` instruments, `depth/` a stereo network's depth, and `poses_bounds.npy`
the camera in LLFF form. What the files do not tell (rate, units, polarity of the masks) is a source option;
docs/recordings.md explains the defaults.
"""

from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from sags_node import geometry
from sags_node.checks import Finding, refuse_errors
from sags_node.config.schema import EndoNerfSource
from sags_node.errors import SagsError, UsageError
from sags_node.rig import check_intrinsics, rectified_rig
from sags_node.sources.pictures import FolderPairs, RawPair, pair_files, read_picture, size_text
from sags_node.sources.pose_axes import READINGS, Seen, reading_that_fits
from sags_node.sources.truth import UNKNOWN, judge_depth, load_npy
from sags_node.types import F32, F64, StereoRig

# Percentiles of a frame's known depths to which all depths are clipped, as in EndoGaussian's loader.
DEPTH_PERCENTILES = (3.0, 99.8)
PUBLISHED = (640, 512, 569.4682)  # px: width, height and focal length of the clips of EndoNeRF
PUBLISHED_BASELINE = 4.324e-3  # m, as their author states
NOMINAL_BASELINE = 0.005  # m, if there is no right image: then nothing depends on it


class Llff(NamedTuple):
    """The camera in `poses_bounds.npy`."""

    width: int  # px
    height: int
    focal: float  # px
    T_world_cam: F64  # [N, 4, 4] m, or its inverse; axes as in the file

    @property
    def K(self) -> F64:
        """The matrix [3, 3] px. Principal point: the image's middle; the first pixel's centre is (0, 0)."""
        x, y = (self.width - 1) / 2, (self.height - 1) / 2
        return np.array([[self.focal, 0, x], [0, self.focal, y], [0, 0, 1]])


class EndoNerfPairs(FolderPairs):
    """The frames of a clip, ordered by file name (numbers in names sort as numbers).

    Raises:
        UsageError: files are missing or do not fit each other, or the units or the masks cannot be right.
    """

    def __init__(self, config: EndoNerfSource) -> None:
        self._config, folder = config, config.folder
        right = None if baseline_of(config) is None else folder / "images_right"
        self._llff = read_llff(config)
        self._T_world_cam = self._llff.T_world_cam
        self._depth_files: list[Path] | None = None
        super().__init__(
            folder / "images", right, folder / "masks", instruments=config.instruments, numbered=True
        )
        self._check_camera(folder)
        if (folder / "depth").is_dir():
            pairs = pair_files((folder / "images", folder / "depth"), numbered=True)
            self._depth_files = [file for _, file in pairs]
            self._check_unit(self._depth_files[0])
        elif right is None:
            raise UsageError(
                f"{folder} holds no depth/; set source.baseline (m between the eyes) to measure depth from "
                "images/ and images_right/"
            )
        self._read_axes(config.pose_axes)

    def _read_axes(self, said: str) -> None:
        """Interpret the poses as the launch file says, or by the reading that explains the images."""
        poses, axes = self._llff.T_world_cam, said
        if said == "auto":
            has_depth = self._depth_files is not None
            fits = reading_that_fits(poses, self._llff.K, self._look) if has_depth else None
            axes = fits or "opencv"
        self._T_world_cam = READINGS[axes](poses)
        if said == "auto" and axes != "opencv":
            what = f"poses_bounds.npy: of two frames with depth the poses fit as {axes}, and are read so"
            fix = f"set source.pose_axes:={axes} if that is right, or opencv"
            self.judged = (Finding("warning", what, fix),)

    def _look(self, index: int) -> Seen:
        pair = self.at(index)
        assert pair is not None and pair.depth is not None and pair.tissue is not None  # `count` is checked
        return Seen(pair.left, pair.depth, pair.tissue)

    def at(self, index: int) -> RawPair | None:
        pair = super().at(index)
        if pair is None:
            return None
        depth = None if self._depth_files is None else self._read_depth(self._depth_files[index])
        return pair._replace(depth=depth, T_world_cam=self._T_world_cam[index])

    def _read_depth(self, file: Path) -> F32:
        """Depth [H, W] m, clipped to `DEPTH_PERCENTILES`; 0 where unknown (counts of 0 and 65535)."""
        counts = read_picture(file, cv2.IMREAD_UNCHANGED)
        if counts.ndim != 2:
            raise SagsError(
                f"{file} has {counts.shape[2]} channels; a depth image is a grey PNG of 8 or 16 bit"
            )
        if counts.shape[1::-1] != self.size:
            raise SagsError(
                f"{file} is {size_text(*counts.shape[1::-1])} px but the images are "
                f"{size_text(*self.size)}; all images of a clip must have one size"
            )
        known = (counts > 0) & (counts != UNKNOWN)
        if not known.any():
            return np.zeros(counts.shape, np.float32)
        near, far = np.percentile(counts[known], DEPTH_PERCENTILES)
        depth: F32 = np.where(known, np.clip(counts, near, far) * self._config.depth_unit, 0).astype(
            np.float32
        )
        return depth

    def _check_camera(self, folder: Path) -> None:
        file, llff = folder / "poses_bounds.npy", self._llff
        if len(llff.T_world_cam) != self.count:
            raise UsageError(
                f"{file} holds {len(llff.T_world_cam)} poses but {folder / 'images'} {self.count} images; "
                "there must be one pose for each image"
            )
        if self.size != (llff.width, llff.height):
            raise UsageError(
                f"{file} is for {size_text(llff.width, llff.height)} px but the images are "
                f"{size_text(*self.size)}; scale columns 4, 9, 14 (height, width, focal length)"
            )

    def _check_unit(self, file: Path) -> None:
        depth = self._read_depth(file)
        known = depth[depth > 0]
        if known.size == 0:
            return
        median, unit = float(np.median(known)), self._config.depth_unit
        if far := judge_depth(file, median, unit, "source.depth_unit"):
            self.oddities.append(far)
        elif "depth_unit" not in self._config.model_fields_set and not is_published(self._config):
            coarse = read_picture(file, cv2.IMREAD_UNCHANGED).dtype == np.uint8
            said = f"{file.parent}: {median * 1e3:.0f} mm (median) with {unit:g} m per count"
            self.oddities.append(
                f"{said}{', of only 8 bit' * coarse}, which the files do not say; ask who made them, and set "
                "source.depth_unit"
            )


def read_llff(config: EndoNerfSource) -> Llff:
    """Read `poses_bounds.npy`: [N, 17], per row a 3x5 matrix and two depth bounds.

    The matrix is [R | t | (height, width, focal length)]; see `pose_axes` for axes and direction.
    Translations are in the unit of `depth/`; the bounds are not used.

    Raises:
        UsageError: the file is missing, damaged, of another form, or its camera is implausible.
    """
    file = config.folder / "poses_bounds.npy"
    table = load_npy(file, (None, 17)).astype(np.float64)
    if not len(table) or not np.isfinite(table).all():
        raise UsageError(f"{file} holds no poses, or values that are not finite")
    matrices = table[:, :15].reshape(-1, 3, 5)
    if (matrices[:, :, 4] != matrices[0, :, 4]).any():
        raise UsageError(f"{file}: size and focal length must be the same for all frames")
    height, width, focal = int(matrices[0, 0, 4]), int(matrices[0, 1, 4]), float(matrices[0, 2, 4])
    poses = np.tile(np.eye(4), (len(table), 1, 1))
    llff = Llff(width, height, focal, poses)
    refuse_errors(check_intrinsics("camera", llff.K, width, height)[:1], file)  # fx and fy are one number
    poses[:, :3] = matrices[:, :, :4]
    wrong = ~geometry.is_rotation(poses[:, :3, :3])
    if wrong.any():
        raise UsageError(
            f"{file}: the pose of frame {int(np.argmax(wrong))} is not a rotation and a translation; a "
            "camera that does not move has the identity"
        )
    poses[:, :3, 3] *= config.depth_unit
    return llff


def read_rig(config: EndoNerfSource) -> StereoRig:
    """Return the clip's calibration: one focal length, principal point in the middle.

    Raises:
        UsageError: as `read_llff`.
    """
    llff, baseline = read_llff(config), baseline_of(config) or NOMINAL_BASELINE
    return rectified_rig(config.folder.name, llff.width, llff.height, llff.K, baseline)


def baseline_of(config: EndoNerfSource) -> float | None:
    """Return the baseline, m; None: it is unknown, and right images are not used.

    Raises:
        UsageError: as `read_llff`.
    """
    if config.baseline is not None or not (config.folder / "images_right").is_dir():
        return config.baseline
    return PUBLISHED_BASELINE if is_published(config) else None


def is_published(config: EndoNerfSource) -> bool:
    """Tell by its camera whether a clip is one of EndoNeRF's own, whose unit and baseline are published.

    Raises:
        UsageError: as `read_llff`.
    """
    width, height, focal, _ = read_llff(config)
    return (width, height, round(focal, 4)) == PUBLISHED
