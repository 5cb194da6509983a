"""Stereo pairs from two folders of images."""

import logging
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from sags_node.checks import Finding, parted
from sags_node.config.schema import Instruments, Levels
from sags_node.errors import SagsError, UsageError
from sags_node.files import SHOWN, read_file
from sags_node.media.picture_file import KINDS, SUFFIXES, decode, is_whole, misread
from sags_node.sources.bag_stamps import judge_skew
from sags_node.sources.bit_depth import EightBits
from sags_node.sources.masks import Masks
from sags_node.sources.names import gaps_in, in_order, numbers, times_in, together
from sags_node.sources.pairing import NEAR, pair
from sags_node.types import F32, F64, I64, U8, Bool, Reference

log = logging.getLogger(__name__)

LARGEST_FILE = 256 << 20  # bytes: more than the largest allowed image can need
MEND = "replace or remove the pair"
NOT_SQUARE = 0.01  # difference of the pixel aspect from 1
LOOKED_AT = 9  # images or masks, spread over a recording, to find out which value is white
STORED = cv2.IMREAD_UNCHANGED

F = TypeVar("F")


@lru_cache(maxsize=256)
def say(oddity: str) -> None:
    """Log a warning once per session, however often its recording is opened (`open_session` clears this)."""
    log.warning(oddity)


class RawPair(NamedTuple):
    """A pair of a recording, before it gets its stamps; for the fields see `StereoFrame`."""

    left: U8  # [H, W, 3] RGB
    right: U8 | None  # [H, W, 3] RGB
    tissue: Bool | None  # [H, W] of the left image
    depth: F32 | None = None  # [H, W] m
    T_world_cam: F64 | None = None  # [4, 4] m
    reference: Reference | None = None


class Pairs:
    """A reader of a recording.

    Attributes:
        count: number of pairs as announced; a video may end earlier.
        rate: the recording's own, Hz; None: not known.
        stamps: [count, 2] ns, of the left and the right image; None: evenly spaced.
        later: delay of the right image in an evenly spaced recording, periods.
        pixel_aspect: width of a pixel over its height, as far as the recording tells.
        oddities: warnings about its files, each with a remedy after a semicolon.
        cut_off: why pairs are missing at its end, with a remedy after a semicolon; "": none are.
        reach: number of complete pairs, if it is cut off.
        judged: findings about its stamps or poses.
        left_count: number of left images, also those without a partner; None: all have one.
        left_numbers: [count] index of each pair's left image among these; poses and references use it.
    """

    count: int
    left_count: int | None = None
    left_numbers: I64 | None = None
    rate: float | None = None
    stamps: I64 | None = None
    later = 0.0
    pixel_aspect = 1.0
    oddities: Sequence[str] = ()
    cut_off = ""
    reach: int
    judged: tuple[Finding, ...] = ()
    _next = 0

    @property
    def findings(self) -> list[Finding]:
        """All findings before it plays; `sags run` and `sags import --check` show the same ones."""
        said = (parted("warning", each) for each in self.oddities)
        return [*said, *self.judged, *judge_pixels(self.pixel_aspect)]

    def at(self, index: int) -> RawPair | None:
        """Read the pair with this number; None past the end. Reading in order is fastest.

        Raises:
            LostPictureError: it cannot be read, but later ones may be.
            SagsError: it is damaged, or does not match those before.
        """
        raise NotImplementedError

    def read(self) -> RawPair | None:
        """Read the next pair, from the first on; see `at`."""
        self._next += 1
        return self.at(self._next - 1)

    def close(self) -> None:
        """Close files that stay open between pairs."""


def judge_pixels(aspect: float) -> tuple[Finding, ...]:
    """Return a warning if pixels are not square; `aspect` is their width over their height."""
    if abs(aspect - 1) < NOT_SQUARE:
        return ()
    what = f"pixels are {aspect:.3g} times as wide as high: the eyes' images are squeezed"
    fix = "calibrate images as they are played; a camera that is guessed has such pixels"
    return (Finding("warning", what, fix, {"pixel_aspect": aspect}),)


