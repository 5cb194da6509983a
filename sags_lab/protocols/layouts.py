"""STIR's and StereoMIS's files: which images, which calibration, which truth."""

import configparser
import json
import sys
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

import cv2
import numpy as np

from sags_lab.protocols.arithmetic import stereo_points_mm
from sags_node import geometry
from sags_node.errors import SagsError, UsageError
from sags_node.files import read_file
from sags_node.media.video import Video
from sags_node.rig import fit_distortion, rectify_eyes
from sags_node.sources.pictures import read_picture
from sags_node.types import F64, I64, Bool, StereoRig

LARGEST_TEXT = 64 << 20  # bytes
ROWS_APART, LEAST_PX, MOST_PX = 10, 8, 105  # px, row and disparity of two marks of STIR that may be one
COEFFICIENTS = 8  # of distortion, for each eye in StereoCalibration.ini
# In calib.json: intrinsics, distortion, rotation and translation.
STIR_NAMES = ("{}cameramat", "{}distortioncoeffs", "rotation", "translation")
STIR_NAMES_2026 = ("K_{}", "D_{}", "R_left_to_right", "t_left_to_right")


@dataclass(frozen=True, slots=True)
class StirClip:
    """One sequence of STIR."""

    name: str  # as its evaluator names it: leftNN/seqNN
    left: Path  # videos
    right: Path
    rig: StereoRig
    starts: F64  # [P, 2] px of the first left image
    ends: F64  # [E, 2] px of the last one, in no order
    starts_mm: F64  # [P3, 3] of those that are marked in the right image too, in the left camera
    ends_mm: F64  # [E3, 3]


def stir_clips(folder: Path) -> list[StirClip]:
    """Return all labelled sequences below a folder: of the whole set, one experiment, or one sequence.

    Raises:
        UsageError: there are none, or a file is missing or wrong.
    """
    below = (folder.glob(pattern) for pattern in ("seq*", "left*/seq*", "*/left*/seq*"))
    found = {
        each.resolve()
        for each in (folder, *chain.from_iterable(below))
        if (each / "segmentation/icgstartseg.png").is_file() and "left" in each.resolve().parent.name
    }
    if not found:
        raise UsageError(
            f"{folder} holds no leftNN/seqNN/segmentation/icgstartseg.png of STIR; give the data set's "
            "folder, one experiment in it, or one seqNN"
        )
    return [clip for each in sorted(found) if (clip := _stir_clip(each)) is not None]


def _stir_clip(left: Path) -> StirClip | None:
    """Read a sequence; None where nothing is marked: STIR's evaluator skips such sequences."""
    right = left.parent.with_name(left.parent.name.replace("left", "right", 1)) / left.name
    left_video, right_video = _one_video(left / "frames"), _one_video(right / "frames")
    marked = (left / f"segmentation/icg{when}seg.png" for when in ("start", "end"))
    starts, ends = (_middles(_boxes(file)).astype(np.float64) for file in marked)
    if not len(starts) or not len(ends):
        return None
    name = f"{left.parent.name}/{left.name}"
    rig = stir_rig(left.parent.parent / "calib.json", Video(left_video).size)
    starts_mm, ends_mm = (marked_in_both(left, right, when, rig) for when in ("start", "end"))
    return StirClip(name, left_video, right_video, rig, starts, ends, starts_mm, ends_mm)


def _one_video(folder: Path) -> Path:
    videos = sorted(folder.glob("*.mp4"))
    if len(videos) != 1:
        raise UsageError(f"{folder} holds {len(videos)} .mp4 files; a sequence of STIR has one for each eye")
    return videos[0]


def _boxes(file: Path) -> I64:
    """Boxes around what is marked, [P, 4]: x, y, width and height, px."""
    marked = read_picture(file, cv2.IMREAD_GRAYSCALE)
    contours, _ = cv2.findContours(marked, cv2.RETR_TREE, cv2.CHAIN_APPROX_SIMPLE)
    return np.array([cv2.boundingRect(contour) for contour in contours], np.int64).reshape(-1, 4)


def _middles(boxes: I64) -> I64:
    """Middles of boxes [P, 2] px, rounded down as by STIR's evaluator."""
    return boxes[:, :2] + boxes[:, 2:] // 2


