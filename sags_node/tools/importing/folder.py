"""What a folder is, by the names of what lies in it."""

import json
import re
import shlex
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from sags_node.config.launch_file import VIDEO_SUFFIXES, is_launch, known_recording, load_launch
from sags_node.config.schema import LaunchConfig
from sags_node.config.yaml_reader import parse_yaml
from sags_node.errors import UsageError
from sags_node.files import SHOWN, check_name
from sags_node.media.picture_file import SUFFIXES
from sags_node.rig import find_form, is_opencv
from sags_node.sources.names import EYE

EYES = (("left", "right"), ("l", "r"), ("image_left", "image_right"), ("left_rectified", "right_rectified"))
HAMLYN_EYES = (("image01", "image02"), ("images", "images_right"))
KITTI_EYES = (
    ("image_0", "image_1"),
    ("image_2", "image_3"),
    ("image_00", "image_01"),
    ("image_02", "image_03"),
)
MASKS = ("masks", "mask", "tools", "toolmask", "tool_mask")
LAUNCH_SUFFIXES = (".yaml", ".yml")
SEEMS = re.compile(
    r"calib|(in|ex)trinsic|camchain|camera_?(info|param)|stereo_?param|^(ost|cam\w*)\.ya?ml$", re.I
)
CALIBRATIONS = (".", "calib", "calibration", "camera", "rig")
DEPTHS = ("depth", "depths", "depth01", "depth_mm_x100")


@dataclass(frozen=True, slots=True)
class Contents:
    """What was found; None: it is not there."""

    what: str
    instead: str = ""  # what to do where it is not played as it is
    level: Literal["ok", "error"] = "ok"  # error: nothing can be made of it as it is
    left: Path | None = None  # folders of images
    right: Path | None = None
    masks: Path | None = None
    depth: Path | None = None
    config: LaunchConfig | None = None  # where it is played as it is
    videos: tuple[Path, ...] = ()  # of both eyes, or one that may show both
    launch: tuple[str, ...] = ()  # `key:=value` that play two folders of images


def recognise(folder: Path) -> Contents:
    """Say what a folder, or a video, is.

    Raises:
        UsageError: it is neither.
    """
    if not folder.exists():
        raise UsageError(f"{folder} does not exist; check the path")
    check_name(folder)
    if is_video(folder):
        return Contents("one video", videos=(folder,))
    if not folder.is_dir() and folder.suffix not in LAUNCH_SUFFIXES and known_recording(folder) is None:
        raise UsageError(f"{folder} is neither a folder nor a video; give the one that holds the recording")
    try:
        config = load_launch(folder)
    except UsageError as error:
        if is_launch(folder):
            return Contents("a session whose launch.yaml is wrong", str(error), "error")
    else:
        return _playable(folder, config)
    for needed, what, instead in _KNOWN:
        if all(any(any(folder.glob(pattern)) for pattern in one_of) for one_of in needed):
            return Contents(what, instead.format(folder=shlex.quote(str(folder))), "error")
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
    return Contents(what, "", "ok", left, right, masks, _first(folder, DEPTHS), config)


def _plain(folder: Path) -> Contents:
    masks, depth = _first(folder, MASKS), _first(folder, DEPTHS)
    eyes = _eye_folders(folder)
    if eyes is not None:
        left, right = eyes
        launch = ("source.kind:=folders", override("source.left", left), override("source.right", right))
        tools = () if masks is None else (override("source.tools", masks),)
        return Contents(
            "two folders of images", "", "ok", left, right, masks, depth, launch=(*launch, *tools)
        )
    videos = sorted(file for file in folder.glob(SHOWN) if is_video(file))
    if videos:
        what = "one video" if len(videos) == 1 else f"{len(videos)} videos"
        of_eyes = _eye_videos(videos)
        if len(of_eyes) > 2:
            what += ", whose names do not tell which are the eyes of one recording"
            both = "name both: sags new LEFT RIGHT -o FILE.yaml, or leave only them in the folder"
            return Contents(what, f"{both}. Parts of one recording are played one by one", "error")
        return Contents(what, videos=of_eyes)
    if has_pictures(folder):
        apart = both_eyes(folder)
        both = f" of both eyes, {len(apart)} pairs," if apart else ""
        instead = "put the images of each eye in a folder of its own, left/ and right/, and check again"
        return Contents(f"images{both} in one folder", instead, "error", left=folder)
    below = sorted(each.name for each in folder.iterdir() if each.is_dir())
    if not below:
        what = (
            "a folder without images, videos or a recording" if any(folder.iterdir()) else "an empty folder"
        )
        return Contents(what, "give the folder that holds the recording", "error")
    instead = f"check one of the folders in it: {', '.join(below[:8])}"
    if len(likely := [name for name in below if has_pictures(folder / name)]) > 1:
        instead = (
            f"name those of both eyes, the left one first: sags new LEFT RIGHT, of {', '.join(likely[:8])}"
        )
    return Contents("nothing that is known", instead, "error")


