"""What a folder is, by the names of what lies in it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from sags_node.config import LaunchConfig
from sags_node.errors import UsageError
from sags_node.launch_file import VIDEO_SUFFIXES, load_launch
from sags_node.picture_header import SUFFIXES

EYES = (("left", "right"), ("l", "r"), ("image_left", "image_right"), ("left_rectified", "right_rectified"))
HAMLYN_EYES = (("image01", "image02"), ("image_0", "image_1"), ("images", "images_right"))
MASKS = ("masks", "mask", "tools", "toolmask", "tool_mask")
DEPTHS = ("depth", "depths", "depth01", "depth_mm_x100")


@dataclass(frozen=True, slots=True)
class Contents:
    """What was found; None: it is not there."""

    what: str
    play: str  # how, or why not yet
    left: Path | None = None  # folders of pictures
    right: Path | None = None
    masks: Path | None = None
    depth: Path | None = None
    config: LaunchConfig | None = None  # where it is played as it is


def recognise(folder: Path) -> Contents:
    """Say what a folder is.

    Raises:
        UsageError: it is no folder.
    """
    if not folder.is_dir():
        raise UsageError(f"{folder} is not a folder; give the one that holds the recording")
    try:
        config = load_launch(folder)
    except UsageError as error:
        if (folder / "launch.yaml").is_file():
            return Contents("a session whose launch.yaml is wrong", str(error))
    else:
        return _playable(folder, config)
    for is_one, contents in _KNOWN:
        if is_one(folder):
            return contents
    return _plain(folder)


def _playable(folder: Path, config: LaunchConfig) -> Contents:
    names = {
        "endonerf": "a clip in the layout of EndoNeRF",
        "scared": "a keyframe of SCARED",
        "bag": "a ROS recording",
        "dvrk": "a session of dVRK's recorder",
    }
    what = names.get(config.source.kind, f"a session with a launch.yaml, source.kind {config.source.kind}")
    left, right = (_folder_of(getattr(config.source, side, None)) for side in ("left", "right"))
    masks = _folder_of(getattr(config.source, "tools", None))
    if config.source.kind == "endonerf":
        right, masks = _first(folder, ("images_right",)), _first(folder, ("masks",))
        left = _first(folder, ("images",))
    play = f"sags run {folder}"
    return Contents(what, play, left, right, masks, _first(folder, DEPTHS), config)


def _plain(folder: Path) -> Contents:
    masks, depth = _first(folder, MASKS), _first(folder, DEPTHS)
    for left_name, right_name in (*EYES, *HAMLYN_EYES):
        left, right = _first(folder, (left_name,)), _first(folder, (right_name,))
        if left is not None and right is not None:
            play = f"sags run source.kind:=folders source.left:={left} source.right:={right}"
            tools = "" if masks is None else f" source.tools:={masks}"
            return Contents(
                "two folders of pictures", f"{play}{tools} rig:=CALIBRATION", left, right, masks, depth
            )
    videos = sorted(file for file in folder.iterdir() if file.suffix.lower() in VIDEO_SUFFIXES)
    if len(videos) == 1:
        play = (
            f"sags calib live source.kind:=videos source.left:={videos[0]} "
            "source.geometry.layout:=side_by_side (or over_under) shows whether both eyes are in it"
        )
        return Contents("one video", play)
    if videos:
        eyes = f"source.left:={videos[0]} source.right:={videos[1]}"
        play = f"sags run source.kind:=videos {eyes} rig:=CALIBRATION"
        return Contents(f"{len(videos)} videos", play)
    if has_pictures(folder):
        play = "put the pictures of each eye in a folder of its own, left/ and right/, and check again"
        return Contents("pictures in one folder", play, left=folder)
    below = sorted(each.name for each in folder.iterdir() if each.is_dir())
    play = f"check one of the folders in it: {', '.join(below[:8])}" if below else "give another folder"
    return Contents("nothing that is known", play)


def _is_stereomis(folder: Path) -> bool:
    return (folder / "groundtruth.txt").is_file() and (folder / "StereoCalibration.ini").is_file()


def _is_stir(folder: Path) -> bool:
    return any(folder.glob("left*/seq*/segmentation")) or any(folder.glob("*/left*/seq*/segmentation"))


_KNOWN: tuple[tuple[Callable[[Path], bool], Contents], ...] = (
    (
        _is_stereomis,
        Contents(
            "a sequence of StereoMIS",
            "sags eval --protocol stereomis FOLDER measures it; to play it, write a launch file with "
            "source.geometry.layout over_under (docs/protocols.md)",
        ),
    ),
    (
        _is_stir,
        Contents(
            "sequences of STIR",
            "sags eval --protocol stir FOLDER measures them; each leftNN/seqNN/frames/*.mp4 and its rightNN "
            "are source.kind videos (docs/protocols.md)",
        ),
    ),
)


def has_pictures(folder: Path) -> bool:
    return any(file.suffix.lower() in SUFFIXES for file in folder.iterdir() if file.is_file())


def _folder_of(value: object) -> Path | None:
    return value if isinstance(value, Path) and value.is_dir() else None


def _first(folder: Path, names: tuple[str, ...]) -> Path | None:
    by_name = {each.name.lower(): each for each in folder.iterdir() if each.is_dir()}
    return next((by_name[name] for name in names if name in by_name and has_pictures(by_name[name])), None)