def marked_in_both(left: Path, right: Path, when: str, rig: StereoRig) -> F64:
    """Return points [P, 3] mm that are marked in both eyes; none where the right eye's marks or an infrared
    image are missing.

    Marks are paired as STIR's loader pairs them: of those whose row and disparity are possible, it takes the
    one whose infrared patch correlates *least* with the left one's. That may be a slip, but published truth
    is made so; it matters only where several are possible.
    """
    marks = [folder / f"segmentation/icg{when}seg.png" for folder in (left, right)]
    infrared = [next(iter(sorted(folder.glob(f"*_icg{when}.png"))), None) for folder in (left, right)]
    if not marks[1].is_file() or infrared[0] is None or infrared[1] is None:
        return np.empty((0, 3))
    pictures = [read_picture(file).astype(np.float64) for file in infrared if file is not None]
    width, offset = pictures[1].shape[1], rig.right.K[0, 2] - rig.left.K[0, 2]
    theirs, pairs = _middles(_boxes(marks[1])), []
    for box, middle in zip(boxes := _boxes(marks[0]), _middles(boxes), strict=True):
        x, y, w, h = box
        patch = pictures[0][y : y + h, x : x + w]
        found = []
        for candidate in theirs:
            disparity = middle[0] + offset - candidate[0]
            first = candidate[0] - w // 2
            apart = abs(candidate[1] - middle[1])
            if apart <= ROWS_APART and LEAST_PX <= disparity <= MOST_PX and first >= 0 and first + w <= width:
                found.append((_correlation(patch, pictures[1][y : y + h, first : first + w]), candidate[0]))
        if found:
            pairs.append((*middle, min(found)[1]))
    points = np.array(pairs, np.float64).reshape(-1, 3)
    return as_stir_counts(rig, points[:, :2], points[:, 2:])


def as_stir_counts(rig: StereoRig, left: F64, right: F64) -> F64:
    """Return points [P, 3] mm of pixels [P, 2] of both raw images, by the arithmetic of STIR's truth."""
    baseline_mm = 1e3 * abs(float(rig.T_right_left[0, 3]))
    return stereo_points_mm(left, right, rig.left.K, rig.right.K, baseline_mm)


def _correlation(a: F64, b: F64) -> float:
    """Zero-mean normalised cross-correlation; 0 where a patch is uniform."""
    spread = float(a.std() * b.std())
    return float(np.mean((a - a.mean()) * (b - b.mean()))) / spread if spread > 0 else 0.0


def stir_rig(file: Path, size: tuple[int, int]) -> StereoRig:
    """Read `calib.json` of any year, in metres. Its transform is from left to right or the inverse, as the
    sign of x tells.

    Args:
        size: width and height of the images, px.

    Raises:
        UsageError: it is missing or no calibration.
    """
    try:
        said = json.loads(read_file(file, LARGEST_TEXT))
        matrix, lens, turn, way = STIR_NAMES_2026 if "K_left" in said else STIR_NAMES
        K = [np.array(said[matrix.format(side)], np.float64).reshape(3, 3) for side in ("left", "right")]
        lenses = [np.array(said[lens.format(side)], np.float64).ravel() for side in ("left", "right")]
        R = np.array(said[turn], np.float64).reshape(3, 3)
        T = np.array(said[way], np.float64).reshape(3)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UsageError(f"{file} is no calibration of STIR ({error}); download it again") from None
    T = T if T[0] < 0 else -R.T @ T  # the right eye sees points farther to the left
    R = R if T[0] < 0 else R.T
    distortion = fit_distortion(lenses[0], str(file)), fit_distortion(lenses[1], str(file))
    return rectify_eyes("stir", size, (K[0], K[1]), distortion, R, T)


@dataclass(frozen=True, slots=True)
class StereoMisSequence:
    """One folder of StereoMIS, `P1` to `P3_...`."""

    video: Path  # the left image above the right one
    rig: StereoRig
    frames: tuple[int, ...]  # numbers of frames whose poses are known
    poses: F64  # [len(frames), 4, 4] T_world_cam of the left raw camera, m
    ranges: tuple[range, ...]  # of frames; each range is measured by itself
    masks: Path | None  # folder of `NNNNNNl.png`, not black where it is tissue; None: there are none

    def tissue_in(self, frame: int) -> Bool | None:
        """Return where the raw left image of a frame shows tissue, [H, W]; None: it has no mask.

        Raises:
            SagsError: the mask is damaged, or of another size than the image.
        """
        file = None if self.masks is None else self.masks / f"{frame:06d}l.png"
        if file is None or not file.is_file():
            return None
        mask = read_picture(file, cv2.IMREAD_GRAYSCALE)
        if mask.shape != (self.rig.left.height, self.rig.left.width):
            raise SagsError(
                f"mask {file} is {mask.shape[1]}x{mask.shape[0]} px, its image "
                f"{self.rig.left.width}x{self.rig.left.height}; was one of them resized?"
            )
        return mask > 0


