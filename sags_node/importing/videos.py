"""What is odd about the videos of a recording, and how the pictures of one show both eyes."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from sags_node.calibration.matches import match_eyes
from sags_node.calibration.pictures import Pair
from sags_node.config.schema import GeometryConfig
from sags_node.errors import SagsError
from sags_node.importing import pictures
from sags_node.importing.timing import check_timing
from sags_node.rig import Finding
from sags_node.sources.layout import Layout
from sags_node.sources.pictures import size_text
from sags_node.sources.videos import Video, VideoPairs
from sags_node.types import U8

LOOKED_AT = 4  # pictures, spread over the video
LEAST_ALONG = 0.8  # share of the matches whose rows agree, of two eyes
ROWS = 1 / 40  # of the width: as far as rows of eyes that are not rectified differ
APART = 1.0  # px: eyes see the tissue in different columns; fields of one picture do not


VIDEO = "source.kind:=videos source.left:={file} source.geometry.layout:="
PANES = VIDEO + "panes source.geometry.crop:=[0,0,{w},{h}] source.geometry.crop_right:=[{w},0,{w},{h}]"


class _Way(NamedTuple):
    """How a picture may show both eyes."""

    what: str
    launch: str
    eyes: Callable[[U8], tuple[U8, U8]]


def _halves(picture: U8, axis: int = 1) -> tuple[U8, U8]:
    first, second = np.array_split(picture[: picture.shape[0] // 2 * 2, : picture.shape[1] // 2 * 2], 2, axis)
    return first, second


def _quarters(picture: U8) -> tuple[tuple[U8, U8], tuple[U8, U8]]:
    upper, lower = _halves(picture, 0)
    return _halves(upper), _halves(lower)


def _fields(picture: U8) -> tuple[U8, U8]:
    rows = picture.shape[0] // 2 * 2
    return picture[0:rows:2], picture[1:rows:2]


_WAYS = (  # a part before the whole: what is found in the one is found in the other, too
    _Way("in the upper two of four panes", PANES, lambda picture: _quarters(picture)[0]),
    _Way("side by side", VIDEO + "side_by_side", _halves),
    _Way("one above the other", VIDEO + "over_under", lambda picture: _halves(picture, 0)),
    _Way("in every other row", VIDEO + "row_interleaved", _fields),
)


def look(files: tuple[Path, ...], calibration: Path | None) -> tuple[list[Finding], str, list[Pair]]:
    """What is odd, how to play them, and some pairs of two videos.

    Args:
        files: of the left and the right eye, or one.
        calibration: that lies beside them.
    """
    rig = f"rig:={calibration or 'CALIBRATION'}"
    try:
        found = [_length(file) for file in files]
        shown = [_some(file) for file in files]
    except SagsError as error:
        play = f"sags run source.kind:=videos source.left:={files[0]} {rig}"
        return [pictures.refused("video", error)], play, []
    if len(files) == 1:
        odd, play = _one(files[0], shown[0], rig)
        return found + odd, play, []
    (left_file, right_file), (left, right) = files, shown
    play = f"sags run source.kind:=videos source.left:={left_file} source.right:={right_file} {rig}"
    found += pictures.check_eye("left", left) + pictures.check_eye("right", right)
    try:
        with closing(VideoPairs(left_file, right_file, Layout(GeometryConfig()))) as pairs:
            ends = check_ends(left_file, right_file, pairs.count)
            found += ends or check_timing(pairs)
    except SagsError as error:
        return [*found, pictures.refused("videos", error)], play, []
    found += pictures.check_eyes(left, right)
    return found, play, [(a, b) for (_, a), (_, b) in zip(left, right, strict=True)]


def _length(file: Path) -> Finding:
    with closing(Video(file)) as video:
        rate = "" if video.rate is None else f" at {video.rate:g} Hz, {video.count / video.rate:.1f} s"
        return Finding("ok", f"{file.name}: {video.count} frames of {size_text(*video.size)} px{rate}")


def check_ends(left: Path, right: Path, needed: int) -> list[Finding]:
    """Whether the right video reaches as far as the left one is played, so many frames."""
    with closing(Video(right)) as video:
        count = video.count
    if count < needed:
        what = f"{right.name} ends after {count} frames but {left.name} goes on: there playing fails"
        return [Finding("error", what, f"set source.frames:={count} to stop there, or give both one length")]
    with closing(Video(left)) as video:
        if count == video.count:
            return []
        what = f"{right.name} has {count} frames, {left.name} {video.count}"
    fix = "were both begun at the same moment? What the left one has is played"
    return [Finding("warning", what, fix)]


def _some(file: Path) -> list[tuple[Path, U8]]:
    """Pictures spread over a video, RGB; the last of them tells whether it is whole.

    Raises:
        SagsError: it cannot be read to its end.
    """
    video = Video(file)
    try:
        found = []
        for number in sorted({round(at) for at in np.linspace(0, video.count - 1, LOOKED_AT)}):
            video.seek(number)
            picture = video.read()
            if picture is None:
                raise SagsError(f"{file} ends before picture {number} of {video.count}; copy it again")
            found.append((file, cv2.cvtColor(picture, cv2.COLOR_BGR2RGB).astype(np.uint8)))
        return found
    finally:
        video.close()


def _one(file: Path, shown: list[tuple[Path, U8]], rig: str) -> tuple[list[Finding], str]:
    height, width = shown[0][1].shape[:2]
    for way in _WAYS:
        pairs = [way.eyes(picture) for _, picture in shown]
        panes = way.launch is PANES
        if not _are_eyes(pairs) or (panes and _are_eyes([_quarters(picture)[1] for _, picture in shown])):
            continue
        left, right = ([(file, np.ascontiguousarray(pair[eye])) for pair in pairs] for eye in (0, 1))
        eyes = pictures.check_eyes(left, right)
        found = [Finding("ok", f"{size_text(width, height)} px show both eyes: {way.what}")]
        looked = pictures.check_eye("left", left) + pictures.check_eye("right", right)
        # Of every other row of a picture the rows lie far apart: that looks like a comb.
        found += [
            each for each in looked if way.eyes is not _fields or "interlaced, " not in each.what
        ] + eyes
        swapped = any("exchanged" in finding.what for finding in eyes)
        first = " source.geometry.first:=right" if swapped and not panes else ""
        return found, f"sags run {way.launch.format(file=file, w=width // 2, h=height // 2)}{first} {rig}"
    what = f"{size_text(width, height)} px show one eye, or both in a way that was not recognised"
    fix = "two videos or one of both eyes are needed; one camera alone needs a network (docs/networks.md)"
    try_it = f"sags calib live source.kind:=videos source.left:={file} source.geometry.layout:=side_by_side"
    found = [Finding("warning", what, fix), *pictures.check_eye("video", shown)]
    return found, f"{try_it} shows what is in it"


def _are_eyes(pairs: list[tuple[U8, U8]]) -> bool:
    """Whether pictures match as two eyes do: in the same rows, and in other columns."""
    matches = np.concatenate([match_eyes(*(np.ascontiguousarray(eye) for eye in pair)) for pair in pairs])
    if len(matches) < pictures.FEWEST_MATCHES:
        return False
    along = np.abs(matches[:, 1] - matches[:, 3]) <= ROWS * pairs[0][0].shape[1]
    apart = np.abs(np.median(matches[:, 0] - matches[:, 2]))
    return bool(np.mean(along) >= LEAST_ALONG and apart >= APART)
