"""What is odd about the videos of a recording, and how the pictures of one show both eyes."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Sequence
from contextlib import closing, suppress
from pathlib import Path
from typing import NamedTuple

import numpy as np

from sags_node.checks import Finding, parted
from sags_node.config.schema import GeometryConfig
from sags_node.errors import UsageError
from sags_node.media.video import SPLIT, LostPictureError, Video
from sags_node.sources.layout import Layout
from sags_node.sources.pictures import size_text
from sags_node.sources.videos import VideoPairs
from sags_node.tools.calibration.matches import match_eyes
from sags_node.tools.calibration.pictures import Pair
from sags_node.tools.importing import pictures
from sags_node.tools.importing.folder import override
from sags_node.types import U8

LOOKED_AT = 4  # pictures, spread over the video
LEAST_ALONG = 0.8  # share of the matches whose rows agree, of two eyes
ROWS = 1 / 40  # of the width: as far as rows of eyes that are not rectified differ
ONE_EYE = "one eye is shown, or both in a way that was not recognised"
NOT_SQUARE = 0.01
APART = 1.0  # px: eyes see the tissue in different columns; fields of one picture do not


LAYOUT = "source.geometry.layout:="
PANES = "source.geometry.crop:=[0,0,{w},{h}]", "source.geometry.crop_right:=[{w},0,{w},{h}]"


class Way(NamedTuple):
    """How a picture may show both eyes."""

    what: str
    layout: str
    eyes: Callable[[U8], tuple[U8, U8]]


def _halves(picture: U8, axis: int = 1) -> tuple[U8, U8]:
    even = picture[: picture.shape[0] // 2 * 2, : picture.shape[1] // 2 * 2]
    first, second = map(np.ascontiguousarray, np.array_split(even, 2, axis))
    return first, second


def _quarters(picture: U8) -> tuple[tuple[U8, U8], tuple[U8, U8]]:
    upper, lower = _halves(picture, 0)
    return _halves(upper), _halves(lower)


def _fields(picture: U8) -> tuple[U8, U8]:
    rows = picture.shape[0] // 2 * 2
    return np.ascontiguousarray(picture[0:rows:2]), np.ascontiguousarray(picture[1:rows:2])


_WAYS = (  # a part before the whole: what is found in the one is found in the other, too
    Way("in the upper two of four panes", "panes", lambda picture: _quarters(picture)[0]),
    Way("side by side", "side_by_side", _halves),
    Way("one above the other", "over_under", lambda picture: _halves(picture, 0)),
    Way("in every other row", "row_interleaved", _fields),
)


def look(files: tuple[Path, ...]) -> list[Finding]:
    """Return what some pictures show, of the videos of the left and the right eye, or of one of both. They
    are played as `launch_of` says.

    Raises:
        SagsError: they cannot be read.
    """
    found = [finding for file in files for finding in _file(file)]
    if len(files) == 1:
        return found + _one(files[0], _some(files[0]))
    with closing(VideoPairs(files[0], files[1], Layout(GeometryConfig()))) as pairs:
        return [*found, *pictures.check_both(*zip(*_some_pairs(pairs), strict=True))]


def launch_of(files: tuple[Path, ...]) -> tuple[str, ...]:
    """`key:=value` that play the videos of the left and the right eye, or one of both.

    Raises:
        SagsError: it cannot be read.
        UsageError: one alone does not show both eyes in a way that is known.
    """
    launch = "source.kind:=videos", override("source.left", files[0])
    if len(files) == 2:
        return *launch, override("source.right", files[1])
    shown = _some(files[0])
    way = way_of(shown)
    if way is None:
        raise UsageError(f"{files[0]}: {ONE_EYE}; {_both_needed(files[0])}")
    return *launch, *layout_of(way, shown)


def way_of(shown: Sequence[U8]) -> Way | None:
    """How pictures [H, W, 3] RGB show both eyes; None: in no way that is known."""
    for way in _WAYS:
        pairs = [way.eyes(picture) for picture in shown]
        lower = way.layout == "panes" and _are_eyes([_quarters(picture)[1] for picture in shown])
        if _are_eyes(pairs) and not lower:
            return way
    return None


def layout_of(way: Way, shown: Sequence[U8]) -> tuple[str, ...]:
    """`key:=value` that take these pictures apart, the left eye first."""
    height, width = shown[0].shape[:2]
    if way.layout == "panes":
        return f"{LAYOUT}panes", *(box.format(w=width // 2, h=height // 2) for box in PANES)
    eyes = zip(*map(way.eyes, shown), strict=True)
    fixes = [fix for finding in pictures.check_eyes(*eyes) for fix in finding.launch]
    return f"{LAYOUT}{way.layout}", *fixes


def _file(file: Path) -> list[Finding]:
    with closing(Video(file)) as video:
        rate = "" if video.rate is None else f" at {video.rate:g} Hz, {video.count / video.rate:.1f} s"
        what = f"{file.name}: {video.count} frames of {size_text(*video.size)} px{rate}"
        found = [Finding("ok", what), *(parted("warning", each) for each in video.oddities)]
        if video.gaps:
            before, missing = video.gaps[0]
            many = "a gap" if len(video.gaps) == 1 else f"{len(video.gaps)} gaps, the first"
            what = (
                f"{file.name}: its stamps have {many} behind picture {before}, as long as {missing} pictures"
            )
            fix = "it is played by its stamps: were pictures lost, or was the recording paused?"
            found.append(Finding("warning", what, fix))
        return found


def check_pixels(aspect: float) -> list[Finding]:
    """Tell whether they are square; `aspect` is their width over their height."""
    if abs(aspect - 1) < NOT_SQUARE:
        return []
    what = f"pixels are {aspect:.3g} times as wide as high: the eyes' pictures are squeezed"
    fix = "calibrate pictures as they are played; a camera that is guessed has such pixels"
    return [Finding("warning", what, fix, {"pixel_aspect": aspect})]


def check_ends(pairs: VideoPairs, needed: int) -> list[Finding]:
    """Tell whether the right video reaches as far as the left one is played, so many frames."""
    if pairs.right is None or not pairs.by_number:
        return []
    left, right, count = pairs.left.path.name, pairs.right.path.name, pairs.right.count
    if count < needed:
        what = f"{right} ends after {count} frames but {left} goes on: there playing fails"
        return [Finding("error", what, f"set source.frames:={count} to stop there, or give both one length")]
    if count == pairs.left.count:
        return []
    what = f"{right} has {count} frames, {left} {pairs.left.count}"
    fix = "were both begun at the same moment? What the left one has is played"
    return [Finding("warning", what, fix)]


def _some(file: Path) -> list[U8]:
    """Pictures spread over a video, RGB."""
    with closing(Video(file)) as video:
        found = []
        for number in _spread(video.count):
            with suppress(LostPictureError):  # it is left out while playing, too
                picture = video.read(number)
                if picture is not None:  # else it is said where the video ends, as while it is played
                    found.append(picture)
        return found


def _some_pairs(pairs: VideoPairs) -> list[Pair]:
    """Spread over two videos, as far as both reach."""
    found = []
    both = min(pairs.count, pairs.right.count) if pairs.right is not None and pairs.by_number else pairs.count
    for index in _spread(both):
        pairs.seek(index)
        with suppress(LostPictureError):
            pair = pairs.read()
            if pair is not None and pair.right is not None:
                found.append((pair.left, pair.right))
    return found


def _spread(count: int) -> list[int]:
    return sorted({round(at) for at in np.linspace(0, count - 1, LOOKED_AT)})


def _one(file: Path, shown: list[U8]) -> list[Finding]:
    size = size_text(*shown[0].shape[1::-1])
    way = way_of(shown)
    if way is None:
        found = Finding("error", f"{size} px: {ONE_EYE}", _both_needed(file))
        return [found, *pictures.check_eye("video", shown)]
    looked = pictures.check_both(*zip(*map(way.eyes, shown), strict=True))
    if way.layout == "row_interleaved":  # of every other row of a picture the rows lie far apart: as a comb
        looked = [each for each in looked if "interlaced, " not in each.what]
    layout = Layout(GeometryConfig(layout="separate" if way.layout == "panes" else way.layout))
    with closing(Video(file)) as video:
        aspect = layout.pixel_aspect(*video.size, video.pixel_aspect)
    found = Finding("ok", f"{size} px show both eyes: {way.what}")
    return [found, *check_pixels(aspect), *looked]


def _both_needed(file: Path) -> str:
    with closing(Video(file)) as video:
        if video.tracks > 1:
            return f"it holds {video.tracks} video tracks; {SPLIT}"
    return (
        "two videos or one of both eyes are needed; sags calib live "
        f"{shlex.quote(override('source.left', file))} source.kind:=videos {LAYOUT}side_by_side shows what "
        "is in it; one camera alone needs a network "
        "(docs/networks.md)"
    )


def _are_eyes(pairs: Sequence[tuple[U8, U8]]) -> bool:
    """Tell whether pictures match as two eyes do: in the same rows, and in other columns."""
    matches = np.concatenate([match_eyes(*pair) for pair in pairs])
    if len(matches) < pictures.FEWEST_MATCHES:
        return False
    along = np.abs(matches[:, 1] - matches[:, 3]) <= ROWS * pairs[0][0].shape[1]
    apart = np.abs(np.median(matches[:, 0] - matches[:, 2]))
    return bool(np.mean(along) >= LEAST_ALONG and apart >= APART)