def stereomis_sequence(folder: Path) -> StereoMisSequence:
    """Read one sequence.

    Raises:
        UsageError: a file is missing or wrong.
    """
    videos = sorted(folder.glob("*.mp4"))
    if len(videos) != 1:
        raise UsageError(f"{folder} holds {len(videos)} .mp4 files; a sequence of StereoMIS has one")
    rig = _stereomis_rig(folder / "StereoCalibration.ini")
    frames, poses = read_tum(folder / "groundtruth.txt")
    masks = folder / "masks"
    return StereoMisSequence(
        videos[0],
        rig,
        tuple(round(frame) for frame in frames),
        poses,
        _ranges(folder / "test_split.csv"),
        masks if masks.is_dir() else None,
    )


def _ranges(file: Path) -> tuple[range, ...]:
    """Ranges of the table: headings, then lines with first and last frame; all frames without a table."""
    if not file.is_file():
        return (range(sys.maxsize),)
    try:
        rows = [line.split(",") for line in read_file(file, LARGEST_TEXT).decode().splitlines()[1:] if line]
        ranges = tuple(range(int(row[0]), int(row[1]) + 1) for row in rows)
    except (OSError, ValueError, IndexError) as error:
        raise UsageError(
            f"{file} is no table of ranges ({error}): a heading, then `first,last` lines"
        ) from None
    if not ranges or not all(ranges):
        raise UsageError(f"{file} holds no frames: a heading, then `first,last` lines")
    return ranges


def read_tum(file: Path) -> tuple[F64, F64]:
    """Read stamps [T] and poses [T, 4, 4] m, in TUM format: `stamp tx ty tz qx qy qz qw`, # begins comments.

    Raises:
        UsageError: it is missing, or holds something else.
    """
    try:
        text = read_file(file, LARGEST_TEXT).decode()
        rows = [line.split() for line in text.splitlines() if line.strip() and not line.startswith("#")]
        table = np.array(rows, np.float64)
    except (OSError, ValueError) as error:
        raise UsageError(f"{file} is no TUM trajectory ({error}): stamp tx ty tz qx qy qz qw") from None
    if table.ndim != 2 or table.shape[1] != 8 or not np.isfinite(table).all():
        raise UsageError(f"{file} is no TUM trajectory: a line is stamp tx ty tz qx qy qz qw")
    if (np.linalg.norm(table[:, 4:], axis=1) < 0.5).any():
        raise UsageError(f"{file} holds quaternions of length 0; export the trajectory again")
    poses = np.tile(np.eye(4), (len(table), 1, 1))
    poses[:, :3, :3] = geometry.quat_to_matrix(table[:, [7, 4, 5, 6]])
    poses[:, :3, 3] = table[:, 1:4]
    return table[:, 0], poses


def _stereomis_rig(file: Path) -> StereoRig:
    """Read `StereoCalibration.ini`: sections StereoLeft and StereoRight; `T_` in mm, from left to right."""
    parser = configparser.ConfigParser()
    try:
        parser.read_string(read_file(file, LARGEST_TEXT).decode())
        eyes = [parser[name] for name in ("StereoLeft", "StereoRight")]
        size = int(float(eyes[0]["res_x"])), int(float(eyes[0]["res_y"]))
        K, lenses = [], []
        for eye in eyes:
            fx, fy, cx, cy = (float(eye[key]) for key in ("fc_x", "fc_y", "cc_x", "cc_y"))
            K.append(np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]))
            lenses.append(np.array([float(eye.get(f"kc_{k}", "0")) for k in range(COEFFICIENTS)]))
        R = np.array([float(eyes[1][f"R_{number}"]) for number in range(9)]).reshape(3, 3)
        T = np.array([float(eyes[1][f"T_{number}"]) for number in range(3)]) * 1e-3
    except (OSError, ValueError, KeyError, configparser.Error) as error:
        raise UsageError(f"{file} is no calibration of StereoMIS ({error}); download it again") from None
    distortion = fit_distortion(lenses[0], str(file)), fit_distortion(lenses[1], str(file))
    return rectify_eyes(file.parent.name, size, (K[0], K[1]), distortion, R, T)


def check_sizes(video: Video, rig: StereoRig) -> None:
    """Raise SagsError where an image, both eyes one above the other, is not of the calibration's size."""
    wanted = rig.left.width, 2 * rig.left.height
    if video.size != wanted:
        raise SagsError(f"{video.path} is {video.size} px, its calibration is for {wanted}; is it resized?")
