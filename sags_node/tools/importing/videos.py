"""What is odd about the videos of a recording, and how the images of one show both eyes."""

import shlex
from collections.abc import Callable, Sequence
from contextlib import closing, suppress
from pathlib import Path
from typing import NamedTuple, TypeVar

import numpy as np

from sags_node.checks import Finding, parted
from sags_node.config.schema import GeometryConfig
from sags_node.errors import UsageError
from sags_node.media.video import LostPictureError, Video
from sags_node.sources.layout import Layout
from sags_node.sources.names import EYE
from sags_node.sources.pictures import size_text
from sags_node.sources.videos import VideoPairs
from sags_node.tools.calibration.matches import match_eyes
from sags_node.tools.importing import pictures, timing
from sags_node.tools.importing.folder import override
from sags_node.types import U8

LOOKED_AT = 4  # images, spread over the video
MOST_LATE = 900  # images: the largest delay of an eye's start that is tried
LEAST_ALONG = 0.8  # share of the matches whose rows agree, of two eyes
ROWS = 1 / 40  # of the width: as far as rows of eyes that are not rectified differ
ONE_EYE = "one eye is shown, or both in a way that was not recognised"
APART = 1.0  # px: eyes see the tissue in different columns; fields of one image do not

LAYOUT = "source.geometry.layout:="
PACKED = {1080: 45, 720: 30}  # rows of an eye, and blank ones below the first: frame packing of HDMI 1.4a

T = TypeVar("T")


class Way(NamedTuple):
    """How an image may show both eyes."""

    what: str
    layout: str
    eyes: Callable[[U8], tuple[U8, U8]]
    right: tuple[int, int] | None = None  # x, y of the second pane, px; None: the layout tells it


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


_WAYS = (  # parts before wholes: images of two of four panes also match as side by side
    Way("in the upper two of four panes", "panes", lambda picture: _quarters(picture)[0]),
    Way("side by side", "side_by_side", _halves),
    Way("one above the other", "over_under", lambda picture: _halves(picture, 0)),
    Way("in every other row", "row_interleaved", _fields),
)


def _packed(start: int, rows: int) -> Way:
    """The way of frame packing: the right eye's image, `rows` rows high, begins in row `start`."""

    def eyes(picture: U8) -> tuple[U8, U8]:
        return picture[:rows], picture[start : start + rows]

    return Way("one above the other, blank rows between them (frame packing)", "panes", eyes, (0, start))


def look(files: tuple[Path, ...]) -> list[Finding]:
    """Look at some images of the videos of the left and the right eye, or of one video of both. They are
    played as `launch_of` says.

    Raises:
        SagsError: they cannot be read.
    """
    found = [finding for file in files for finding in _file(file)]
    if len(files) == 1:
        return found + _one(files[0], _shown(files[0]))
    with closing(VideoPairs(files[0], files[1], Layout(GeometryConfig()))) as pairs:
        some = _some(pairs.reach, pairs.at)
        found += pictures.check_both(
            [each.left for each in some], [each.right for each in some if each.right is not None]
        )
        return [*found, *_late(pairs)]


def launch_of(files: tuple[Path, ...]) -> tuple[str, ...]:
    """The overrides `key:=value` that play the videos of the left and the right eye, or one of both.

    Raises:
        SagsError: it cannot be read.
        UsageError: one alone does not show both eyes in a way that is known; or one of two does.
    """
    launch = "source.kind:=videos", override("source.left", files[0])
    if len(files) == 2 and all(EYE.search(file.stem) for file in files):
        return *launch, override("source.right", files[1])
    shown = _shown(files[0])
    way = way_of(shown)
    if len(files) == 2:
        if way is None:
            return *launch, override("source.right", files[1])
        raise UsageError(
            f"{files[0].name} shows both eyes, {way.what}, and {files[1].name} lies beside it: are they "
            f"parts of one recording? Play one after the other: sags run {shlex.quote(str(files[0]))}"
        )
    if way is None:
        raise UsageError(f"{files[0]}: {ONE_EYE}; {_both_needed(files[0])}")
    return *launch, *layout_of(way, shown)


