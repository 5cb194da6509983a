"""Finds out whether images come rectified: they must not be rectified a second time."""

import re
from pathlib import Path

from sags_node.config import schema as cfg
from sags_node.rig import already_rectified, rectifies
from sags_node.sources.pictures import say
from sags_node.types import StereoRig

RECTIFIED, RAW = {"rect", "rectified"}, {"raw", "unrectified"}
NOT = {"not", "non", "un", "no"}
# Beside one of these words, rect means rectified, not rectum.
OF_PICTURES = {"image", "images", "img", "frames", "left", "right", "l", "r"}


def as_pictures_come(rig: StereoRig, config: cfg.LaunchConfig) -> StereoRig:
    """Return the rig for a session's images. If these come rectified, only P of the calibration holds.

    A calibration from files that hardly moves a pixel was made with rectified images: it stays as it is.
    """
    if not come_rectified(config):
        return rig
    return _rectified_with(rig) if config.rig is None or rectifies(rig) else rig


def as_named(rig: StereoRig, *names: Path) -> StereoRig:
    """Do as `as_pictures_come` for files or folders, by their names alone."""
    return _rectified_with(rig) if named_rectified(*names) and rectifies(rig) else rig


def _rectified_with(rig: StereoRig) -> StereoRig:
    """The rig for images that were rectified with it; warns if its files do not hold P."""
    if not rig.says_P:
        say(
            f"{rig.path} does not say how images were rectified: P of cv2.stereoRectify with alpha=0 is "
            "taken, and if theirs has another focal length, depth is wrong by as much; write R1 R2 P1 P2 of "
            "their rectification into one OpenCV file with the rest"
        )
    return already_rectified(rig)


def come_rectified(config: cfg.LaunchConfig) -> bool:
    """Tell whether a session's images are rectified: by the launch file, or else by names of the source."""
    source = config.source
    if config.rectified is not None:
        return config.rectified
    if isinstance(source, cfg.BagSource):
        from sags_node.sources.bags import find_eyes, read_contents

        return named_rectified(*find_eyes(source, read_contents(source.path)))
    if not isinstance(source, cfg.Ros2Source | cfg.FoldersSource | cfg.VideosSource):
        return False
    both = isinstance(source, cfg.Ros2Source) and source.geometry.layout != "separate"
    return named_rectified(source.left, *([] if both or source.right is None else [source.right]))


def named_rectified(*names: Path | str) -> bool:
    """Tell whether all these names of topics, folders or files say that images are rectified."""
    return bool(names) and all(_says_rectified(name) for name in names)


def _says_rectified(name: Path | str) -> bool:
    """Tell by the last part of a name that says raw or rectified. In a topic any part counts. In a path only
    the last one does, and its folder if that is named after images, not after a case."""
    parts = [
        _words(part) for part in (name.absolute().parts[-2:] if isinstance(name, Path) else name.split("/"))
    ]
    if isinstance(name, Path) and set(parts[0]) - OF_PICTURES - RECTIFIED - NOT:
        del parts[0]
    for words in reversed(parts):
        short = len(words) == 1 or OF_PICTURES & set(words)
        at = next(
            (k for k, word in enumerate(words) if word in RECTIFIED and (short or word != "rect")), None
        )
        if at is not None:
            return at == 0 or words[at - 1] not in NOT
        if RAW & set(words):
            return False
    return False


def _words(part: str) -> list[str]:
    return re.findall("[a-z]+", re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", part).lower())
