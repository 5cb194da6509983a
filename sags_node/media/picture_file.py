"""Decodes foreign image files after a check of their headers, and holds the options for writing PNG.

Decoders take the memory that a header asks for. They fill the missing part of a cut-off image with grey,
and do not tell. They print their own messages about a file, without its name.
"""

import logging
import os
import re
import sys
import threading
import warnings
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from io import BytesIO
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import BmpImagePlugin, Image, JpegImagePlugin, PngImagePlugin, PpmImagePlugin, WebPImagePlugin
from PIL import TiffImagePlugin as Tiff
from PIL.ImageFile import ImageFile

from sags_node.errors import SagsError

log = logging.getLogger(__name__)

KINDS = "JPEG, PNG, TIFF, BMP, WebP or binary PGM/PPM"
SUFFIXES = frozenset((".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp", ".pgm", ".ppm", ".pnm"))
_JPEG, _PNG = b"\xff\xd8", b"\x89PNG\r\n\x1a\n"
_READERS: dict[bytes, Callable[[BytesIO], ImageFile]] = {  # by how a file begins
    _JPEG: JpegImagePlugin.JpegImageFile,
    _PNG: PngImagePlugin.PngImageFile,
    b"BM": BmpImagePlugin.BmpImageFile,
    b"P5": PpmImagePlugin.PpmImageFile,
    b"P6": PpmImagePlugin.PpmImageFile,
    b"RIFF": WebPImagePlugin.WebPImageFile,
}
_ENDS = {_JPEG: b"\xff\xd9", _PNG: b"IEND\xaeB`\x82"}  # marks of an image's end
_JPEG_MARK = re.compile(rb"\xff+([^\0\xff\xd0-\xd7])")  # but those inside pixel data
warnings.filterwarnings("ignore", module=r"PIL\.TiffImagePlugin")  # of damaged files; they are refused
_LONGEST_PADDING = 512  # bytes at the end of a file in which the end mark is looked for first
# The brightest value of a PGM or PPM: the third number, behind spaces and comments.
_PNM_WHITE = re.compile(rb"P[56](?:(?:\s|#.*\n)+(\d+)){3}")
_TURNED = 274  # EXIF: how an image is to be shown; 1: as it is stored
_WHITE_IS_0, _LAB, _IN_PLANES = 0, (8, 9, 10), 2  # values of TIFF tags
_TIFF_PARTS = (Tiff.STRIPOFFSETS, Tiff.STRIPBYTECOUNTS), (Tiff.TILEOFFSETS, Tiff.TILEBYTECOUNTS)
MAX_PIXELS = 64 << 20
_MOST_KINDS = 32
_FILTER, _PAETH = 19, 128  # cv2.IMWRITE_PNG_FILTER: older versions lack and ignore it
_RLE = cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_RLE
# Options of `cv2.imencode` for camera images, masks and depth: one filter for all rows, and run-length
# encoding. With a level but no filter, OpenCV tries all filters in each row: 1/3 to 2/3 more time.
PNG = (cv2.IMWRITE_PNG_COMPRESSION, 1, *_RLE, _FILTER, _PAETH)
STDERR = 2
MOST_BYTES = 1 << 16  # kept of what is printed; a library may repeat a message for every row
_LIBRARY = re.compile(
    rb"libpng (error|warning): |RPly: |\[[\w,]+ @ 0x[0-9a-f]+\] |\[ ?[A-Z]+:\d+@[\d.]+\] |OpenCV\([\d.]+\) "
    # libjpeg's warnings have no common beginning
    rb"|Corrupt JPEG data: |Premature end of JPEG file|Invalid SOS parameters|Inconsistent progression "
    rb"|Warning: unknown JFIF revision |Unknown Adobe color transform "
)
_lock = threading.RLock()  # the descriptor is the whole process's