class FolderPairs(Pairs):
    """Images of two folders, paired by `pair_files`, or of the left one alone. Names that are times since
    1970 give the stamps.

    Attributes:
        files: the left images in order.
        size: width and height of all images, px.
        oddities: see `Pairs`.

    Raises:
        UsageError: a folder is missing or empty, or the folders do not match.
    """

    oddities: list[str]

    def __init__(
        self,
        left: Path,
        right: Path | None,
        tools: Path | None = None,
        *,
        instruments: Instruments = "white",
        levels: Levels | None = None,
        numbered: bool = False,
    ) -> None:
        there = [folder for folder in (left, right, tools) if folder is not None]
        self._files = pair_files(there, numbered)
        self.files = [files[0] for files in self._files]
        times = times_in(self.files)
        if times is not None and len(times) > 1:
            period = float(np.median(np.diff(times)))
            others = times if right is None else times_in([files[1] for files in self._files])
            if others is None or np.abs(others - times).max() > NEAR * period:
                others = times
            self.stamps, self.rate = np.stack([times, others], axis=1), 1e9 / period
            self.judged = judge_skew(self.stamps)
        self.oddities = gaps_in(self.files, times is not None)
        self._has_right = right is not None
        self._masks: Masks | None = None
        if tools is not None:
            some = (files[-1] for files in some_of(self._files, LOOKED_AT))
            self._masks = Masks(tools, ((file, read_picture(file, STORED)) for file in some), instruments)
            self.oddities += self._masks.oddities
        self.count = len(self.files)
        first = read_samples(self.files[0])
        self.size, self._type = _size(first), first.dtype
        self._eight_bits: EightBits | None = None  # None: they have 8 bits
        if first.dtype != np.uint8 or levels is not None:
            eyes = [file for files in self._files for file in files[: 1 + self._has_right]]
            self._eight_bits = EightBits(map(self._samples, some_of(eyes, LOOKED_AT)), levels)
            if levels is None:
                self._eight_bits.tell(left)
        self.at(0)  # checks that the eyes match, by the first pair

    def at(self, index: int) -> RawPair | None:
        if index >= self.count:
            return None
        files = self._files[index]
        left = self._eye(files[0])
        right = self._eye(files[1]) if self._has_right else None
        tissue = None
        if self._masks is not None:
            mask = self._checked(read_picture(files[-1], STORED), files[-1])
            tissue = self._masks.tissue(mask, files[-1])
        return RawPair(left, right, tissue)

    def _eye(self, file: Path) -> U8:
        samples = self._samples(file)
        return samples if self._eight_bits is None else self._eight_bits(samples, file)

    def _samples(self, file: Path) -> NDArray[Any]:
        """The image, if its type is that of the first one."""
        samples = self._checked(read_samples(file), file)
        if samples.dtype != self._type:
            raise SagsError(f"{file} holds {samples.dtype}, others {self._type}; save all images alike")
        return samples

    def _checked(self, picture: NDArray[Any], file: Path) -> NDArray[Any]:
        """The image, if its size is that of the first one."""
        if _size(picture) != self.size:
            raise SagsError(
                f"{file} is {size_text(*_size(picture))} px but {self.files[0]} is {size_text(*self.size)}; "
                "all images must have one size"
            )
        return picture


def list_pictures(folder: Path) -> list[Path]:
    """List the image files of a folder, sorted by name, with numbers compared as numbers.

    Raises:
        UsageError: the folder is missing or holds no image, or something else has an image's name.
    """
    if not folder.is_dir():
        reason = "is not a folder" if folder.exists() else "does not exist"
        raise UsageError(f"image folder {folder} {reason}; check the path, or SAGS_DATA if it is used")
    pictures = [file for file in folder.glob(SHOWN) if file.suffix.lower() in SUFFIXES]
    for file in pictures:
        if file.exists() and not file.is_file():
            raise UsageError(f"{file} has an image's name but is no file; remove it from the folder")
    if not pictures:
        raise UsageError(f"image folder {folder} holds no image ({KINDS})")
    return in_order(pictures)


def read_picture(file: Path, flags: int = cv2.IMREAD_COLOR) -> NDArray[Any]:
    """Decode one image: RGB of 8 bit for `IMREAD_COLOR`, else as OpenCV's flags say.

    OpenCV silently fills the missing part of a cut-off image with grey, so its end is checked first.

    Raises:
        SagsError: the file is missing, no plain file, cut off, damaged, too large, holds several, or is one
            that OpenCV reads wrongly.
    """
    if flags == cv2.IMREAD_COLOR:
        samples = read_samples(file)
        return samples if samples.dtype == np.uint8 else EightBits([samples])(samples, file)
    try:
        data = read_file(file, LARGEST_FILE)
    except OSError as error:
        raise SagsError(f"cannot read image {file}: {error.strerror}") from None
    if not is_whole(memoryview(data)):
        raise SagsError(f"image {file} is damaged or cut off ({len(data)} bytes); {MEND}")
    if reason := misread(memoryview(data), flags == cv2.IMREAD_UNCHANGED):
        raise SagsError(f"{file} {reason}")
    return decode(data, flags, f"image {file}", MEND)