def _eye_folders(folder: Path) -> tuple[Path, Path] | None:
    """The folders of both eyes, by usual names, else by names that differ only in the eye, as `cam_left`."""
    for left_name, right_name in (*EYES, *HAMLYN_EYES, *KITTI_EYES):
        left, right = _first(folder, (left_name,)), _first(folder, (right_name,))
        if left is not None and right is not None:
            return left, right
    by_name = {each.name: each for each in folder.iterdir() if each.is_dir() and has_pictures(each)}
    named = [(by_name[left], by_name[right]) for left, right in _pairs(by_name)]
    return named[0] if len(named) == 1 else None


def _eye_videos(videos: list[Path]) -> tuple[Path, ...]:
    """The left and the right video, if the names tell which they are; else all."""
    by_name = {file.stem: file for file in videos}
    named = [(by_name[left], by_name[right]) for left, right in _pairs(by_name)]
    return named[0] if len(named) == 1 else tuple(videos)


def both_eyes(folder: Path) -> list[tuple[Path, Path]]:
    """Images of left and right eye in one folder, as `left_001.png` and `right_001.png`; no masks."""
    by_name = {
        file.name: file
        for file in sorted(folder.glob(SHOWN))
        if file.suffix.lower() in SUFFIXES and file.is_file() and "mask" not in file.name.lower()
    }
    return [(by_name[left], by_name[right]) for left, right in _pairs(by_name)]


def _pairs(names: Iterable[str]) -> list[tuple[str, str]]:
    """Names that differ in nothing but the eye: a word `left` or `l` where the other has `right` or `r`."""
    eyes: dict[str, dict[str, str]] = {}
    for name in names:
        for match in EYE.finditer(name):
            rest = f"{name[: match.start()]}*{len(match[0])}*{name[match.end() :]}".replace("*5*", "*4*")
            eyes.setdefault(rest, {})[match[0][0].lower()] = name
    return [(found["l"], found["r"]) for found in eyes.values() if len(found) == 2]


def calibration_of(folder: Path) -> Path | None:
    """Find the calibration beside the images, in a folder of a usual name or with them."""
    places = [place for name in CALIBRATIONS if (place := folder / name).is_dir()]
    known = next((place for place in places if find_form(place) is not None), None)
    files = [file for place in places for file in place.glob(SHOWN) if is_opencv(file)]
    named = [file for file in files if file.parent != folder or "calib" in file.stem.lower()]
    return named[0] if known is None and len(named) == 1 else known


def seem_calibrations(folder: Path) -> list[Path]:
    """Files in a folder, and in the folders there, that by name or content seem to be a calibration."""
    files = [*folder.glob(SHOWN), *folder.glob(f"{SHOWN}/{SHOWN}")]
    named = [file for file in files if is_opencv(file) or (SEEMS.search(file.name) and file.is_file())]
    return sorted(file for file in named if file.suffix.lower() not in (*SUFFIXES, *VIDEO_SUFFIXES))


def is_video(file: Path) -> bool:
    """Tell whether this is a file with the suffix of a video."""
    return file.suffix.lower() in VIDEO_SUFFIXES and file.is_file()


def override(key: str, path: Path | str) -> str:
    """The override `key:=path`, quoted where YAML would read the path as something else."""
    plain = f"{key}:={path}"
    with suppress(UsageError):
        if parse_yaml(str(path), plain) == str(path):
            return plain
    return f"{key}:={json.dumps(str(path))}"


_KNOWN: tuple[tuple[tuple[tuple[str, ...], ...], str, str], ...] = (
    # Data sets that are not played as they are. A folder is one if a pattern of each group matches.
    (
        (("track_pts.*",),),
        "a sequence of StereoMIS-Tracking",
        "sags eval --protocol stereomis {folder} follows its points (docs/evaluation.md)",
    ),
    (
        (("left_images_rect", *(f"{depth}clips/*/left_images_rect" for depth in ("", "*/", "*/*/"))),),
        "clips of D4D",
        "sags eval --protocol d4d {folder} measures them; to play one, give its left_images_rect and "
        "right_images_rect as source.kind folders (docs/evaluation.md)",
    ),
    (
        (("groundtruth.txt",), ("StereoCalibration.ini",)),
        "a sequence of StereoMIS",
        "sags eval --protocol stereomis {folder} measures it; to play it, write a launch file with "
        "source.geometry.layout over_under (docs/evaluation.md)",
    ),
    (
        (("left*/seq*/segmentation", "*/left*/seq*/segmentation"),),
        "sequences of STIR",
        "sags eval --protocol stir {folder} measures them; each leftNN/seqNN/frames/*.mp4 and its rightNN "
        "are source.kind videos (docs/evaluation.md)",
    ),
)


def has_pictures(folder: Path) -> bool:
    return any(file.suffix.lower() in SUFFIXES for file in folder.glob(SHOWN) if file.is_file())


def _folder_of(value: object) -> Path | None:
    return value if isinstance(value, Path) and value.is_dir() else None


def _first(folder: Path, names: tuple[str, ...]) -> Path | None:
    by_name = {each.name.lower(): each for each in folder.glob("*") if each.is_dir()}
    return next((by_name[name] for name in names if name in by_name and has_pictures(by_name[name])), None)
