"""D4D's files (Docea et al., arXiv 2603.02985): which images, which calibration, which surface.

By the README and the loader of its authors (github.com/reubendocea/d4d): lengths are metres, and a curated
pose maps points of the left rectified camera into the frame of the structured light. Which colour of a mask
is the instrument is not said there.
"""

import json
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from sags_node import geometry
from sags_node.config.yaml_reader import read_yaml
from sags_node.errors import SagsError, UsageError
from sags_node.files import read_file
from sags_node.sources.pictures import list_pictures, read_picture
from sags_node.types import F64, Bool, Eye, StereoRig

LARGEST_JSON = 64 << 20  # bytes
BASELINES = (1e-3, 50e-3)  # m: outside, the calibration is not in metres
LOOKED_AT = 8  # masks, at most
UNSURE = (0.4, 0.6)  # share of an image that is white: it does not tell which colour is the instrument
MOVED = (5e-3, 3.0)  # m and degrees between the curated poses of a clip; beyond, the endoscope was moved
DEFAULT_RATE = 15.0  # Hz, where names are no stamps


@dataclass(frozen=True, slots=True)
class Scan:
    """The surface as structured light saw it, just before a clip (`start`) or just after it (`end`)."""

    when: str
    cloud: Path  # .ply
    pose: Path
    T_cloud_cam: F64  # [4, 4] m, of the left rectified camera
    tools: Path | None  # mask over the scanner's image; None: there is none
    scanner: Path  # its camera_info


@dataclass(frozen=True, slots=True)
class D4dClip:
    name: str  # specimen/session/clip
    left: Path  # folders of rectified images
    right: Path
    rig: StereoRig
    rate: float  # Hz
    masks: dict[int, Path]  # by number of the frame
    scans: tuple[Scan, ...]
    stereo: tuple[Path, ...]  # depth [H, W] m of each frame by the set's own stereo; empty: there is none

    @property
    def is_moved(self) -> bool:
        """Whether the endoscope was moved in the clip, by its curated poses."""
        if len(self.scans) < 2:
            return False
        step = geometry.invert(self.scans[0].T_cloud_cam) @ self.scans[1].T_cloud_cam
        turned = np.degrees(np.arccos(np.clip((np.trace(step[:3, :3]) - 1) / 2, -1, 1)))
        return bool(np.linalg.norm(step[:3, 3]) > MOVED[0] or turned > MOVED[1])


# ---- which clips -----------------------------------------------------------------------------------------


def d4d_clips(folder: Path) -> list[D4dClip]:
    """Return all clips with a scan below a folder: of the whole set, a specimen, a session, or one clip.

    Raises:
        UsageError: there are none, or a file is missing or wrong.
    """
    if (folder / "left_images_rect").is_dir():
        session = folder.resolve().parent.parent
        wanted = [(session, folder.resolve().name)]
    else:
        tables = chain.from_iterable(folder.glob("*/" * depth + "clips.json") for depth in range(4))
        sessions = sorted({file.parent.resolve() for file in tables if "ambiguous" not in str(file.parent)})
        wanted = [(session, name) for session in sessions for name in _clips_of(session)]
    clips = [_clip(session, name) for session, name in wanted if (session / "clips" / name).is_dir()]
    if not any(clip.scans for clip in clips):
        raise UsageError(
            f"{folder} holds no clip of D4D with a scan: clips.json, pointcloud/ and "
            "clips/Clip_1/curated_camera_pose_start.txt; give the data set's folder, a specimen, a session "
            "or a clip"
        )
    return [clip for clip in clips if clip.scans]


def _clips_of(session: Path) -> dict[str, dict[str, Any]]:
    """What clips.json says of each clip."""
    file = session / "clips.json"
    try:
        rows = json.loads(read_file(file, LARGEST_JSON))["clips"]
        return {str(row["name"]): dict(row) for row in rows}
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UsageError(f"{file} is no table of D4D's clips ({error}); download it again") from None


def _clip(session: Path, name: str) -> D4dClip:
    folder = session / "clips" / name
    said = _clips_of(session).get(name, {})
    left, right = folder / "left_images_rect", folder / "right_images_rect"
    pictures = list_pictures(left)
    stereo = sorted((folder / "stereo_depth").glob("*.npy"))
    return D4dClip(
        "/".join((*session.parts[-2:], name)),
        left,
        right,
        _rig(folder, session),
        _rate(pictures),
        _masks(folder / "left_images_rect_masks", pictures),
        tuple(scan for when in ("start", "end") if (scan := _scan(session, folder, said, when)) is not None),
        tuple(stereo) if len(stereo) == len(pictures) else (),
    )


def _scan(session: Path, folder: Path, said: dict[str, Any], when: str) -> Scan | None:
    geometry_of, pose = said.get(f"{when}_geometry"), folder / f"curated_camera_pose_{when}.txt"
    if not isinstance(geometry_of, str) or not pose.is_file() or not (session / geometry_of).is_file():
        return None
    tools = [file for file in sorted((folder / "zivid_masks").glob("*.png")) if when in file.stem.lower()]
    return Scan(
        when,
        session / geometry_of,
        pose,
        _read_pose(pose),
        tools[0] if len(tools) == 1 else None,
        session / "camera_info/color_camera_info.yaml",
    )