def read_samples(file: Path) -> NDArray[Any]:
    """Decode one image as RGB [H, W, 3] of its own depth: uint8, uint16 or float32.

    Raises:
        SagsError: as `read_picture`, or its samples have another type.
    """
    picture = read_picture(file, cv2.IMREAD_ANYCOLOR | cv2.IMREAD_ANYDEPTH)  # grey: [H, W]
    if picture.dtype.kind == "f":
        picture = np.nan_to_num(picture, posinf=0.0, neginf=0.0).astype(np.float32)
    elif picture.dtype not in (np.uint8, np.uint16):
        raise SagsError(
            f"image {file} holds {picture.dtype}, which is not read; save it as PNG of 8 or 16 bit"
        )
    return np.asarray(cv2.cvtColor(picture, cv2.COLOR_GRAY2RGB if picture.ndim == 2 else cv2.COLOR_BGR2RGB))


def size_text(width: int, height: int) -> str:
    """Format an image size: 640x480."""
    return f"{width}x{height}"


def pair_files(folders: Sequence[Path], numbered: bool = False) -> list[tuple[Path, ...]]:
    """Match the images of several folders: by name, if most are in all folders; by the times in names; or
    else by order. Images that are left out, and odd pairs, are logged.

    Args:
        numbered: other data (poses, depth) goes by number, so that no image may be left out.

    Raises:
        UsageError: a folder cannot be read, or they cannot be paired.
    """
    files = [list_pictures(folder) for folder in folders]
    found, how = together(files), "of their name"
    if not found:
        found, how = _at_one_time(files), "at their time"
    most = max(map(len, files))
    if len(found) == most:
        return found
    if found:
        kept = {file for each in found for file in each}
        alone = [file for each in files for file in each if file not in kept]
        where = " and ".join(map(str, folders))
        said = f"{len(alone)} images of {where} have no partner {how}, e.g. {alone[0]}"
        if numbered:
            raise UsageError(f"{said}; poses and depth go by number, so every image needs its partners")
        log.warning("%s; they are left out", said)
        return found
    for folder, each in zip(folders, files, strict=True):
        if len(each) != len(files[0]):
            raise UsageError(
                f"{folders[0]} holds {len(files[0])} images but {folder} holds {len(each)}; pairing goes "
                "by sorted name, so both need the same number, or names that tell which belong together"
            )
    for each in files[1:]:
        _warn_of_gaps(files[0], each)
    return list(zip(*files, strict=True))


def _at_one_time(folders: Sequence[Sequence[Path]]) -> list[tuple[Path, ...]]:
    """Match files by the times in their names, in the order of the first folder; empty if most have no
    partner."""
    times = [found for files in folders if (found := times_in(files)) is not None and len(found) > 1]
    if len(times) < len(folders):
        return []
    period = float(np.median(np.diff(times[0])))
    partners = [dict(pair(times[0], others, NEAR * period * 1e-9).tolist()) for others in times[1:]]
    shared = [at for at in range(len(times[0])) if all(at in each for each in partners)]
    if 2 * len(shared) <= max(map(len, folders)):
        for files, others in zip(folders[1:], times[1:], strict=True):
            log.warning(
                "%s begins %.3g s from %s by the times in names; both are paired by order: were the clocks "
                "set alike, and do they show the same moments?",
                *(files[0].parent, (others[0] - times[0][0]) * 1e-9, folders[0][0].parent),
            )
        return []
    return [
        (folders[0][at], *(files[each[at]] for files, each in zip(folders[1:], partners, strict=True)))
        for at in shared
    ]


def some_of(files: Sequence[F], count: int) -> Sequence[F]:
    """Return at most `count` of the files, spread over all."""
    return files[:: max(1, -(-len(files) // count))]


def _size(picture: NDArray[Any]) -> tuple[int, int]:
    return picture.shape[1], picture.shape[0]


def _warn_of_gaps(left: Sequence[Path], right: Sequence[Path]) -> None:
    """Warn if numbers in names show a missing image: equal counts may hide one on each side."""
    one, other = (np.array(numbers(each), np.float64) for each in (left, right))
    if len(one) != len(other) or len(one) < 2:
        return
    odd = np.abs(np.diff(one - other)) > 0.5 * np.median(np.diff(one))
    if odd.any():
        at = int(np.argmax(odd)) + 1
        log.warning(
            "%s is paired with %s, unlike the pairs before: is an image missing?", left[at], right[at]
        )