def decode(data: bytes | NDArray[np.uint8], flags: int, where: str, fix: str) -> NDArray[Any]:
    """Decode an image with OpenCV.

    The decoder's warnings about an image that it could read go to the log, with `where`.

    Args:
        flags: of `cv2.imdecode`.
        where: name of the image in messages.
        fix: what the user can do if it is damaged.

    Raises:
        SagsError: it is not one of `KINDS`, is damaged, or claims more than `MAX_PIXELS`.
    """
    array = np.frombuffer(data, np.uint8)
    size = claimed_size(array.data)
    if size is None:
        raise SagsError(f"{where} is no {KINDS}, or is damaged ({array.size} bytes); {fix}")
    width, height = size
    if not 0 < width * height <= MAX_PIXELS:
        raise SagsError(
            f"{where} says that it is {width}x{height} px; at most {MAX_PIXELS >> 20} Mpx are read; {fix}"
        )
    with native_output() as said:
        try:
            picture: NDArray[Any] | None = cv2.imdecode(array, flags)
        except cv2.error:
            picture = None
    if picture is None:
        reason = f": {said[-1]}" if said else ""
        raise SagsError(f"{where} is damaged or cut off ({array.size} bytes){reason}; {fix}")
    complaints.tell(where, said)
    return picture


class Complaints:
    """Logs decoders' messages, each kind once: all images of a recording often have the same flaw."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._kinds: set[str] = set()

    def tell(self, where: str, said: list[str]) -> None:
        for line in said:
            kind = re.sub(r"\d+|0x[0-9a-f]+", "", line)
            with self._lock:
                is_new = kind not in self._kinds and len(self._kinds) < _MOST_KINDS
                if is_new:
                    self._kinds.add(kind)
            if is_new:
                log.warning("%s: %s (said once, of the first such image)", where, line)


complaints = Complaints()


# ---- what a header says ----------------------------------------------------------------------------------


def claimed_size(data: memoryview) -> tuple[int, int] | None:
    """Width and height in a file's header, px; None if it has none or is of a kind that is not read."""
    try:
        if _is_tiff(data):
            tags = _tiff_tags(data)
            return tags[Tiff.IMAGEWIDTH], tags[Tiff.IMAGELENGTH]
        with closing(_opened(data)) as picture:
            return picture.size
    except Exception:  # Pillow raises a dozen kinds on damaged headers
        return None


def misread(data: memoryview, as_stored: bool) -> str:
    """Say why OpenCV would not give what an image file holds, with a remedy after a semicolon; "": it does.

    Args:
        as_stored: it is decoded with `cv2.IMREAD_UNCHANGED`.
    """
    try:
        if _is_tiff(data):
            return _tiff_misread(data)
        with closing(_opened(data)) as picture:
            turned = Image.Image.getexif(picture).get(_TURNED, 1) if as_stored else 1
            if turned != 1:
                return f"is to be shown turned or mirrored (EXIF orientation {turned}); save it as it is seen"
            white = None if as_stored else _PNM_WHITE.match(data)
            if white is not None and int(white[1]) < 255:
                return f"would be too dark, as {int(white[1])} is white in it; save it as PNG"
            return _several(int(getattr(picture, "n_frames", 1)))
    except Exception:  # as above
        return ""


def _tiff_misread(data: memoryview) -> str:
    first, read = _tiff_tags(data), set[int]()
    tags: Any = first
    if tags[Tiff.PHOTOMETRIC_INTERPRETATION] in _LAB:
        return "has Lab colours; save it as RGB"
    in_planes = tags.get(Tiff.SAMPLESPERPIXEL, 1) > 1 and tags.get(Tiff.PLANAR_CONFIGURATION) == _IN_PLANES
    white_is_0 = tags[Tiff.PHOTOMETRIC_INTERPRETATION] == _WHITE_IS_0
    if (in_planes or white_is_0) and max(tags.get(Tiff.BITSPERSAMPLE, (1,))) > 8:
        return "is a deep TIFF whose white is 0, or with one colour behind the other; save it as PNG"
    count = 1
    while tags.next and tags.next not in read:
        read.add(tags.next)
        tags = _tiff_tags(data, tags.next)
        # Smaller ones are thumbnails.
        count += all(tags[side] == first[side] for side in (Tiff.IMAGEWIDTH, Tiff.IMAGELENGTH))
    return _several(count)