def _read_pose(file: Path) -> F64:
    try:
        pose = np.array(read_file(file, LARGEST_JSON).split(), np.float64).reshape(4, 4)
    except (OSError, ValueError):
        raise UsageError(f"{file} is no pose: 16 numbers, a matrix [4, 4]; download it again") from None
    if not np.isfinite(pose).all() or not geometry.is_rotation(pose[:3, :3]):
        raise UsageError(f"{file} is no pose: its upper left 3x3 numbers are no rotation; download it again")
    return pose


def _rate(pictures: list[Path]) -> float:
    """Frames per second of images named `seconds_nanoseconds`."""
    stamps = [file.stem.split("_") for file in pictures]
    if len(stamps) < 2 or not all(len(each) == 2 and "".join(each).isdecimal() for each in stamps):
        return DEFAULT_RATE
    step = float(np.median(np.diff([int(seconds) + 1e-9 * int(rest) for seconds, rest in stamps])))
    return 1 / step if step > 0 else DEFAULT_RATE


def _masks(folder: Path, pictures: list[Path]) -> dict[int, Path]:
    """Masks by number of the frame: those named as images, else, if as many, in order."""
    files = sorted(folder.glob("*.png"))
    stems = {file.stem: file for file in files}
    named = {number: stems[file.stem] for number, file in enumerate(pictures) if file.stem in stems}
    return named or (dict(enumerate(files)) if len(files) == len(pictures) else {})


# ---- calibration -----------------------------------------------------------------------------------------


def _rig(folder: Path, session: Path) -> StereoRig:
    """The rig of rectified images, by the projection matrices of the clip, else of its session."""
    places = ((folder, "{}_rect*.yaml"), (folder, "{}.yaml"), (session, "{}.yaml"))
    files = []
    for side in ("left", "right"):
        found = chain.from_iterable(
            sorted((place / "camera_info").glob(name.format(side))) for place, name in places
        )
        file = next(found, None)
        if file is None:
            raise UsageError(
                f"{folder / 'camera_info'} holds no {side}_rect.yaml, nor its session {side}.yaml"
            )
        files.append(file)
    read = [_camera_info(file) for file in files]
    (width, height, P_left), (_, _, P_right) = read
    baseline = abs(P_right[0, 3] / P_right[0, 0] - P_left[0, 3] / P_left[0, 0])
    if not BASELINES[0] <= baseline <= BASELINES[1]:
        raise UsageError(
            f"{files[1]} puts the eyes {baseline * 1e3:.3g} mm apart, possible are {BASELINES[0] * 1e3:g} to "
            f"{BASELINES[1] * 1e3:g}; P is in metres times pixels"
        )
    eyes = []
    for P, shift in ((P_left, 0.0), (P_right, baseline)):  # `placed` has the left principal point for both
        placed = np.column_stack([P_left[:, :3], [-P_left[0, 0] * shift, 0, 0]])
        eyes.append(Eye(width, height, P[:, :3], np.zeros(5), np.eye(3), placed))
    return StereoRig(folder.name, *eyes)


def _camera_info(file: Path) -> tuple[int, int, F64]:
    """Width and height, px, and P [3, 4]."""
    said = read_yaml(file, "calibration")
    try:
        width, height = (
            int(said[f"image_{side}"] if f"image_{side}" in said else said[side])
            for side in ("width", "height")
        )
        return width, height, matrix_in(said, "P", "projection_matrix", (3, 4))
    except (KeyError, TypeError, ValueError) as error:
        raise UsageError(f"{file} is no camera_info file ({error}); download it again") from None


def matrix_in(said: dict[str, Any], short: str, long: str, shape: tuple[int, int]) -> F64:
    """Return a matrix of a camera_info file, by either of its names.

    Raises:
        KeyError, TypeError, ValueError: it is missing or wrong.
    """
    value = said[long] if long in said else said[short]
    matrix = np.array(value["data"] if isinstance(value, dict) else value, np.float64).reshape(shape)
    if not np.isfinite(matrix).all() or matrix[0, 0] <= 0:
        raise ValueError(f"{long} is none")
    return matrix


# ---- masks -----------------------------------------------------------------------------------------------


def instruments_are_white(masks: list[Path]) -> bool | None:
    """Tell whether white is the instrument in masks: the colour that covers less is. None without masks.

    Raises:
        SagsError: about half of the images is white, or a mask cannot be read.
    """
    if not masks:
        return None
    chosen = masks[:: max(1, -(-len(masks) // LOOKED_AT))]
    share = float(np.median([np.mean(read_picture(file, cv2.IMREAD_GRAYSCALE) > 0) for file in chosen]))
    if UNSURE[0] < share < UNSURE[1]:
        raise SagsError(
            f"{masks[0].parent}: {share:.0%} of the masks is white: it is not clear which colour "
            "is the instrument; take the folder of masks away, and instruments are found by colour"
        )
    return share <= UNSURE[0]


def read_tools(file: Path, white: bool) -> Bool:
    """Read where a mask marks an instrument, [H, W].

    Raises:
        SagsError: it cannot be read.
    """
    marked: Bool = (read_picture(file, cv2.IMREAD_GRAYSCALE) > 0) == white
    return marked