def way_of(shown: Sequence[U8]) -> Way | None:
    """How images [H, W, 3] RGB show both eyes; None: in no way that is known."""
    height, width = shown[0].shape[:2]
    for rows, blank in PACKED.items():
        if abs(height - 2 * rows - blank) <= 1:  # some codecs take even heights only
            return _packed(rows + blank, min(rows, height - rows - blank))
    for way in _WAYS:
        pairs = [way.eyes(picture) for picture in shown]
        lower = way.layout == "panes" and _are_eyes([_quarters(picture)[1] for picture in shown])
        if _are_eyes(pairs) and not lower:
            return way._replace(right=(width // 2, 0)) if way.layout == "panes" else way
    return None


def layout_of(way: Way, shown: Sequence[U8]) -> tuple[str, ...]:
    """The overrides `key:=value` that take these images apart, the left eye first."""
    eyes = zip(*map(way.eyes, shown), strict=True)
    fixes = [fix for finding in pictures.check_eyes(*eyes) for fix in finding.launch]
    if way.right is None:
        return f"{LAYOUT}{way.layout}", *fixes
    height, width = way.eyes(shown[0])[0].shape[:2]
    boxes = [f"[{x},{y},{width},{height}]" for x, y in ((0, 0), way.right)]
    if pictures.RIGHT_FIRST in fixes:
        boxes.reverse()
    return f"{LAYOUT}panes", f"source.geometry.crop:={boxes[0]}", f"source.geometry.crop_right:={boxes[1]}"


def _file(file: Path) -> list[Finding]:
    with closing(Video(file)) as video:
        rate = "" if video.rate is None else f" at {video.rate:g} Hz, {video.count / video.rate:.1f} s"
        what = f"{file.name}: {video.count} frames of {size_text(*video.size)} px{rate}"
        return [Finding("ok", what), *(parted("warning", each) for each in video.oddities)]


def _shown(file: Path) -> list[U8]:
    """Images spread over a video, RGB."""
    with closing(Video(file)) as video:
        return _some(video.count, video.read)


def _some(count: int, read: Callable[[int], T | None]) -> list[T]:
    """Images or pairs, read by number, spread over a video. It may end early, which is logged as when it is
    played."""
    found = []
    for number in sorted({round(at) for at in np.linspace(0, count - 1, LOOKED_AT)}):
        with suppress(LostPictureError):  # it is left out while playing, too
            found.append(read(number))
    return [each for each in found if each is not None]


def _late(pairs: VideoPairs) -> list[Finding]:
    """A finding on which eye began later, of two videos of different lengths that are paired by number."""
    if pairs.right is None or not pairs.by_number or pairs.left.count == pairs.right.count:
        return []
    longer = abs(pairs.left.count - pairs.right.count)
    looked = timing.Timing(longer)
    for index in range(min(pairs.reach, timing.LOOKED_AT + min(longer, MOST_LATE))):
        with suppress(LostPictureError):
            pair = pairs.at(index)
            if pair is not None and pair.right is not None:
                looked.add(pair.left, pair.right)
    return looked.findings()


def _one(file: Path, shown: list[U8]) -> list[Finding]:
    size = size_text(*shown[0].shape[1::-1])
    way = way_of(shown)
    if way is None:
        found = Finding("error", f"{size} px: {ONE_EYE}", _both_needed(file))
        return [found, *pictures.check_eye("video", shown)]
    looked = pictures.check_both(*zip(*map(way.eyes, shown), strict=True))
    if way.layout == "row_interleaved":  # an eye's rows lie two rows apart, which looks like a comb
        looked = [each for each in looked if "interlaced, " not in each.what]
    # `layout_of` exchanges them.
    said = "points lie farther to the right in the second image, which is taken for the left eye's"
    looked = [Finding("ok", said) if pictures.RIGHT_FIRST in each.launch else each for each in looked]
    return [Finding("ok", f"{size} px show both eyes: {way.what}"), *looked]


def _both_needed(file: Path) -> str:
    with closing(Video(file)) as video:
        if video.tracks > 1:
            return f"it holds {video.tracks} video tracks; {video.split}"
    return (
        "two videos or one of both eyes are needed; sags calib live "
        f"{shlex.quote(override('source.left', file))} source.kind:=videos {LAYOUT}side_by_side shows what "
        "is in it; one camera alone needs a network "
        "(docs/networks.md)"
    )


def _are_eyes(pairs: Sequence[tuple[U8, U8]]) -> bool:
    """Tell whether images match as two eyes do: in the same rows, and in other columns."""
    matches = np.concatenate([match_eyes(*pair) for pair in pairs])
    if len(matches) < pictures.FEWEST_MATCHES:
        return False
    along = np.abs(matches[:, 1] - matches[:, 3]) <= ROWS * pairs[0][0].shape[1]
    apart = np.abs(np.median(matches[:, 0] - matches[:, 2]))
    return bool(np.mean(along) >= LEAST_ALONG and apart >= APART)