def _several(count: int) -> str:
    how = "save each as a file of its own (in ImageJ: Save As, Image Sequence)"
    return f"holds {count} images, of which one would be shown; {how}" if count > 1 else ""


def is_whole(data: memoryview) -> bool:
    """Tell whether an image is complete: it has its end mark or, in formats without one, all pixels."""
    begin = next((begin for begin in _ENDS if bytes(data[: len(begin)]) == begin), None)
    if begin is not None:
        near = _ENDS[begin] in bytes(data[-_LONGEST_PADDING:])
        return near or (_jpeg_ends(data) if begin == _JPEG else _ENDS[begin] in bytes(data))
    try:
        if _is_tiff(data):
            tags = _tiff_tags(data)
            begins, lengths = next(each for each in _TIFF_PARTS if each[0] in tags)
            return max(map(sum, zip(tags[begins], tags[lengths], strict=True))) <= len(data)
        with closing(_opened(data)) as picture:
            picture.load()
    except Exception:  # as above
        return False
    return True


def _jpeg_ends(data: memoryview) -> bool:
    """Tell whether the segments and scans lead to an end mark. Drivers' buffers may go on behind it."""
    at = 2
    while (found := _JPEG_MARK.search(data, at)) is not None and found[1] != b"\xd9":
        length = int.from_bytes(data[found.end() : found.end() + 2], "big")
        at = found.end() + max(2, length)
    return found is not None


def _is_tiff(data: memoryview) -> bool:
    return bytes(data[:4]) in (b"II*\0", b"MM\0*")


def _tiff_tags(data: memoryview, at: int | None = None) -> Tiff.ImageFileDirectory_v2:
    """The TIFF tags of the first image, or of the one at byte `at`. Pillow itself cannot open some
    that OpenCV reads, such as three floats per pixel."""
    tags = Tiff.ImageFileDirectory_v2(bytes(data[:8]))
    file = BytesIO(data)
    file.seek(tags.next if at is None else at)
    tags.load(file)
    return tags


def _opened(data: memoryview) -> ImageFile:
    """An image whose header is read. `Image.open` would try other kinds, and warn of large images."""
    start = bytes(data[:8])
    return next(reader for begin, reader in _READERS.items() if start.startswith(begin))(BytesIO(data))


# ---- what C libraries print ------------------------------------------------------------------------------


@contextmanager
def native_output() -> Iterator[list[str]]:
    """Keep what C libraries write to stderr within the block; the list holds their lines after it.

    Whatever else other threads write to stderr is passed on when the block ends.
    """
    lines: list[str] = []
    with _lock:
        if sys.stderr is not None:
            sys.stderr.flush()
        kept = os.memfd_create("stderr", os.MFD_CLOEXEC)
        try:
            terminal = os.dup(STDERR)
        except OSError:  # this process has no stderr
            os.close(kept)
            yield lines
            return
        os.dup2(kept, STDERR)
        try:
            yield lines
        finally:
            os.dup2(terminal, STDERR)
            os.close(terminal)
            _sort(kept, lines)


def _sort(kept: int, lines: list[str]) -> None:
    size = os.lseek(kept, 0, os.SEEK_END)
    if size:
        others, of_library = b"", False
        for line in os.pread(kept, MOST_BYTES, 0).splitlines(keepends=True):
            of_library = _LIBRARY.match(line) is not None or (of_library and not line.strip())
            if not of_library:
                others += line
            elif line.strip():
                lines.append(line.decode("utf-8", "replace").strip())
        if others:
            os.write(STDERR, others)
    os.close(kept)
