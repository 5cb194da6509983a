"""Stereo pairs from two folders of pictures."""

from __future__ import annotations

import logging
import re
from pathlib import Path
from typing import NamedTuple

import cv2

from sags_node.errors import SagsError, UsageError
from sags_node.files import read_file
from sags_node.media.picture_file import decode
from sags_node.media.picture_header import KINDS, SUFFIXES, is_whole
from sags_node.types import F32, F64, U8, Bool, Reference

log = logging.getLogger(__name__)

LARGEST_FILE = 256 << 20  # bytes: more than the largest picture that is decoded can need
MEND = "replace or remove the pair"


class RawPair(NamedTuple):
    """One moment of a recording, before it gets its stamps; the fields are those of `StereoFrame`."""

    left: U8  # [H, W, 3] RGB
    right: U8 | None  # [H, W, 3] RGB
    tissue: Bool | None  # [H, W] of the left picture
    depth: F32 | None = None  # [H, W] m
    T_world_cam: F64 | None = None  # [4, 4] m
    reference: Reference | None = None


class FolderPairs:
    """Pictures of two folders, paired by sorted name (numbers in names sort as numbers), or of the left one.

    Attributes:
        files: the left pictures in order.
        size: width and height of all pictures, px.

    Raises:
        UsageError: a folder is missing or empty, or the folders do not fit each other.
    """

    rate: float | None = None  # folders do not know it

    def __init__(self, left: Path, right: Path | None, tools: Path | None = None) -> None:
        self.files = list_pictures(left)
        self._right = None if right is None else list_pictures(right)
        self._tools = None if tools is None else list_pictures(tools)
        if right is not None and self._right is not None:
            check_counts(left, self.files, right, self._right)
            _warn_of_gaps(self.files, self._right)
        if tools is not None and self._tools is not None:
            check_counts(left, self.files, tools, self._tools)
        self.count = len(self.files)
        self.size = _size(read_picture(self.files[0]))
        self._next = 0
        self.read()  # the first pair shows whether the eyes fit each other
        self.seek(0)

    def seek(self, index: int) -> None:
        self._next = index

    def skip(self) -> bool:
        self._next += 1
        return self._next <= self.count

    def read(self) -> RawPair | None:
        """The next pair, None at the end.

        Raises:
            SagsError: a picture is damaged or has another size than the first one.
        """
        index = self._next
        if index >= self.count:
            return None
        self._next += 1
        left = self._picture(self.files[index])
        right = None if self._right is None else self._picture(self._right[index])
        tissue = None
        if self._tools is not None:
            tissue = self._picture(self._tools[index], cv2.IMREAD_GRAYSCALE) < 128
        return RawPair(left, right, tissue)

    def close(self) -> None:
        """Nothing stays open between pictures."""

    def _picture(self, file: Path, flags: int = cv2.IMREAD_COLOR) -> U8:
        picture = read_picture(file, flags)
        if _size(picture) != self.size:
            raise SagsError(
                f"{file} is {size_text(*_size(picture))} px but {self.files[0]} is {size_text(*self.size)}; "
                "all pictures must have one size"
            )
        return picture


def list_pictures(folder: Path) -> list[Path]:
    """Picture files of a folder in order of their names, numbers compared as numbers.

    Raises:
        UsageError: the folder is missing or holds no picture, or what only has a picture's name.
    """
    if not folder.is_dir():
        reason = "is not a folder" if folder.exists() else "does not exist"
        raise UsageError(f"picture folder {folder} {reason}; check the path, or SAGS_DATA if it is used")
    pictures = [file for file in folder.iterdir() if file.suffix.lower() in SUFFIXES]
    for file in pictures:
        if file.exists() and not file.is_file():
            raise UsageError(f"{file} has a picture's name but is no file; remove it from the folder")
    if not pictures:
        raise UsageError(f"picture folder {folder} holds no picture ({KINDS})")
    return sorted(pictures, key=lambda file: (_natural(file.stem), file.name))


def read_picture(file: Path, flags: int = cv2.IMREAD_COLOR) -> U8:
    """Decode one picture: RGB for `IMREAD_COLOR`, else as OpenCV's flags say.

    OpenCV fills what is missing of a cut-off picture with grey and says nothing, so its end is checked first.

    Raises:
        SagsError: the file is missing, no plain file, cut off, damaged or too large.
    """
    try:
        data = read_file(file, LARGEST_FILE)
    except OSError as error:
        raise SagsError(f"cannot read picture {file}: {error.strerror}") from None
    if not is_whole(memoryview(data)):
        raise SagsError(f"picture {file} is damaged or cut off ({len(data)} bytes); {MEND}")
    picture = decode(data, flags, f"picture {file}", MEND)
    decoded: U8 = cv2.cvtColor(picture, cv2.COLOR_BGR2RGB) if flags == cv2.IMREAD_COLOR else picture
    return decoded


def _natural(name: str) -> list[str | int]:
    """'a10b' -> ['a', 10, 'b']: text and numbers alternate, so any two names compare."""
    return [int(part) if part.isdecimal() else part for part in re.split(r"(\d+)", name)]


def size_text(width: int, height: int) -> str:
    """As people write a picture size: 640x480."""
    return f"{width}x{height}"


def _size(picture: U8) -> tuple[int, int]:
    return picture.shape[1], picture.shape[0]


def check_counts(one: Path, one_files: list[Path], other: Path, other_files: list[Path]) -> None:
    """Refuse two folders that cannot be paired.

    Raises:
        UsageError: they do not hold the same number of pictures.
    """
    if len(one_files) != len(other_files):
        raise UsageError(
            f"{one} holds {len(one_files)} pictures but {other} holds {len(other_files)}; "
            "pairing goes by sorted name, so both need the same number"
        )


def _warn_of_gaps(left: list[Path], right: list[Path]) -> None:
    """Equal counts may still hide one missing picture on each side; the names' last numbers tell."""
    shift: int | None = None
    for left_file, right_file in zip(left, right, strict=True):
        numbers = [re.findall(r"\d+", file.stem) for file in (left_file, right_file)]
        if not all(numbers):
            return
        difference = int(numbers[0][-1]) - int(numbers[1][-1])
        if shift is not None and difference != shift:
            log.warning(
                "%s is paired with %s, unlike the pairs before: is a picture missing?",
                *(left_file, right_file),
            )
            return
        shift = difference
